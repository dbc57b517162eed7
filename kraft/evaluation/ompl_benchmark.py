"""Trials of an evaluation as an OMPL benchmark: logs, and their database for Planner Arena.

There is a log for each entry, in which a method is a planner and a trial is a run.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from kraft.errors import Code, InputError
from kraft.evaluation.experiment import Cell, Experiment
from kraft.evaluation.journal import OUTCOMES, Key, TrialRow
from kraft.evaluation.statistics import percentile
from kraft.files import EXPECTED, Replacement, write_whole
from kraft.text import slugs

DATABASE: Final = "benchmark.db"
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
    logs = _logs(folder, experiment)
    for name, log in logs.items():
        cells = [cell for cell in experiment.cells if cell.entry.name == name]
        write_whole(log, ("\n".join(_log(cells, experiment, rows, manifest, wall)) + "\n").encode())
    make_database(folder / DATABASE, list(logs.values()))


def benchmark_files(folder: Path, experiment: Experiment) -> list[Path]:
    """Files that `write_benchmark` writes: the logs and the database."""
    return [*_logs(folder, experiment).values(), folder / DATABASE]


def _logs(folder: Path, experiment: Experiment) -> dict[str, Path]:
    """Log of each entry."""
    names = slugs(dict.fromkeys(cell.entry.name for cell in experiment.cells))
    files = ["benchmark.log"] if len(names) == 1 else [f"benchmark-{slug}.log" for slug in names.values()]
    return {name: folder / file for name, file in zip(names, files, strict=True)}


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

    The tool runs in its own process because it prints and leaves its connections to the database open, and in its own
    session, where an interrupt at the terminal, which the caller handles, does not end it.

    Raises:
        InputError: if the database cannot be written; an earlier one stays.
    """
    with Replacement(database) as new:
        command = [sys.executable, "-P", "-m", "ompl.ompl_benchmark_statistics", "--database", str(new.temporary)]
        done = subprocess.run(
            [*command, *map(str, logs)], capture_output=True, text=True, check=False, start_new_session=True
        )
        if done.returncode != 0:
            reason = done.stderr.strip().splitlines()[-1:] or [f"OMPL's tool ended with {done.returncode}"]
            raise InputError.of(str(database), f"cannot be written: {reason[0]}", EXPECTED, Code.UNWRITABLE)
        new.commit()
