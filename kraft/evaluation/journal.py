"""`trials.jsonl` and its rows: one line for each finished trial, on the disk before the next result is handled."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np
from pydantic import ValidationError

from kraft.errors import Code, Diagnostic, InputError
from kraft.files import EXPECTED
from kraft.text import finite
from kraft.trial.measures import Measures, Record
from kraft.trial.result import TrialResult

Key: TypeAlias = tuple[str, str, int]
"""Entry, method and seed; the entry of a plain scenario has the scenario's name."""


class Measured(Record):
    """Measured times, the only part of a row that differs between repetitions.

    `planning_ms` has one value per cycle, `missed` is the number of cycles that exceeded their planning time, `wall_s`
    is the duration of the whole trial.
    """

    planning_ms: tuple[float, ...] = ()
    missed: int = 0
    wall_s: float = 0.0


class TrialRow(Record):
    """Data of a trial that the tables need.

    Attributes:
        entry: name of the entry of the evaluation; empty in rows of older evaluations, where it is the scenario's.
        t_s: time of its end, s; None if it failed.
        obstacle: obstacle of the collision.
        min_clearance_m: smallest true distance to an obstacle; None without obstacles.
        iterations: planning iterations of all cycles.
        digest: hash over all ticks, equal for equal drives.
        error: why the trial failed, which means that it ended with a defect instead of an outcome.
    """

    entry: str = ""
    scenario: str
    method: str
    seed: int
    outcome: Literal["success", "collision", "timeout", "failed"]
    t_s: float | None = None
    obstacle: str | None = None
    min_clearance_m: float | None = None
    cycles: int = 0
    contingencies: int = 0
    iterations: int = 0
    digest: str | None = None
    error: str | None = None
    measures: Measures = Measures()
    measured: Measured = Measured()

    @property
    def key(self) -> Key:
        """Entry, method and seed."""
        return self.entry or self.scenario, self.method, self.seed


def trial_row(key: Key, result: TrialResult, wall: float) -> TrialRow:
    """Row of a trial; `wall` is the duration of its computation (s)."""
    entry, method, seed = key
    planning = tuple(round(cycle.planning_ms, 3) for cycle in result.cycles)
    return TrialRow(
        entry=entry,
        scenario=result.scenario,
        method=method,
        seed=seed,
        outcome=result.outcome.value,
        t_s=float(result.time),
        obstacle=result.obstacle,
        min_clearance_m=finite(result.min_clearance),
        cycles=len(result.cycles),
        contingencies=result.contingencies,
        iterations=sum(cycle.iterations for cycle in result.cycles),
        digest=digest(result),
        measures=result.measures,
        measured=Measured(planning_ms=planning, missed=result.missed, wall_s=round(wall, 3)),
    )


def digest(result: TrialResult) -> str:
    """Hash over true state, estimated state and command at every tick."""
    found = hashlib.sha256()
    for step in result.steps:
        numbers = [step.time, *step.pose, step.speed, *step.estimate, *step.command, step.cycle]
        found.update(np.asarray(numbers, dtype=float).tobytes())
    return found.hexdigest()[:16]


NAME: Final = "trials.jsonl"


@dataclass(frozen=True)
class JournalContent:
    """Rows of a journal, the number of bytes of its complete lines and of an incomplete last line."""

    rows: dict[Key, TrialRow]
    complete_bytes: int
    incomplete_bytes: int


def read_journal(path: Path, expected: Collection[Key] | None = None) -> JournalContent:
    """Read a journal.  A last line that a crash cut off is ignored.

    A failed trial may occur again, after it was repeated; its last line is valid.

    Args:
        path: the file; a missing file is an empty journal.
        expected: the trials that may occur; None allows all.

    Raises:
        InputError: with every line that is not a trial, not an expected trial, or a duplicate.
    """
    try:
        content = path.read_bytes() if path.exists() else b""
    except OSError as error:
        problem = f"cannot be read: {error.strerror}"
        raise InputError.of(str(path), problem, "expected the lines of trials", Code.UNREADABLE) from None
    complete = content.rfind(b"\n") + 1
    rows: dict[Key, TrialRow] = {}
    problems = []
    for number, line in enumerate(content[:complete].splitlines(), start=1):
        try:
            row = TrialRow.model_validate_json(line)
        except ValidationError:
            problems.append(_line_problem(path, number, "is not a trial", Code.SYNTAX))
            continue
        name = f"{row.scenario}, {row.method}, seed {row.seed}"
        if expected is not None and row.key not in expected:
            problems.append(_line_problem(path, number, f"{name} is not a trial of this evaluation", Code.MISMATCH))
        if row.key in rows and rows[row.key].outcome != "failed":
            problems.append(_line_problem(path, number, f"{name} is a duplicate", Code.DUPLICATE))
        rows[row.key] = row
    if problems:
        raise InputError(problems)
    return JournalContent(rows, complete, len(content) - complete)


def _line_problem(path: Path, line: int, problem: str, code: Code) -> Diagnostic:
    return Diagnostic(str(path), problem, "expected the line repaired or removed", line, 1, code=code)


class Journal:
    """Open journal that one process appends to."""

    def __init__(self, path: Path, keep: int = 0) -> None:
        """Open and lock `path` and truncate it to its first `keep` bytes.

        Raises:
            InputError: if the file cannot be written, or another process has it open.
        """
        self.path, self._end = path, keep
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise self._problem(error) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.ftruncate(self._file, keep)
            os.lseek(self._file, keep, os.SEEK_SET)
        except BlockingIOError:
            os.close(self._file)
            expected = "expected the other one to end first"
            raise InputError.of(str(path), "is in use by another kraft eval", expected, Code.CONFLICT) from None
        except OSError as error:
            os.close(self._file)
            raise self._problem(error) from error

    def append(self, row: TrialRow) -> None:
        """Write a line and wait until it is on the disk.

        Raises:
            InputError: if the line cannot be written; the earlier lines stay.
        """
        line = row.model_dump_json().encode() + b"\n"
        try:
            left = memoryview(line)
            while left:
                left = left[os.write(self._file, left) :]
            os.fsync(self._file)
        except OSError as error:
            self._truncate()
            raise self._problem(error) from error
        self._end += len(line)

    def close(self) -> None:
        """Close and unlock the file."""
        os.close(self._file)

    def _truncate(self) -> None:
        with suppress(OSError):  # the line stays incomplete, which reading allows
            os.ftruncate(self._file, self._end)

    def _problem(self, error: OSError) -> InputError:
        return InputError.of(str(self.path), f"cannot be written: {error.strerror}", EXPECTED, Code.UNWRITABLE)
