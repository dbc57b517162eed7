"""Logs that several files of tests read, recorded once for all worker processes."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import numpy as np
import pytest

from kraft_cli.main import main

RUNS, SEED = 8, 1
IDENTIFY = ("sysid", "logs", "--model", "mushr-lag", "--extras", "none")
FOUR = tuple(f"logs/run_{k:02d}" for k in (2, 3, 4, 5))
"""Logs where eight would show nothing more."""


def recorded_logs(factory: pytest.TempPathFactory) -> Path:
    """Folder of `kraft record --runs 8 --seed 1`, not to be written to; the first process to ask for it records it."""
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # which all workers share
    folder, unfinished = base / "recorded" / "logs", base / "unfinished"
    with (base / "recorded.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            arguments = ["record", "--out", str(unfinished), "--runs", str(RUNS), "--seed", str(SEED), "-q"]
            assert main(arguments) == 0
            folder.parent.mkdir()
            unfinished.rename(folder)
    return folder


def weaken(run: Path, factor: float) -> None:
    """Scale the throttle of a log, as if it were of a car that drives faster with less of it."""
    heading, *rows = (run / "commands.csv").read_text().splitlines()
    commands = np.loadtxt(rows, delimiter=",") * [1.0, factor, 1.0]
    np.savetxt(run / "commands.csv", commands, fmt="%.9g", delimiter=",", header=heading, comments="")


def contents(path: Path) -> dict[str, bytes]:
    """Bytes of every file in a folder, by its path in it."""
    return {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}
