"""Identification on logs recorded in the simulated world: errors of predictions of other logs, before and after."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.effort import Effort
from benchmarks.report import Row, Target, row
from kraft.logs.log import Log
from kraft.logs.reader import read_logs
from kraft.sysid import Settings, identify, prediction_errors
from kraft.vehicles.config import load_vehicle_config
from kraft.vehicles.mushr import MUSHR, MUSHR_LAG
from kraft_cli.work.record import RecordRequest, record_logs

NOMINAL = {"mushr": dict(MUSHR.parameters), "mushr-lag": dict(MUSHR_LAG.parameters)}
AFTER = 2.0  # s


@dataclass(frozen=True)
class Errors:
    """Held-out position error after 2 s (m): nominal parameters, identified ones, identified with extras."""

    nominal: float
    plain: float
    auxiliary: float


def recorded_rows(effort: Effort) -> list[Row]:
    """Fit on every second recorded run, predict the others."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "logs"
        record_logs(RecordRequest(out=out, runs=min(40, 4 * effort.repeats)), lambda text: None)
        logs = list(read_logs(out).logs)
    paper, lag = errors("mushr", logs), errors("mushr-lag", logs)
    rows = []
    for name, found in (("mushr", paper), ("mushr-lag", lag)):
        rows += [
            row(f"recorded, {name}: held-out error after 2 s, nominal", "m", [found.nominal]),
            row(f"recorded, {name}: the same, identified", "m", [found.plain]),
            row(f"recorded, {name}: the same, with the extras that the data show", "m", [found.auxiliary]),
            row(f"recorded, {name}: with extras over nominal", "times", [found.auxiliary / found.nominal], Target(0.5)),
        ]
    return [*rows, row("recorded: mushr-lag over mushr", "times", [lag.plain / paper.plain], Target(1.0))]


def errors(name: str, logs: list[Log]) -> Errors:
    """Of one model."""
    vehicle, fitted, held_out = load_vehicle_config(name), logs[::2], logs[1::2]
    plain = identify(vehicle, fitted, Settings(auxiliary="none"))
    auxiliary = identify(vehicle, fitted)
    after = [
        prediction_errors(vehicle, held_out, values).position[AFTER]
        for values in (NOMINAL[name], plain.values, auxiliary.values)
    ]
    return Errors(*after)
