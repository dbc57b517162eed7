"""Record of the drive for the identification: poses, the filter's states, commands, and when the vehicle moved."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.driving.messages import Observation
from kraft.driving.vehicle_model import VehicleModel
from kraft.vehicles import DELAY_MAX
from ompl_ext.arrays import Floats, Matrix

AROUND_MOTION: Final = 0.5
"""Time before and after a motion that belongs to it, s: standstill determines the speed there."""
SEEN: Final = 1.0
"""Time in which poses show whether the vehicle moves, s."""
SEEN_WAY: Final = 0.03
"""Distance of the mean place in the second half of that time from the one in the first half, at least, m."""
SEEN_DEVIATIONS: Final = 2.0
"""The same in standard deviations of a position."""
REST_BEFORE: Final = 0.5
"""Time before the drive in which the vehicle rested at its start, s."""
DRIVE_MAX: Final = 30.0
"""Age of the oldest poses that are kept for the window, s."""
RECORD_ROWS: Final = 256
"""Number of rows for which a record has room at first."""


@dataclass(frozen=True)
class RecordedDrive:
    """Recorded drive: poses with the states that the filter had at their times, and commands.

    Attributes:
        times: (n,) of the poses, ascending, s.
        poses: (n, 3) x, y (m), yaw (rad, continuous).
        states: (n, nx) estimated by the filter.
        command_times: (m,) ascending, s.
        commands: (m, nu).
    """

    times: Floats
    poses: Matrix
    states: Matrix
    command_times: Floats
    commands: Matrix

    @property
    def interval(self) -> float:
        """Mean time between poses, s."""
        return float(self.times[-1] - self.times[0]) / (len(self.times) - 1)


class DriveHistory:
    """Recorded poses with the filter's states, commands and times of motion, the last `DRIVE_MAX` s of them."""

    def __init__(self, start_state: Floats, model: VehicleModel) -> None:
        self._theta = model.theta
        pose = start_state[[model.x, model.y, model.theta]]
        self._poses = _Record(3 + len(start_state))
        for t in np.arange(-REST_BEFORE, -0.05, 0.1):
            self._poses.append(float(t), pose, start_state)
        self._commands = _Record(len(model.rest))
        self._commands.append(-math.inf, model.rest)
        self.moving: list[tuple[float, float]] = []
        self._held_until = -math.inf  # time before which commands count as given at standstill (s)

    def observe(self, observation: Observation, state: Floats) -> None:
        """Add a pose with the state (nx,) that the filter has at its time; late ones are left out."""
        if observation.time <= self._poses.times[-1]:
            return
        yaw = state[self._theta] + math.remainder(observation.theta - state[self._theta], math.tau)
        self._poses.append(observation.time, np.array([observation.x, observation.y, yaw]), state)
        if self._poses.times[0] < observation.time - 2.0 * DRIVE_MAX:  # where another process identifies, nobody asks
            self._forget(observation.time - DRIVE_MAX - REST_BEFORE)

    def command(self, time: float, control: Floats, moves: bool) -> None:
        """Add a command, and whether the vehicle moves at its time."""
        last = float(self._commands.times[-1])
        self._commands.append(time, control)
        if moves and time >= self._held_until:
            if self.moving and self.moving[-1][1] >= last:
                self.moving[-1] = self.moving[-1][0], time
            else:
                self.moving.append((time, time))

    def has_moved(self, variance: float) -> bool:
        """Whether the poses of the latest `SEEN` s show a motion, given the variance of their position (m^2)."""
        times, places = self._poses.times, self._poses.values[:, :2]
        first, middle = (int(k) for k in np.searchsorted(times, times[-1] - SEEN * np.array([1.0, 0.5])))
        if first == middle:
            return False
        away = places[middle:].mean(axis=0) - places[first:middle].mean(axis=0)
        return math.hypot(*away) > max(SEEN_WAY, SEEN_DEVIATIONS * math.sqrt(variance))

    def leave_out(self, begin: float, end: float) -> None:
        """Take the time from `begin` to `end` (s), and what belongs to a motion before and after, as standstill."""
        first, last = begin - AROUND_MOTION, end + AROUND_MOTION
        parts = [part for a, b in self.moving for part in ((a, min(b, first)), (max(a, last), b))]
        self.moving = [(a, b) for a, b in parts if a < b]
        self._held_until = max(self._held_until, last)

    def drive(self, begin: float) -> RecordedDrive | None:
        """The recorded drive from `begin` (s) on; None before two poses."""
        self._forget(begin)
        times, poses, commanded = self._poses.times, self._poses.values, self._commands.times
        if len(times) < 2:
            return None
        first = min([times[0], *commanded[1:2]]) - 1.0
        return RecordedDrive(times, poses[:, :3], poses[:, 3:], np.maximum(commanded, first), self._commands.values)

    def _forget(self, before: float) -> None:
        """Drop what is not needed for a drive from `before` (s) on."""
        self._poses.forget(before)
        acting = int(np.searchsorted(self._commands.times, before - DELAY_MAX, side="right")) - 1
        self._commands.forget(float(self._commands.times[max(acting, 0)]))
        self.moving = [span for span in self.moving if span[1] >= before]


class _Record:
    """Rows of an array with ascending times; what has been given out stays as it is."""

    def __init__(self, columns: int) -> None:
        self._rows, self._begin, self._end = np.empty((RECORD_ROWS, 1 + columns)), 0, 0

    def append(self, time: float, *values: Floats) -> None:
        """Add a row at `time` s."""
        if self._end == len(self._rows):
            kept = self._rows[self._begin :]
            self._rows = np.empty((RECORD_ROWS + 2 * len(kept), kept.shape[1]))
            self._rows[: len(kept)] = kept
            self._begin, self._end = 0, len(kept)
        self._rows[self._end, 0], self._rows[self._end, 1:] = time, np.concatenate(values)
        self._end += 1

    def forget(self, before: float) -> None:
        """Drop the rows before `before` s, apart from the newest one."""
        self._begin += int(np.searchsorted(self.times[:-1], before))

    @property
    def times(self) -> Floats:
        """Times (n,) of the rows, s."""
        return self._rows[self._begin : self._end, 0]

    @property
    def values(self) -> Matrix:
        """Rows (n, columns)."""
        return self._rows[self._begin : self._end, 1:]
