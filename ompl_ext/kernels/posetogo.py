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
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Floats, Floats32, Floats32Cube, IntMatrix, IntMatrix32, Ints, Ints32, Matrix, Matrix32
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
    SPARE,
    UNKNOWN,
    NearPoses,
    link_cell,
    near_poses,
    pose_before,
    slack_at,
    unlink_cell,
)
from ompl_ext.kernels.penetration import fill_penetration
from ompl_ext.trigonometry import cos

MAX_CELLS = 1_000_000
STRIDE = 1.1  # cells, or bins of the heading, of a motion
CAUTION = 0.8  # factor that makes up for restricted motions, which overestimate
HEADINGS = (36, 240)  # fewest and most bins of the heading
ALLOWED = 0.4  # share of a cell by which a pose may lack clearance, because another one in the cell may not
DEVIATION_PENALTY = 0.05  # share of the cost-to-go that counts for a cell of deviation
NEARBY = 2  # cells around a pose of which one must have been reached
LEADS_ON = 0.03  # share of the cells that a search must reach, else another one is tried
EASE = 0.9  # share of the curvature that motions have where possible, so that errors can be corrected
LENGTHS = np.array([0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0])  # of a motion with which a path begins, in strides
PARTS = (0.25, 0.5, 0.75, 1.0)  # of these motions where poses have to be free
ASIDE = 10.0  # factor of errors to the side and of the heading where a path begins
LACKING = 4.0  # factor of the time of motions to poses that lack clearance
FIRST_NEAR = -2
INSIDE = 0.8  # share of the goal's tolerances that the fine search around it aims for


