"""Results folder of an evaluation: created, resumed on request, never overwritten; its trials as an OMPL benchmark too.

An OMPL benchmark is a log for each scenario, in which a method is a planner and a trial is a run.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from kraft.errors import Code, InputError
from kraft.evaluation import journal, report
from kraft.evaluation.experiment import MANIFEST, Cell, Experiment, check_same_manifest, manifest_of, read_manifest
from kraft.evaluation.journal import Journal, Key, TrialRow, read_journal
from kraft.evaluation.report import CommandLine, Results
from kraft.evaluation.statistics import percentile
from kraft.evaluation.summary import FILE as SUMMARY
from kraft.evaluation.summary import SCHEMA, Summary, evaluation_json, recorded_wall
from kraft.files import EXPECTED, Replacement, check_writable, write_json, write_whole
from kraft.text import slugs

ROOT: Final = Path("results")


@dataclass
class Folder:
    """Open results folder.

    `rows` are its finished trials; `incomplete_line` is whether the last line of the journal was cut off.
    """

    path: Path
    manifest: dict[str, Any]
    journal: Journal
    rows: dict[Key, TrialRow]
    incomplete_line: bool = False

    @property
    def wall(self) -> float:
        """Duration in the summary of the folder, s; 0 without one, or if it is damaged and is written again."""
        return recorded_wall(self.path) or 0.0


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
    check_new(path)
    try:
        path.mkdir(parents=True)
    except OSError as error:
        raise InputError.of(
            str(path), f"cannot be created: {error.strerror}", "expected a new folder", Code.UNWRITABLE
        ) from None
    return _new_folder(path, experiment, arguments)


def check_new(path: Path) -> None:
    """Check that a folder can be created.

    Raises:
        InputError: if it exists or cannot be written.
    """
    if path.is_dir():
        raise InputError.of(str(path), "is there already", "expected a new folder, or to resume this one", Code.EXISTS)
    check_writable(path)


def reopen(path: Path, experiment: Experiment, arguments: Mapping[str, Any]) -> Folder:
    """Open the folder of an unfinished evaluation; its failed trials are not among the finished ones.

    Raises:
        InputError: if the folder does not exist or is damaged; with every difference if it is of another evaluation.
    """
    check_exists(path)
    if not (path / MANIFEST).exists() and not (path / journal.NAME).exists():
        check_empty(path)
        return _new_folder(path, experiment, arguments)  # it was stopped before the manifest was written
    was = read_manifest(path / MANIFEST)
    check_same_manifest(path / MANIFEST, was, manifest_of(experiment, arguments))
    file = path / journal.NAME
    opened = Journal(file)  # first, so that no other process writes it any more
    try:
        rows = read_journal(file, {job.key for job in experiment.jobs()})
    except InputError:
        opened.close()
        raise
    return Folder(path, was, opened, _finished(rows), opened.was_cut)


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
    write_json(folder.path / SUMMARY, {"schema": SCHEMA, **evaluation_json(summary)})
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


DATABASE: Final = "benchmark.db"
OUTCOMES: Final = ("success", "collision", "timeout", "failed")
PROPERTIES: Final = (
    "time REAL",
    "solved BOOLEAN",
    "outcome ENUM",
    "correct solution BOOLEAN",
    "trial seed INTEGER",
    "execution time REAL",
    "minimum clearance REAL",
    "cycles INTEGER",
    "contingencies INTEGER",
    "iterations INTEGER",
    "planning time median REAL",
    "planning time maximum REAL",
    "missed deadlines INTEGER",
)


def write_benchmark(
    folder: Path, experiment: Experiment, rows: Mapping[Key, TrialRow], manifest: Mapping[str, Any], wall: float
) -> None:
    """Write the logs and the Planner Arena database.

    A file of OMPL's format holds one scene, so the log of one entry is `benchmark.log`, and of several entries each has
    its own `benchmark-ENTRY.log`.

    Raises:
        InputError: if a file cannot be written.
    """
    names = slugs(dict.fromkeys(cell.entry.name for cell in experiment.cells))
    logs = [folder / ("benchmark.log" if len(names) == 1 else f"benchmark-{slug}.log") for slug in names.values()]
    for name, log in zip(names, logs, strict=True):
        cells = [cell for cell in experiment.cells if cell.entry.name == name]
        write_whole(log, ("\n".join(_log(cells, experiment, rows, manifest, wall)) + "\n").encode())
    make_database(folder / DATABASE, logs)


def _log(
    cells: Sequence[Cell],
    experiment: Experiment,
    rows: Mapping[Key, TrialRow],
    manifest: Mapping[str, Any],
    wall: float,
) -> Iterator[str]:
    """Lines of a log, in the format that OMPL's `Benchmark::saveResultsToStream` writes."""
    scenario = cells[0].scenario
    yield f"OMPL version {manifest['versions']['ompl']}"
    yield f"Experiment {cells[0].entry.name}"
    yield f"Running on {manifest['host'] or 'localhost'}"
    yield f"Starting at {manifest['began']}"
    yield "<<<|"
    yield f"kraft {manifest['versions']['kraft']}"
    yield from json.dumps(manifest["scenarios"][cells[0].entry.name], indent=2).splitlines()
    yield "|>>>"
    yield f"{experiment.seed} is the random seed"
    yield f"{max(scenario.trial.timeout, scenario.trial.oneshot_timeout):g} seconds per run"
    yield "0 MB per run"
    yield f"{experiment.trials} runs per planner"
    yield f"{wall:.3f} seconds spent to collect the data"
    yield "1 enum type"
    yield "|".join(("outcome", *OUTCOMES))
    yield f"{len(cells)} planners"
    for cell in cells:
        yield from _planner(cell, [rows[key] for key in _keys(cell, experiment) if key in rows], manifest)


