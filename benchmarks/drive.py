"""What a trial costs: the world with control and sensing, a planning cycle, and whether anything grows over trials."""

from __future__ import annotations

import time

import numpy as np

from benchmarks.effort import Effort
from benchmarks.machine import resident_bytes
from benchmarks.report import Report, Row, Target, row
from kraft.driving.method import load_method
from kraft.scenario import load_scenario
from kraft.trial.result import TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle

SCENES = ("turns", "boxes", "slope", "slip", "bump", "movable")
SEED = 1000  # of the first trial: tuning's, not the tables'
WARM = 10  # trials after which memory is counted


def run(effort: Effort) -> Report:
    """Measure one-shot trials for the world, replanning ones for the cycle."""
    rows = [entry for name in SCENES for entry in world_rows(name, effort)]
    for method in ("kraft", "conservative-kraft", "filtered-kraft"):
        rows += cycle_rows(method, effort)
    rows += growth_rows(effort)
    notes = [
        "Processor time of one core. World: OneShot + Kinodynamic trials from their first command on, no planning.",
        "Cycle: all that the replanner does between two cycles' ends, as each trial records it.",
    ]
    return Report("drive", rows, notes=notes)


def spec(scene: str, method: str, seed: int) -> TrialSpec:
    """A trial of bundled parts."""
    scenario, chosen = load_scenario(scene), load_method(method)
    return TrialSpec(scenario, chosen, load_vehicle(chosen.planner.vehicle or scenario.vehicle), seed)


def world_rows(scene: str, effort: Effort) -> list[Row]:
    """How much faster than real time a trial is from its first command on: all of it but planning and preparing."""
    factors, before = [], []
    driven(spec(scene, "oneshot-kinodynamic", SEED))
    for k in range(effort.repeats):
        factor, prepared = driven(spec(scene, "oneshot-kinodynamic", SEED + k))
        factors.append(factor)
        before.append(prepared)
    return [
        row(f"{scene}: world, camera and control, faster than real time", "times", factors, Target(50.0, most=False)),
        row(f"{scene}: the world, maps and one plan's verification before it", "ms", before),
    ]


def driven(job: TrialSpec) -> tuple[float, float]:
    """How much faster than real time a one-shot trial is once it drives, and what comes before, less the search, ms."""
    marks: list[float] = []
    began = time.process_time()
    result = run_trial(job, on_step=lambda world, step: marks.append(time.process_time()) if not marks else None)
    ended = time.process_time()
    planning = sum(cycle.planning_ms for cycle in result.cycles)
    return result.time / (ended - marks[0]), 1000.0 * (marks[0] - began) - planning


def cycle_rows(method: str, effort: Effort) -> list[Row]:
    """Planning time of a cycle, in all scenes."""
    times = [
        cycle.planning_ms
        for name in SCENES
        for k in range(effort.repeats)
        for cycle in run_trial(spec(name, method, SEED + k)).cycles
    ]
    p99 = float(np.quantile(times, 0.99))
    return [
        row(f"{method}: planning cycle, {len(times)} of them", "ms", times),
        row(f"{method}: planning cycle, p99", "ms", [p99], Target(50.0)),
    ]


def growth_rows(effort: Effort) -> list[Row]:
    """Planning time and memory of the first trials against the last ones, in one process."""
    trials = max(effort.cycles, 4)
    first: list[float] = []
    last: list[float] = []
    memory = []
    for k in range(trials):
        result = run_trial(spec("turns", "kraft", SEED + k))
        times = [cycle.planning_ms for cycle in result.cycles[1:]]
        first += times if k < trials // 2 else []
        last += times if k >= trials // 2 else []
        memory.append(resident_bytes() / 2**20)  # not the largest so far, which cannot grow after a peak
    warm = memory[min(WARM, trials - 2)]
    return [
        row("trials in one process", "", [trials]),
        row("planning cycle, second half of the trials over the first", "times", [np.median(last) / np.median(first)]),
        row("resident memory, growth after the first trials", "MB", [memory[-1] - warm], Target(20.0)),
    ]
