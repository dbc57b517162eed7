"""Resuming a recording: the runs that its folder has, and whether they are those of the same recording."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from kraft.errors import Code, Diagnostic, InputError, Problems
from kraft.provenance import difference_text, differences
from kraft.recording.manoeuvres import Manoeuvre
from kraft.recording.recorder import FILES, KEYS, NEW_KEYS, SCHEMA

_RUN: Final = re.compile(r"run_(\d{2,})")
_PART: Final = re.compile(r"\.run_\d{2,}\..*\.part")
COUNTED: Final = ("commands", "poses")
"""Keys of a manifest that state the number of rows of a file of that name."""
OTHER: Final = "expected no change, or another folder"


@dataclass(frozen=True)
class FinishedRun:
    """Run that a folder has: its number, its own folder, and its manifest."""

    number: int
    folder: Path
    manifest: Mapping[str, Any]

    @property
    def manifest_file(self) -> str:
        """Path of the manifest."""
        return str(self.folder / "manifest.json")


def finished_runs(folder: Path) -> dict[int, FinishedRun]:
    """Runs in a folder by their number.  A run appears in it whole; what a kill left of another one does not count.

    Raises:
        InputError: if there is no such folder, or it has other files and no run; with every run that is damaged.
    """
    expected = "expected the folder of an interrupted kraft record"
    if not folder.is_dir():
        raise InputError.of(str(folder), "there is no such folder", expected, Code.NOT_FOUND)
    runs: dict[int, FinishedRun] = {}
    problems: list[Diagnostic] = []
    for each in sorted(folder.iterdir()):
        name = _RUN.fullmatch(each.name)
        if name is None or each.name != f"run_{int(name[1]):02d}":
            continue
        try:
            runs[int(name[1])] = FinishedRun(int(name[1]), each, _manifest(each, int(name[1])))
        except InputError as error:
            problems += error.diagnostics
    if problems:
        raise InputError(problems)
    others = sorted(each.name for each in folder.iterdir() if not _PART.fullmatch(each.name))
    if others and not runs:
        raise InputError.of(str(folder), f"has no run, but other files, such as {others[0]}", expected, Code.MISMATCH)
    return runs


def check_same_recording(finished: Iterable[FinishedRun], described: Mapping[str, Any], runs: int) -> None:
    """Check that runs are those of one recording of so many `runs`, or the first ones of one that had fewer.

    `described` are the keys that all its manifests have.

    Raises:
        InputError: with every difference, at the first run that has it; one for all runs if `runs` is too small.
    """
    finished = tuple(finished)
    now = json.loads(json.dumps(dict(described)))
    found: dict[tuple[str, str], Diagnostic] = {}
    last = max((run.number for run in finished), default=0)
    stated = [number for run in finished if isinstance(number := run.manifest["arguments"].get("runs"), int)]
    # a folder that states `runs` itself has a run of another recording; files of commands are as many as the runs
    too_few = runs < min(last, max(stated, default=0)) and "commands" not in now["arguments"]
    if too_few:
        problem, expected = (
            f"is {runs}, the folder has runs up to {last}",
            f"expected {last} or more: runs are kept",
        )
        found["runs", problem] = Diagnostic("runs", problem, expected, code=Code.MISMATCH, argument=True)
    for run in finished:
        for path, problem in _differences(run, now):
            if not (too_few and path == "arguments.runs"):
                difference = Diagnostic(run.manifest_file, problem, OTHER, path=path, code=Code.MISMATCH)
                found.setdefault((path, problem), difference)
        if run.number > runs and not too_few:
            problem, expected = f"is run {run.number} of {runs}", "expected the folder removed, or another folder"
            found[str(run.folder), problem] = Diagnostic(str(run.folder), problem, expected, code=Code.MISMATCH)
    if found:
        raise InputError(found.values())


def _differences(run: FinishedRun, now: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Key and text of each difference of a manifest; of its arguments alone, if they are others."""
    was = {key: value for key, value in run.manifest.items() if key in now}
    now = {key: value for key, value in now.items() if key in was}  # an older run does not state all
    if _is_continued(was["arguments"], now["arguments"]):
        was = {**was, "arguments": {**was["arguments"], "runs": now["arguments"]["runs"]}}
    given = list(differences(was["arguments"], now["arguments"], ("arguments",)))
    for keys, before, after in given or differences(was, now):
        yield ".".join(keys), difference_text(before, after)


