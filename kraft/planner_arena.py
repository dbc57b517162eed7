"""The database that Planner Arena reads, made from OMPL benchmark logs with OMPL's own tool."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from kraft.errors import InputError
from kraft.files import EXPECTED


def make_database(database: Path, logs: Sequence[Path]) -> None:
    """Make a database of benchmark logs, in place of an earlier one.

    The tool runs in a process of its own: it prints, and leaves its connections to the database open.

    Raises:
        InputError: if it cannot be written; what was there before is still there then.
    """
    part = database.with_name(f".{database.name}.part")
    command = [sys.executable, "-P", "-m", "ompl.ompl_benchmark_statistics", "--database", str(part)]
    try:
        done = subprocess.run([*command, *map(str, logs)], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            reason = done.stderr.strip().splitlines()[-1:] or [f"OMPL's tool ended with {done.returncode}"]
            raise InputError.of(str(database), f"cannot be written: {reason[0]}", EXPECTED)
        os.replace(part, database)
    except OSError as error:
        raise InputError.of(str(database), f"cannot be written: {error.strerror}", EXPECTED) from error
    finally:
        part.unlink(missing_ok=True)
