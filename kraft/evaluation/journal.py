"""`trials.jsonl` and its rows: one line for each finished trial, on the disk before the next result is handled.

`replays.jsonl` beside it has the replays of the trials, a line for each.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Final, Literal, Self, TypeAlias

import numpy as np
from pydantic import Field, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from kraft.errors import Code, Diagnostic, InputError
from kraft.evaluation.replay import Replay
from kraft.files import LineFile, unwritable
from kraft.text import finite
from kraft.trial.cause import Cause
from kraft.trial.measures import Amount, Count, Measures, Record
from kraft.trial.result import TrialResult

Key: TypeAlias = tuple[str, str, int]
"""Entry, method and seed; the entry of a plain scenario has the scenario's name."""
OUTCOMES: Final = ("success", "collision", "timeout", "failed")
"""Outcomes of a row, in the order of their numbers in `benchmark.log`; the last one is that of a failed trial."""
OWN_CODE_ERROR: Final = "error in own code"
DEFECT: Final = "defect in kraft"
"""Causes of a failed trial, which ended by an error instead of an outcome."""


def reason_of_failures(failed: int, defects: int) -> str:
    """Why trials have failed, as a relative clause; `defects` of the `failed` ones failed by a defect in kraft."""
    own = "because of an error in the user's own code"
    if defects == 0:
        return own
    defect = "which is a defect in kraft"
    return defect if defects == failed else f"{failed - defects} {own}, and {defects} by a defect in kraft"


class Measured(Record):
    """Measured times, the only part of a row that differs between repetitions.

    `planning_ms` has one value per cycle, `missed` is the number of cycles that exceeded their planning time.
    `command_us` has one value per command of the controller, `late_commands` is the number of those that took longer
    than the time between two; older evaluations have none.  `wall_s` is the duration of the whole trial,
    `elapsed_s` the time for which the evaluation had run when it ended; 0 in older evaluations.
    """

    planning_ms: tuple[Amount, ...] = ()
    missed: Count = 0
    command_us: tuple[Count, ...] = ()
    late_commands: Count = 0
    wall_s: Amount = 0.0
    elapsed_s: Amount = 0.0


class TrialRow(Record):
    """Data of a trial that the tables need.

    Attributes:
        entry: name of the entry of the evaluation; empty in rows of older evaluations, where it is the scenario's.
        t_s: time of its end, s; None if it failed.
        obstacle: obstacle of the collision.
        min_clearance_m: smallest true distance to an obstacle; None without obstacles.
        iterations: planning iterations of all cycles.
        digest: hash over all ticks, equal for equal drives.
        error: why the trial failed, which means that it ended with an error instead of an outcome.
        own_code: whether the error is one of the user's own code, and not a defect in kraft.
        cause: cause of a collision or a timeout; None in rows of older evaluations.
        replay: replay on its way from the worker to the journal, which writes it into its own file.
    """

    entry: str = ""
    scenario: str
    method: str
    seed: int
    outcome: Literal["success", "collision", "timeout", "failed"]
    t_s: Amount | None = None
    obstacle: str | None = None
    min_clearance_m: float | None = None
    cycles: Count = 0
    contingencies: Count = 0
    iterations: Count = 0
    digest: str | None = None
    error: str | None = None
    own_code: bool = False
    cause: Cause | None = None
    measures: Measures = Measures()
    measured: Measured = Measured()
    replay: Replay | None = Field(default=None, exclude=True, repr=False)

    @model_validator(mode="after")
    def _check_time(self) -> Self:
        if self.t_s is None and self.outcome != "failed":
            raise PydanticCustomError("time", "a {outcome} without a time t_s", {"outcome": self.outcome})
        return self

    @property
    def key(self) -> Key:
        """Entry, method and seed."""
        return self.entry or self.scenario, self.method, self.seed

    @property
    def is_defect(self) -> bool:
        """Whether the trial failed because of a defect in kraft."""
        return self.outcome == "failed" and not self.own_code

    @property
    def why(self) -> tuple[str, str] | None:
        """Cause of a trial that did not succeed, and its explanation; None where no cause was recorded."""
        if self.outcome == "failed":
            return DEFECT if self.is_defect else OWN_CODE_ERROR, self.error or ""
        return None if self.cause is None else (str(self.cause.kind), self.cause.text)

    @property
    def success_time(self) -> float | None:
        """Duration of a successful trial, s; None for the others."""
        return self.t_s if self.outcome == "success" else None

    def after(self, seconds: float) -> TrialRow:
        """The same row of a trial that ended when the evaluation had run for so long, s."""
        measured = self.measured.model_copy(update={"elapsed_s": round(seconds, 3)})
        return self.model_copy(update={"measured": measured})


