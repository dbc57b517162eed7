"""Ctrl-C and other signals while numba compiles: recorded, and handled between two passes of the compiler.

LLVM calls back into Python while it compiles and while it loads (llvmlite's object cache).  An exception raised in such
a callback, `KeyboardInterrupt` included, is printed and lost.  Between two passes it is safe to raise; the longest pass
over the planner's kernels takes about 2 s.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeAlias

from numba.core import event

from ompl_ext.signals import STOPPING

_event: Any = event  # numba has no types

Handler: TypeAlias = Callable[[int, FrameType | None], Any]


class _PendingSignal(event.Listener):
    """Record of a signal, passed to the earlier handler when the next pass begins."""

    def __init__(self, before: Mapping[int, Handler]) -> None:
        self._before = before
        self._pending = 0

    def record(self, number: int, _: FrameType | None) -> None:
        """Record a signal (signal handler)."""
        self._pending = number

    def handle(self) -> None:
        """Call the earlier handler if there was a signal; it may raise."""
        number, self._pending = self._pending, 0
        if number:
            self._before[number](number, None)

    def on_start(self, event: object) -> None:
        """Handle a signal at the beginning of a pass (called by numba)."""
        self.handle()

    def on_end(self, event: object) -> None:
        """Do nothing at the end of a pass (called by numba): an exception of the pass must not be replaced."""


@contextmanager
def interrupts_between_passes() -> Iterator[Callable[[], None]]:
    """Context for compilation: signals are handled between passes of numba, by the yielded function, or at the end.

    It concerns the signals of `STOPPING` that have a handler in Python, such as the one that raises KeyboardInterrupt.
    It has no effect outside the main thread, where signals are ignored, nor within another such context: that one goes
    on to handle them, and its function is yielded.
    """
    before: dict[int, Handler] = {
        number: handler for number in STOPPING if callable(handler := signal.getsignal(number))
    }
    if not before or threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    for handler in before.values():
        if isinstance(outer := getattr(handler, "__self__", None), _PendingSignal):
            yield outer.handle
            return
    pending = _PendingSignal(before)
    for number in before:
        signal.signal(number, pending.record)
    try:
        with _event.install_listener("numba:run_pass", pending):
            yield pending.handle
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        pending.handle()
