"""Screening of logs before an identification: what a car's commands and its motion say about each other without a model.

The motion of all logs is put on equal time steps.  Regressions of the yaw rate on speed and steering, and of the change
of the speed on throttle and speed, are enough to see that commands and poses do not belong together: an offset of their
clocks, swapped columns, two cars.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.sysid.smoothing import smoothed, thinned
from ompl_ext.arrays import Floats, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


STEP: Final = 0.05
"""Time between two samples, s."""
POSE_INTERVAL: Final = 0.03
"""Least time between two poses of the parabolas that give speed and yaw rate, s."""
SPAN: Final = 0.3
"""Time over which the change of the speed is explained, s."""
FINE_DELAYS: Final = tuple(0.01 * k for k in range(-10, 11))
"""Delays at which the response to the steering is sought, s."""
EXPLAINED_MAX: Final = 0.5
"""Share of a motion that a command leaves unexplained, up to which it counts as its cause."""
MOVING: Final = 0.3
"""Share of the high speeds above which curvature is evaluated."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion and commands of one part on equal time steps, n samples."""

    log: int
    times: Floats
    """(n,) s, as in the log"""
    speed: Floats
    """(n,) along the car, m/s"""
    side: Floats
    """(n,) to its left, m/s"""
    rate: Floats
    """(n,) of the yaw, rad/s"""
    part: Part

    def commands(self, delay: float = 0.0) -> Matrix:
        """Commands (n, 2), throttle and steering, from `delay` s before each sample."""
        at = np.searchsorted(self.part.command_times, self.times - delay, side="right") - 1
        found: Matrix = self.part.commands[np.maximum(at, 0)]
        return found


def motions(logs: Sequence[Log]) -> list[Motion]:
    """Motion of all parts that last for a second or longer, commands in the order throttle, steering."""
    found = []
    for i, log in enumerate(logs):
        columns = [log.controls.index(name) for name in ("throttle", "steering")]
        for part in log.parts:
            if part.duration >= 1.0 and len(part.pose_times) >= 10:
                found.append(motion(i, part, columns))
    return found


def motion(log: int, part: Part, columns: Sequence[int]) -> Motion:
    """Motion of one part; `columns` are those of throttle and steering."""
    less = thinned(part, POSE_INTERVAL)
    times = np.arange(part.pose_times[0], part.pose_times[-1], STEP)
    poses, rates = smoothed(less.pose_times, less.poses, times)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    ordered = replace(part, commands=part.commands[:, list(columns)])
    return Motion(
        log, times, rates[:, 0] * c + rates[:, 1] * s, rates[:, 1] * c - rates[:, 0] * s, rates[:, 2], ordered
    )


def yaw_error(found: Sequence[Motion], delay: float, *, swapped: bool = False) -> float:
    """Share of the yaw rate that speed and steering do not explain, with steering from `delay` s before."""
    control = 0 if swapped else 1
    terms = [np.column_stack([m.speed, m.speed * m.commands(delay)[:, control]]) for m in found]
    return _unexplained(np.concatenate(terms), np.concatenate([m.rate for m in found]))


def speed_error(found: Sequence[Motion], delay: float, *, swapped: bool = False) -> float:
    """Share of the change of the speed that throttle and speed do not explain, with throttle from `delay` s before."""
    control, count, terms, changes = 1 if swapped else 0, round(SPAN / STEP), [], []
    for m in found:
        total = np.concatenate([[0.0], np.cumsum(m.commands(delay)[:-1, control])])
        mean = (total[count:] - total[:-count]) / count
        terms.append(np.column_stack([np.ones(len(mean)), mean, m.speed[:-count]]))
        changes.append(m.speed[count:] - m.speed[:-count])
    change = np.concatenate(changes)
    return _unexplained(np.concatenate(terms), change - np.mean(change))


def _unexplained(terms: Matrix, values: Floats) -> float:
    """Share of the sum of squares of `values` (n,) that is left by least squares on `terms` (n, k)."""
    whole = float(values @ values)
    if whole <= 0.0:
        return 1.0
    left = values - terms @ np.linalg.lstsq(terms, values, rcond=None)[0]
    return float(left @ left) / whole


def turns_before_steered(logs: Sequence[Log]) -> bool:
    """Whether the yaw rate precedes the steering: commands are recorded later than they act."""
    if not logs or not {"throttle", "steering"} <= set(logs[0].controls):
        return False
    found = motions(logs)
    if not found:
        return False
    errors = np.array([yaw_error(found, delay) for delay in FINE_DELAYS])
    best = int(np.argmin(errors))
    return bool(FINE_DELAYS[best] < 0.0 and errors[best] < EXPLAINED_MAX and errors.max() > 1.2 * errors[best])
