"""Ctrl-C while numba compiles: recorded, and raised between two passes of the compiler.

LLVM calls back into Python while it compiles and while it loads (llvmlite's object cache).  An exception raised in such
a callback, `KeyboardInterrupt` included, is printed and lost.  Between two passes it is safe to raise; the longest pass
over the planner's kernels takes about 2 s.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from numba.core import event

_event: Any = event  # numba has no types


class _PendingInterrupt(event.Listener):
    """Record of an interrupt, raised when the next pass begins."""

    def __init__(self) -> None:
        self._pending = False

    def handle_signal(self, _: int, __: FrameType | None) -> None:
        """Record the interrupt (signal handler)."""
        self._pending = True

    def raise_pending(self) -> None:
        """Raise the interrupt if there was one."""
        if self._pending:
            self._pending = False
            raise KeyboardInterrupt

    def on_start(self, event: object) -> None:
        """Raise at the begin of a pass (called by numba)."""
        self.raise_pending()

    def on_end(self, event: object) -> None:
        """Do nothing at the end of a pass (called by numba): an exception of the pass must not be replaced."""


@contextmanager
def interrupts_between_passes() -> Iterator[Callable[[], None]]:
    """Context for compilation: interrupts are raised between passes of numba, by the yielded function, or at the end.

    It has no effect outside the main thread, where signals are ignored, and within another such context, which then
    raises them.
    """
    before = signal.getsignal(signal.SIGINT)
    nested = isinstance(getattr(before, "__self__", None), _PendingInterrupt)
    if nested or before in (signal.SIG_IGN, None) or threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    pending = _PendingInterrupt()
    signal.signal(signal.SIGINT, pending.handle_signal)
    try:
        with _event.install_listener("numba:run_pass", pending):
            yield pending.raise_pending
    finally:
        signal.signal(signal.SIGINT, before)
        pending.raise_pending()
