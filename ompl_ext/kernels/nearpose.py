"""Search for motions into a narrow goal: the same search as in `posetogo`, in a fine grid around the goal.

A gap that is hardly longer than the vehicle is entered by many short moves, which a grid over the whole workspace
cannot resolve.  Between obstacles few poses are free, so that a fine grid that stores only the cells that were reached
gets out of the gap with some ten thousand of them.  The poses are checked without tolerance, and with clearance to
spare.  `posetogo` continues where this search ends.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Floats, Floats32, IntMatrix32, Ints, Ints32, Matrix, Matrix32, int64
from ompl_ext.jit import compiled, inlined, part
from ompl_ext.kernels.clearance import pose_slack
from ompl_ext.kernels.kernel_types import REACH, X_HIGH, X_LOW, Y_HIGH, Y_LOW, Maps
from ompl_ext.trigonometry import cos, sin

UNKNOWN = 1e9  # seconds
CELLS = 100_000  # reached cells at which the search ends, more in a finer grid
GOAL_SHARE = 8.0  # times the cells in the goal region that the search may reach
LOAD = 2.0  # slots of the hash table over cells
HASH, SHIFT = int64(-7046029254386353131), 20  # odd multiplier (Fibonacci hashing), low bits that are not used
OFFSET = 2**19  # of rows and columns, so that they are positive
CELL = 0.018  # side of a cell as a share of the footprint's width
REQUIRED, COMFORT = 0.02, 0.1  # clearance required and wanted of the poses, as shares of the footprint's width
NARROW = 2.0  # factor of the time of motions to poses with less clearance than wanted
LONG_STRIDE = 2.4  # cells of a motion
# Indices of `frame`: position of cell (0, 0) (m), 1 / cell, number of headings, the first of them (rad); clearance
# required and wanted (m)
NEAR_X, NEAR_Y, NEAR_INVERSE, NEAR_BINS, NEAR_HEADING, NEAR_REQUIRED, NEAR_WANTED = range(7)
LEVELS = ((1.0, 1.0), (0.7, 1.0), (0.5, 1.0), (0.35, 0.5))  # factors of CELL and REQUIRED that are tried in turn


class NearPoses(NamedTuple):
    """Poses around the goal: `seconds` (n,) to the goal, `pose` (n, 4) with the speed ahead of the motion from there.

    `after` (n, 2) is the pose that follows each one, -1 in the goal, and the motion to it, a row of `motions` (k, 4).
    All poses that are nearer to the goal than `complete` s were reached.
    """

    seconds: Floats32
    pose: Matrix32
    after: IntMatrix32
    motions: Matrix
    complete: float


class _Sparse(NamedTuple):
    """Cells that were reached, in a hash table, and the buckets of open cells."""

    key: Ints
    seconds: Floats32
    pose: Matrix32  # x, y, heading, speed ahead of the motion from there
    link: IntMatrix32  # next and previous cell of the same bucket
    after: IntMatrix32  # the cell that follows towards the goal, and the motion to it
    buckets: Ints32
    frame: Floats  # see NEAR_X
    result: Floats  # cells that were reached, cells that are open, seconds up to which the search is complete


def near_poses(maps: Maps, region: Floats, twists: Matrix, reversal: float, width: float) -> NearPoses | None:
    """Poses from which motions lead into the goal, those nearest to it; None if no motion leads away from it.

    Args:
        maps: discs of the footprint and fields.
        region: position (m) and heading of the goal, its radius and the tolerance of its heading.
        twists: body velocities (n, 3) of the motions.
        reversal: time that a change between ahead and astern costs (s).
        width: of the footprint (m).
    """
    goal_volume = 2.0 * math.pi * region[3] ** 2 * region[4] * maps.scalar[REACH]
    least = (GOAL_SHARE * goal_volume / CELLS) ** (1.0 / 3.0)
    for finer, ease in LEVELS:
        cell = finer * max(CELL * width, least)
        bins = math.ceil(2.0 * math.pi * maps.scalar[REACH] / cell)
        motions = motions_of(twists, cell, bins, LONG_STRIDE)
        shortest = float(motions[:, 3].min())
        most = round(CELLS / finer**1.5)
        slots = 2 ** math.ceil(math.log2(LOAD * most))
        table = _Sparse(
            key=np.full(slots, -1),
            seconds=np.full(slots, UNKNOWN, np.float32),
            pose=np.zeros((slots, 4), np.float32),
            link=np.full((slots, 2), -1, np.int32),
            after=np.full((slots, 2), -1, np.int32),
            buckets=np.full(math.ceil((NARROW * motions[:, 3].max() + reversal) / shortest) + 2, -1, np.int32),
            frame=np.array(
                [region[0], region[1], 1.0 / cell, bins, region[2], ease * REQUIRED * width, COMFORT * width]
            ),
            result=np.zeros(3),
        )
        _search(table, shortest, motions, reversal, region, maps, most)
        if table.result[1] > 0:
            return _reached(table, motions)
    return None


def _reached(table: _Sparse, motions: Matrix) -> NearPoses:
    """Cells of a table that were reached, without the free slots."""
    slots = np.flatnonzero(table.key >= 0)
    number = np.full(len(table.key) + 1, -1, np.int32)  # the last entry is that of -1
    number[slots] = np.arange(len(slots))
    after = np.ascontiguousarray(table.after[slots])
    after[:, 0] = number[after[:, 0]]
    return NearPoses(table.seconds[slots], table.pose[slots], after, motions, float(table.result[2]))


def motions_of(twists: Matrix, cell: float, bins: int, stride: float) -> Matrix:
    """Motions (n, 4): the twists with the time in which each moves by `stride` cells, or turns by as many bins."""
    speed, turning = np.hypot(twists[:, 0], twists[:, 1]), np.abs(twists[:, 2])
    with np.errstate(divide="ignore"):
        time = np.minimum(stride * cell / speed, stride * 2.0 * math.pi / bins / turning)
    return np.column_stack([twists, time])


@inlined
def link_cell(link: IntMatrix32, buckets: Ints32, cell: int, bucket: int) -> None:
    """Add a cell to a bucket."""
    head = buckets[bucket]
    link[cell, 0], link[cell, 1] = head, -2 - bucket
    if head >= 0:
        link[head, 1] = cell
    buckets[bucket] = cell


@inlined
def unlink_cell(link: IntMatrix32, buckets: Ints32, cell: int) -> None:
    """Remove a cell from its bucket."""
    after, before = link[cell, 0], link[cell, 1]
    if before <= -2:
        buckets[-2 - before] = after
    else:
        link[before, 0] = after
    if after >= 0:
        link[after, 1] = before


@inlined
def slack_at(maps: Maps, x: float, y: float, theta: float, required: float) -> float:
    """Clearance of a pose beyond `required` (m), negative outside the bounds."""
    scalar = maps.scalar
    if not (scalar[X_LOW] <= x <= scalar[X_HIGH] and scalar[Y_LOW] <= y <= scalar[Y_HIGH]):
        return -1.0
    return pose_slack(maps, x, y, cos(theta), sin(theta), required)


@inlined
def pose_before(x: float, y: float, theta: float, motion: Floats) -> tuple[float, float, float]:
    """Pose from which a motion leads to a pose."""
    ahead, aside, time = motion[0], motion[1], motion[3]
    turn = motion[2] * time
    middle, chord = theta - 0.5 * turn, time * (1.0 - turn * turn / 24.0)
    c, s = cos(middle), sin(middle)
    return x - chord * (ahead * c - aside * s), y - chord * (ahead * s + aside * c), theta - turn


@inlined
def _key(x: float, y: float, theta: float, frame: Floats) -> int:
    """Number of a pose's cell in an unbounded grid."""
    column = int64(math.floor((x - frame[NEAR_X]) * frame[NEAR_INVERSE] + 0.5)) + OFFSET
    row = int64(math.floor((y - frame[NEAR_Y]) * frame[NEAR_INVERSE] + 0.5)) + OFFSET
    bins = int64(frame[NEAR_BINS])
    k = int64(math.floor((theta - frame[NEAR_HEADING]) * (bins / (2.0 * math.pi)) + 0.5)) % bins
    return (k * (2 * OFFSET) + row) * (2 * OFFSET) + column


