"""Local optimisation of plans: costs and changes of the steering over time with and without it, and what it costs."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np

from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, number, row
from benchmarks.scenes import NO_MARGIN, SCENES, Scene, scene
from ompl_ext.kernels import kernel_types as at
from ompl_ext.plan import Plan
from ompl_ext.polish import Polish, guess_of
from ompl_ext.query import Settings
from ompl_ext.solver import DirtSolver

LOOKS = (0.005, 0.02, 0.1)  # s
COST_WITHIN = {("turns", 0.02): 9.65, ("boxes", 0.02): 9.82}
STEERING_AFTER = 0.02  # s
WARM_UP = 3000  # iterations
GUESS = 1024  # iterations of the plan that is optimised


def run(effort: Effort) -> Report:
    """Measure both scenes with the benchmark vehicle."""
    rows: list[Row] = []
    for name in SCENES:
        query = scene(name)
        without, optimised = (over_time(query, polish, effort.seeds) for polish in (False, True))
        rows += [*without, *optimised, share_of_steering(name, without, optimised)]
        rows.append(one_optimisation(query, effort.seeds))
    notes = ["Steering: sum of the changes of the command along the plan; its range is 2."]
    return Report("polish", rows, notes=notes)


def solver(query: Scene, *, polish: bool) -> DirtSolver:
    """Solver of a scene that has already been used once."""
    dirt = DirtSolver(query.vehicle, query.workspace, query.goal, NO_MARGIN, Settings(polish=polish))
    dirt.start(query.start, 0)
    dirt.grow(iterations=WARM_UP)
    return dirt


def over_time(query: Scene, polish: bool, seeds: int) -> list[Row]:
    """First plans, costs and changes of the steering after several times, and edges per second of the search.

    A search without a plan has an infinite cost, and its steering no changes.  First plans are those of the longest
    searches, since shorter ones end before some of them.
    """
    dirt, rows = solver(query, polish=polish), []
    which = f"{query.name}, {'with' if polish else 'without'}"
    firsts, rates = [], []
    for look in LOOKS:
        costs, changes = [], []
        for seed in range(seeds):
            dirt.start(query.start, seed)
            progress = dirt.grow(seconds=look)
            plan, first = dirt.plan(), progress.first_solution
            found = plan is not None and plan.reaches_goal
            costs.append(plan.cost if plan is not None and found else math.inf)
            changes += [steering_changes(query, plan)] if plan is not None and found else []
            if look == max(LOOKS):
                firsts.append(math.inf if first is None else 1e3 * first[0])
        target = COST_WITHIN.get((query.name, look)) if polish else None
        rows += [
            row(f"{which}: cost after {number(1e3 * look)} ms", "s", costs, Target(target) if target else None),
            row(f"{which}: steering after {number(1e3 * look)} ms", "", changes),
        ]
    for seed in range(seeds):
        dirt.start(query.start, seed)
        began = time.perf_counter()
        progress = dirt.grow(iterations=WARM_UP)
        rates.append(progress.edges / (time.perf_counter() - began))
    return [
        row(f"{which}: first plan", "ms", firsts),
        *rows,
        replace(row(f"{which}: edges, optimisation included", "1/s", rates), more=True),
    ]


def share_of_steering(name: str, without: list[Row], optimised: list[Row]) -> Row:
    """Median of the changes of the steering of optimised plans over that of others, after equal times."""
    medians = [
        float(np.median(each.samples))
        for rows in (optimised, without)
        for each in rows
        if each.quantity.endswith(f"steering after {number(1e3 * STEERING_AFTER)} ms")
    ]
    return row(f"{name}: steering with over without", "", [medians[0] / medians[1]], Target(0.25))


def steering_changes(query: Scene, plan: Plan) -> float:
    """Total variation of the steering command."""
    steering = list(query.vehicle.controls).index("steering")
    return float(np.abs(np.diff(plan.controls[:, steering])).sum())


def one_optimisation(query: Scene, seeds: int) -> Row:
    """Time of one optimisation of a plan of the tree."""
    dirt, times = solver(query, polish=False), []
    polish = Polish(query.vehicle, dirt.problem)
    for seed in range(seeds):
        dirt.start(query.start, seed)
        dirt.grow(iterations=GUESS)
        plan = dirt.plan()
        if plan is None or dirt.tree_arrays.count[at.BEST] < 0:
            continue
        guess = guess_of(query.vehicle, plan.times, plan.trajectory, plan.controls, plan.durations)
        began = time.perf_counter()
        polish.improve(guess, query.goal)
        times.append(1e3 * (time.perf_counter() - began))
    return row(f"{query.name}: one optimisation", "ms", times)
