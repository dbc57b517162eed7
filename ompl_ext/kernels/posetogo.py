"""Cost-to-go of poses: least time from a position with a heading to the goal, for a vehicle that turns as it can.

A search backwards from the goal over short motions at the vehicle's extreme body velocities, in a grid over x, y and
heading.  As in hybrid A* (Dolgov et al., Path planning for autonomous vehicles in unknown semi-structured environments,
2010) a cell keeps the exact pose by which it was reached first, so that motions do not round to the grid.  It
disregards accelerations, apart from a time for each change between ahead and astern.  Around the goal `nearpose`
searches in a finer grid, without any tolerance for poses that lack clearance; this search continues from there.

The grid covers the bounds, or a square around the goal on large maps; beyond it the geodesic cost-to-go plus
POSE_BEYOND applies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Floats, Floats32, Floats32Cube, IntMatrix32, Ints32, Matrix, Matrix32
from ompl_ext.jit import compiled, inlined, part
from ompl_ext.kernels.arcs import cross_track
from ompl_ext.kernels.costtogo import UNREACHABLE
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    GRID_INVERSE,
    GRID_X,
    GRID_Y,
    POSE_BEYOND,
    POSE_COLUMNS,
    POSE_HEADING,
    POSE_HEADINGS,
    POSE_INVERSE,
    POSE_ROWS,
    POSE_X,
    POSE_Y,
    REACH,
    SCALARS,
    X_HIGH,
    Y_HIGH,
    Maps,
    Problem,
)
from ompl_ext.kernels.nearpose import (  # fmt: skip
    COMFORT,
    NARROW,
    REQUIRED,
    UNKNOWN,
    NearPoses,
    link_cell,
    motions_of,
    near_poses,
    pose_before,
    slack_at,
    unlink_cell,
)
from ompl_ext.kernels.penetration import fill_penetration
from ompl_ext.kernels.posepath import (  # fmt: skip
    FIRST_NEAR,
    FRAME_ALLOWED,
    FRAME_BINS,
    FRAME_FINE,
    FRAME_INVERSE,
    FRAME_REQUIRED,
    FRAME_WANTED,
    PoseCostToGo,
    cell_of,
)
from ompl_ext.trigonometry import cos

MAX_CELLS = 1_000_000
STRIDE = 1.1  # cells, or bins of the heading, of a motion
CAUTION = 0.8  # factor that makes up for restricted motions, which overestimate
HEADINGS = (36, 240)  # fewest and most bins of the heading
ALLOWED = 0.4  # share of a cell by which a pose may lack clearance, because another one in the cell may not
LEADS_ON = 0.03  # share of the cells that a search must reach, else another one is tried
EASE = 0.9  # share of the curvature that motions have where possible, so that errors can be corrected
GAIN = 0.05  # share by which another search must reach more cells to be preferred
LACKING = 4.0  # factor of the time of motions to poses that lack clearance
CLEAR = 0.06  # clearance below which motions on clear paths take LACKING times as long, as a share of the width
INSIDE = 0.8  # share of the goal's tolerances that the fine search around it aims for


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
    footprint_width: float,
    tight_discs: Matrix,
    clear: bool = False,
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
        footprint_width: of the vehicle (m).
        tight_discs: of the footprint, for the search around the goal.
        clear: refuse poses that lack clearance and avoid those that hardly keep it: a vehicle that follows a path along
            them with its dynamics deviates by more than they leave.
    """
    grid = _grid(bounds, goal, twists, cells)
    headings, rows, columns = grid.shape
    allowance = ALLOWED * (grid.cell + 2.0 * math.pi / headings * maps.scalar[REACH])
    required, wanted = REQUIRED * footprint_width, COMFORT * footprint_width
    if clear:
        allowance, required = -required, CLEAR * footprint_width
    frame = np.array(
        [*grid.origin, 1.0 / grid.cell, rows, columns, headings, goal[2], allowance, required, wanted, 0.0]
    )
    region = np.array([*goal, goal_radius, goal_tolerance])
    nearby = None
    if goal_tolerance < math.pi:  # a goal that any heading reaches is not narrow
        close = region * (1.0, 1.0, 1.0, INSIDE, INSIDE)
        nearby = near_poses(maps._replace(discs=tight_discs), close, twists, reversal, footprint_width)
    table, motions, near = _widest_search(grid, frame, twists, reversal, region, maps, nearby)
    filled = np.empty_like(table.seconds)
    _fill(table.seconds.reshape(grid.shape), filled.reshape(grid.shape), CAUTION)
    beyond = 0.0 if grid.covers else _beyond(filled.reshape(grid.shape), grid.origin, grid.cell, maps, geodesic)
    return PoseCostToGo(
        filled,
        grid.origin,
        grid.cell,
        grid.shape,
        beyond,
        table.seconds,
        table.pose[:, :3],
        table.after,
        motions,
        table.frame,
        near,
        float(maps.scalar[REACH]),
        float(np.hypot(twists[:, 0], twists[:, 1]).max()),
        reversal,
    )


