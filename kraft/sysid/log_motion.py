"""Motion and commands of logs on equal time steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final
from weakref import WeakKeyDictionary

import numpy as np

from kraft.sysid.smoothing import smoothed, thinned
from kraft.vehicles import CAR_CONTROLS
from ompl_ext.arrays import Floats, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


STEP: Final = 0.05
"""Time between two samples, s."""
POSE_INTERVAL: Final = 0.03
"""Least time between two poses of the parabolas that give speed and yaw rate, s."""
SPAN: Final = 0.3
"""Time over which the change of the speed is explained, s."""
REVERSE_SHARE: Final = 0.1
"""Share of the high speeds above which a vehicle counts as driving backwards."""
REVERSE_TIME_MIN: Final = 2.0
"""Least time of all drives backwards that shows the drive of throttle backwards, s."""
SWEEPS: Final = (0.2, 0.4, 0.6, 0.8, 1.2, 1.6, 2.4, 3.2)
"""Times in which a slow servo or a speed controller may follow the largest command, s."""
_SMOOTHED: WeakKeyDictionary[Part, tuple[Floats, Matrix, Matrix]] = WeakKeyDictionary()
"""What `_smoothed` found for parts that still exist."""


@dataclass(frozen=True, eq=False)
class LogMotion:
    """Motion and commands of one part on equal time steps, n samples."""

    log: int
    times: Floats
    """(n,) s, as in the log"""
    speed: Floats
    """(n,) along the vehicle, m/s"""
    side: Floats
    """(n,) to its left, m/s"""
    rate: Floats
    """(n,) of the yaw, rad/s"""
    yaw: Floats
    """(n,) rad"""
    part: Part

    def commands(self, delay: float = 0.0) -> Matrix:
        """Commands (n, controls) `delay` s before each sample: throttle and steering, unless others were asked for."""
        at = np.searchsorted(self.part.command_times, self.times - delay, side="right") - 1
        found: Matrix = self.part.commands[np.maximum(at, 0)]
        return found


def are_of_cars(logs: Sequence[Log]) -> bool:
    """Whether every log has the commands of a car."""
    return all(set(CAR_CONTROLS) <= set(log.controls) for log in logs)


def motions(logs: Sequence[Log], controls: Sequence[str] = CAR_CONTROLS) -> list[LogMotion]:
    """Motion of all parts of a second and ten poses or more, with the commands in the order of `controls`."""
    found = []
    for i, log in enumerate(logs):
        columns = [log.controls.index(name) for name in controls]
        for part in log.parts:
            if part.duration >= 1.0 and len(part.pose_times) >= 10:
                found.append(motion(i, part, columns))
    return found


def reverses(logs: Sequence[Log]) -> bool:
    """Whether the vehicle drives backwards by throttle backwards for some time, and does not only brake with it."""
    found = motions(logs, ("throttle",))
    if not found:
        return False
    throttle = np.concatenate([m.commands()[:, 0] for m in found])
    speed = np.concatenate([m.speed for m in found])
    speed = math.copysign(1.0, float(throttle @ speed)) * speed  # the yaw may be that of the rear
    fast = REVERSE_SHARE * float(np.quantile(np.abs(speed), 0.95))
    return bool(STEP * np.count_nonzero((throttle < 0.0) & (speed < -fast)) >= REVERSE_TIME_MIN)


def motion(log: int, part: Part, columns: Sequence[int]) -> LogMotion:
    """Motion of one part; `columns` are those of its commands."""
    times, poses, rates = _smoothed(part)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    ordered = replace(part, commands=part.commands[:, list(columns)])
    speed, side = rates[:, 0] * c + rates[:, 1] * s, rates[:, 1] * c - rates[:, 0] * s
    return LogMotion(log, times, speed, side, rates[:, 2], poses[:, 2], ordered)


def _smoothed(part: Part) -> tuple[Floats, Matrix, Matrix]:
    """Times (n,) of the samples, poses and rates (n, 3) then; kept, because several checks need them."""
    found = _SMOOTHED.get(part)
    if found is None:
        less = thinned(part, POSE_INTERVAL)
        times = np.arange(part.pose_times[0], part.pose_times[-1], STEP)
        found = _SMOOTHED[part] = (times, *smoothed(less.pose_times, less.poses, times))
    return found


def sums_of(values: Floats, count: int) -> Floats:
    """Sums (n - count,) of `count` successive values of n, beginning with each value in turn."""
    total = np.concatenate([[0.0], np.cumsum(values[:-1])])
    sums: Floats = total[count:] - total[:-count]
    return sums


def followed(commands: Floats, step: float) -> Floats:
    """Command (n,) that follows commands (n,) by at most `step` from sample to sample."""
    found, at = np.empty(len(commands)), float(commands[0])
    for k, wanted in enumerate(commands.tolist()):
        at += min(max(wanted - at, -step), step)
        found[k] = at
    return found