def _planner(cell: Cell, rows: Sequence[TrialRow], manifest: Mapping[str, Any]) -> Iterator[str]:
    settings = dict(_settings(manifest["methods"][cell.method.name]["content"]))
    yield cell.method.name
    yield f"{len(settings)} common properties"
    yield from (f"{name} = {value}" for name, value in settings.items())
    yield f"{len(PROPERTIES)} properties for each run"
    yield from PROPERTIES
    yield f"{len(rows)} runs"
    yield from ("; ".join([*_run(row), ""]) for row in rows)
    yield "."


def _run(row: TrialRow) -> list[str]:
    """Values of the properties; `time` is the planning time of all cycles, as for any OMPL planner."""
    planning = list(row.measured.planning_ms)
    solved = row.outcome == "success"
    return [
        _text(sum(planning) / 1000),
        str(int(solved)),
        str(OUTCOMES.index(row.outcome)),
        str(int(solved)),
        str(row.seed),
        _text(row.t_s),
        _text(row.min_clearance_m),
        str(row.cycles),
        str(row.contingencies),
        str(row.iterations),
        _text(percentile(planning, 0.5), 1e-3),
        _text(percentile(planning, 1.0), 1e-3),
        str(row.measured.missed),
    ]


def _keys(cell: Cell, experiment: Experiment) -> Iterator[Key]:
    return ((*cell.key, seed) for seed in experiment.seeds)


def _settings(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in content.items():
        if isinstance(value, dict):
            yield from _settings(value, f"{prefix}{name}.")
        elif name not in ("name", "title", "description"):
            yield f"{prefix}{name}", json.dumps(value)


def _text(value: float | None, scale: float = 1.0) -> str:
    return "nan" if value is None else f"{value * scale:.9g}"


def make_database(database: Path, logs: Sequence[Path]) -> None:
    """Make the database of benchmark logs with OMPL's tool, replacing an earlier one.

    The tool runs in its own process because it prints and leaves its connections to the database open.

    Raises:
        InputError: if the database cannot be written; an earlier one stays.
    """
    with Replacement(database) as new:
        command = [sys.executable, "-P", "-m", "ompl.ompl_benchmark_statistics", "--database", str(new.temporary)]
        done = subprocess.run([*command, *map(str, logs)], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            reason = done.stderr.strip().splitlines()[-1:] or [f"OMPL's tool ended with {done.returncode}"]
            raise InputError.of(str(database), f"cannot be written: {reason[0]}", EXPECTED, Code.UNWRITABLE)
        new.commit()
