"""A log in one wide table, with some of its columns changed: what reading makes of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kraft.errors import InputError
from kraft.logs.log import Finding, Log
from kraft.logs.reader import read_logs
from support.logs import drive, located, wide_columns, write_wide

MADE = drive()
TIMES = np.arange(0.025, 5.9, 0.025)
WIDE = wide_columns(TIMES, MADE)
N = len(TIMES)
ROW = np.arange(N)


def read(tmp_path: Path, **changed: np.ndarray) -> Log:
    (log,) = read_logs(write_wide(tmp_path / "a.csv", changed)).logs
    return log


def refused(tmp_path: Path, **changed: np.ndarray) -> tuple[list[str], str]:
    """Place and code of each problem, and the whole message."""
    with pytest.raises(InputError) as error:
        read_logs(write_wide(tmp_path / "a.csv", changed))
    return located(error.value.diagnostics, tmp_path), str(error.value)


def finding(log: Log, kind: str) -> Finding:
    (found,) = [f for f in log.findings if f.kind == kind]
    return found