class PoseCostToGo(NamedTuple):
    """Cost-to-go `seconds[heading, row, column]` at poses; `origin` is the position of row 0, column 0."""

    seconds: Floats32
    origin: tuple[float, float]
    cell: float
    shape: tuple[int, int, int]
    beyond: float  # what is added to the geodesic cost-to-go outside the grid (s)
    exact: Floats32  # without CAUTION, UNKNOWN where no motion was found
    pose: Matrix32  # the exact pose of each cell
    after: IntMatrix32  # the cell that follows each one towards the goal, and the motion to it; see `_Table`
    motions: Matrix
    frame: Floats
    near: NearPoses | None  # None if the whole grid is coarse
    reach: float  # of the footprint (m)
    top_speed: float  # of the motions (m/s)
    reversal: float  # time that a change between ahead and astern costs (s)

    def path_from(self, x: float, y: float, theta: float) -> PosePath | None:
        """Motions from a pose near (x, y, theta) to the goal; None if none was found near it."""
        cell = _nearest_reached(x, y, theta, self.exact, self.frame, self.pose)
        return None if cell < 0 else self._path_of(cell)

    def paths_from(self, x: float, y: float, theta: float, most: int) -> Iterator[PosePath]:
        """Motions from a pose to the goal, in the order of their times: up to `most` that begin differently.

        Up to two motions lead from the pose to one that was reached.  Its cell has just one pose, which they have to
        meet, so that many are tried.
        """
        numbers, times = _beginnings(self.motions)
        first = _poses_after(np.array([x, y, theta]), self.motions[numbers[:, 0]], times[:, 0])
        second = _poses_after(first, self.motions[numbers[:, 1]], times[:, 1])
        seconds, cells = self._met(second)
        for share in PARTS:  # cells on the way were reached too: they are free
            on_first = _poses_after(np.array([x, y, theta]), self.motions[numbers[:, 0]], share * times[:, 0])
            on_second = _poses_after(first, self.motions[numbers[:, 1]], share * times[:, 1])
            seconds[(self._met(on_first)[0] >= UNKNOWN) | (self._met(on_second)[0] >= UNKNOWN)] = UNKNOWN
        speed, turned = self.motions[numbers, 0] * (times > 0.0), self.after[cells, 1]
        onward = np.where(turned >= 0, self.motions[turned, 0], 0.0)
        changes = (speed[:, 0] * speed[:, 1] < 0.0) + (
            np.where(times[:, 1] > 0.0, speed[:, 1], speed[:, 0]) * onward < 0.0
        )
        seconds = seconds + times.sum(axis=1) + self.reversal * changes
        order = np.argsort(seconds, kind="stable")
        order = order[seconds[order] < UNKNOWN]
        kinds = np.where(times[order] > 0.0, numbers[order], -1)
        _, distinct = np.unique(kinds, axis=0, return_index=True)
        for k in order[np.sort(distinct)[:most]]:
            pose, poses, twist, lasting = np.array([x, y, theta]), [], [], []
            for number, time in zip(numbers[k], times[k], strict=True):
                count = math.ceil(time / self.motions[number, 3])
                poses += [pose] if count > 0 else []
                shares = np.arange(1, count + 1) / max(count, 1)
                after = _poses_after(pose, self.motions[np.full(count, number)], time * shares)
                poses += list(after[:-1])
                pose = after[-1] if count > 0 else pose
                twist += [number] * count
                lasting += [time / max(count, 1)] * count
            rest = self._path_of(int(cells[k]))
            joined = np.concatenate([twist, rest.twist]).astype(np.int64), np.concatenate([lasting, rest.times])
            yield PosePath(np.vstack([*poses, rest.poses]), *joined)

    def _met(self, poses: Matrix) -> tuple[Floats, Ints]:
        """Time to the goal (n,) from the pose that was reached in the cell of each pose (n, 3), and that cell.

        Deviations add to the time; it is `UNKNOWN` where no pose was reached.
        """
        rows, columns, bins = (int(number) for number in self.frame[3:6])
        column, row = (np.floor((poses[:, k] - self.origin[k]) / self.cell + 0.5).astype(np.int64) for k in range(2))
        k = np.floor((poses[:, 2] - self.frame[6]) * (bins / math.tau) + 0.5).astype(np.int64) % bins
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        cells = np.where(inside, (k * rows + row) * columns + column, 0)
        met = self.pose[cells]
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        dx, dy = met[:, 0] - poses[:, 0], met[:, 1] - poses[:, 1]
        turned = np.mod(met[:, 2] - poses[:, 2] + math.pi, math.tau) - math.pi
        away = np.abs(dx * c + dy * s) + ASIDE * (np.abs(dy * c - dx * s) + self.reach * np.abs(turned))
        known = inside & (self.exact[cells] < UNKNOWN)
        return np.where(known, self.exact[cells] + away / self.top_speed, UNKNOWN), cells

    def _path_of(self, cell: int) -> PosePath:
        """Motions from the pose of a cell to the goal."""
        poses, numbers, times = [self.pose[cell]], [], []
        while self.after[cell, 0] >= 0:
            numbers.append(int(self.after[cell, 1]))
            times.append(self.motions[numbers[-1], 3])
            cell = int(self.after[cell, 0])
            poses.append(self.pose[cell])
        if self.near is not None and self.after[cell, 0] <= FIRST_NEAR:
            at = FIRST_NEAR - int(self.after[cell, 0])
            while self.near.after[at, 0] >= 0:
                numbers.append(int(self.near.after[at, 1]))
                times.append(self.near.motions[numbers[-1], 3])
                at = int(self.near.after[at, 0])
                poses.append(self.near.pose[at, :3])
        return PosePath(np.array(poses, dtype=float), np.array(numbers, np.int64), np.array(times))


def _beginnings(motions: Matrix) -> tuple[IntMatrix, Matrix]:
    """Numbers (n, 2) of two motions and how long each lasts (n, 2), s: none, one or two of several durations."""
    kinds = np.arange(len(motions))
    number = np.concatenate([[0], np.repeat(kinds, len(LENGTHS))])
    time = np.concatenate([[0.0], (motions[:, 3:] * LENGTHS).ravel()])
    second, first = np.meshgrid(np.arange(len(time)), np.arange(len(time)))
    wanted = (first.ravel() > 0) | (second.ravel() == 0)
    chosen = np.column_stack([first.ravel(), second.ravel()])[wanted]
    return number[chosen], time[chosen]


