"""Planning of a task: check it, grow the tree, and verify the plan exactly before it is returned."""

from __future__ import annotations

import math
import time as clock
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from kraft.errors import Defect
from kraft.planning.feasibility import UNREACHABLE, check_placement, nearest_obstacle, reachable
from kraft.planning.free_place import free_place
from kraft.planning.search import (
    Budget,
    OnProgress,
    Previous,
    SearchRequest,
    SearchResult,
    check_previous,
    check_seed,
    check_threads,
    search_named,
)
from kraft.planning.workspace import (
    goal_of,
    safety_of_task,
    settings_of,
    start_state,
    vehicle_of_task,
    workspace_of,
)
from kraft.scenario import Scenario, Task, load_scenario
from kraft.text import counted, listed
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan, TreeView
from ompl_ext.poses import pose_of
from ompl_ext.problem import settings_for
from ompl_ext.query import Settings
from ompl_ext.query_tree import Progress
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle
from ompl_ext.verification import Requirement, Verification, verify

FINER: Final = (0.05, 0.02, 0.01)
"""Excesses, as shares of the width, of the covers that are tried for a start too near to an obstacle for few discs."""


@dataclass(frozen=True)
class PlanResult:
    """Result of planning a task.

    Attributes:
        plan: best plan, or the one that ends closest to the goal; None if no plan may be executed.
        tree: copy of the search tree.
        progress: iterations, edges, and the history of costs.
        verification: exact verification of the plan; None without a plan.  Plans of DIRT have no problems; a plan of
            one of OMPL's own planners, which have no SAFETY, is free of collisions but may lack clearance or a
            contingency.
        reason: why no plan reaches the goal; empty if one does.
        budget: budget of the search.
        settings: of the planner, with those that it chose for the start and the goal.
        seed: of the random generator.
        setup_seconds: clearance field, cost-to-go, loading the compiled kernels.
        verify_seconds: verification.
        threads: number of trees grown at the same time.
    """

    plan: Plan | None
    tree: TreeView = field(repr=False)
    progress: Progress
    verification: Verification | None
    reason: str
    budget: Budget
    settings: Settings
    seed: int
    setup_seconds: float
    verify_seconds: float
    threads: int = 1

    @property
    def safe(self) -> bool:
        """Whether the plan keeps its clearance and has a contingency, as verified."""
        return self.verification is not None and not self.verification.problems

    @property
    def solved(self) -> bool:
        """Whether there is a plan that reaches the goal."""
        return self.plan is not None and self.plan.reaches_goal


def budget_of(task: Task) -> Budget:
    """Budget of the task itself."""
    return Budget(task.planning.iteration_budget, task.planning.time)


def plan_task(
    task: Task,
    vehicle: Vehicle,
    budget: Budget | None = None,
    seed: int = 0,
    previous: Previous | None = None,
    threads: int = 1,
    on_progress: OnProgress | None = None,
) -> PlanResult:
    """Plan to the goal from the start of the task, or from a state of a previous plan.

    Args:
        task: scene, start, goal and planning settings.
        vehicle: from `kraft.vehicles.load.load_vehicle`; the reference in the task is ignored.
        budget: by default that of the task.
        seed: the same seed, iterations and threads give the same plan, bit for bit.
        previous: earlier plan to start from and to retain.
        threads: number of trees that are grown at the same time and share the best cost; only with DIRT.
        on_progress: receives what the search has done so far, many times a second; not of OMPL's own planners.

    Raises:
        InputError: if start or goal is in collision or out of bounds, the previous plan is not of this vehicle,
            there is no such planner, or the seed is negative.
        TypeError: if the previous plan is no `Previous`, which holds a plan and the time since its start.
        Defect: if a plan of DIRT fails verification.
    """
    if not isinstance(previous, Previous | None):
        raise TypeError(f"previous: expected a kraft.planning.search.Previous, not {type(previous).__name__}")
    search = search_named(task.planning.planner)
    check_threads(task.planning.planner, threads)
    check_seed(seed)
    seed, threads = int(seed), int(threads)
    check_previous(task.planning.planner, previous, vehicle)
    state = start_state(task, vehicle) if previous is None else previous.state
    check_placement(task, vehicle, state, previous.origin if previous else None)
    began = clock.perf_counter()
    dirt, settings, slack = _started_solver(task, vehicle, state, seed, threads)
    setup_seconds = clock.perf_counter() - began
    budget = budget or budget_of(task)
    reason = _infeasible_start(task, dirt, state, slack)
    request = SearchRequest(state, budget, seed, previous, on_progress)
    found = SearchResult(None, dirt.progress) if reason else search(dirt, request)
    began = clock.perf_counter()
    verification = verify(dirt, found.plan) if found.plan is not None else None
    verify_seconds = clock.perf_counter() - began
    plan, unfit = _accepted(found, verification, seed)
    reason = reason or unfit or _failure_reason(task, vehicle, plan, found.progress)
    judged = verification if plan is not None else None
    used = settings_for(settings, vehicle, dirt.workspace, dirt.goal)
    return PlanResult(
        plan, dirt.tree(), found.progress, judged, reason, budget, used, seed, setup_seconds, verify_seconds, threads
    )


