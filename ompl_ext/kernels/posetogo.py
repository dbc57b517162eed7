"""Cost-to-go of poses: least time from a position with a heading to the goal, for a vehicle that turns as it can.

A search backwards from the goal over short motions at the vehicle's extreme body velocities, in a grid over x, y and
heading.  As in hybrid A* (Dolgov et al., Path planning for autonomous vehicles in unknown semi-structured environments,
2010) a cell keeps the exact pose by which it was reached first, so that motions do not round to the grid.  It
disregards accelerations, apart from a time for each change between ahead and astern.

The grid covers the bounds, or a square around the goal on large maps; beyond it the geodesic cost-to-go plus
POSE_BEYOND applies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Bytes, FloatCube, Floats, Floats32, IntCube, Ints32, Matrix, Matrix32
from ompl_ext.jit import compiled, inlined
from ompl_ext.kernels.clearance import pose_slack
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    POSE_BEYOND,
    POSE_COLUMNS,
    POSE_HEADING,
    POSE_HEADINGS,
    POSE_INVERSE,
    POSE_ROWS,
    POSE_X,
    POSE_Y,
    REACH,
    X_HIGH,
    X_LOW,
    Y_HIGH,
    Y_LOW,
    Maps,
    Problem,
)
from ompl_ext.trigonometry import cos, sin

MAX_CELLS = 1_000_000
STRIDE, REFINED_STRIDE = 1.5, 2.0  # cells, or bins of the heading, of a motion
PASSES = 0
HEADINGS = (36, 240)
ALLOWED = 0.4
UNKNOWN = 1e9  # seconds


class PoseCostToGo(NamedTuple):
    """Cost-to-go `seconds[heading, row, column]` at poses; `origin` is the position of row 0, column 0."""

    seconds: Floats32
    origin: tuple[float, float]
    cell: float
    headings: int
    rows: int
    columns: int
    beyond: float


def pose_cost_to_go(
    maps: Maps,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    goal: tuple[float, float, float],
    goal_radius: float,
    goal_tolerance: float,
    twists: Matrix,
    reversal: float,
    cells: tuple[float, float],
    geodesic: Matrix32,
) -> PoseCostToGo:
    """Cost-to-go of the poses from which the vehicle can get to the goal region.

    Args:
        maps: discs of the footprint and clearance field.
        bounds: of the workspace (m).
        goal: centre (m) and heading (rad).
        goal_radius: of the region (m).
        goal_tolerance: of the heading (rad).
        twists: body velocities (n, 3) of the motions: ahead, to the left (m/s), turning rate (rad/s).
        reversal: time that a change between ahead and astern costs (s).
        cells: smallest and largest side of a cell (m).
        geodesic: cost-to-go of positions on the cells of the clearance field (s).
    """
    area = (bounds[0][1] - bounds[0][0]) * (bounds[1][1] - bounds[1][0])
    curvature = np.abs(twists[:, 2]).max() / np.hypot(twists[:, 0], twists[:, 1]).max()
    cell = (2.0 * math.pi * area / (MAX_CELLS * curvature)) ** (1.0 / 3.0)
    cell = min(max(cell, cells[0]), cells[1])
    headings = min(max(math.ceil(2.0 * math.pi / (cell * curvature)), HEADINGS[0]), HEADINGS[1])
    half = 0.5 * cell * math.sqrt(MAX_CELLS / headings)
    before = [math.ceil(min(c - low, half) / cell) + 1 for c, (low, _) in zip(goal, bounds, strict=False)]
    columns, rows = (
        before[k] + math.ceil(min(bounds[k][1] - goal[k], half) / cell) + 2 for k in range(2)
    )  # the goal is in the centre of a cell
    origin = (goal[0] - before[0] * cell, goal[1] - before[1] * cell)
    count = headings * rows * columns
    motions = _motions(twists, cell, headings, STRIDE)
    width = float(motions[:, 3].min())
    buckets = np.full(math.ceil((motions[:, 3].max() + reversal) / width) + 2, -1, np.int32)
    seconds = np.full(count, UNKNOWN, np.float32)
    pose, link, order = np.zeros((count, 4), np.float32), np.full((count, 2), -1, np.int32), np.zeros(count, np.int32)
    allowance = ALLOWED * (cell + 2.0 * math.pi / headings * maps.scalar[REACH])
    frame = np.array([origin[0], origin[1], 1.0 / cell, rows, columns, headings, goal[2], allowance])
    region = np.array([*goal, goal_radius, goal_tolerance])
    reached = _search(seconds, pose, link, order, buckets, width, motions, reversal, region, frame, maps)
    free = np.zeros(count, np.uint8)
    _find_free(free, frame, maps)
    motions = _motions(twists, cell, headings, REFINED_STRIDE)
    offsets = np.zeros((headings, len(motions), 5), np.int32)
    weights = np.zeros((headings, len(motions), 8))
    _stencils(motions, frame, offsets, weights)
    for _ in range(PASSES):
        _refine(seconds, free, order[:reached], offsets, weights, motions, frame)
    table = seconds.reshape(headings, rows, columns)
    _fill(table)
    return PoseCostToGo(seconds, origin, cell, headings, rows, columns, 0.0)


def _motions(twists: Matrix, cell: float, headings: int, stride: float) -> Matrix:
    """Motions (n, 4): the twists with the time in which each leaves a cell or a bin of the heading."""
    speed, turning = np.hypot(twists[:, 0], twists[:, 1]), np.abs(twists[:, 2])
    with np.errstate(divide="ignore"):
        time = np.minimum(stride * cell / speed, stride * 2.0 * math.pi / headings / turning)
    return np.column_stack([twists, time])


@inlined
def _cell_of(x: float, y: float, theta: float, frame: Floats) -> int:
    """Index of a pose's cell, -1 outside the grid."""
    rows, columns, headings = int(frame[3]), int(frame[4]), int(frame[5])
    column = int(math.floor((x - frame[0]) * frame[2] + 0.5))
    row = int(math.floor((y - frame[1]) * frame[2] + 0.5))
    if not (0 <= column < columns and 0 <= row < rows):
        return -1
    k = int(math.floor((theta - frame[6]) * (headings / (2.0 * math.pi)) + 0.5)) % headings
    return (k * rows + row) * columns + column


