"""Random scenes and seeds: is any plan that the planner returns in collision, any contingency nearer than delta?"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

from benchmarks.effort import Effort
from benchmarks.judge import Judgement, judge
from benchmarks.random_scenes import VEHICLES, RandomScene, random_scene, vehicle_named
from benchmarks.report import Report, Target, row
from kraft.planning.compilation import ensure_compiled
from ompl_ext.arrays import Floats
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.plan import Plan
from ompl_ext.solver import DirtSolver
from ompl_ext.verification import verify

REPLAN_EVERY = 3  # of the scenes: the plan is kept where its first cycle ends, and planning goes on from there
CAPACITY = 20_000  # nodes
FAULTS = {
    "differs": "plans whose trajectory is not what their controls do",
    "collides": "plans in collision",
    "too_close": "plans nearer than delta(v) in the first cycle",
    "no_contingency": "plans without the contingency asked for",
    "contingency_collides": "contingencies in collision",
    "contingency_too_close": "contingencies nearer than delta(v)",
}


@dataclass(frozen=True)
class Outcome:
    """A scene's plan, or the plan that followed it: whether it reaches the goal, and what both judges say."""

    scene: int
    vehicle: str
    replanned: bool
    planned: bool
    reaches_goal: bool = False
    braking: bool = False
    refused: tuple[str, ...] = ()
    judgement: Judgement | None = None


def run(effort: Effort) -> Report:
    """Plan in all scenes and judge every plan."""
    for name in VEHICLES:
        ensure_compiled(vehicle_named(name), lambda text: print(text, file=sys.stderr))
    outcomes = [each for of_scene in everywhere(effort) for each in of_scene]
    plans = [each for each in outcomes if each.planned]
    judged = [(each, each.judgement) for each in plans if each.judgement is not None]
    counts = {
        "scenes": effort.scenes,
        "queries": len(outcomes),
        "queries that continue an earlier plan": sum(each.replanned for each in outcomes),
        "plans": len(plans),
        "plans that reach the goal": sum(each.reaches_goal for each in plans),
        "contingencies": sum(each.braking for each in plans),
    }
    rows = [row(quantity, "", [count]) for quantity, count in counts.items()]
    rows.append(row("plans that ompl_ext.verification refuses", "", [sum(bool(p.refused) for p in plans)], Target(0)))
    faulty = {fault: [each.scene for each, verdict in judged if getattr(verdict, fault)] for fault in FAULTS}
    rows += [row(FAULTS[fault], "", [len(scenes)], Target(0)) for fault, scenes in faulty.items()]
    touching = [each.scene for each, verdict in judged if verdict.exact_collides]
    rows.append(row("plans in collision if integrated exactly", "", [len(touching)]))
    for name in VEHICLES:
        errors = [1e3 * verdict.integration_error for each, verdict in judged if each.vehicle == name]
        rows.append(row(f"{name}: integration error of the planner's steps", "mm", errors))
    listed = {**{FAULTS[fault]: scenes for fault, scenes in faulty.items()}, "if integrated exactly": touching}
    listed["refused by ompl_ext.verification"] = [each.scene for each in plans if each.refused]
    notes = [
        "Judged with models and obstacles of their own: controls rolled out, FCL asked every 5 mm of motion.",
        *(f"{what}: scenes {scenes}" for what, scenes in listed.items() if scenes),
    ]
    return Report("safety", rows, notes=notes)


def everywhere(effort: Effort) -> Iterator[list[Outcome]]:
    """Outcomes of all scenes, in their order."""
    numbers = range(effort.scenes)
    if effort.jobs == 1:
        yield from with_progress(map(plan_and_judge, numbers), effort.scenes)
        return
    with ProcessPoolExecutor(effort.jobs, mp_context=get_context("spawn")) as pool:
        yield from with_progress(pool.map(plan_and_judge, numbers, chunksize=5), effort.scenes)


def with_progress(outcomes: Iterable[list[Outcome]], total: int) -> Iterator[list[Outcome]]:
    """The same, telling how far it has come."""
    said = time.monotonic()
    for done, outcome in enumerate(outcomes, 1):
        yield outcome
        if time.monotonic() - said > 10:
            said = time.monotonic()
            print(f"  {done:,} of {total:,} scenes", file=sys.stderr, flush=True)


def plan_and_judge(number: int) -> list[Outcome]:
    """Plan in a scene, in some of them once more from the end of the plan's first cycle, and judge the plans."""
    query = random_scene(number)
    dirt = DirtSolver(query.vehicle, query.workspace, query.goal, query.safety, query.settings, CAPACITY)
    dirt.start(query.start, number)
    dirt.grow(iterations=query.iterations)
    plan = dirt.plan()
    outcomes = [outcome(query, dirt, query.start, plan, replanned=False)]
    after = query.safety.cycle
    if plan is not None and number % REPLAN_EVERY == 0 and 0.0 < after < plan.cost:
        state = interpolated_rows(after, plan.times, plan.trajectory)
        dirt.start(state, number)
        dirt.retain(plan, after)
        dirt.grow(iterations=query.iterations // 4)
        outcomes.append(outcome(query, dirt, state, dirt.plan(), replanned=True))
    return outcomes


def outcome(query: RandomScene, dirt: DirtSolver, start: Floats, plan: Plan | None, *, replanned: bool) -> Outcome:
    """Both judgements of a plan."""
    if plan is None:
        return Outcome(query.number, query.vehicle.name, replanned, planned=False)
    return Outcome(
        scene=query.number,
        vehicle=query.vehicle.name,
        replanned=replanned,
        planned=True,
        reaches_goal=plan.reaches_goal,
        braking=plan.contingency is not None,
        refused=tuple(map(str, verify(dirt, plan).problems)),
        judgement=judge(query, start, plan),
    )