def _poses_after(poses: Matrix, motions: Matrix, times: Floats) -> Matrix:
    """Poses (n, 3) after motions (n, 4) at constant velocity for `times` (n,) from one pose or n poses."""
    turn = motions[:, 2] * times
    middle, chord = poses[..., 2] + 0.5 * turn, times * (1.0 - turn * turn / 24.0)
    c, s = np.cos(middle), np.sin(middle)
    ahead, aside = motions[:, 0], motions[:, 1]
    x, y = poses[..., 0] + chord * (ahead * c - aside * s), poses[..., 1] + chord * (ahead * s + aside * c)
    return np.column_stack([x, y, poses[..., 2] + turn])


class PosePath(NamedTuple):
    """Poses (n + 1, 3), headings continuous, and between them the number of the twist (n,) and its time (n,), s."""

    poses: Matrix
    twist: Ints
    times: Floats


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
    """
    area = (bounds[0][1] - bounds[0][0]) * (bounds[1][1] - bounds[1][0])
    curvature = np.abs(twists[:, 2]).max() / np.hypot(twists[:, 0], twists[:, 1]).max()
    cell = (2.0 * math.pi * area / (MAX_CELLS * curvature)) ** (1.0 / 3.0)
    cell = min(max(cell, cells[0]), cells[1])
    headings = min(max(math.ceil(2.0 * math.pi / (cell * curvature)), HEADINGS[0]), HEADINGS[1])
    fits = area * headings / cell**2 <= 1.2 * MAX_CELLS  # which rounding of the bins may exceed
    half = math.inf if fits else 0.5 * cell * math.sqrt(MAX_CELLS / headings)
    before = [math.ceil(min(c - low, half) / cell) + 1 for c, (low, _) in zip(goal, bounds, strict=False)]
    columns, rows = (
        before[k] + math.ceil(min(bounds[k][1] - goal[k], half) / cell) + 2 for k in range(2)
    )  # the goal is in the centre of a cell
    origin = (goal[0] - before[0] * cell, goal[1] - before[1] * cell)
    count = headings * rows * columns
    allowance = ALLOWED * (cell + 2.0 * math.pi / headings * maps.scalar[REACH])
    frame = np.array([*origin, 1.0 / cell, rows, columns, headings, goal[2], allowance, 0.0, 0.0, 0.0])
    frame[8:10] = SPARE * footprint_width, COMFORT * footprint_width
    region = np.array([*goal, goal_radius, goal_tolerance])
    close = region * (1.0, 1.0, 1.0, INSIDE, INSIDE)
    nearby = near_poses(maps._replace(discs=tight_discs), close, twists, reversal, footprint_width)
    for near, ease in ((nearby, EASE), (nearby, 1.0), (None, 1.0)):
        motions = _motions(np.where(twists[:, :1] != 0.0, twists * (1.0, 1.0, ease), twists), cell, headings)
        table = _searched(count, frame, motions, reversal, region, maps, near)
        if np.count_nonzero(table.seconds < UNKNOWN) >= LEADS_ON * count:
            break
    filled = np.empty_like(table.seconds)
    shape = headings, rows, columns
    _fill(table.seconds.reshape(shape), filled.reshape(shape), CAUTION)
    beyond = 0.0 if fits else _beyond(filled.reshape(shape), origin, cell, maps, geodesic)
    return PoseCostToGo(
        filled,
        origin,
        cell,
        shape,
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
    table = _Table(
        seconds=np.full(count, UNKNOWN, np.float32),
        pose=np.zeros((count, 4), np.float32),
        link=np.full((count, 2), -1, np.int32),
        after=np.full((count, 2), -1, np.int32),
        buckets=np.full(buckets, -1, np.int32),
        frame=frame.copy(),
    )
    if near is None:
        opened = _open_goal(table, region, maps)
    else:
        opened = _open_near(table, width, near.seconds, near.pose)
        table.frame[10] = near.complete
    _search(table, opened, width, motions, reversal, maps)
    return table


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


def _motions(twists: Matrix, cell: float, headings: int) -> Matrix:
    """Motions (n, 4): the twists with the time in which each leaves a cell or a bin of the heading."""
    speed, turning = np.hypot(twists[:, 0], twists[:, 1]), np.abs(twists[:, 2])
    with np.errstate(divide="ignore"):
        time = np.minimum(STRIDE * cell / speed, STRIDE * 2.0 * math.pi / headings / turning)
    return np.column_stack([twists, time])


@inlined
def _cell_of(x: float, y: float, theta: float, frame: Floats) -> int:
    """Index of a pose's cell, -1 outside the grid."""
    rows, columns, headings = int(frame[3]), int(frame[4]), int(frame[5])
    column = math.floor((x - frame[0]) * frame[2] + 0.5)
    row = math.floor((y - frame[1]) * frame[2] + 0.5)
    if not (0 <= column < columns and 0 <= row < rows):
        return -1
    k = math.floor((theta - frame[6]) * (headings / (2.0 * math.pi)) + 0.5) % headings
    return (k * rows + row) * columns + column


