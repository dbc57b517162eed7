"""Results folder of an evaluation: created, resumed on request, never overwritten."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from kraft.errors import Code, InputError
from kraft.evaluation import journal, report
from kraft.evaluation.experiment import Experiment
from kraft.evaluation.journal import Journal, Key, TrialRow, read_journal
from kraft.evaluation.manifest import MANIFEST, check_continues, grown_manifest, manifest_of, read_manifest
from kraft.evaluation.ompl_benchmark import benchmark_files, write_benchmark
from kraft.evaluation.report import CommandLine, Results
from kraft.evaluation.report.results import parts_of_manifest
from kraft.evaluation.summary import FILE as SUMMARY
from kraft.evaluation.summary import SCHEMA, Summary, evaluation_json, recorded_wall, wall_of
from kraft.files import check_new_folder, write_json, write_whole

ROOT: Final = Path("results")
NEW: Final = "expected a new folder, or to resume this one"


@dataclass
class Folder:
    """Open results folder.

    `rows` are its finished trials; `wall` is the time for which the evaluation has run, s; `incomplete_line` is whether
    the last line of the journal was cut off.
    """

    path: Path
    manifest: dict[str, Any]
    journal: Journal
    rows: dict[Key, TrialRow]
    wall: float = 0.0
    incomplete_line: bool = False


def default_path(seed: int, root: Path = ROOT) -> Path:
    """Default path of a results folder; no folder of this name exists yet."""
    name = f"eval-{datetime.now():%Y%m%d-%H%M%S}-seed{seed}"
    candidates = (root / (name if n == 1 else f"{name}-{n}") for n in range(1, 10_000))
    return next(path for path in candidates if not path.exists())


def create(path: Path, experiment: Experiment, arguments: Mapping[str, Any]) -> Folder:
    """Create the folder of a new evaluation.

    Raises:
        InputError: if the folder exists or cannot be written.
    """
    check_new_folder(path, NEW)
    try:
        path.mkdir(parents=True)
    except OSError as error:
        raise InputError.of(
            str(path), f"cannot be created: {error.strerror}", "expected a new folder", Code.UNWRITABLE
        ) from None
    return _new_folder(path, experiment, arguments)


def reopen(path: Path, experiment: Experiment, arguments: Mapping[str, Any]) -> Folder:
    """Open the folder of an evaluation, which may have more trials or methods now.

    Its failed trials are not among the finished ones.

    Raises:
        InputError: if the folder does not exist, is damaged or cannot be written; with every difference if it is of
            another evaluation.
    """
    if check_resumable(path, experiment, arguments) is None:
        return _new_folder(path, experiment, arguments)
    file = path / journal.NAME
    opened = Journal(file)  # first, so that no other process writes it any more
    try:
        was, now = read_manifest(path / MANIFEST), manifest_of(experiment, arguments)
        grown = check_continues(path / MANIFEST, was, now)  # again: another process may have replaced it
        rows = read_journal(file, {job.key for job in experiment.jobs()})
        finished = _finished(rows)
        wall = wall_of(recorded_wall(path), rows.values())
        if grown or len(finished) < len(rows):
            _remove_results(path, experiment)
        if grown:
            was = grown_manifest(was, now)
            write_json(path / MANIFEST, was)
    except BaseException:
        opened.close()
        raise
    return Folder(path, was, opened, finished, wall, opened.was_cut)


def _remove_results(path: Path, experiment: Experiment) -> None:
    """Remove what was written when all trials had ended, the summary first.

    A stop at any time, also between this and the new manifest, leaves the folder of an evaluation without a summary,
    which can be resumed.

    Raises:
        InputError: if a file cannot be removed.
    """
    for file in (path / SUMMARY, path / report.NAME, *benchmark_files(path, experiment)):
        try:
            file.unlink(missing_ok=True)
        except OSError as error:
            expected = "expected a folder whose files can be replaced"
            problem = f"cannot be removed: {error.strerror}"
            raise InputError.of(str(file), problem, expected, Code.UNWRITABLE) from error


def check_resumable(path: Path, experiment: Experiment, arguments: Mapping[str, Any]) -> dict[str, Any] | None:
    """Check that a folder is of this evaluation, or of one with fewer trials or methods, and return its manifest.

    Returns:
        None if the evaluation was stopped before the manifest was written.

    Raises:
        InputError: if the folder does not exist or is damaged; with every difference if it is of another evaluation.
    """
    check_exists(path)
    if not (path / MANIFEST).exists() and not (path / journal.NAME).exists():
        check_empty(path)
        return None
    was = read_manifest(path / MANIFEST)
    check_continues(path / MANIFEST, was, manifest_of(experiment, arguments))
    parts_of_manifest(path / MANIFEST, was)  # before the trials: the report is the last that is written
    return was


def check_exists(path: Path) -> None:
    """Check that the folder to resume exists.

    Raises:
        InputError: if it does not exist.
    """
    if not path.is_dir():
        expected = "expected the folder of an earlier kraft eval"
        raise InputError.of(str(path), "there is no such folder", expected, Code.NOT_FOUND)


def check_empty(path: Path) -> None:
    """Check that a folder without a manifest has nothing in it but what a stopped evaluation leaves.

    Raises:
        InputError: if it has other files.
    """
    others = sorted(each.name for each in path.iterdir() if not (each.name.startswith(".") and each.suffix == ".part"))
    if others:
        expected = "expected the folder of an earlier kraft eval"
        problem = f"has no {MANIFEST}, but other files, such as {others[0]}"
        raise InputError.of(str(path), problem, expected, Code.MISMATCH)


def write_results(
    folder: Folder,
    experiment: Experiment,
    rows: Mapping[Key, TrialRow],
    summary: Summary,
    command_line: CommandLine | None = None,
) -> None:
    """Write the summary, the report, the benchmark logs and their database.

    Raises:
        InputError: if a file cannot be written.
    """
    content = evaluation_json(summary, experiment.warnings)
    write_json(folder.path / SUMMARY, {"schema": SCHEMA, **content})
    replays = journal.Replays(folder.path / journal.REPLAYS)
    results = Results.of(experiment, folder.manifest, rows, summary, command_line, replays)
    write_whole(folder.path / report.NAME, report.page(results).encode())
    write_benchmark(folder.path, experiment, rows, folder.manifest, summary.wall)


def _new_folder(path: Path, experiment: Experiment, arguments: Mapping[str, Any]) -> Folder:
    content = manifest_of(experiment, arguments)
    try:
        write_json(path / MANIFEST, content)
    except InputError:
        with suppress(OSError):  # an empty folder would block the next attempt; one with other files stays
            path.rmdir()
        raise
    return Folder(path, content, Journal(path / journal.NAME), {})


def _finished(rows: Mapping[Key, TrialRow]) -> dict[Key, TrialRow]:
    return {key: row for key, row in rows.items() if row.outcome != "failed"}