def _is_continued(was: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether there are more runs now, of which those that there were are the first ones, the same bit by bit.

    A random run and a planned drive depend on their number and on those before them alone; files of commands are as
    many as the runs.
    """
    before, after = was.get("runs"), now["runs"]
    return isinstance(before, int) and before < after and not {"commands"} & {*was, *now}


def check_same_commands(run: FinishedRun, manoeuvre: Manoeuvre) -> None:
    """Check that a run was driven with the commands of a manoeuvre, as far as it came.

    Raises:
        InputError: at the first line that has other commands.
    """
    file = run.folder / "commands.csv"
    expected = "expected the same model or the same commands as before, or another folder"
    try:
        rows = list(csv.reader(file.read_text(encoding="utf-8").splitlines()))[1:]
        for number, row in enumerate(rows, start=2):
            time, *control = map(float, row)
            if control != manoeuvre.control_at(time).tolist():
                problem = "has a command that is another one now"
                raise InputError([Diagnostic(str(file), problem, expected, number, 1, code=Code.MISMATCH)])
    except (OSError, ValueError) as error:
        raise InputError.of(str(file), f"is damaged: {error}", "expected the folder removed", Code.SYNTAX) from None


def remove_unfinished(folder: Path) -> None:
    """Remove what a kill left of runs that were being written.

    Raises:
        InputError: if it cannot be removed.
    """
    for each in folder.iterdir():
        if not _PART.fullmatch(each.name):
            continue
        try:
            shutil.rmtree(each)
        except OSError as error:
            problem, expected = f"cannot be removed: {error.strerror}", "expected a folder whose files can be replaced"
            raise InputError.of(str(each), problem, expected, Code.UNWRITABLE) from error


def _manifest(folder: Path, number: int) -> dict[str, Any]:
    """Manifest of a run.

    Raises:
        InputError: if it is missing or damaged, another file of the run is missing, or the run has other numbers of
            commands or poses than it says.
    """
    expected = "expected the folder removed; its run is then driven again"
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise InputError.of(str(folder), f"lacks {', '.join(missing)}", expected, Code.MISSING)
    path = folder / "manifest.json"
    try:
        content = json.loads(path.read_bytes().decode("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError.of(str(path), f"is damaged: {error}", expected, Code.SYNTAX) from None
    if not isinstance(content, dict) or content.get("schema") != SCHEMA or not content.keys() >= set(KEYS) - NEW_KEYS:
        raise InputError.of(str(path), "is no manifest of kraft record", expected, Code.SYNTAX)
    if content["run"] != number or not isinstance(content["arguments"], dict):
        raise InputError.of(str(path), f"is not that of run {number}", expected, Code.MISMATCH)
    problems = Problems()
    for counted in COUNTED:
        problems.of(partial(_check_rows, folder / f"{counted}.csv", content[counted], expected))
    problems.check()
    return content


def _check_rows(path: Path, stated: object, expected: str) -> None:
    """Check that a file has as many rows below its heading as the manifest says.

    Raises:
        InputError: if it has another number of rows, or cannot be read.
    """
    try:
        rows = max(0, len(path.read_bytes().splitlines()) - 1)
    except OSError as error:
        raise InputError.of(str(path), f"is damaged: {error}", expected, Code.SYNTAX) from None
    if rows != stated:
        raise InputError.of(str(path), f"has {rows} rows, not {stated} as its manifest says", expected, Code.MISMATCH)
