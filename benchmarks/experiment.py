"""Experiment design: recommended drives against random ones, by predictions of other random drives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, row
from kraft.logs.log import Log
from kraft.logs.reader import read_logs
from kraft.sysid import Identification, Settings, identify, prediction_errors
from kraft.vehicles.config import VehicleConfig, load_vehicle_config
from kraft.vehicles.load import load_vehicle
from kraft_cli.work.record import RecordRequest, record_logs

VEHICLES = {"mushr": "mushr-lag", "f1tenth": "f1tenth", "jackal": "jackal"}
"""Vehicle that drives, and model that is identified."""
PLANNED, RANDOM, HELD_OUT = 3, 10, 20
HELD_OUT_SEED = 1000
PLAIN = Settings(auxiliary="none")


def run(effort: Effort) -> Report:
    """Measure with the true robots of the bundled vehicles, in the scenario training."""
    rows = [entry for name in VEHICLES for entry in compared(name, effort)]
    return Report("experiment", rows, notes=["From the priors of each model; --extras none."])


def compared(name: str, effort: Effort) -> list[Row]:
    """Errors and standard deviations after recommended and after random drives, over several seeds."""
    model = load_vehicle_config(VEHICLES[name])
    held_out = recorded(name, HELD_OUT_SEED, min(HELD_OUT, 2 * effort.repeats))
    planned, few, many, stds = [], [], [], []
    for seed in range(1, min(effort.repeats, 4) + 1):
        own = identify(model, recorded(name, seed, PLANNED, VEHICLES[name]), PLAIN)
        logs = recorded(name, seed, RANDOM)
        other = identify(model, logs, PLAIN)
        planned.append(errors(model, held_out, own))
        many.append(errors(model, held_out, other))
        few.append(errors(model, held_out, identify(model, logs[:PLANNED], PLAIN)))
        stds.append(np.sqrt(np.diag(own.graph_covariance) / np.diag(other.graph_covariance)))
    rows = []
    for k, after in enumerate(("1 s", "2 s", "3 s")):
        rows += [
            row(f"{name}: held-out error after {after}, {PLANNED} recommended", "m", [e[k] for e in planned]),
            row(f"{name}: the same, {PLANNED} random", "m", [e[k] for e in few]),
            row(f"{name}: the same, {RANDOM} random", "m", [e[k] for e in many]),
            row(
                f"{name}: {PLANNED} recommended over {RANDOM} random, after {after}", "times",
                [a[k] / b[k] for a, b in zip(planned, many, strict=True)], Target(1.0),
            ),
        ]  # fmt: skip
    worst = [float(each.max()) for each in stds]
    return [*rows, row(f"{name}: worst standard deviation over that of {RANDOM} random", "times", worst)]


def recorded(vehicle: str, seed: int, runs: int, model: str | None = None) -> Sequence[Log]:
    """Logs of random drives, or of those recommended for a model."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "logs"
        record_logs(RecordRequest(out=out, runs=runs, seed=seed, vehicle=vehicle, model=model), lambda text: None)
        return read_logs(out, tuple(load_vehicle(vehicle).controls)).logs


def errors(model: VehicleConfig, logs: Sequence[Log], found: Identification) -> list[float]:
    """Position errors after 1, 2 and 3 s, m."""
    return list(prediction_errors(model, logs, found.values, PLAIN).position.values())