@inlined
def _link(link: Ints32, buckets: Ints32, cell: int, bucket: int) -> None:
    head = buckets[bucket]
    link[cell, 0], link[cell, 1] = head, -2 - bucket
    if head >= 0:
        link[head, 1] = cell
    buckets[bucket] = cell


@inlined
def _unlink(link: Ints32, buckets: Ints32, cell: int) -> None:
    after, before = link[cell, 0], link[cell, 1]
    if before <= -2:
        buckets[-2 - before] = after
    else:
        link[before, 0] = after
    if after >= 0:
        link[after, 1] = before


@inlined
def _is_free(maps: Maps, x: float, y: float, theta: float, allowance: float) -> bool:
    """Whether a pose is free, or may be if it is moved within its cell."""
    scalar = maps.scalar
    if not (scalar[X_LOW] <= x <= scalar[X_HIGH] and scalar[Y_LOW] <= y <= scalar[Y_HIGH]):
        return False
    return pose_slack(maps, x, y, cos(theta), sin(theta), -allowance) >= 0.0


@compiled
def _search(
    seconds: Floats32,
    pose: Matrix32,
    link: Ints32,
    order: Ints32,
    buckets: Ints32,
    width: float,
    motions: Matrix,
    reversal: float,
    region: Floats,
    frame: Floats,
    maps: Maps,
) -> int:
    """Dijkstra's search with buckets of `width` s, backwards from the goal region; number of cells reached."""
    open_cells, reached = 0, 0
    bins, side = int(frame[5]), 1.0 / frame[2]
    around = int(math.ceil(region[3] / side))
    for k in range(-1, bins):
        theta = region[2] + 2.0 * math.pi * max(k, 0) / bins
        if cos(theta - region[2]) < cos(min(region[4], math.pi)):
            continue
        for i in range(-around, around + 1):
            for j in range(-around, around + 1):
                x, y = region[0] + i * side, region[1] + j * side
                if (k >= 0 or i != 0 or j != 0) and math.hypot(x - region[0], y - region[1]) > region[3]:
                    continue
                cell = _cell_of(x, y, theta, frame)
                if cell >= 0 and seconds[cell] > 0.0 and _is_free(maps, x, y, theta, frame[7]):
                    seconds[cell] = 0.0
                    pose[cell, 0], pose[cell, 1], pose[cell, 2], pose[cell, 3] = x, y, theta, 0.0
                    _link(link, buckets, cell, 0)
                    open_cells += 1
    current = 0
    while open_cells > 0:
        cell = buckets[current % len(buckets)]
        if cell < 0:
            current += 1
            continue
        _unlink(link, buckets, cell)
        link[cell, 1] = -1
        open_cells -= 1
        order[reached] = cell
        reached += 1
        x, y, theta, way = pose[cell, 0], pose[cell, 1], pose[cell, 2], pose[cell, 3]
        for m in range(len(motions)):
            ahead, aside, turning, time = motions[m, 0], motions[m, 1], motions[m, 2], motions[m, 3]
            cost = seconds[cell] + time
            if way * ahead < 0.0:
                cost += reversal
            turn = turning * time
            middle, chord = theta - 0.5 * turn, time * (1.0 - turn * turn / 24.0)
            c, s = cos(middle), sin(middle)
            px, py = x - chord * (ahead * c - aside * s), y - chord * (ahead * s + aside * c)
            other = _cell_of(px, py, theta - turn, frame)
            if other < 0 or seconds[other] <= cost + 1e-6:
                continue
            if not _is_free(maps, px, py, theta - turn, frame[7]):
                continue
            if seconds[other] < UNKNOWN:
                if link[other, 1] == -1:
                    continue  # finished in the same bucket
                _unlink(link, buckets, other)
            else:
                open_cells += 1
            seconds[other] = cost
            pose[other, 0], pose[other, 1], pose[other, 2] = px, py, theta - turn
            pose[other, 3] = ahead if ahead != 0.0 else way
            _link(link, buckets, other, int(cost / width) % len(buckets))
    return reached


