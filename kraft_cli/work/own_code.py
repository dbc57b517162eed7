"""What `kraft run` tells while a command of the user's own controller does not return."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from kraft.driving.control_settings import ControllerSettings, UserCode
from kraft.robot.planner_thread import place_in_code
from kraft.text import MessageSink

INTERVAL: Final = 5.0
"""Time without a cycle after which, and again, it is told where the user's code is, s."""


@contextmanager
def reported_own_code(
    settings: ControllerSettings, report: MessageSink, interval: float = INTERVAL
) -> Iterator[Callable[[], None]]:
    """Context that reports where the user's code is while no cycle is decided; yields what each cycle calls."""
    if not isinstance(settings, UserCode):
        yield lambda: None
        return
    caller, ended, last = threading.get_ident(), threading.Event(), time.monotonic()

    def look() -> None:
        while not ended.wait(interval):
            since = time.monotonic() - last
            if since >= interval and (place := place_in_code(settings, caller)):
                report(f"  no cycle for {since:.0f} s: a command of the controller is at {place}")

    def cycle_decided() -> None:
        nonlocal last
        last = time.monotonic()

    thread = threading.Thread(target=look, name="own code", daemon=True)
    thread.start()
    try:
        yield cycle_decided
    finally:
        ended.set()
        thread.join()