def elapsed(rows: Iterable[TrialRow]) -> float:
    """Time for which an evaluation had run when the last of these trials ended, s; 0 in older evaluations."""
    return max((row.measured.elapsed_s for row in rows), default=0.0)


def trial_row(key: Key, result: TrialResult, wall: float, replay: Replay | None = None) -> TrialRow:
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
        cause=result.cause,
        replay=replay,
        measures=result.measures,
        measured=Measured(
            planning_ms=planning,
            missed=result.missed,
            command_us=tuple(round(1000.0 * each) for each in result.command_ms),
            late_commands=result.late_commands,
            wall_s=round(wall, 3),
        ),
    )


def success_times(rows: Iterable[TrialRow]) -> list[float]:
    """Durations of the successful trials, s."""
    return [time for row in rows if (time := row.success_time) is not None]


def digest(result: TrialResult) -> str:
    """Hash over true state, estimated state and command at every tick."""
    numbers = [
        [step.time, *step.pose, step.speed, *step.estimate.tolist(), *step.command.tolist(), step.cycle]
        for step in result.steps
    ]
    return hashlib.sha256(np.array(numbers, dtype=float).tobytes()).hexdigest()[:16]


NAME: Final = "trials.jsonl"
REPLAYS: Final = "replays.jsonl"


