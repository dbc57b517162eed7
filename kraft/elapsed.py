"""How long something takes that tells nothing itself, reported while it goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from kraft.text import MessageSink

INTERVAL: Final = 5.0
"""Time between two messages, s."""
LOADING: Final = "loading and checking"
LOADING_INTERVAL: Final = 3.0
"""Time between two messages about modules that are loaded, s: few starts after the first one take as long."""


@contextmanager
def elapsed_time(log: MessageSink, what: str | Callable[[], str], *, interval: float | None = None) -> Iterator[None]:
    """Context that reports every `interval` s, `INTERVAL` by default, how long it has lasted, and `what` goes on in it.

    A thread of its own reports: neither a compilation nor an import returns before it ends.
    """
    ended, began, wait = threading.Event(), time.monotonic(), INTERVAL if interval is None else interval

    def report() -> None:
        while not ended.wait(wait):
            log(f"  {time.monotonic() - began:.0f} s: {what if isinstance(what, str) else what()}")

    thread = threading.Thread(target=report, name="elapsed time", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def loading(log: MessageSink) -> Iterator[None]:
    """Context in which modules are loaded and files are checked, which is reported if it takes long."""
    with elapsed_time(log, LOADING, interval=LOADING_INTERVAL):
        yield
