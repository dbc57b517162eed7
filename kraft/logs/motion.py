"""Motion of a log from its poses: noise, chords, extent, agreement with the yaw; outliers, teleports, stale poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from kraft.logs.log import Array
from kraft.logs.table import Flags, Rows

CHORD_MIN = 0.1
"""Least distance that determines a direction of motion, m; noise may require more."""

AVERAGING_TIME = 0.5
"""Longest time over which poses are averaged to determine the extent of the motion, s."""


TOP_SPEED_MIN: Final = 3.0
"""Least top speed that is assumed of a vehicle, m/s."""

NOISE_MARGIN: Final = 10.0
"""Standard deviations of a position within which a jump is noise."""

NEIGHBOURS: Final = 5
"""Poses whose median tells a single outlier."""

STEPS_MARGIN: Final = 3.0
"""Usual steps between two poses within which a position may be away from this median."""

YAW_STEP_MAX: Final = 1.2
"""Largest change of yaw between two poses, rad, besides that of `YAW_RATE_MAX`."""

YAW_RATE_MAX: Final = 10.0
"""Largest yaw rate that counts as motion, rad/s: a full turn in 0.6 s, faster than robots on wheels turn."""

TRACK_POSES_MIN: Final = 8
"""Number of consecutive consistent poses that begin a new track."""

OUTLIER: Final = -1

FIRST_TRACK: Final = 0


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
    """Follow the positions, shape (n, 2), from one to the next that is far enough away, past single outliers."""
    least = max(CHORD_MIN, 10 * position_noise(positions))
    single = isolated(positions)
    start = int(np.argmin(single))
    knots, (x, y) = [start], positions[start]
    for i, (to_x, to_y) in enumerate(positions.tolist()):  # plain numbers are faster than rows of an array
        if single[i]:
            continue
        if (to_x - x) ** 2 + (to_y - y) ** 2 >= least * least:
            knots.append(i)
            x, y = to_x, to_y
    ends = np.column_stack([knots[:-1], knots[1:]]).astype(np.int64)
    step = positions[ends[:, 1]] - positions[ends[:, 0]]
    durations = times[ends[:, 1]] - times[ends[:, 0]]
    speeds = np.hypot(step[:, 0], step[:, 1]) / durations
    return Chords(np.arctan2(step[:, 1], step[:, 0]), speeds, durations, ends)


def isolated(positions: Array) -> Flags:
    """Positions, shape (n, 2) in any unit, far from the median of the `NEIGHBOURS` around each, as outliers are."""
    if len(positions) < NEIGHBOURS:
        return np.zeros(len(positions), bool)
    half = NEIGHBOURS // 2
    around = sliding_window_view(np.pad(positions, ((half, half), (0, 0)), mode="reflect"), NEIGHBOURS, axis=0)
    usual_step = float(np.median(np.hypot(*np.diff(positions, axis=0).T)))
    far = NOISE_MARGIN * position_noise(positions) + STEPS_MARGIN * usual_step
    flags: Flags = np.hypot(*(positions - np.median(around, axis=-1)).T) > far
    return flags


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


def top_speed(times: Array, positions: Array) -> float:
    """Estimated top speed, m/s: three times the speed that is not exceeded for nine tenths of the time."""
    path = chords(times, positions)
    if not len(path.speeds):
        return TOP_SPEED_MIN
    order = np.argsort(path.speeds)
    passed = np.cumsum(path.durations[order])  # weighted by time: jumps to and fro are many, but short
    usual = path.speeds[order][int(np.searchsorted(passed, 0.9 * passed[-1]))]
    return max(TOP_SPEED_MIN, 3.0 * float(usual))


def tracks(times: Array, poses: Array, speed: float) -> Rows:
    """Number of the track of each pose, shape (n, 3), from 0; -1 for an outlier. Shape (n,)."""
    reach = max(0.05, NOISE_MARGIN * position_noise(poses[:, :2]))
    labels = np.full(len(times), FIRST_TRACK, np.int64)
    if _reachable(times[:-1], poses[:-1], times[1:], poses[1:], speed, reach).all():
        return labels
    track, last = FIRST_TRACK, 0
    suspects: list[int] = []

    def near(a: int, b: int) -> bool:
        at, to = slice(a, a + 1), slice(b, b + 1)
        return bool(_reachable(times[at], poses[at], times[to], poses[to], speed, reach)[0])

    for i in range(1, len(times)):
        if near(last, i):
            labels[suspects] = OUTLIER
            suspects, labels[i], last = [], track, i
            continue
        if suspects and not near(suspects[-1], i):
            labels[suspects] = OUTLIER
            suspects = []
        suspects.append(i)
        if len(suspects) == TRACK_POSES_MIN:
            track += 1
            labels[suspects] = track
            suspects, last = [], i
    labels[suspects] = OUTLIER
    return labels


def leading_zeros(times: Array, poses: Array, speed: float) -> int:
    """Number of first poses, shape (n, 3), that are all 0 and from which the next one cannot be reached."""
    count = int(np.argmax(np.any(poses != 0.0, axis=1))) if np.any(poses) else 0
    if count == 0:
        return 0
    reach = max(0.05, NOISE_MARGIN * position_noise(poses[:, :2]))
    last, first = slice(count - 1, count), slice(count, count + 1)
    return 0 if _reachable(times[last], poses[last], times[first], poses[first], speed, reach)[0] else count


def _reachable(t0: Array, p0: Array, t1: Array, p1: Array, speed: float, reach: float) -> Flags:
    dt, step = t1 - t0, p1 - p0
    turn = np.abs((step[:, 2] + np.pi) % (2 * np.pi) - np.pi)
    near: Flags = np.hypot(step[:, 0], step[:, 1]) <= reach + speed * dt
    return near & (turn <= YAW_STEP_MAX + YAW_RATE_MAX * dt)


def stale(times: Array, poses: Array, speed: float) -> Flags:
    """Poses that repeat the previous one bit for bit while the vehicle moves, so that nothing was measured. Shape
    (n,).

    It has moved on at half or more of the speed before, or its motion goes on where `speed` (m/s) would not have taken
    it since the last repetition: a vehicle that turns may end near where its poses began to repeat.
    """
    flags = np.zeros(len(times), bool)
    fresh = np.flatnonzero(np.concatenate([[True], np.any(np.diff(poses, axis=0) != 0, axis=1)]))
    if len(fresh) == len(times) or len(fresh) < 3:
        return flags
    way = np.hypot(*np.diff(poses[fresh, :2], axis=0).T)
    speeds = way / np.diff(times[fresh])
    reach = max(0.05, NOISE_MARGIN * position_noise(poses[fresh, :2]))
    near = _reachable(times[:-1], poses[:-1], times[1:], poses[1:], speed, reach)
    for k in range(1, len(fresh) - 1):  # speed into and out of each run of equal poses
        is_near, after = near[fresh[k + 1] - 1], near[fresh[k + 1] :][: TRACK_POSES_MIN - 1]
        goes_on = len(after) == TRACK_POSES_MIN - 1 and after.all()
        is_outlier = not is_near and not after[:1].all()
        moved = speeds[k] >= 0.5 * speeds[k - 1] and way[k - 1] > 1e-3 and not is_outlier
        if moved or (goes_on and not is_near):
            flags[fresh[k] + 1 : fresh[k + 1]] = True
    return flags