class _Grid(NamedTuple):
    """Cells of poses: lower corner `origin` (m), side `cell` (m), headings, rows and columns.

    It `covers` the workspace, or as much round the goal as `MAX_CELLS` reach.
    """

    origin: tuple[float, float]
    cell: float
    shape: tuple[int, int, int]
    covers: bool


def _grid(
    bounds: tuple[tuple[float, float], tuple[float, float]],
    goal: tuple[float, float, float],
    twists: Matrix,
    cells: tuple[float, float],
) -> _Grid:
    """Grid with the goal in the centre of a cell."""
    area = (bounds[0][1] - bounds[0][0]) * (bounds[1][1] - bounds[1][0])
    cell, headings = _resolution(area, twists, cells)
    fits = area * headings / cell**2 <= 1.2 * MAX_CELLS  # which rounding of the bins may exceed
    half = math.inf if fits else 0.5 * cell * math.sqrt(MAX_CELLS / headings)
    before = [math.ceil(max(min(c - low, half), 0.0) / cell) + 1 for c, (low, _) in zip(goal, bounds, strict=False)]
    columns, rows = (before[k] + math.ceil(max(min(bounds[k][1] - goal[k], half), 0.0) / cell) + 2 for k in range(2))
    origin = (goal[0] - before[0] * cell, goal[1] - before[1] * cell)
    return _Grid(origin, cell, (headings, rows, columns), fits)


def _widest_search(
    grid: _Grid, frame: Floats, twists: Matrix, reversal: float, region: Floats, maps: Maps, nearby: NearPoses | None
) -> tuple[_Table, Matrix, NearPoses | None]:
    """Table of the search that reaches most cells, with its motions and the poses around the goal that it begins at.

    Searches with eased turns, which leave room to correct errors, and from the poses nearby come first.
    """
    count = math.prod(grid.shape)
    attempts = [(None, EASE), (None, 1.0)] if nearby is None else [(nearby, EASE), (nearby, 1.0), (None, 1.0)]
    one_way = bool(np.all(twists[:, 0] >= 0.0) or np.all(twists[:, 0] <= 0.0))
    most, best = -1, None
    for poses, ease in attempts:
        eased = np.where(twists[:, :1] != 0.0, twists * (1.0, 1.0, ease), twists)
        motions = motions_of(eased, grid.cell, grid.shape[0], STRIDE)
        found = _searched(count, frame, motions, reversal, region, maps, poses)
        reached = int(np.count_nonzero(found.seconds < UNKNOWN))
        if reached > (1.0 + GAIN) * most:
            most, best = reached, (found, motions, poses)
        if most >= LEADS_ON * count and not (one_way and ease < 1.0):
            break
    assert best is not None, "the first attempt was taken"
    return best


def _resolution(area: float, twists: Matrix, cells: tuple[float, float]) -> tuple[float, int]:
    """Side of a cell (m) and number of bins of the heading, for a workspace of `area` m^2.

    A motion turns by about a bin on a cell, and there are about `MAX_CELLS` of them.  A vehicle that never turns stays
    in the bin in which it is, a vehicle that only turns in its cell.
    """
    turning, speed = float(np.abs(twists[:, 2]).max()), float(np.hypot(twists[:, 0], twists[:, 1]).max())
    if turning == 0.0:
        return cells[1], HEADINGS[0]
    curvature = turning / speed if speed > 0.0 else math.inf
    cell = (2.0 * math.pi * area / (MAX_CELLS * curvature)) ** (1.0 / 3.0)
    cell = min(max(cell, cells[0]), cells[1])
    return cell, min(max(math.ceil(2.0 * math.pi / (cell * curvature)), HEADINGS[0]), HEADINGS[1])


def _searched(
    count: int,
    frame: Floats,
    motions: Matrix,
    reversal: float,
    region: Floats,
    maps: Maps,
    near: NearPoses | None,
) -> _Table:
    """Table of `count` cells after the search, which begins at the poses around the goal if there are any."""
    width = float(motions[:, 3].min())
    latest = 0.0 if near is None else float(near.seconds.max())
    buckets = math.ceil((latest + LACKING * motions[:, 3].max() + reversal) / width) + 2
    table = _empty_table(count, buckets, frame)
    if near is None:
        opened = _open_goal(table, region, maps)
    else:
        opened = _open_near(table, width, near.seconds, near.pose)
        table.frame[FRAME_FINE] = near.complete
    _search(table, opened, width, motions, reversal, maps)
    return table


