"""Motion of a log from its poses, whatever their units: noise, chords, extent, agreement with the yaw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kraft.logs.log import Array

CHORD_MIN = 0.1
"""Least distance that determines a direction of motion, m; noise may require more."""

AVERAGING_TIME = 0.5
"""Longest time over which poses are averaged to determine the extent of the motion, s."""


def position_noise(positions: Array) -> float:
    """Standard deviation of a position, from second differences, which motion hardly changes. Shape (n, 2), m."""
    if len(positions) < 3:
        return 0.0
    second = np.diff(positions, n=2, axis=0)
    return float(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0))


@dataclass(frozen=True, eq=False)
class Chords:
    """Chords: straight lines between poses whose distance determines a direction.

    Attributes:
        directions: of each chord, shape (c,), rad.
        speeds: along each chord, shape (c,), m/s.
        durations: of each chord, shape (c,), s.
        ends: indices of first and last pose of each chord, shape (c, 2).
    """

    directions: Array
    speeds: Array
    durations: Array
    ends: np.ndarray


def chords(times: Array, positions: Array) -> Chords:
    """Follow the positions, shape (n, 2), from one to the next that is far enough away."""
    least = max(CHORD_MIN, 10 * position_noise(positions))
    knots, (x, y) = [0], positions[0]
    for i, (to_x, to_y) in enumerate(positions.tolist()):  # plain numbers are faster than rows of an array
        if (to_x - x) ** 2 + (to_y - y) ** 2 >= least * least:
            knots.append(i)
            x, y = to_x, to_y
    ends = np.column_stack([knots[:-1], knots[1:]]).astype(np.int64)
    step = positions[ends[:, 1]] - positions[ends[:, 0]]
    durations = times[ends[:, 1]] - times[ends[:, 0]]
    speeds = np.hypot(step[:, 0], step[:, 1]) / durations
    return Chords(np.arctan2(step[:, 1], step[:, 0]), speeds, durations, ends)


def agreement(found: Chords, yaw: Array) -> tuple[float, float]:
    """Agreement of a yaw, shape (n,), rad, with the direction of motion, forward or backward.

    Returns:
        A number from 0 (not at all) to 1 (with a constant difference), and that difference in rad, from -pi/2 to pi/2.
    """
    if not len(found.directions):
        return 0.0, 0.0
    middle = (found.ends[:, 0] + found.ends[:, 1]) // 2
    mean = np.mean(np.exp(2j * (found.directions - yaw[middle])))  # twice the angle: reverse is forward
    return float(abs(mean)), float(np.angle(mean) / 2)


def extent(times: Array, poses: Array) -> tuple[float, float]:
    """Extent of the motion (m) and of the turn (rad), between means over equal times of at most `AVERAGING_TIME`.

    Args:
        times: of two poses or more, shape (n,), s.
        poses: shape (n, 3).
    """
    passed = times - times[0]
    blocks = max(2, int(np.ceil(passed[-1] / AVERAGING_TIME)))  # a single mean would show no motion at all
    block = np.minimum((passed * (blocks / passed[-1])).astype(np.int64), blocks - 1)
    _, block, counts = np.unique(block, return_inverse=True, return_counts=True)
    means = np.column_stack([np.bincount(block, poses[:, k]) / counts for k in range(3)])
    spread = means.max(axis=0) - means.min(axis=0)
    return float(np.hypot(spread[0], spread[1])), float(spread[2])
