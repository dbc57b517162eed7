"""The peers at equal information: all rows over the suites, and the paper's claims with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial, reduce
from operator import or_

import numpy as np

from benchmarks import claims
from benchmarks.claims import PAPER, SAFETY, Claim
from benchmarks.effort import Effort
from benchmarks.parallel import each, interval
from benchmarks.report import Report, Row, Target, number, row
from kraft.driving.method import Method, load_method
from kraft.driving.needs import needs_of
from kraft.evaluation.statistics import SIGNIFICANT
from kraft.evaluation.suite import Entry, load_suite
from kraft.planning.compilation import ensure_all_compiled, ensure_compiled
from kraft.planning.workspace import goal_of, settings_of, start_state, workspace_of
from kraft.scenario import load_scenario
from kraft.trial.result import Outcome, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats
from ompl_ext.query import Safety
from ompl_ext.solver import DirtSolver

METHODS = ("adaptive-kraft", "kraft-mppi", "kraft-nmpc", "sst", "mppi", "nmpc", "dwa")
WITHOUT = ("mppi", "nmpc", "dwa", "kraft-mppi")
"""Rows that are driven without contingencies, too."""
PLANNERS = ("dirt", "sst")
BUDGETS = (1000, 5000, 20_000)


@dataclass(frozen=True)
class Drive:
    """How a trial of a row ended, and what it took."""

    name: str
    scenario: str
    seed: int
    outcome: str
    time: float
    obstacle: str | None
    contingencies: int
    missed: int


@dataclass(frozen=True)
class Case:
    """Row of the table: a method, with or without its contingencies."""

    method: str
    contingency: bool = True

    @property
    def name(self) -> str:
        """Name in the table."""
        return self.method if self.contingency else f"{self.method}, no contingencies"

    def load(self) -> Method:
        """The method."""
        found = load_method(self.method)
        if self.contingency:
            return found
        content = found.model_dump()
        content["planner"] |= {"contingency": False}
        return Method.model_validate(content)


def cases() -> tuple[Case, ...]:
    """Rows of the table, and those that only the claims need."""
    named = {name for claim in PAPER for name in claim.methods} | set(METHODS)
    order = [*METHODS, *sorted(named - set(METHODS))]
    return (*(Case(name) for name in order), *(Case(name, contingency=False) for name in WITHOUT))


@cache
def entries() -> tuple[Entry, ...]:
    """Entries of the suites `paper` and `hard`."""
    return tuple(entry for suite in ("paper", "hard") for entry in load_suite(suite))


def run(effort: Effort) -> Report:
    """Drive every row in every entry with every seed, and plan with dirt and sst."""
    compile_all()
    count = len(cases()) * len(entries()) * effort.peer_trials
    drives = each(partial(drive, seeds=effort.peer_trials), range(count), effort.jobs)
    notes = [f"{effort.peer_trials} seeds per row and entry, from 0; times of the successful drives"]
    compared = comparisons(drives)
    tables = {"rows": table_of(drives), "claims": claims.table(compared, {}), "costs of plans, s": plans()}
    return Report("peers_table", rows_of(compared), tables, notes)


def compile_all() -> None:
    """Compile what the rows need."""
    for case in cases():
        method = case.load()
        vehicle = load_vehicle(method.planner.vehicle or "mushr")
        needs = [needs_of(method, vehicle, entry.scenario.goal) for entry in entries()]
        ensure_all_compiled([reduce(or_, needs)], print)


def drive(k: int, seeds: int) -> Drive:
    """Drive number `k`: seed after seed, then entry after entry, then row after row."""
    case, entry = cases()[k // seeds // len(entries())], entries()[k // seeds % len(entries())]
    return drive_case(case, entry, k % seeds)


def drive_case(case: Case, entry: Entry, seed: int) -> Drive:
    """One trial of a row in an entry."""
    return drive_method(case.load(), entry, seed, case.name)


def drive_method(method: Method, entry: Entry, seed: int, name: str) -> Drive:
    """One trial of a method in an entry; `name` is that of its row."""
    vehicle = load_vehicle(method.planner.vehicle or entry.scenario.vehicle)
    found = run_trial(TrialSpec(entry.scenario, method, vehicle, seed))
    return Drive(
        name, entry.name, seed, str(found.outcome), found.time, found.obstacle, found.contingencies, found.missed
    )


def table_of(drives: Sequence[Drive]) -> list[list[str]]:
    """Table of the rows."""
    found = [["row", "trials", "success (95 %)", "collision", "timeout", "mean time, s", "contingencies", "missed"]]
    for name in dict.fromkeys(d.name for d in drives):
        mine = [d for d in drives if d.name == name]
        times = [d.time for d in mine if d.outcome == Outcome.SUCCESS]
        found.append(
            [
                name,
                str(len(mine)),
                f"{len(times)} ({interval(len(times), len(mine))})",
                *(str(sum(d.outcome == outcome for d in mine)) for outcome in (Outcome.COLLISION, Outcome.TIMEOUT)),
                number(float(np.mean(times))) if times else "-",
                number(float(np.mean([d.contingencies for d in mine]))),
                str(sum(d.missed for d in mine)),
            ]
        )
    return found


def comparisons(drives: Sequence[Drive]) -> list[claims.Comparison]:
    """The paper's claims, and that contingencies help the peers, on the same entries and seeds."""
    peers = (Claim(SAFETY, case.method, case.name) for case in cases() if not case.contingency)
    found = (claims.compare(claim, *(trials(drives, name) for name in claim.methods)) for claim in (*PAPER, *peers))
    return [each for each in found if each is not None]