def _empty_table(count: int, buckets: int, frame: Floats) -> _Table:
    return _Table(
        seconds=np.full(count, UNKNOWN, np.float32),
        pose=np.zeros((count, 4), np.float32),
        link=np.full((count, 2), -1, np.int32),
        after=np.full((count, 2), -1, np.int32),
        buckets=np.full(buckets, -1, np.int32),
        frame=frame.copy(),
    )


def compile_pose_cost_to_go(field: Matrix32, geodesic: Matrix32) -> None:
    """Compile the kernels of this module, of `arcs` and of `penetration`, or load them from the cache."""
    cross_track(np.zeros((1, 1, 3)), np.zeros(3), np.ones(3), 1.0)
    scalar = np.zeros(SCALARS)
    scalar[[X_HIGH, Y_HIGH, GRID_INVERSE, REACH]] = 0.1, 0.1, 1.0, 0.1
    tile, squares = np.full((1, 1), -1, np.int32), np.zeros((1, 1), np.uint16)
    bounds, twists = ((0.0, 0.1), (0.0, 0.1)), np.array([[1.0, 0.0, 1.0]])
    for radius in (0.0, 10.0):  # the goal is free, or not
        maps = Maps(np.array([[0.0, 0.0, radius, 0.0]]), field, tile, squares, scalar)
        found = pose_cost_to_go(
            maps, bounds, (0.05, 0.05, 0.0), 0.01, 0.1, twists, 0.0, (0.1, 0.1), geodesic, 0.1, maps.discs
        )
    found.path_from(0.05, 0.05, 0.0)
    _open_near(_empty_table(1, 1, found.frame), 1.0, np.zeros(0, np.float32), np.zeros((0, 4), np.float32))
    fill_penetration(field, 1.0, np.empty_like(field))


def _beyond(seconds: Floats32Cube, origin: tuple[float, float], cell: float, maps: Maps, geodesic: Matrix32) -> float:
    """What to add to the geodesic cost-to-go outside the grid: the least that is to add at its border (s)."""
    rows, columns = seconds.shape[1:]
    row, column = np.mgrid[0:rows, 0:columns]
    border = (row == 0) | (row == rows - 1) | (column == 0) | (column == columns - 1)
    places = [origin[k] + cell * index[border] for k, index in enumerate((column, row))]
    i, j = (
        ((place - maps.scalar[low]) * maps.scalar[GRID_INVERSE]).astype(np.int64).clip(0, size - 1)
        for place, low, size in zip(places[::-1], (GRID_Y, GRID_X), geodesic.shape, strict=True)
    )
    added = seconds.min(axis=0)[border] - geodesic[i, j]
    inside = geodesic[i, j] < UNREACHABLE
    return max(float(added[inside].min()), 0.0) if inside.any() else 0.0


class _Table(NamedTuple):
    """Arrays of a search: per cell, and the buckets of open cells."""

    seconds: Floats32
    pose: Matrix32  # x, y, heading, speed ahead of the motion from there
    link: IntMatrix32  # next and previous cell of the same bucket
    after: IntMatrix32  # the cell that follows towards the goal, and the motion to it; FIRST_NEAR - k at near pose k
    buckets: Ints32
    frame: Floats  # see FRAME_X


@part
def _open(table: _Table, cell: int, bucket: int, x: float, y: float, theta: float, way: float) -> None:
    """Set a cell's pose and add it to a bucket."""
    table.pose[cell, 0], table.pose[cell, 1], table.pose[cell, 2], table.pose[cell, 3] = x, y, theta, way
    link_cell(table.link, table.buckets, cell, bucket)


@compiled
def _open_goal(table: _Table, region: Floats, maps: Maps) -> int:
    """Open the cells whose centres are free and in the goal region, and that of its centre; their number."""
    count, frame = 0, table.frame
    bins, side = int(frame[FRAME_BINS]), 1.0 / frame[FRAME_INVERSE]
    around = math.ceil(region[3] / side)
    for k in range(bins):
        theta = region[2] + 2.0 * math.pi * k / bins
        if cos(theta - region[2]) < cos(min(region[4], math.pi)):
            continue
        for i in range(-around, around + 1):
            for j in range(-around, around + 1):
                x, y = region[0] + i * side, region[1] + j * side
                if k + abs(i) + abs(j) > 0 and math.hypot(i * side, j * side) > region[3]:
                    continue
                cell = cell_of(x, y, theta, frame)
                if (
                    cell >= 0
                    and table.seconds[cell] > 0.0
                    and slack_at(maps, x, y, theta, -frame[FRAME_ALLOWED]) >= 0.0
                ):
                    table.seconds[cell] = 0.0
                    _open(table, cell, 0, x, y, theta, 0.0)
                    count += 1
    return count