class _Table(NamedTuple):
    """Arrays of a search: per cell, and the buckets of open cells."""

    seconds: Floats32
    pose: Matrix32  # x, y, heading, speed ahead of the motion from there
    link: IntMatrix32  # next and previous cell of the same bucket
    after: IntMatrix32  # the cell that follows towards the goal, and the motion to it; FIRST_NEAR - k at near pose k
    buckets: Ints32
    frame: Floats  # of the grid (7 numbers), allowance, clearance required and wanted (m), s of the fine search


@part
def _open(table: _Table, cell: int, bucket: int, x: float, y: float, theta: float, way: float) -> None:
    """Set a cell's pose and add it to a bucket."""
    table.pose[cell, 0], table.pose[cell, 1], table.pose[cell, 2], table.pose[cell, 3] = x, y, theta, way
    link_cell(table.link, table.buckets, cell, bucket)


@compiled
def _open_goal(table: _Table, region: Floats, maps: Maps) -> int:
    """Open the cells whose centres are free and in the goal region, and that of its centre; their number."""
    count, frame = 0, table.frame
    bins, side = int(frame[5]), 1.0 / frame[2]
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
                cell = _cell_of(x, y, theta, frame)
                if cell >= 0 and table.seconds[cell] > 0.0 and slack_at(maps, x, y, theta, -frame[7]) >= 0.0:
                    table.seconds[cell] = 0.0
                    _open(table, cell, 0, x, y, theta, 0.0)
                    count += 1
    return count


@compiled
def _open_near(table: _Table, width: float, seconds: Floats32, pose: Matrix32) -> int:
    """Open the cells of the poses around the goal, each with its pose nearest to the goal; their number."""
    count = 0
    for k in range(len(seconds)):
        cell = _cell_of(pose[k, 0], pose[k, 1], pose[k, 2], table.frame)
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
        other = _cell_of(px, py, pt, frame)
        if other < 0 or table.seconds[other] <= cost + 1e-6:
            continue
        if slack_at(maps, px, py, pt, frame[9]) < 0.0:
            if slack_at(maps, px, py, pt, frame[8]) >= 0.0:
                cost += (NARROW - 1.0) * time
            elif cost >= frame[10] and slack_at(maps, px, py, pt, -frame[7]) >= 0.0:
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


@compiled
def _nearest_reached(x: float, y: float, theta: float, seconds: Floats32, frame: Floats, pose: Matrix32) -> int:
    """Reached cell with a pose near (x, y, theta), the one with the least cost-to-go and deviation; -1 without one."""
    rows, columns, bins = int(frame[3]), int(frame[4]), int(frame[5])
    middle, best, chosen = _cell_of(x, y, theta, frame), math.inf, -1
    if middle < 0:
        return -1
    column, row, k = middle % columns, (middle // columns) % rows, middle // (columns * rows)
    for t in range(-NEARBY, NEARBY + 1):
        for r in range(max(row - NEARBY, 0), min(row + NEARBY + 1, rows)):
            for c in range(max(column - NEARBY, 0), min(column + NEARBY + 1, columns)):
                cell = (((k + t) % bins) * rows + r) * columns + c
                if seconds[cell] < UNKNOWN:
                    away = math.hypot(pose[cell, 0] - x, pose[cell, 1] - y) * frame[2]
                    turned = (pose[cell, 2] - theta) * bins / (2.0 * math.pi)
                    away += abs(turned - bins * math.floor(turned / bins + 0.5))
                    cost = seconds[cell] * (1.0 + DEVIATION_PENALTY * away)
                    if cost < best:
                        best, chosen = cost, cell
    return chosen


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
