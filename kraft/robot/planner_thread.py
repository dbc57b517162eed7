"""The planner of a drive in a thread of its own: its process goes on if a command of a user's controller never ends."""

from __future__ import annotations

import queue
import sys
import threading
import time
import traceback
from collections.abc import Callable
from multiprocessing import Pipe
from typing import Any

from kraft.config.user_code import place_of
from kraft.driving.control.user_controller import user_class
from kraft.driving.control_settings import ControllerSettings, UserCode


class PlannerThread:
    """Calls functions one after the other; `ready` can be waited for, and is readable when a result can be taken."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[Callable[[], Any]] = queue.SimpleQueue()
        self.ready, self._done = Pipe(duplex=False)
        self._results: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._since: float | None = None
        self._thread = threading.Thread(target=self._work, name="planner", daemon=True)
        self._thread.start()

    def call(self, function: Callable[[], Any]) -> None:
        """Call a function after those that were handed over before."""
        self._calls.put(function)

    def result(self) -> Any:
        """The next result, or the exception that was raised instead."""
        self.ready.recv_bytes()
        return self._results.get()

    @property
    def busy(self) -> float:
        """Time for which the present function has worked, s; 0 if none does."""
        since = self._since
        return 0.0 if since is None else time.monotonic() - since

    def place(self, settings: ControllerSettings) -> str:
        """``FILE:LINE`` of the user's controller where the thread is; empty if it is not there."""
        return place_in_code(settings, self._thread.ident)

    def _work(self) -> None:
        while True:
            call = self._calls.get()
            self._since = time.monotonic()
            try:
                result = call()
            except BaseException as error:  # the other thread raises it
                result = error
            self._since = None
            self._results.put(result)
            self._done.send_bytes(b"1")


def place_in_code(settings: ControllerSettings, thread: int | None) -> str:
    """``FILE:LINE`` in the file of a user's controller at which a thread is now; empty if it is not there."""
    frame = None if thread is None else sys._current_frames().get(thread)
    if not isinstance(settings, UserCode) or frame is None:
        return ""
    file = place_of(sys.modules[user_class(settings).__module__])
    lines = [each.lineno for each in traceback.extract_stack(frame) if each.filename == file]
    return f"{file}:{lines[-1]}" if lines else ""
