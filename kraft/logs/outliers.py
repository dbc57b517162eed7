"""Poses that the vehicle cannot have reached: outliers, teleports, and stale measurements."""

from __future__ import annotations

from typing import Final

import numpy as np

from kraft.logs.log import Array
from kraft.logs.motion import chords, position_noise
from kraft.logs.table import Flags, Rows

TOP_SPEED_MIN: Final = 3.0
"""Least top speed that is assumed of a vehicle, m/s."""


NOISE_MARGIN: Final = 10.0
"""Standard deviations of a position within which a jump is noise."""


YAW_STEP_MAX: Final = 1.2
"""Largest change of yaw between two poses, rad, besides that of `YAW_RATE_MAX`."""


YAW_RATE_MAX: Final = 10.0


TRACK_POSES_MIN: Final = 8
"""Number of consecutive consistent poses that begin a new track."""


OUTLIER: Final = -1


FIRST_TRACK: Final = 0


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


def stale(times: Array, poses: Array) -> Flags:
    """Poses that repeat the previous one bit for bit while the vehicle moves, so that nothing was measured. Shape
    (n,).
    """
    flags = np.zeros(len(times), bool)
    fresh = np.flatnonzero(np.concatenate([[True], np.any(np.diff(poses, axis=0) != 0, axis=1)]))
    if len(fresh) == len(times) or len(fresh) < 3:
        return flags
    way = np.hypot(*np.diff(poses[fresh, :2], axis=0).T)
    speeds = way / np.diff(times[fresh])
    for k in range(1, len(fresh) - 1):  # speed into and out of each run of equal poses
        if speeds[k] >= 0.5 * speeds[k - 1] and way[k - 1] > 1e-3:
            flags[fresh[k] + 1 : fresh[k + 1]] = True
    return flags
