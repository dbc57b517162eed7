"""Folder that `kraft run --out` writes: one trial as CSV and JSON files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from kraft.evaluation.experiment import Experiment
from kraft.evaluation.manifest import MANIFEST, manifest_of
from kraft.files import new_folder, write_csv, write_json, write_whole
from kraft.trial.result import TrialResult, cycle_content
from ompl_ext.vehicle import Vehicle

MANIFEST_SCHEMA: Final = "kraft.run-manifest/1"
SCHEMA: Final = "kraft.run/1"


def write_run(
    folder: Path,
    experiment: Experiment,
    arguments: Mapping[str, Any],
    vehicle: Vehicle,
    result: TrialResult,
    content: Mapping[str, Any],
) -> None:
    """Write a trial into a new folder; `content` is the JSON object of the run.

    Raises:
        InputError: if a file cannot be written.
    """
    recorded = {**manifest_of(experiment, arguments), "schema": MANIFEST_SCHEMA}
    cycles = "".join(json.dumps(cycle_content(cycle)) + "\n" for cycle in result.cycles)
    with new_folder(folder) as new:
        write_csv(new / "steps.csv", step_heading(vehicle), _steps(result))
        write_csv(new / "observations.csv", ("time", "arrival", "x", "y", "theta"), _observations(result))
        write_whole(new / "cycles.jsonl", cycles.encode())
        write_json(new / "result.json", {"schema": SCHEMA, **content})
        write_json(new / MANIFEST, recorded)


def step_heading(vehicle: Vehicle) -> tuple[str, ...]:
    """Names of the columns of `steps.csv`."""
    estimate = (f"estimate_{name}" for name in vehicle.state)
    command = (f"command_{name}" for name in vehicle.controls)
    return ("time", "x", "y", "theta", "speed", *estimate, *command, "cycle")


def _steps(result: TrialResult) -> Iterator[list[float]]:
    for step in result.steps:
        belief, command = map(float, step.estimate), map(float, step.command)
        yield [float(step.time), *map(float, step.pose), float(step.speed), *belief, *command, step.cycle]


def _observations(result: TrialResult) -> Iterator[list[float]]:
    for observation in result.observations:
        yield [
            float(value)
            for value in (observation.time, observation.arrival, observation.x, observation.y, observation.theta)
        ]