def trials(drives: Sequence[Drive], name: str) -> claims.Trials:
    """Trials of a row; the entries of both suites have different names."""
    return {
        ("", d.scenario, d.seed): claims.Trial(
            d.outcome == Outcome.SUCCESS,
            d.outcome == Outcome.COLLISION,
            d.time if d.outcome == Outcome.SUCCESS else None,
        )
        for d in drives
        if d.name == name
    }


def rows_of(compared: Sequence[claims.Comparison]) -> list[Row]:
    """Each claim's gain in points, of successes, or of avoided collisions for safety, and its p-value.

    The target is that of a gain that is shown; the p-value of a loss is no help and counts as 1.
    """
    found = []
    for comparison in compared:
        claim = comparison.claim
        safety = claim.part == SAFETY
        difference = comparison.collision if safety else comparison.success
        low, middle, high = (
            100.0 * end for end in (difference.interval[0], difference.difference, difference.interval[1])
        )
        if safety:
            low, middle, high = -high, -middle, -low
        what = "fewer collisions" if safety else "more successes"
        quantity = f"{claim.part}, {claim.method} against {claim.reference}: {middle:+.1f} points {what}"
        quantity += f" (95 %: {low:+.1f} to {high:+.1f}), p"
        found.append(row(quantity, "", [difference.p if middle > 0.0 else 1.0], Target(SIGNIFICANT)))
    return found


def plans() -> list[list[str]]:
    """Median cost over 5 seeds of plans of the benchmark vehicle, without local optimisation."""
    vehicle = load_vehicle("benchmark")
    found = [["scene", "planner", *(f"{budget:,} iterations" for budget in BUDGETS)]]
    ensure_compiled(vehicle, print, modules=("sst",))
    for scene in ("turns", "boxes"):
        task = load_scenario(scene).task()
        for planner in PLANNERS:
            settings = replace(settings_of(task, vehicle), polish=False, planner=planner)
            solver = DirtSolver(vehicle, workspace_of(task, vehicle), goal_of(task), Safety(enabled=False), settings)
            costs = np.array([costs_of(solver, start_state(task, vehicle), seed) for seed in range(5)])
            found.append([scene, planner, *(number(float(np.median(column))) for column in costs.T)])
    return found


def costs_of(solver: DirtSolver, start: Floats, seed: int) -> list[float]:
    """Cost of the best plan after each of the `BUDGETS` of iterations of one search, s."""
    costs = []
    solver.start(start, seed)
    for budget in BUDGETS:
        solver.grow(iterations=budget - solver.progress.iterations)
        costs.append(float(solver.best_cost))
    return costs
