"""The database that Planner Arena reads, made from OMPL benchmark logs with OMPL's own tool."""

from __future__ import annotations

import io
import os
import sqlite3
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path

from kraft.atomic_file import EXPECTED
from kraft.errors import InputError


def make_database(database: Path, logs: Sequence[Path]) -> None:
    """Make a database of benchmark logs, in place of an earlier one.

    Raises:
        InputError: if it cannot be written.
    """
    from ompl import tools

    try:
        database.unlink(missing_ok=True)
        with silenced(), warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # OMPL's tool leaves its connections open
            tools.readBenchmarkLog(str(database), [str(log) for log in logs], False)
            tools.computeViews(str(database), False)
    except (OSError, sqlite3.OperationalError) as error:
        raise InputError.of(str(database), f"cannot be written: {error}", EXPECTED) from error


@contextmanager
def silenced() -> Iterator[None]:
    """Send what OMPL's tools print, from C++ and from Python, nowhere."""
    sys.stdout.flush()
    saved, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        with redirect_stdout(io.StringIO()):  # what Python holds back would come out later
            yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(nowhere)