@compiled
def _open_near(table: _Table, width: float, seconds: Floats32, pose: Matrix32) -> int:
    """Open the cells of the poses around the goal, each with its pose nearest to the goal; their number."""
    count = 0
    for k in range(len(seconds)):
        cell = cell_of(pose[k, 0], pose[k, 1], pose[k, 2], table.frame)
        if cell >= 0 and seconds[k] < table.seconds[cell]:
            count += 1 if table.seconds[cell] >= UNKNOWN else 0
            table.seconds[cell], table.after[cell, 0] = seconds[k], FIRST_NEAR - k
    for cell in range(len(table.seconds)):
        k = FIRST_NEAR - table.after[cell, 0]
        if k >= 0:
            bucket = int(seconds[k] / width) % len(table.buckets)
            _open(table, cell, bucket, pose[k, 0], pose[k, 1], pose[k, 2], pose[k, 3])
    return count


@part
def _expand(table: _Table, cell: int, width: float, motions: Matrix, reversal: float, maps: Maps) -> int:
    """Open the cells from which a motion leads to the pose of `cell`; change of the number of open cells."""
    opened, frame = 0, table.frame
    x, y, theta, way = table.pose[cell, 0], table.pose[cell, 1], table.pose[cell, 2], table.pose[cell, 3]
    for m in range(len(motions)):
        ahead, time = motions[m, 0], motions[m, 3]
        cost = table.seconds[cell] + time + (reversal if way * ahead < 0.0 else 0.0)
        px, py, pt = pose_before(x, y, theta, motions[m])
        other = cell_of(px, py, pt, frame)
        if other < 0 or table.seconds[other] <= cost + 1e-6:
            continue
        if slack_at(maps, px, py, pt, frame[FRAME_WANTED]) < 0.0:
            if slack_at(maps, px, py, pt, frame[FRAME_REQUIRED]) >= 0.0:
                cost += (NARROW - 1.0) * time
            elif cost >= frame[FRAME_FINE] and slack_at(maps, px, py, pt, -frame[FRAME_ALLOWED]) >= 0.0:
                cost += (LACKING - 1.0) * time
            else:
                continue
            if table.seconds[other] <= cost + 1e-6:
                continue
        if table.seconds[other] < UNKNOWN:
            if table.link[other, 1] == -1:
                continue  # finished in the same bucket
            unlink_cell(table.link, table.buckets, other)
        else:
            opened += 1
        table.seconds[other] = cost
        table.after[other, 0], table.after[other, 1] = cell, m
        bucket = int(cost / width) % len(table.buckets)
        _open(table, other, bucket, px, py, pt, ahead if ahead != 0.0 else way)
    return opened


@compiled
def _search(table: _Table, opened: int, width: float, motions: Matrix, reversal: float, maps: Maps) -> None:
    """Dijkstra's search with buckets of `width` s, backwards from the cells that are open."""
    open_cells, current = opened, 0
    while open_cells > 0:
        cell = table.buckets[current % len(table.buckets)]
        if cell < 0:
            current += 1
            continue
        unlink_cell(table.link, table.buckets, cell)
        table.link[cell, 1] = -1
        open_cells += _expand(table, cell, width, motions, reversal, maps) - 1


@part
def _least_around(table: Floats32Cube, k: int, row: int, column: int) -> float:
    """Least value of a cell and those around it, `UNKNOWN` without one."""
    bins, rows, columns = table.shape
    least = UNKNOWN
    for r in range(max(row - 1, 0), min(row + 2, rows)):
        for c in range(max(column - 1, 0), min(column + 2, columns)):
            for t in range(-1, 2):
                least = min(least, table[(k + t) % bins, r, c])
    return least


@compiled
def _fill(found: Floats32Cube, filled: Floats32Cube, factor: float) -> None:
    """Multiply by a factor; cells that were not reached get the least value around them, or else the largest of all."""
    bins, rows, columns = found.shape
    largest = 0.0
    for k in range(bins):
        for row in range(rows):
            for column in range(columns):
                if found[k, row, column] < UNKNOWN:
                    largest = max(largest, found[k, row, column])
    for k in range(bins):
        for row in range(rows):
            for column in range(columns):
                value = found[k, row, column]
                if value >= UNKNOWN:
                    value = min(_least_around(found, k, row, column), largest)
                filled[k, row, column] = factor * value


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
    column, row, k = int(u), int(v), math.floor(w)
    u, v, w = u - column, v - row, w - k
    first, second = ((k % bins) * rows + row) * columns + column, (((k + 1) % bins) * rows + row) * columns + column
    low = table[first] * (1.0 - u) + table[first + 1] * u
    high = table[first + columns] * (1.0 - u) + table[first + columns + 1] * u
    here = low * (1.0 - v) + high * v
    low = table[second] * (1.0 - u) + table[second + 1] * u
    high = table[second + columns] * (1.0 - u) + table[second + columns + 1] * u
    return here * (1.0 - w) + (low * (1.0 - v) + high * v) * w