@inlined
def _slot(keys: Ints, key: int) -> int:
    """Slot of a key, or the free one where it belongs."""
    mask = len(keys) - 1
    slot = ((key * HASH) >> SHIFT) & mask
    while keys[slot] != -1 and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@part
def _open_goal(table: _Sparse, region: Floats, maps: Maps, most: int) -> int:
    """Open the free poses on the grid within the goal region, `most` of them at most; their number."""
    count, frame = 0, table.frame
    bins, side = int64(frame[NEAR_BINS]), 1.0 / frame[NEAR_INVERSE]
    around = int64(math.ceil(region[3] / side))
    for k in range(bins):
        theta = region[2] + 2.0 * math.pi * k / bins
        if k > 0 and cos(theta - region[2]) < cos(min(region[4], math.pi)):
            continue
        for i in range(-around, around + 1):
            for j in range(-around, around + 1):
                if k + abs(i) + abs(j) > 0 and math.hypot(i * side, j * side) > region[3]:
                    continue
                x, y = region[0] + i * side, region[1] + j * side
                if slack_at(maps, x, y, theta, frame[NEAR_REQUIRED]) < 0.0:
                    continue
                key = _key(x, y, theta, frame)
                slot = _slot(table.key, key)
                if table.key[slot] == key:
                    continue
                table.key[slot], table.seconds[slot] = key, 0.0
                table.pose[slot, 0], table.pose[slot, 1], table.pose[slot, 2] = x, y, theta
                link_cell(table.link, table.buckets, slot, int64(0))
                count += 1
                if count >= most:  # a wide region with a small tolerance has more: the table would overflow
                    return count
    return count


