"""Identification: how long it takes, whether it converges, whether its intervals are honest, what outliers do."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.effort import Effort
from benchmarks.recorded_logs import recorded_rows
from benchmarks.report import Report, Row, Target, row
from benchmarks.synthetic_logs import synthetic_logs
from kraft.logs.log import Log, Part
from kraft.sysid import Identification, Noise, Settings, identify, prediction_errors
from kraft.vehicles.config import VehicleConfig, load_vehicle_config

TRUTH = {"L": 0.30, "phi_diff": 0.03, "v_delta": 0.7, "tau": 0.6}
PROCESS = {"x": 0.003, "y": 0.003, "theta": 0.006, "v": 0.015}
CONTROL = {"throttle": 0.01, "steering": 0.0076}
NOISE = Noise(0.01, 0.02)
PLAIN = Settings(auxiliary="none")
STATED = replace(PLAIN, noise=NOISE, process=PROCESS, control_noise=CONTROL)
LOGS, SECONDS = 10, 10.0


def run(effort: Effort) -> Report:
    """Measure on synthetic logs, and on the real ones if they are there."""
    problems = 2 * effort.seeds
    rows = [*speed(effort), *convergence(problems), *outliers(effort.repeats)]
    rows += coverage(problems, STATED, "matched noise")
    rows += coverage(problems, ten_times_smaller(STATED), "noise stated ten times too small")
    rows += recorded_rows(effort)
    notes = ["Model mushr-lag. Times are of identify() as it is by default: reading files is not in them."]
    if "KRAFT_REAL_LOGS" in os.environ:
        rows += [entry for name in ("mushr", "mushr-lag") for entry in real(name)]
    else:
        notes.append("No real logs: KRAFT_REAL_LOGS does not name their folder.")
    return Report("sysid", rows, notes=notes)


def timed(vehicle: VehicleConfig, logs: list[Log], settings: Settings | None = None) -> tuple[Identification, float]:
    """The result and its processor time, s."""
    began = time.process_time()
    result = identify(vehicle, logs, settings)
    return result, time.process_time() - began


def speed(effort: Effort) -> list[Row]:
    """Time of 20 logs of 20 s, and how it grows."""
    vehicle = load_vehicle_config("mushr-lag")
    many = 10 if effort.repeats > 1 else 1
    logs = synthetic_logs(vehicle, TRUTH, range(20 * many))
    timed(vehicle, logs[:2])  # compiles
    few = [timed(vehicle, logs[:20])[1] for _ in range(effort.repeats)]
    lots = [timed(vehicle, logs)[1] for _ in range(max(1, effort.repeats // 3))]
    result, paper = timed(vehicle, logs[:2], Settings(graph="paper", auxiliary="none"))
    return [
        row("20 logs of 20 s, 50 ms steps, 30 Hz", "s", few, Target(1.0)),
        row("200 logs, time per log over that of 20", "times", [np.median(lots) / np.median(few) / many], Target(1.2)),
        row("every factor explicit (--graph paper), per log and iteration", "s", [paper / 2 / result.iterations]),
    ]


def random_problem(vehicle: VehicleConfig, seed: int, logs: int, **noise: object) -> tuple[dict[str, float], list[Log]]:
    """Random true parameters and logs of them."""
    rng = np.random.default_rng(seed)
    truth = {
        "L": rng.uniform(0.2, 0.5),
        "phi_diff": rng.uniform(-0.1, 0.1),
        "v_delta": rng.uniform(0.3, 1.5),
        "tau": rng.uniform(0.2, 2.0),
    }
    seeds = range(1000 * seed, 1000 * seed + logs)
    return truth, synthetic_logs(vehicle, truth, seeds, seconds=SECONDS, **noise)  # type: ignore[arg-type]


def convergence(problems: int) -> list[Row]:
    """Random problems from initial parameters anywhere within the bounds."""
    vehicle = load_vehicle_config("mushr-lag")
    found, iterations = [], []
    for seed in range(problems):
        truth, logs = random_problem(vehicle, seed, 4, process=tuple(PROCESS.values()))
        rng = np.random.default_rng(10_000 + seed)
        wild = {name: rng.uniform(p.min or 0.0, p.max or 0.0) for name, p in vehicle.parameters.items()}
        result = identify(vehicle, logs, replace(PLAIN, values=wild))
        right = all(
            abs(e.value - truth[name]) < 6.0 * e.std + 0.01 * abs(truth[name]) for name, e in result.parameters.items()
        )
        found.append(float(result.converged and right))
        iterations.append(result.iterations)
    share = [float(np.mean(found))]
    return [
        row(f"converged, of {problems} problems from wild parameters", "share", share, Target(0.99, most=False)),
        row("iterations of these", "", iterations),
    ]


def ten_times_smaller(settings: Settings) -> Settings:
    """Settings that believe in a tenth of the noise."""
    noise = settings.noise or NOISE
    return replace(
        settings,
        noise=Noise(noise.position / 10.0, noise.yaw / 10.0),
        process={name: value / 10.0 for name, value in settings.process.items()},
        control_noise={name: value / 10.0 for name, value in settings.control_noise.items()},
    )


def coverage(problems: int, settings: Settings, what: str) -> list[Row]:
    """How often 95 % intervals hold the truth, by parameter."""
    vehicle = load_vehicle_config("mushr-lag")
    hits: dict[str, list[float]] = {name: [] for name in vehicle.parameters}
    for seed in range(problems):
        truth, logs = random_problem(
            vehicle, 500 + seed, LOGS, process=tuple(PROCESS.values()), control_noise=tuple(CONTROL.values())
        )
        result = identify(vehicle, logs, settings)
        for name, estimated in result.parameters.items():
            hits[name].append(float(estimated.ci95[0] <= truth[name] <= estimated.ci95[1]))
    shares = [float(np.mean(found)) for found in hits.values()]
    return [
        row(f"{what}: truth in the 95 % interval, by parameter", "share", shares, Target(0.9, most=False, of="worst")),
        row(f"{what}: the most", "share", [max(shares)], Target(0.98)),
    ]


def outliers(repeats: int) -> list[Row]:
    """How far 5 % of outliers of 0.5 m move the wheelbase."""
    vehicle = load_vehicle_config("mushr-lag")
    moved = []
    for k in range(max(repeats, 2)):
        seeds = range(20 * k, 20 * k + 5)
        clean, dirty = (
            identify(vehicle, synthetic_logs(vehicle, TRUTH, seeds, outliers=share), PLAIN).values["L"]
            for share in (0.0, 0.05)
        )
        moved.append(abs(dirty / clean - 1.0))
    return [row("5 % outliers of 0.5 m: change of L", "share", moved, Target(0.02, of="worst"))]


def real_logs() -> list[Log]:
    """The F1TENTH runs that KRAFT_REAL_LOGS names: t, x, y, yaw, v, cmd_speed, cmd_steer; v is not used."""
    return list(_real_logs(Path(os.environ["KRAFT_REAL_LOGS"], "f1tenth_koopman_cc0")))


def _real_logs(folder: Path) -> Iterator[Log]:
    for path in sorted(folder.glob("run_*.csv")):
        with path.open(encoding="utf-8", newline="") as file:
            rows = [{name: float(value) for name, value in entry.items()} for entry in csv.DictReader(file)]
        data = {name: np.array([entry[name] for entry in rows]) for name in rows[0]}
        commands = np.column_stack([data["cmd_speed"], data["cmd_steer"]])
        poses = np.column_stack([data["x"], data["y"], np.unwrap(data["yaw"])])
        yield Log(path.stem, (), ("throttle", "steering"), (Part(data["t"], commands, data["t"], poses),))


def real(name: str) -> list[Row]:
    """Fit on every second run of a real car, predict the others, and the other way round."""
    vehicle, logs = load_vehicle_config(name), real_logs()
    position, yaw, all_position, delays, ahead = [], [], [], [], []
    for first in (0, 1):
        result = identify(vehicle, logs[first::2])
        errors = prediction_errors(vehicle, logs[1 - first :: 2], result.values)
        position.append(errors.position[3.0])
        yaw.append(errors.yaw[3.0])
        all_position.append(errors.overall_position)
        delays.append(result.values.get("delay", 0.0))
        ahead.append(result.rear_axle or 0.0)
    near = Target(0.0164, of="worst") if name == "mushr-lag" else None  # mushr's speed has a fixed lag
    return [
        row(f"F1TENTH, {name}: held-out position error after 3 s", "m", position, near),
        row(f"F1TENTH, {name}: held-out yaw error after 3 s", "rad", yaw, Target(0.016, of="worst")),
        row(f"F1TENTH, {name}: held-out position error over 3 s", "m", all_position),
        row(f"F1TENTH, {name}: delay", "s", delays),
        row(f"F1TENTH, {name}: tracked point ahead of the rear axle", "m", ahead),
    ]
