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
HELD_OUT_SEED, RANDOM_SEED = 1000, 7
SETS = 4
"""Most sets of drives of each kind."""
PLAIN = Settings(auxiliary="none")


def run(effort: Effort) -> Report:
    """Measure with the true robots of the bundled vehicles, in the scenario training."""
    rows = [entry for name in VEHICLES for entry in compared(name, effort)]
    return Report("experiment", rows, notes=["From the priors of each model; --extras none."])


def compared(name: str, effort: Effort) -> list[Row]:
    """Errors and standard deviations after recommended and after random drives, several times each."""
    model, count = load_vehicle_config(VEHICLES[name]), min(effort.repeats, SETS)
    held_out = recorded(name, HELD_OUT_SEED, min(HELD_OUT, 2 * effort.repeats))
    drives = [recorded(name, seed, PLANNED, VEHICLES[name]) for seed in range(1, count + 1)]
    random = recorded(name, RANDOM_SEED, RANDOM * count)
    tens = [random[RANDOM * k : RANDOM * (k + 1)] for k in range(count)]
    after = {
        f"{PLANNED} recommended": drives,
        f"{PLANNED} random": [each[:PLANNED] for each in tens],
        f"{RANDOM} random": tens,
        f"{RANDOM * count} random": [random],
        "the held-out ones themselves": [held_out],
    }
    fits = {what: [identify(model, logs, PLAIN) for logs in sets] for what, sets in after.items()}
    found = {what: np.array([errors(model, held_out, fit) for fit in own]) for what, own in fits.items()}
    planned, others = fits[f"{PLANNED} recommended"], fits[f"{RANDOM} random"]
    stds = [
        np.sqrt(np.diag(p.graph_covariance) / np.diag(o.graph_covariance)) for p, o in zip(planned, others, strict=True)
    ]
    rows = []
    for k, time in enumerate(("1 s", "2 s", "3 s")):
        rows += [row(f"{name}: held-out error after {time}, {what}", "m", each[:, k]) for what, each in found.items()]
        means = [float(found[what][:, k].mean()) for what in (f"{PLANNED} recommended", f"{RANDOM} random")]
        what = f"{name}: mean of {PLANNED} recommended over that of {RANDOM} random, after {time}"
        rows.append(row(what, "times", [means[0] / means[1]], Target(1.0)))
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