@part
def _expand(table: _Sparse, cell: int, shortest: float, motions: Matrix, reversal: float, maps: Maps) -> int:
    """Open the cells from which a motion leads to the pose of `cell`; change of the number of open cells."""
    opened = 0
    x, y, theta, way = table.pose[cell, 0], table.pose[cell, 1], table.pose[cell, 2], table.pose[cell, 3]
    for m in range(len(motions)):
        ahead = motions[m, 0]
        cost = table.seconds[cell] + motions[m, 3] + (reversal if way * ahead < 0.0 else 0.0)
        px, py, pt = pose_before(x, y, theta, motions[m])
        key = _key(px, py, pt, table.frame)
        slot = _slot(table.key, key)
        known = table.key[slot] == key
        if known and (table.seconds[slot] <= cost + 1e-6 or table.link[slot, 1] == -1):
            continue
        if slack_at(maps, px, py, pt, table.frame[NEAR_WANTED]) < 0.0:
            if slack_at(maps, px, py, pt, table.frame[NEAR_REQUIRED]) < 0.0:
                continue
            cost += (NARROW - 1.0) * motions[m, 3]
            if known and table.seconds[slot] <= cost + 1e-6:
                continue
        if known:
            unlink_cell(table.link, table.buckets, slot)
        else:
            opened += 1
        table.key[slot], table.seconds[slot] = key, cost
        table.pose[slot, 0], table.pose[slot, 1], table.pose[slot, 2] = px, py, pt
        table.pose[slot, 3] = ahead if ahead != 0.0 else way
        table.after[slot, 0], table.after[slot, 1] = cell, m
        link_cell(table.link, table.buckets, slot, int(cost / shortest) % len(table.buckets))
    return opened


@compiled
def _search(
    table: _Sparse, shortest: float, motions: Matrix, reversal: float, region: Floats, maps: Maps, most: int
) -> None:
    """Dijkstra's search with buckets of `shortest` s, backwards from the goal, until `most` cells are reached."""
    open_cells, current = _open_goal(table, region, maps, most), int64(0)
    reached = open_cells
    while open_cells > 0 and reached < most:
        cell = int64(table.buckets[current % len(table.buckets)])
        if cell < 0:
            current += 1
            continue
        unlink_cell(table.link, table.buckets, cell)
        table.link[cell, 1] = -1
        opened = _expand(table, cell, shortest, motions, reversal, maps)
        open_cells += opened - 1
        reached += opened
    table.result[0], table.result[1], table.result[2] = reached, open_cells, current * shortest
