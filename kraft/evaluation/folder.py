"""The results folder: made once, gone on with on request, never overwritten."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from kraft.errors import Code, InputError
from kraft.evaluation import journal, manifest, report
from kraft.evaluation.experiment import Experiment
from kraft.evaluation.journal import Journal, read_journal
from kraft.evaluation.ompl_log import write_benchmark
from kraft.evaluation.report import CommandLine, Results
from kraft.evaluation.row import Key, TrialRow
from kraft.evaluation.summary import FILE as SUMMARY
from kraft.evaluation.summary import SCHEMA, Summary, evaluation_json
from kraft.files import check_writable, write_json, write_whole

ROOT: Final = Path("results")


@dataclass
class Folder:
    """An open results folder.

    `rows` are the trials it holds that need not be run, `torn` says that the last line was half written.
    """

    path: Path
    manifest: dict[str, Any]
    journal: Journal
    rows: dict[Key, TrialRow]
    torn: bool = False


def default_path(seed: int, root: Path = ROOT) -> Path:
    """A folder that does not exist yet."""
    name = f"eval-{datetime.now():%Y%m%d-%H%M%S}-seed{seed}"
    candidates = (root / (name if n == 1 else f"{name}-{n}") for n in range(1, 10_000))
    return next(path for path in candidates if not path.exists())


def create(path: Path, experiment: Experiment, arguments: Mapping[str, Any]) -> Folder:
    """Make the folder of a new evaluation.

    Raises:
        InputError: if there is something already, or it cannot be written.
    """
    if path.is_dir():
        raise InputError.of(str(path), "is there already", "expected a new folder, or to go on with it", Code.EXISTS)
    check_writable(path)
    try:
        path.mkdir(parents=True)
    except OSError as error:
        raise InputError.of(
            str(path), f"cannot be made: {error.strerror}", "expected a new folder", Code.UNWRITABLE
        ) from None
    return _begun(path, experiment, arguments)


def reopen(path: Path, experiment: Experiment, arguments: Mapping[str, Any]) -> Folder:
    """Open the folder of an evaluation that did not end; failed trials in it are to be run again.

    Raises:
        InputError: if there is none, if it is of something else, with every field that differs, or if it is damaged.
    """
    check_exists(path)
    if not (path / manifest.NAME).exists() and not (path / journal.NAME).exists():
        return _begun(path, experiment, arguments)  # it was stopped before there was anything
    was = manifest.read_manifest(path / manifest.NAME)
    manifest.check_same(path / manifest.NAME, was, manifest.manifest_of(experiment, arguments))
    file = path / journal.NAME
    found = read_journal(file, {job.key for job in experiment.jobs()})
    opened = Journal(file, found.whole)
    return Folder(path, was, opened, _done(found.rows), found.torn > 0)


def check_exists(path: Path) -> None:
    """Check that there is a folder to go on with.

    Raises:
        InputError: if not.
    """
    if not path.is_dir():
        expected = "expected that of an earlier kraft eval"
        raise InputError.of(str(path), "there is no such folder", expected, Code.NOT_FOUND)


def write_results(
    folder: Folder,
    experiment: Experiment,
    rows: Mapping[Key, TrialRow],
    summary: Summary,
    command_line: CommandLine | None = None,
) -> None:
    """Write what is made of the trials: the summary, the benchmark log, the database and the report.

    Raises:
        InputError: if there is no room.
    """
    write_json(folder.path / SUMMARY, {"schema": SCHEMA, **evaluation_json(summary)})
    write_benchmark(folder.path, experiment, rows, folder.manifest, summary.wall)
    results = Results.of(experiment, folder.manifest, rows, summary, command_line)
    write_whole(folder.path / report.NAME, report.page(results).encode())


def _begun(path: Path, experiment: Experiment, arguments: Mapping[str, Any]) -> Folder:
    content = manifest.manifest_of(experiment, arguments)
    try:
        write_json(path / manifest.NAME, content)
    except InputError:
        path.rmdir()  # nothing is in it, and it must not stand in the way
        raise
    return Folder(path, content, Journal(path / journal.NAME), {})


def _done(rows: Mapping[Key, TrialRow]) -> dict[Key, TrialRow]:
    return {key: row for key, row in rows.items() if row.outcome != "failed"}