@compiled
def _find_free(free: Bytes, frame: Floats, maps: Maps) -> None:
    """Set `free` to 1 where the footprint in the centre of a cell is free."""
    rows, columns, headings = int(frame[3]), int(frame[4]), int(frame[5])
    for k in range(headings):
        for row in range(rows):
            for column in range(columns):
                x, y = frame[0] + column / frame[2], frame[1] + row / frame[2]
                if _is_free(maps, x, y, frame[6] + 2.0 * math.pi * k / headings, frame[7]):
                    free[(k * rows + row) * columns + column] = 1


@compiled
def _stencils(motions: Matrix, frame: Floats, offsets: IntCube, weights: FloatCube) -> None:
    """Cells and weights by which each motion from the centre of a cell ends, for each heading.

    `offsets` (headings, motions, 5): columns, rows and headings to the first of the eight cells around the end, columns
    and rows to the middle.  `weights` (headings, motions, 8) are those of trilinear interpolation.
    """
    headings = int(frame[5])
    bin_size = 2.0 * math.pi / headings
    for k in range(headings):
        for m in range(len(motions)):
            ahead, aside, time = motions[m, 0], motions[m, 1], motions[m, 3]
            turn = motions[m, 2] * time
            chord = time * (1.0 - turn * turn / 24.0) * frame[2]
            middle = frame[6] + k * bin_size + 0.5 * turn
            c, s = cos(middle), sin(middle)
            u, v, w = chord * (ahead * c - aside * s), chord * (ahead * s + aside * c), turn / bin_size
            i, j, t = int(math.floor(u + 1e-9)), int(math.floor(v + 1e-9)), int(math.floor(w + 1e-9))
            offsets[k, m, 0], offsets[k, m, 1], offsets[k, m, 2] = i, j, t
            offsets[k, m, 3], offsets[k, m, 4] = int(math.floor(0.5 * u + 0.5)), int(math.floor(0.5 * v + 0.5))
            u, v, w = max(u - i, 0.0), max(v - j, 0.0), max(w - t, 0.0)
            for corner in range(8):
                weight = u if corner & 1 else 1.0 - u
                weight *= v if corner & 2 else 1.0 - v
                weights[k, m, corner] = weight * (w if corner & 4 else 1.0 - w)


