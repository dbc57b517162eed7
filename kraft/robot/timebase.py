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
STANDS: Final = 500_000_000
"""Time without a later stamp after which a simulation is paused, ns, ..."""
GAPS: Final = 5
"""... or this many times the usual time between two stamps, if that is more."""
BACK: Final = 200_000_000
"""Time by which a stamp is earlier than the last one if another simulation has begun, and not only late, ns."""
LOOK: Final = 0.05
"""Longest time to sleep before another look at a clock, s."""


class Timebase(Protocol):
    """Clock by which a drive happens; its times are ns, and their differences are the durations of the drive."""

    is_running: bool
    """Whether the time is known."""
    restarts: int
    """Number of times that it has gone back."""

    @property
    def stands(self) -> bool:
        """Whether it does not go on now."""

    def at(self, monotonic: int) -> int:
        """Time at a time of the machine's monotonic clock (ns), which transports give to what arrives."""

    def now(self) -> int:
        """Time now, ns."""

    def stamp(self) -> int:
        """Stamp of a message that is sent now, ns since 1970 or since the simulation's own zero."""

    def wall(self, duration: float) -> float:
        """How long a duration (s) takes by the machine's clock at most until another look at this one, s."""


class MachineClock:
    """The clock of this machine."""

    is_running, restarts, stands = True, 0, False

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

    Of the messages of the last seconds, those count that came with the least delay.  `now` never goes back, unless
    another simulation begins.  A simulation that is paused sends the same time or none; the clock then stands too.
    """

    def __init__(self, transport: Transport, topic: str) -> None:
        self._received: deque[tuple[int, int]] = deque()  # arrival, stamp
        self._lock = threading.Lock()
        self._line = (0, 0, 1.0, 0)  # arrival, stamp, speed, and the arrival up to which it is continued
        self._last, self._patience = 0, STANDS
        self.is_running, self.restarts = False, 0
        transport.subscribe(topic, CLOCK, self._take, reliable=False)

    def _take(self, message: Any, arrival: int) -> None:
        stamp = nanoseconds_of(message.clock)
        with self._lock:
            received = self._received
            if received and stamp <= received[-1][1]:
                if stamp < received[-1][1] - BACK:
                    self._restart(arrival, stamp)
                return  # a pause, or a message that is late
            paused = self.is_running and arrival - received[-1][0] > self._patience
            if paused:  # the speed is that from before
                received.clear()
            received.append((arrival, stamp))
            while arrival - received[0][0] > WINDOW:
                received.popleft()
            if len(received) > 1:
                self._patience = max(STANDS, GAPS * (arrival - received[0][0]) // (len(received) - 1))
            if paused:
                self._line = arrival, stamp, self._line[2], arrival + self._patience
            elif (line := self._measured(arrival, stamp)) is not None:
                self._line, self.is_running = (*line, arrival + self._patience), True
            else:
                self._line = (*self._line[:3], arrival + self._patience)

    def _restart(self, arrival: int, stamp: int) -> None:
        """Another simulation has begun, whose speed is not known yet."""
        self._received.clear()
        self._received.append((arrival, stamp))
        self._last, self._patience, self.is_running = 0, STANDS, False
        self.restarts += 1

    def _measured(self, arrival: int, stamp: int) -> tuple[int, int, float] | None:
        """Arrival and stamp of a message of little delay, and the speed, after a message; None if that is too early."""
        received = self._received
        first, third = received[0], (arrival - received[0][0]) // 3
        if third < SHORTEST:
            return None
        speed = (stamp - first[1]) / (arrival - first[0])

        def lead(each: tuple[int, int]) -> float:
            return (each[1] - stamp) - speed * (each[0] - arrival)

        old = max((each for each in received if each[0] <= first[0] + third), key=lead)
        new = max((each for each in received if each[0] >= arrival - third), key=lead)
        return (*new, (new[1] - old[1]) / (new[0] - old[0]))

    @property
    def stands(self) -> bool:
        """Whether no later time has come for so long that the simulation is paused, or it has not caught up yet."""
        with self._lock:
            monotonic = time.monotonic_ns()
            return self.is_running and (monotonic > self._line[3] or self.at(monotonic) < self._last)

    def at(self, monotonic: int) -> int:
        """Time of the simulation at a time of the monotonic clock, ns; it stands where no later time has come."""
        arrival, stamp, speed, until = self._line
        end = min(monotonic, until) if self.is_running else monotonic
        return stamp + round(speed * (end - arrival))

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
        """How long a duration of the simulation (s) takes by the machine's clock, LOOK at most, s."""
        speed = self._line[2]
        return min(duration / speed, LOOK) if speed > 0.0 else LOOK


def clock_of(robot: Robot, transport: Transport) -> Timebase:
    """The clock that a robot file names."""
    return MachineClock() if robot.clock is None else TopicClock(transport, robot.clock.topic)