def _started_solver(
    task: Task, vehicle: Vehicle, state: Floats, seed: int, threads: int
) -> tuple[DirtSolver, Settings, float]:
    """A solver that is started in a state (nx,), its settings, and the slack of the clearance there, m.

    Where the footprint is free, but the discs of the task's settings are not, it has the first of the finer covers
    `FINER` whose discs are.
    """
    workspace, safety, settings = workspace_of(task, vehicle), safety_of_task(task), settings_of(task, vehicle)
    goal = goal_of(task)
    dirt = DirtSolver(vehicle, workspace, goal, safety, settings, threads=threads)
    slack = dirt.start(state, seed)
    is_coarse = settings.excess == 0.0 and not goal.has_heading  # for a goal with a heading the cover is fine
    free = _distance(dirt, state) if slack < 0.0 and is_coarse and not _beyond_limits(vehicle, state) else 0.0
    for excess in FINER:
        if slack < 0.0 and free > excess * vehicle.footprint.width:  # free, but too near for few discs
            settings = replace(settings, excess=excess)
            dirt = DirtSolver(vehicle, workspace, goal, safety, settings, threads=threads)
            slack = dirt.start(state, seed)
    return dirt, settings, slack


def finds_plan(task: Task, vehicle: Vehicle, iterations: int) -> bool:
    """Whether DIRT with these iterations and the seed 0 finds a plan to the goal; ends with the first one.

    `plan_task` may find one where this does not: it also optimises plans, and covers the footprint by smaller discs
    where the start asks for that.

    Args:
        task: scene, start and goal, both free.
        vehicle: as for `plan_task`.
        iterations: budget of the search; the result is repeatable.

    Raises:
        Defect: if the plan fails verification.
    """
    state = start_state(task, vehicle)
    settings = replace(settings_of(task, vehicle), polish=False)  # the first plan counts, however long it is
    dirt = DirtSolver(vehicle, workspace_of(task, vehicle), goal_of(task), safety_of_task(task), settings)
    if _infeasible_start(task, dirt, state, dirt.start(state, seed=0)):
        return False
    dirt.grow(iterations=iterations, stop=lambda: bool(dirt.progress.history))
    found = SearchResult(dirt.plan(), dirt.progress)
    verification = verify(dirt, found.plan) if found.plan is not None else None
    accepted, _ = _accepted(found, verification, seed=0)
    return accepted is not None and accepted.reaches_goal


def plan(
    scenario: Task | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    *,
    iterations: int | None = None,
    time: float | None = None,
    seed: int = 0,
    previous: Previous | None = None,
    threads: int = 1,
) -> PlanResult:
    """Plan a scenario, as `plan_task` does with what is already loaded.

    Args:
        scenario: a bundled name, the path of a file, a loaded scenario, or a task.
        vehicle: a reference as in `kraft.load_vehicle`, or a vehicle; by default the scenario's.
        iterations: budget instead of the scenario's.
        time: budget instead of the scenario's, in s of wall-clock time; at most one of the two.
        seed: the same seed and iterations give the same plan, bit for bit.
        previous: an earlier plan to begin with.
        threads: number of trees that are grown at the same time.

    Raises:
        InputError: with what is wrong with scenario, vehicle or budget, or as `plan_task`.
        TypeError: if the scenario, the vehicle or the previous plan is none of these.
        Defect: if the plan found does not pass exact verification.
    """
    loaded = load_scenario(scenario) if isinstance(scenario, str | Path) else scenario
    task = loaded.task() if isinstance(loaded, Scenario) else loaded
    if not isinstance(task, Task):
        raise TypeError(f"scenario: expected a name, a path, a Scenario or a Task, not {type(scenario).__name__}")
    if vehicle is None:
        vehicle = vehicle_of_task(task)
    model = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    budget = None
    if iterations is not None or time is not None:
        limits = {"iterations": _number(iterations), "time": _number(time)}
        budget = budget_of(replace(task, planning=task.planning.with_budget(**limits)))
    return plan_task(task, model, budget, seed, previous, threads)


def _number(value: Any) -> Any:
    """Python's number of one of numpy; other values as they are."""
    return value.item() if isinstance(value, np.generic) else value


