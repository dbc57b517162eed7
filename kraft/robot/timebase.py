"""The clock of a drive: this machine's, or that of a simulation, which runs faster or slower and sends its time."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any, Final, Protocol

from kraft.robot.messages import CLOCK, nanoseconds_of
from kraft.robot.robot_file import Robot
from kraft.robot.transport import Transport

WINDOW: Final = 10_000_000_000
"""Time over which the speed of a simulation is measured, ns."""
SHORTEST: Final = 200_000_000
"""Shortest such time, ns."""


class Timebase(Protocol):
    """Clock by which a drive happens; its times are ns, and their differences are the durations of the drive."""

    is_running: bool
    """Whether the time is known."""

    def at(self, monotonic: int) -> int:
        """Time at a time of the machine's monotonic clock (ns), which transports give to what arrives."""

    def now(self) -> int:
        """Time now, ns."""

    def stamp(self) -> int:
        """Stamp of a message that is sent now, ns since 1970 or since the simulation's own zero."""

    def wall(self, duration: float) -> float:
        """How long a duration (s) takes by the machine's clock, s."""


class MachineClock:
    """The clock of this machine."""

    is_running = True

    def at(self, monotonic: int) -> int:
        """The time itself."""
        return monotonic

    def now(self) -> int:
        """Time of the monotonic clock, ns."""
        return time.monotonic_ns()

    def stamp(self) -> int:
        """Time since 1970, ns."""
        return time.time_ns()

    def wall(self, duration: float) -> float:
        """The duration itself."""
        return duration


class TopicClock:
    """Clock of a simulation, from the messages of rosgraph_msgs/Clock on a topic, continued between them.

    Of the messages of the last seconds, those count that came with the least delay.  It never goes back.
    """

    def __init__(self, transport: Transport, topic: str) -> None:
        self._received: deque[tuple[int, int]] = deque()  # arrival, stamp
        self._lock = threading.Lock()
        self._speed, self._anchor = 1.0, (0, 0)
        self._last = 0
        self.is_running = False
        transport.subscribe(topic, CLOCK, self._take, reliable=False)

    def _take(self, message: Any, arrival: int) -> None:
        stamp = nanoseconds_of(message.clock)
        with self._lock:
            received = self._received
            if received and stamp < received[-1][1]:
                received.clear()  # another simulation has begun
                self._last, self.is_running = 0, False
            received.append((arrival, stamp))
            while arrival - received[0][0] > WINDOW:
                received.popleft()
            first, third = received[0], (arrival - received[0][0]) // 3
            if third < SHORTEST or stamp <= first[1]:
                return
            speed = (stamp - first[1]) / (arrival - first[0])

            def lead(each: tuple[int, int]) -> float:
                return (each[1] - stamp) - speed * (each[0] - arrival)

            old = max((each for each in received if each[0] <= first[0] + third), key=lead)
            new = max((each for each in received if each[0] >= arrival - third), key=lead)
            self._speed, self._anchor, self.is_running = (new[1] - old[1]) / (new[0] - old[0]), new, True

    def at(self, monotonic: int) -> int:
        """Time of the simulation at a time of the monotonic clock, ns."""
        arrival, stamp = self._anchor
        return stamp + round(self._speed * (monotonic - arrival))

    def now(self) -> int:
        """Time of the simulation, ns."""
        with self._lock:
            now = self.at(time.monotonic_ns())
            if not self.is_running:
                return now  # which is not of the simulation, and may be later than all of its times
            self._last = max(self._last, now)
            return self._last

    def stamp(self) -> int:
        """Time of the simulation, ns."""
        return self.now()

    def wall(self, duration: float) -> float:
        """How long a duration of the simulation (s) takes by the machine's clock, s."""
        return duration / self._speed


def clock_of(robot: Robot, transport: Transport) -> Timebase:
    """The clock that a robot file names."""
    return MachineClock() if robot.clock is None else TopicClock(transport, robot.clock.topic)
