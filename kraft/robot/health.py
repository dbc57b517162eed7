"""Whether a drive works as it should: poses that arrive at their rate, ticks and decisions in time.

A link that loses messages, or a computer that other programs load, breaks nothing at once: the car drives on verified
plans, from fewer poses and later decisions.  When too much of the last seconds is missing or late, it must stop.
"""

from __future__ import annotations

import itertools
from collections import deque
from typing import Final

from kraft.robot.robot_file import Watchdog

WINDOW: Final = 2.0
"""Shortest time that is judged, s."""
AGES: Final = 5.0
"""It is at least this many times the watchdog's `pose_age`, so that poses that stop altogether are reported as that."""
DECISIONS: Final = 4
"""Number of decisions that are judged."""


class Health:
    """What arrived and what was late in the last seconds of a drive; times in s of the drive.

    Args:
        watchdog: the shares that may be missing or late.
        rate: poses per second that arrive when all is well, Hz; 0 if it is not known.
        period: time from one command to the next, s.
    """

    def __init__(self, watchdog: Watchdog, rate: float, period: float) -> None:
        self._watchdog, self._period = watchdog, period
        self._window = max(WINDOW, AGES * watchdog.pose_age)
        self._expected = rate * self._window
        self._since: float | None = None
        self._poses: deque[float] = deque()
        self._ticks: deque[tuple[float, bool]] = deque()
        self._decisions: deque[bool] = deque(maxlen=DECISIONS)
        self._is_lossy = False

    def tick(self, now: float, late: float, poses: int) -> None:
        """Note a tick that came `late` (s), and the number of poses that have arrived since the last one."""
        self._since = now if self._since is None else self._since
        self._ticks.append((now, late > 0.5 * self._period))
        self._poses.extend(itertools.repeat(now, poses))
        begin = now - self._window
        while self._ticks[0][0] <= begin:
            self._ticks.popleft()
        while self._poses and self._poses[0] <= begin:
            self._poses.popleft()
        if now - self._since >= self._window:  # half the share ends it: the number of poses in a window varies
            self._is_lossy = self._missing > self._watchdog.lost * (0.5 if self._is_lossy else 1.0)

    @property
    def _missing(self) -> float:
        """Share of the window's poses that have not arrived; 0 if their rate is not known."""
        return 1.0 - len(self._poses) / self._expected if self._expected > 0.0 else 0.0

    def decision(self, late: bool) -> None:
        """Note a decision of the planner."""
        self._decisions.append(late)

    def trouble(self, now: float) -> str:
        """Why the vehicle must not drive; empty if it may, and as long as the drive is too short to tell."""
        if self._since is None or now - self._since < self._window:
            return ""
        watchdog, window = self._watchdog, self._window
        if self._is_lossy:
            return f"{100 * self._missing:.0f} % of the poses of the last {window:g} s are missing"
        late = sum(is_late for _, is_late in self._ticks) / max(len(self._ticks), 1)
        if late > watchdog.late:
            return f"{100 * late:.0f} % of the commands of the last {window:g} s are late: the computer is overloaded"
        if (count := sum(self._decisions)) > watchdog.late * DECISIONS:
            return f"{count} of the last {DECISIONS} decisions of the planner came too late"
        return ""