@compiled
def _refine(
    seconds: Floats32,
    free: Bytes,
    order: Ints32,
    offsets: IntCube,
    weights: FloatCube,
    motions: Matrix,
    frame: Floats,
) -> None:
    """Value iteration in place, cells in the order of their cost-to-go: the least time by a motion and what follows."""
    rows, columns, headings = int(frame[3]), int(frame[4]), int(frame[5])
    for cell in order:
        column, row, k = cell % columns, (cell // columns) % rows, cell // (columns * rows)
        best = seconds[cell]
        if best <= 0.0 or free[cell] == 0:
            continue
        for m in range(len(motions)):
            i, j = column + offsets[k, m, 0], row + offsets[k, m, 1]
            if not (0 <= i < columns - 1 and 0 <= j < rows - 1):
                continue
            t = (k + offsets[k, m, 2]) % headings
            total = motions[m, 3]
            for corner in range(8):
                weight = weights[k, m, corner]
                if weight > 1e-6:
                    level = (t + (corner >> 2)) % headings
                    other = (level * rows + j + ((corner >> 1) & 1)) * columns + i + (corner & 1)
                    total += weight * seconds[other]
                    if total >= best:
                        break
            if total < best:
                best = total
        seconds[cell] = best


@compiled
def _fill(table: Floats32) -> None:
    """Set cells that were not reached to the least value around them, or else to the largest of all."""
    bins, rows, columns = table.shape
    largest = 0.0
    for k in range(bins):
        for row in range(rows):
            for column in range(columns):
                if table[k, row, column] < UNKNOWN:
                    largest = max(largest, table[k, row, column])
    for k in range(bins):
        for row in range(rows):
            for column in range(columns):
                if table[k, row, column] < UNKNOWN:
                    continue
                best = UNKNOWN
                for r in range(max(row - 1, 0), min(row + 2, rows)):
                    for c in range(max(column - 1, 0), min(column + 2, columns)):
                        for t in range(-1, 2):
                            value = table[(k + t) % bins, r, c]
                            if 0.0 <= value < best:
                                best = value
                table[k, row, column] = -1.0 - (best if best < UNKNOWN else largest)  # negative until all are known
    for k in range(bins):
        for row in range(rows):
            for column in range(columns):
                if table[k, row, column] < 0.0:
                    table[k, row, column] = -1.0 - table[k, row, column]


@inlined
def seconds_to_goal_pose(problem: Problem, x: float, y: float, theta: float, geodesic: float) -> float:
    """Trilinear interpolation of the cost-to-go at a pose (s); `geodesic` is the cost-to-go of its position."""
    table, scalar = problem.pose_togo, problem.scalar
    bins, rows, columns = (
        problem.option[POSE_HEADINGS],
        problem.option[POSE_ROWS],
        problem.option[POSE_COLUMNS],
    )
    u, v = (x - scalar[POSE_X]) * scalar[POSE_INVERSE], (y - scalar[POSE_Y]) * scalar[POSE_INVERSE]
    if not (0.0 <= u < columns - 1 and 0.0 <= v < rows - 1):
        return geodesic + scalar[POSE_BEYOND]
    w = (theta - scalar[POSE_HEADING]) * (bins / (2.0 * math.pi))
    column, row, k = int(u), int(v), int(math.floor(w))
    u, v, w = u - column, v - row, w - k
    first, second = ((k % bins) * rows + row) * columns + column, (((k + 1) % bins) * rows + row) * columns + column
    low = table[first] * (1.0 - u) + table[first + 1] * u
    high = table[first + columns] * (1.0 - u) + table[first + columns + 1] * u
    here = low * (1.0 - v) + high * v
    low = table[second] * (1.0 - u) + table[second + 1] * u
    high = table[second + columns] * (1.0 - u) + table[second + columns + 1] * u
    return here * (1.0 - w) + (low * (1.0 - v) + high * v) * w
