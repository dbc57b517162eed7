"""Fast drives in generated worlds: an F1TENTH car and a Jackal in rooms of posts and on race tracks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.effort import Effort
from benchmarks.parallel import each, interval, planning_vehicle
from benchmarks.report import Report, Row, Target, number, row
from kraft.driving.method import load_method
from kraft.planning.feasibility import geodesic_time
from kraft.scenario import Scenario, load_scenario
from kraft.trial.result import Outcome, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle
from kraft.worlds.generate import generate
from kraft.worlds.world import write_worlds

VEHICLES = ("jackal", "f1tenth")
TRACK_EVERY = 6  # of the worlds
SUCCESS_MIN, COLLISION_MAX, TIME_MAX = 95.0, 1.0, 1.3  # %, %, times the bound


@dataclass(frozen=True)
class Drive:
    """How a trial ended, its time and the bound (s): the shortest path at top speed."""

    kind: str
    vehicle: str
    scenario: str
    outcome: str
    time: float
    bound: float
    contingencies: int


def run(effort: Effort) -> Report:
    """Drive once in every world."""
    for vehicle in VEHICLES:
        planning_vehicle(effort.method, vehicle)
    drives = each(partial(drive, name=effort.method), range(effort.worlds), effort.jobs)
    table = [["", "drives", "success", "collision", "timeout", "mean time, s", "times the bound"]]
    table += [line(kind, name, drives) for kind in ("posts", "track") for name in VEHICLES]
    bad = [f"{d.scenario}, {d.vehicle} ({d.outcome})" for d in drives if d.outcome != Outcome.SUCCESS]
    notes = [f"{effort.method}, seed of the trial: that of the world. Bound: the shortest path at top speed."]
    notes += [f"not arrived: {', '.join(bad)}"] if bad else []
    return Report("worlds", rows_of(drives), {"by kind": table}, notes)


def world(k: int) -> tuple[str, str, Scenario]:
    """Kind, vehicle and scenario of world `k`: a track after five rooms of posts; the vehicles take turns."""
    kind = "track" if k % TRACK_EVERY == TRACK_EVERY - 1 else "posts"
    name = VEHICLES[(k + k // TRACK_EVERY) % len(VEHICLES)]
    with TemporaryDirectory() as folder:
        written = write_worlds([generate(kind, k, name)], Path(folder) / "world", "one", "")
        return kind, name, load_scenario(written.scenarios[0])


def drive(k: int, name: str) -> Drive:
    """Drive in world `k`."""
    kind, vehicle_name, scenario = world(k)
    vehicle = load_vehicle(vehicle_name)
    result = run_trial(TrialSpec(scenario, load_method(name), vehicle, k))
    bound = geodesic_time(scenario, vehicle)
    return Drive(kind, vehicle_name, scenario.name, str(result.outcome), result.time, bound, result.contingencies)


def rows_of(drives: Sequence[Drive]) -> list[Row]:
    """Rows for all drives."""
    total = len(drives)
    count = {outcome: sum(d.outcome == outcome for d in drives) for outcome in map(str, Outcome)}
    targets = {"success": Target(SUCCESS_MIN, most=False), "collision": Target(COLLISION_MAX)}
    rows = [
        row(f"{outcome}, {k} of {total} ({interval(k, total)})", "%", [100.0 * k / total], targets.get(outcome))
        for outcome, k in count.items()
    ]
    done = [d for d in drives if d.outcome == Outcome.SUCCESS]
    ratios = [d.time / d.bound for d in done]
    mean = sum(d.time for d in done) / sum(d.bound for d in done) if done else math.inf
    return [
        *rows,
        row("mean time over mean bound, successful drives", "times", [mean], Target(TIME_MAX)),
        row("time over the bound", "times", ratios),
        row("contingencies in a drive", "", [d.contingencies for d in drives]),
    ]


def line(kind: str, vehicle: str, drives: Sequence[Drive]) -> list[str]:
    """Line of the table by kind and vehicle."""
    mine = [d for d in drives if (d.kind, d.vehicle) == (kind, vehicle)]
    done = [d for d in mine if d.outcome == Outcome.SUCCESS]
    counts = [str(sum(d.outcome == outcome for d in mine)) for outcome in ("success", "collision", "timeout")]
    means = [number(float(np.mean([d.time for d in done]))), number(float(np.mean([d.time / d.bound for d in done])))]
    return [f"{kind}, {vehicle}", str(len(mine)), *counts, *(means if done else ["-", "-"])]
