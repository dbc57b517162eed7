"""Paths of poses to the goal: where the motions of the search of `posetogo` lead from each cell of its grid."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Floats, Floats32, IntMatrix, IntMatrix32, Ints, Matrix, Matrix32
from ompl_ext.jit import compiled, inlined
from ompl_ext.kernels.nearpose import UNKNOWN, NearPoses

DEVIATION_PENALTY = 0.05  # share of the cost-to-go that counts for a cell of deviation
NEARBY = 2  # cells around a pose of which one must have been reached
LENGTHS = np.array([0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0])  # of a motion with which a path begins, in strides
PARTS = (0.25, 0.5, 0.75, 1.0)  # of these motions where poses have to be free
ASIDE = 10.0  # factor of errors to the side and of the heading where a path begins
FIRST_NEAR = -2  # less k where a cell is followed by near pose k
# Indices of `frame`: position of cell (0, 0) (m), 1 / cell, shape of the grid, heading of the first layer (rad);
# clearance that may be lacking, clearance required and wanted (m); seconds up to which the fine search is complete
FRAME_X, FRAME_Y, FRAME_INVERSE, FRAME_ROWS, FRAME_COLUMNS, FRAME_BINS, FRAME_HEADING = range(7)
FRAME_ALLOWED, FRAME_REQUIRED, FRAME_WANTED, FRAME_FINE = range(7, 11)


class PoseCostToGo(NamedTuple):
    """Cost-to-go `seconds[heading, row, column]` at poses; `origin` is the position of row 0, column 0."""

    seconds: Floats32
    origin: tuple[float, float]
    cell: float
    shape: tuple[int, int, int]
    beyond: float  # what is added to the geodesic cost-to-go outside the grid (s)
    exact: Floats32  # without CAUTION, UNKNOWN where no motion was found
    pose: Matrix32  # the exact pose of each cell
    after: IntMatrix32  # the cell that follows each one towards the goal, and the motion to it; or FIRST_NEAR - k
    motions: Matrix
    frame: Floats  # see FRAME_X
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
            yield PosePath(_unwrapped(np.vstack([*poses, rest.poses]), theta), *joined)

    def _met(self, poses: Matrix) -> tuple[Floats, Ints]:
        """Time to the goal (n,) from the pose that was reached in the cell of each pose (n, 3), and that cell.

        Deviations add to the time; it is `UNKNOWN` where no pose was reached.
        """
        rows, columns, bins = (int(self.frame[k]) for k in (FRAME_ROWS, FRAME_COLUMNS, FRAME_BINS))
        column, row = (np.floor((poses[:, k] - self.origin[k]) / self.cell + 0.5).astype(np.int64) for k in range(2))
        k = np.floor((poses[:, 2] - self.frame[FRAME_HEADING]) * (bins / math.tau) + 0.5).astype(np.int64) % bins
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
        exact = np.array(poses, dtype=float)
        return PosePath(_unwrapped(exact, exact[0, 2]), np.array(numbers, np.int64), np.array(times))


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
    middle, chord = poses[..., 2] + 0.5 * turn, times * np.sinc(turn / math.tau)
    c, s = np.cos(middle), np.sin(middle)
    ahead, aside = motions[:, 0], motions[:, 1]
    x, y = poses[..., 0] + chord * (ahead * c - aside * s), poses[..., 1] + chord * (ahead * s + aside * c)
    return np.column_stack([x, y, poses[..., 2] + turn])


def _unwrapped(poses: Matrix, theta: float) -> Matrix:
    """Poses (n, 3) whose headings change by less than half a turn from each to the next, the first one from `theta`."""
    headings: Floats = np.unwrap(np.append(theta, poses[:, 2]))[1:]
    return np.column_stack([poses[:, :2], headings])


class PosePath(NamedTuple):
    """Poses (n + 1, 3), headings continuous, and between them the number of the twist (n,) and its time (n,), s."""

    poses: Matrix
    twist: Ints
    times: Floats


@inlined
def cell_of(x: float, y: float, theta: float, frame: Floats) -> int:
    """Index of a pose's cell, -1 outside the grid."""
    rows, columns, headings = int(frame[FRAME_ROWS]), int(frame[FRAME_COLUMNS]), int(frame[FRAME_BINS])
    column = math.floor((x - frame[FRAME_X]) * frame[FRAME_INVERSE] + 0.5)
    row = math.floor((y - frame[FRAME_Y]) * frame[FRAME_INVERSE] + 0.5)
    if not (0 <= column < columns and 0 <= row < rows):
        return -1
    k = math.floor((theta - frame[FRAME_HEADING]) * (headings / (2.0 * math.pi)) + 0.5) % headings
    return (k * rows + row) * columns + column


@compiled
def _nearest_reached(x: float, y: float, theta: float, seconds: Floats32, frame: Floats, pose: Matrix32) -> int:
    """Reached cell with a pose near (x, y, theta), the one with the least cost-to-go and deviation; -1 without one."""
    rows, columns, bins = int(frame[FRAME_ROWS]), int(frame[FRAME_COLUMNS]), int(frame[FRAME_BINS])
    middle, best, chosen = cell_of(x, y, theta, frame), math.inf, -1
    if middle < 0:
        return -1
    column, row, k = middle % columns, (middle // columns) % rows, middle // (columns * rows)
    for t in range(-NEARBY, NEARBY + 1):
        for r in range(max(row - NEARBY, 0), min(row + NEARBY + 1, rows)):
            for c in range(max(column - NEARBY, 0), min(column + NEARBY + 1, columns)):
                cell = (((k + t) % bins) * rows + r) * columns + c
                if seconds[cell] < UNKNOWN:
                    away = math.hypot(pose[cell, 0] - x, pose[cell, 1] - y) * frame[FRAME_INVERSE]
                    turned = (pose[cell, 2] - theta) * bins / (2.0 * math.pi)
                    away += abs(turned - bins * math.floor(turned / bins + 0.5))
                    cost = seconds[cell] * (1.0 + DEVIATION_PENALTY * away)
                    if cost < best:
                        best, chosen = cost, cell
    return chosen
