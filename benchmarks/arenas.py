"""Whole drives in random arenas and rooms of posts: does the robot arrive, how soon, and does it keep its plans?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.effort import Effort
from benchmarks.parallel import each, interval, planning_vehicle
from benchmarks.random_arenas import Kind, random_arena
from benchmarks.report import Report, Row, Target, number, row
from kraft.driving.method import load_method
from kraft.evaluation.statistics import while_driving
from kraft.scenario import Scenario
from kraft.trial.result import Outcome, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle

KINDS: dict[str, tuple[Kind, tuple[float, float]]] = {
    "arenas, narrow": ("arena", (1.35, 1.6)),
    "posts, narrow": ("posts", (1.2, 1.6)),
    "arenas, wider": ("arena", (1.7, 2.2)),
    "posts, wider": ("posts", (1.6, 2.0)),
}
"""Kind of the scenarios and their gaps, as multiples of the width of the car; between posts, 0.2 m more."""
REGRESSIONS_MAX = 10.0  # share of the cycles (%)
CYCLE_MAX = 25.0  # p99 of the planning time of a cycle (ms)


@dataclass(frozen=True)
class Drive:
    """How a trial ended, its plans that cost more than what was left of the last one, and its planning times (ms)."""

    kind: str
    scenario: str
    outcome: str
    time: float
    compared: int
    regressions: int
    contingencies: int
    planning: tuple[float, ...]


def run(effort: Effort) -> Report:
    """Drive once in every scenario."""
    planning_vehicle(effort.method)
    drives = each(partial(drive, name=effort.method), range(effort.arenas), effort.jobs)
    table = [["", "drives", "success", "collision", "timeout", "mean time, s", "regressions"]]
    table += [line(kind, [d for d in drives if d.kind == kind]) for kind in KINDS]
    bad = [f"{d.scenario} ({d.outcome})" for d in drives if d.outcome != Outcome.SUCCESS]
    notes = [
        f"{effort.method}, seed of the trial: the number of the scenario; times of the successful drives.",
        "Changes were kept or refused by the arenas 0 to 259: the method was chosen with these worlds.",
    ]
    notes += [f"not arrived: {', '.join(bad)}"] if bad else []
    return Report("arenas", rows_of(drives), {"by kind": table}, notes)


def arena(k: int) -> tuple[str, Scenario]:
    """Kind of scenario `k`, and the scenario; kinds take turns."""
    label = list(KINDS)[k % len(KINDS)]
    return label, random_arena(k, *KINDS[label])


def drive(k: int, name: str) -> Drive:
    """Drive in scenario `k`."""
    (label, scenario), method = arena(k), load_method(name)
    vehicle = load_vehicle(method.planner.vehicle or scenario.vehicle)
    result = run_trial(TrialSpec(scenario, method, vehicle, k))
    return Drive(
        kind=label,
        scenario=scenario.name,
        outcome=str(result.outcome),
        time=result.time,
        compared=result.measures.compared,
        regressions=sum(result.measures.regressions.values()),
        contingencies=result.contingencies,
        planning=tuple(cycle.planning_ms for cycle in result.cycles),
    )


def rows_of(drives: Sequence[Drive]) -> list[Row]:
    """Rows for all drives."""
    total, times = len(drives), [d.time for d in drives if d.outcome == Outcome.SUCCESS]
    count = {outcome: sum(d.outcome == outcome for d in drives) for outcome in map(str, Outcome)}
    targets = {"collision": Target(0), "timeout": Target(0)}
    rows = [
        row(f"{outcome}, of {total} ({interval(k, total)})", "", [k], targets.get(outcome))
        for outcome, k in count.items()
    ]
    planning = while_driving(d.planning for d in drives)
    compared = max(1, sum(d.compared for d in drives))
    regressions = 100.0 * sum(d.regressions for d in drives) / compared
    return [
        *rows,
        row("mean time of the successful drives", "s", [float(np.mean(times))] if times else []),
        row("time of the successful drives", "s", times),
        row(f"plans that became worse, of {compared:,} cycles", "%", [regressions], Target(REGRESSIONS_MAX)),
        row("contingencies in a drive", "", [d.contingencies for d in drives]),
        row("planning time of a cycle", "ms", planning),
        row("planning time of a cycle, p99", "ms", [float(np.quantile(planning, 0.99))], Target(CYCLE_MAX)),
    ]


def line(kind: str, drives: Sequence[Drive]) -> list[str]:
    """Line of the table by kind."""
    times = [d.time for d in drives if d.outcome == Outcome.SUCCESS]
    compared = sum(d.compared for d in drives)
    worse = f"{100.0 * sum(d.regressions for d in drives) / compared:.1f} %" if compared else "-"
    counts = [str(sum(d.outcome == outcome for d in drives)) for outcome in ("success", "collision", "timeout")]
    return [kind, str(len(drives)), *counts, number(float(np.mean(times))) if times else "-", worse]
