"""What a drive tells of a controller of the user's own whose commands do not return or take too long."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from typing import Any, Final

from kraft.driving.control_settings import UserCode
from kraft.robot.planner_thread import PlannerThread
from kraft.robot.protocol import DriveSpec, Status

HANGS: Final = 2.0
"""Time at work on one message after which a command of the user's is named, s."""
SILENT: Final = 3.0
"""Time without a report of the controller, which makes one every second, after which it is ended, s."""
SHARE: Final = 0.5
"""Largest share of a tick, and in predictions of a cycle, that commands may take without a warning."""


class OwnCodeWatch:
    """Names a command that does not return, and ends a controller that one holds up: the brake guard drives then.

    Nothing of other controllers is watched.  `measures` is what to tell of the commands, `killed` why the controller
    was ended, empty if it was not.
    """

    def __init__(
        self, spec: DriveSpec, thread: PlannerThread, process: BaseProcess, on_status: Callable[[Status], None]
    ) -> None:
        self._spec, self._thread, self._process, self._on_status = spec, thread, process, on_status
        self._own = spec.method.controller if isinstance(spec.method.controller, UserCode) else None
        self.has_begun, self._is_reported, self._time, self._last_message = False, False, 0.0, 0.0
        self.measures: dict[str, float] = {}
        self.killed = ""

    def begin(self, command_seconds: float) -> None:
        """Watch the controller too from now on; warn of commands that are too slow."""
        self.has_begun, self._last_message = True, time.monotonic()
        if self._own is None:
            return
        self.measures = {"own_command_ms": 1000.0 * command_seconds}
        period, cycle = self._spec.period, self._spec.method.planner.cycle
        count = math.ceil(cycle / period)
        if command_seconds > SHARE * period or count * command_seconds > SHARE * cycle:
            self._note(
                f"warning: a command of {self._own.code} takes {1000 * command_seconds:.0f} ms, and one is due every "
                f"{1000 * period:.0f} ms; the prediction of a cycle of {cycle:g} s asks for {count} more, which take "
                f"{count * command_seconds:.1f} s"
            )

    def note_message(self, message: Any) -> None:
        """Note that the controller has sent a message."""
        self._last_message = time.monotonic()
        if isinstance(message, Status):
            self._time = message.time

    def look(self) -> None:
        """Tell once what does not return."""
        if self._own is None:
            return
        busy = self._thread.busy
        if busy < HANGS:
            self._is_reported = False
        elif not self._is_reported and (place := self._thread.place(self._own)):
            self._is_reported = True
            then = "; without decisions the vehicle stops with its contingency" if self.has_begun else ""
            self._note(
                f"the planner has waited for {busy:.1f} s for commands of {self._own.code}, now at {place}{then}"
            )
        silence = time.monotonic() - self._last_message
        is_silent = self.has_begun and silence > SILENT and self._spec.robot.clock is None  # which may be paused
        if is_silent and not self.killed:
            self.killed = f"a command of {self._own.code} has not returned, and the brake guard stops the vehicle"
            self._note(f"the controller has not reported for {silence:.1f} s: {self.killed}")
            self._process.kill()  # the guard drives already, and ends when the vehicle stands

    def _note(self, text: str) -> None:
        self._on_status(Status(self._time, math.nan, 0, 0, text))
