"""Drives to goals with a heading: the eight bundled scenes, in directions all round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.effort import Effort
from benchmarks.parallel import each, interval, planning_vehicle
from benchmarks.report import Report, Row, Target, number, row
from kraft.driving.method import load_method
from kraft.evaluation.statistics import while_driving
from kraft.scenario import load_scenario
from kraft.trial.result import Outcome, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle

SCENES = ("turns", "boxes", "slope", "bump", "slip", "movable", "turns-real", "boxes-real")
DIRECTIONS = 30
SHIFT = 5.0  # of the directions from one round of them to the next (degrees)
TOLERANCE = 10.0  # degrees


@dataclass(frozen=True)
class Drive:
    """How a trial to a goal with a heading (degrees) ended, its time (s) and the planning times of its cycles (ms)."""

    scene: str
    heading: float
    seed: int
    outcome: str
    time: float
    contingencies: int
    planning: tuple[float, ...]


def run(effort: Effort) -> Report:
    """Drive in every scene, once in each direction."""
    planning_vehicle(effort.method)
    drives = each(partial(drive, name=effort.method), range(len(SCENES) * effort.headings), effort.jobs)
    table = [["", "drives", "success", "collision", "timeout", "mean time, s", "contingencies"]]
    table += [line(scene, [d for d in drives if d.scene == scene]) for scene in SCENES]
    bad = [
        f"{d.scene}, {d.heading:g} degrees, seed {d.seed} ({d.outcome})" for d in drives if d.outcome != Outcome.SUCCESS
    ]
    notes = [f"{effort.method}; headings within {TOLERANCE:g} degrees, all round; seed: number of the direction."]
    notes += [f"not arrived: {', '.join(bad)}"] if bad else []
    return Report("headings", rows_of(drives), {"by scene": table}, notes)


def heading(k: int) -> float:
    """Direction `k`, degrees; every round of `DIRECTIONS` lies between those of the round before."""
    return 360.0 * (k % DIRECTIONS) / DIRECTIONS + SHIFT * (k // DIRECTIONS)


def drive(number: int, name: str) -> Drive:
    """Drive `number`: the scenes take turns."""
    scene, k = SCENES[number % len(SCENES)], number // len(SCENES)
    settings = {"goal.heading_deg": heading(k), "goal.heading_tolerance_deg": TOLERANCE}
    scenario, method = load_scenario(scene, settings), load_method(name)
    vehicle = load_vehicle(method.planner.vehicle or scenario.vehicle)
    result = run_trial(TrialSpec(scenario, method, vehicle, k))
    return Drive(
        scene,
        heading(k),
        k,
        str(result.outcome),
        result.time,
        result.contingencies,
        tuple(cycle.planning_ms for cycle in result.cycles),
    )


def rows_of(drives: Sequence[Drive]) -> list[Row]:
    """Rows for all drives."""
    total = len(drives)
    count = {outcome: sum(d.outcome == outcome for d in drives) for outcome in map(str, Outcome)}
    targets = {"success": Target(100.0, most=False)}
    rows = [
        row(f"{outcome}, {k} of {total} ({interval(k, total)})", "%", [100.0 * k / total], targets.get(outcome))
        for outcome, k in count.items()
    ]
    return [
        *rows,
        row("time of the successful drives", "s", [d.time for d in drives if d.outcome == Outcome.SUCCESS]),
        row("contingencies in a drive", "", [d.contingencies for d in drives]),
        row("planning time of a cycle", "ms", while_driving(d.planning for d in drives)),
    ]


def line(scene: str, drives: Sequence[Drive]) -> list[str]:
    """Line of the table by scene."""
    times = [d.time for d in drives if d.outcome == Outcome.SUCCESS]
    counts = [str(sum(d.outcome == outcome for d in drives)) for outcome in ("success", "collision", "timeout")]
    contingencies = number(sum(d.contingencies for d in drives) / max(1, len(drives)))
    return [scene, str(len(drives)), *counts, number(float(np.mean(times))) if times else "-", contingencies]
