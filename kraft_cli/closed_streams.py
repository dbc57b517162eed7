"""Standard streams that are closed when the process starts, as after ``2>&-`` or from some services."""

from __future__ import annotations

import os
import sys


def open_closed_streams() -> None:
    """Connect closed standard streams to the null device.

    Python has None for them. `print` to None prints to stdout: messages would be among the data. The next file that is
    opened would get the number of a closed stream, and libraries in C would print into it.
    """
    if sys.stdin is None:
        sys.stdin = os.fdopen(_null(0, os.O_RDONLY), "r", encoding="utf-8")
    if sys.stdout is None:
        sys.stdout = os.fdopen(_null(1, os.O_WRONLY), "w", encoding="utf-8")
    if sys.stderr is None:
        sys.stderr = os.fdopen(_null(2, os.O_WRONLY), "w", encoding="utf-8")


def _null(number: int, flags: int) -> int:
    """Open the null device as the stream with this number, which child processes inherit."""
    opened = os.open(os.devnull, flags)
    if opened != number:
        os.dup2(opened, number)  # inheritable
        os.close(opened)
    else:
        os.set_inheritable(number, True)
    return number
