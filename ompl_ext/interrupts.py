"""Ctrl-C while numba compiles: recorded, and raised where nothing can swallow it.

LLVM calls back into Python while it compiles and while it loads (llvmlite's object cache).  What is raised in there,
a `KeyboardInterrupt` too, is printed and lost.  Between two passes of the compiler it is safe to raise; the longest
pass over the planner's kernels takes about 2 s.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from numba.core import event

_event: Any = event  # its functions are not typed


class _PendingInterrupt(event.Listener):
    """Remembers that there was an interrupt; raises it when the next pass begins."""

    def __init__(self) -> None:
        self._pending = False

    def handle_signal(self, _: int, __: FrameType | None) -> None:
        """As a signal handler."""
        self._pending = True

    def raise_pending(self) -> None:
        """Raise the interrupt if there was one."""
        if self._pending:
            self._pending = False
            raise KeyboardInterrupt

    def on_start(self, event: object) -> None:
        """For numba: a pass begins."""
        self.raise_pending()

    def on_end(self, event: object) -> None:
        """For numba: a pass is over, and something may be on its way up that must not be replaced."""


@contextmanager
def interrupts_between_passes() -> Iterator[Callable[[], None]]:
    """Compile in here: interrupts are raised between two passes of numba, by the yielded function, or at the end.

    Does nothing where interrupts do not arrive as exceptions: in another thread than the main one, where they are
    ignored, or within another such block, which then raises them.
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