def _accepted(found: SearchResult, verification: Verification | None, seed: int) -> tuple[Plan | None, str]:
    """Plan that passes verification, or the reason why there is none.

    Raises:
        Defect: if the plan of a planner with SAFETY fails verification.
    """
    if found.plan is None or verification is None or not verification.problems:
        return found.plan, ""
    problems = listed(verification.problems)
    if found.promises_safety:
        raise Defect(f"the plan of seed {seed} fails verification: {problems}")
    collides = any(problem.requirement is Requirement.COLLISION for problem in verification.problems)
    if verification.min_clearance > 0.0 and not collides:
        return found.plan, ""  # free of collisions, which is all that this planner guarantees
    return None, f"the planner's plan was refused: {problems}"


def _distance(dirt: DirtSolver, state: Floats) -> float:
    """Distance of the footprint from obstacles in a state (nx,), m."""
    return dirt.exact.distance(*pose_of(state, dirt.vehicle))


def _beyond_limits(vehicle: Vehicle, state: Floats) -> str:
    """Components of a state (nx,) that are beyond the vehicle's limits, with their values; empty if none is."""
    beyond = [
        f"{name} is {value:g}, not {low:g} to {high:g}"
        for name, value, (low, high) in zip(vehicle.state, state, vehicle.state_limits, strict=True)
        if not low <= value <= high
    ]
    return ", ".join(beyond)


def _infeasible_start(task: Task, dirt: DirtSolver, state: Floats, slack: float) -> str:
    """Reason why no plan from this start exists, whatever the budget; empty if one may exist."""
    x, y, _ = pose_of(state, dirt.vehicle)
    if not reachable(dirt.problem, x, y):
        return UNREACHABLE
    if slack < 0.0 and (beyond := _beyond_limits(dirt.vehicle, state)):
        return f"the start is beyond the limits of the vehicle: {beyond}"
    if slack < 0.0:
        return _too_near(task, dirt, state)
    _, beyond_delta = dirt.edge(state, np.zeros(len(dirt.vehicle.controls)), 0.0, 0.0)
    if beyond_delta < 0.0:
        return (
            f"the start lacks {-beyond_delta:.3f} m of the clearance delta that its first cycle requires; start "
            "farther from obstacles, or ask for less (planning.safety)"
        )
    return ""


def _too_near(task: Task, dirt: DirtSolver, state: Floats) -> str:
    """What to say of a start that is free, but not by as much as the planner's bounds of the distance are too short."""
    vehicle, pose = dirt.vehicle, pose_of(state, dirt.vehicle)
    place = free_place(task, vehicle, pose)
    such = "" if place is None else f", such as at ({place[0]:.2f}, {place[1]:.2f}) with this heading"
    return (
        f"the start is too near to {nearest_obstacle(task, vehicle, pose)}: {vehicle.name} is "
        f"{1000.0 * _distance(dirt, state):.1f} mm away, and the planner, which takes distances for a little shorter "
        f"than they are, needs more room; start farther away{such}"
    )


def _failure_reason(task: Task, vehicle: Vehicle, plan: Plan | None, progress: Progress) -> str:
    """Reason why no plan reaches the goal; empty if one does."""
    if plan is not None and plan.reaches_goal:
        return ""
    used = f"{counted(progress.iterations, 'iteration')} ({progress.seconds:.3g} s)"
    if plan is not None:
        return f"no plan reaches the goal after {used}; the best one ends {_distance_to_goal(task, vehicle, plan)}"
    unsafe = f", {progress.unsafe} of them because no contingency is safe" if progress.unsafe else ""
    # OMPL's own planners do not count the edges that they try
    tried = f", of {counted(progress.edges, 'edge')} tried{unsafe}" if progress.edges else ""
    return f"no edge may be executed after {used}{tried}"


def _distance_to_goal(task: Task, vehicle: Vehicle, plan: Plan) -> str:
    """Phrase with the distance of the end of a plan from the goal region and its heading error."""
    goal = task.goal
    x, y, heading = pose_of(plan.states[-1], vehicle)
    distance = math.dist((x, y), goal.center) - goal.radius
    place = f"{distance:.3g} m from the goal region" if distance > 0.0 else "in the goal region"
    for name, (low, high) in goal.limits.items():
        value = float(plan.states[-1][vehicle.index(name)])
        if not low <= value <= high:
            place += f", {name} {value:.3g}, of which {low:g} to {high:g} are allowed"
    if goal.heading is None or goal.heading_tolerance is None:
        return place
    off = math.degrees(abs(math.remainder(heading - goal.heading, math.tau)))
    tolerance = math.degrees(goal.heading_tolerance)
    return (
        f"{place}, {off:.3g} degrees off the heading, of which {tolerance:.3g} are allowed"
        if off > tolerance
        else place
    )
