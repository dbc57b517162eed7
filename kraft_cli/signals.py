"""Signals that end a command: each ends it as Ctrl-C does, with a word and an exit code of its own."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final, TypeAlias

from kraft_cli.exit_status import ExitStatus
from ompl_ext.signals import STOPPING

Handler: TypeAlias = Callable[[int], None]

ECHO: Final = 1.0
"""Time for which SIGTERM and SIGHUP are ignored after a signal, s: `timeout` and a closing terminal send them twice."""
AGAIN: Final = 0.05
"""Time after which a signal whose exception Python ignored is sent again, s; plus `ECHO` where that ignores it."""
WORDS: Final[dict[int, str]] = {
    signal.SIGINT: "interrupted",
    signal.SIGTERM: "terminated",
    signal.SIGHUP: "hung up",
}


class Stopped(KeyboardInterrupt):
    """Signal that ends the command, with its number."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def raise_stopped(number: int) -> None:
    """Raise `Stopped`."""
    raise Stopped(number)


def set_handler(handler: Handler) -> dict[int, Any]:
    """Handle the signals that end a command; a signal that is ignored, as SIGHUP with nohup, stays so.

    Returns:
        The earlier handlers; none outside the main thread, where this has no effect.
    """
    last = -math.inf

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal last
        now = time.monotonic()
        if number != signal.SIGINT and now - last < ECHO:
            return
        last = now
        if number == signal.SIGHUP:
            leave_lost_terminal()
        handler(number)

    before: dict[int, Any] = {}
    try:
        for number in STOPPING:
            if signal.getsignal(number) is not signal.SIG_IGN:
                before[number] = signal.signal(number, handle)
    except ValueError:  # not in the main thread, which alone handles signals
        pass
    return before


def repeat_ignored_signals() -> None:
    """Send a signal again whose exception Python ignored: one that arrived in a finalizer, or in a callback of a fork.

    Without that the command would go on as if nobody had interrupted it.
    """
    others = sys.unraisablehook

    def hook(event: sys.UnraisableHookArgs) -> None:
        if not isinstance(event.exc_value, KeyboardInterrupt):
            others(event)
            return
        number = _number(event.exc_value)
        after = AGAIN if number == signal.SIGINT else ECHO + AGAIN
        threading.Timer(after, os.kill, (os.getpid(), number)).start()

    sys.unraisablehook = hook


@contextmanager
def handled(handler: Handler) -> Iterator[None]:
    """Handle the signals that end a command within the block; see `set_handler`."""
    before = set_handler(handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def word_of(error: KeyboardInterrupt) -> str:
    """What has happened to the command."""
    return WORDS[_number(error)]


def status_of(error: KeyboardInterrupt) -> ExitStatus:
    """Exit code of the command."""
    return ExitStatus(128 + _number(error))


def leave_lost_terminal() -> None:
    """Redirect stdout and stderr to the null device where their terminal was closed, as writing to it fails."""
    for stream in (1, 2):
        try:
            os.write(stream, b"")
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)


def _number(error: KeyboardInterrupt) -> int:
    return error.number if isinstance(error, Stopped) else signal.SIGINT
