"""`trials.jsonl`: one line for each trial, on disk before the next one is looked at."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from kraft.errors import Code, Diagnostic, InputError
from kraft.evaluation.row import Key, TrialRow
from kraft.files import EXPECTED

NAME: Final = "trials.jsonl"


@dataclass(frozen=True)
class JournalContent:
    """What a journal holds: the rows, how many bytes of it are whole lines, and how many the torn end has."""

    rows: dict[Key, TrialRow]
    whole: int
    torn: int


def read_journal(path: Path, expected: Collection[Key] | None = None) -> JournalContent:
    """Read a journal.  The last line may be torn by a crash; it does not count.

    A failed trial may come again, after it was repeated; the last line of a trial holds.

    Args:
        path: the file; one that does not exist is an empty journal.
        expected: the trials that may be in it; None allows all.

    Raises:
        InputError: with every line that is not a trial, not an expected one, or there twice.
    """
    try:
        content = path.read_bytes() if path.exists() else b""
    except OSError as error:
        problem = f"cannot be read: {error.strerror}"
        raise InputError.of(str(path), problem, "expected the lines of trials", Code.UNREADABLE) from None
    whole = content.rfind(b"\n") + 1
    rows: dict[Key, TrialRow] = {}
    problems = []
    for number, line in enumerate(content[:whole].splitlines(), start=1):
        try:
            row = TrialRow.model_validate_json(line)
        except ValidationError:
            expected_line = "expected it repaired or removed"
            problems.append(Diagnostic(str(path), "is not a trial", expected_line, number, 1, code=Code.SYNTAX))
            continue
        name = f"{row.scenario}, {row.method}, seed {row.seed}"
        if expected is not None and row.key not in expected:
            problem = f"{name} is not a trial of this evaluation"
            problems.append(Diagnostic(str(path), problem, "expected it removed", number, 1, code=Code.MISMATCH))
        if row.key in rows and rows[row.key].outcome != "failed":
            problem = f"{name} is there twice"
            problems.append(Diagnostic(str(path), problem, "expected it once", number, 1, code=Code.DUPLICATE))
        rows[row.key] = row
    if problems:
        raise InputError(problems)
    return JournalContent(rows, whole, len(content) - whole)


class Journal:
    """Appends to a journal that nobody else appends to; to be closed."""

    def __init__(self, path: Path, keep: int = 0) -> None:
        """Open `path` and cut it to its first `keep` bytes.

        Raises:
            InputError: if it cannot be written, or another process writes it.
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
            expected = "expected that one to end first"
            raise InputError.of(str(path), "another kraft eval writes it", expected, Code.CONFLICT) from None
        except OSError as error:
            os.close(self._file)
            raise self._problem(error) from error

    def append(self, row: TrialRow) -> None:
        """Write a line and wait until it is on the disk.

        Raises:
            InputError: if there is no room; what was written before stays.
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
        """Close the file, and let others write it."""
        os.close(self._file)

    def _truncate(self) -> None:
        with suppress(OSError):  # then the line stays torn, which reading allows for
            os.ftruncate(self._file, self._end)

    def _problem(self, error: OSError) -> InputError:
        return InputError.of(str(self.path), f"cannot be written: {error.strerror}", EXPECTED, Code.UNWRITABLE)