def read_journal(path: Path, expected: Collection[Key] | None = None) -> dict[Key, TrialRow]:
    """Read the rows of a journal.  A last line that a crash cut off is ignored.

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
        except ValidationError as error:
            problems.append(_line_problem(path, number, f"is not a trial ({_reason(error)})", Code.SYNTAX))
            continue
        name = f"{', '.join(row.key[:2])}, seed {row.seed}"
        if expected is not None and row.key not in expected:
            problems.append(_line_problem(path, number, f"{name} is not a trial of this evaluation", Code.MISMATCH))
        if row.key in rows and rows[row.key].outcome != "failed":
            problems.append(_line_problem(path, number, f"{name} is a duplicate", Code.DUPLICATE))
        rows[row.key] = row
    if problems:
        raise InputError(problems)
    return rows


def _reason(error: ValidationError) -> str:
    """What is wrong with a row first, and at which key."""
    first = error.errors(include_url=False)[0]
    text = f"{first['msg'][:1].lower()}{first['msg'][1:]}"
    return ": ".join([".".join(map(str, first["loc"])), text] if first["loc"] else [text])


def _line_problem(path: Path, line: int, problem: str, code: Code) -> Diagnostic:
    return Diagnostic(str(path), problem, "expected the line repaired or removed", line, 1, code=code)


class Journal:
    """Open journal that one process appends to, with the file of the replays."""

    def __init__(self, path: Path) -> None:
        """Open and lock `path`; replays are in the same folder.  A last line that a crash cut off is removed.

        Raises:
            InputError: if a file cannot be written, or another process has it open.
        """
        self.path = path
        self._trials = _Lines(path)
        self.was_cut: Final = self._trials.was_cut
        """whether its last line was incomplete"""
        try:
            self._replays = _Lines(path.with_name(REPLAYS))
        except InputError:
            self._trials.close()
            raise

    def append(self, row: TrialRow) -> None:
        """Write a line, after that of the replay, and wait until it is on the disk.

        Raises:
            InputError: if a line cannot be written; the earlier lines stay.
        """
        if row.replay is not None:
            entry, method, seed = row.key
            names = {"entry": entry, "method": method, "seed": seed}
            replay = {"drive": row.replay.drive, "trees": row.replay.trees}
            self._replays.append(json.dumps({**names, **replay}, ensure_ascii=False).encode())
        self._trials.append(row.model_dump_json().encode())

    def close(self) -> None:
        """Close and unlock the files."""
        self._trials.close()
        self._replays.close()


class _Lines:
    """Open and locked file of lines, which continues after the complete ones that are there."""

    def __init__(self, path: Path) -> None:
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise unwritable(path, error) from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # with the lock: before, another process may still append lines
            end = complete_bytes(path)
            self.was_cut = os.fstat(file).st_size > end
            os.ftruncate(file, end)
            os.lseek(file, end, os.SEEK_SET)
        except BlockingIOError:
            os.close(file)
            expected = "expected the other one to end first"
            raise InputError.of(str(path), "is in use by another kraft eval", expected, Code.CONFLICT) from None
        except OSError as error:
            os.close(file)
            raise unwritable(path, error) from error
        self._file = LineFile(path, file, end)

    def append(self, line: bytes) -> None:
        self._file.append(line, sync=True)

    def close(self) -> None:
        self._file.close()


def complete_bytes(path: Path) -> int:
    """Number of bytes of a file's complete lines; 0 if there is no such file.

    Raises:
        InputError: if it cannot be read.
    """
    try:
        with path.open("rb") as file:
            end = file.seek(0, os.SEEK_END)
            while end > 0:
                begin = max(0, end - 65536)
                file.seek(begin)
                if (found := file.read(end - begin).rfind(b"\n")) >= 0:
                    return begin + found + 1
                end = begin
    except FileNotFoundError:
        return 0
    except OSError as error:
        raise _unreadable(path, error) from None
    return 0


class Replays:
    """Replays of a results folder, read when they are asked for."""

    def __init__(self, path: Path) -> None:
        """Find the lines of the file; a missing one has none, an incomplete last line is ignored.

        Raises:
            InputError: if it cannot be read, or with the first line that is not a replay.
        """
        self._path = path
        self._lines: dict[Key, tuple[int, int, int]] = {}  # where each begins and its length, bytes, and its number
        self._sizes: dict[Key, tuple[int, int]] = {}
        end, begin = complete_bytes(path), 0
        if not end:
            return
        try:
            with path.open("rb") as file:
                for number, line in enumerate(file, start=1):
                    if begin + len(line) > end:
                        break
                    key, replay = self._parsed(line, number)
                    self._lines[key] = begin, len(line), number
                    self._sizes[key] = len(replay.drive), len(replay.trees or "")
                    begin += len(line)
        except OSError as error:
            raise _unreadable(path, error) from None

    def __contains__(self, key: Key) -> bool:
        return key in self._lines

    def __len__(self) -> int:
        return len(self._lines)

    def sizes(self, key: Key) -> tuple[int, int]:
        """Lengths of the texts of the drive and of the trees."""
        return self._sizes[key]

    def read(self, key: Key) -> Replay:
        """Read a replay.

        Raises:
            InputError: if the file cannot be read any more, or its line is another one now.
        """
        begin, length, number = self._lines[key]
        try:
            with self._path.open("rb") as file:
                file.seek(begin)
                found, replay = self._parsed(file.read(length), number)
        except OSError as error:
            raise _unreadable(self._path, error) from None
        if found != key:
            problem = "is the replay of another trial now"
            raise InputError([_line_problem(self._path, number, problem, Code.SYNTAX)])
        return replay

    def _parsed(self, line: bytes, number: int) -> tuple[Key, Replay]:
        try:
            content = json.loads(line)
            key = str(content["entry"]), str(content["method"]), int(content["seed"])
            drive, trees = content["drive"], content["trees"]
            if not isinstance(drive, str) or not isinstance(trees, str | None):
                raise TypeError
        except (ValueError, KeyError, TypeError, OverflowError):
            raise InputError([_line_problem(self._path, number, "is not a replay", Code.SYNTAX)]) from None
        return key, Replay(drive, trees)


def _unreadable(path: Path, error: OSError) -> InputError:
    expected = "expected a file of lines"
    return InputError.of(str(path), f"cannot be read: {error.strerror}", expected, Code.UNREADABLE)
