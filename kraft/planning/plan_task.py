"""Plan a task: check it, grow the tree, and have the plan judged before anybody sees it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from kraft.errors import Defect
from kraft.planning.feasibility import UNREACHABLE, check_placement, reachable
from kraft.planning.search import Budget, Previous, SearchResult, search_named
from kraft.planning.workspace import (
    goal_of,
    heading_of,
    pose_of,
    safety_of_task,
    settings_of,
    start_state,
    workspace_of,
)
from kraft.scenario import Task
from kraft.text import counted
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan, TreeView
from ompl_ext.solver import Dirt, Progress
from ompl_ext.vehicle import Vehicle
from ompl_ext.verify import Requirement, Verification, verify


@dataclass(frozen=True)
class PlanResult:
    """What came of planning a task.

    Attributes:
        plan: the best plan, or the one that ends closest to the goal, or None if there is none that may be executed.
        tree: a copy of the tree that it was found in.
        progress: iterations, edges, and when which cost was found.
        verification: FCL's judgement of the plan; None without a plan.  DIRT's have no problems; a plan of one of
            OMPL's own planners, which know no SAFETY, is free of collisions but may lack clearance or a contingency.
        reason: why there is no plan that reaches the goal; empty if there is one.
        budget: what was asked for.
        seed: of the random generator.
        setup_seconds: clearance field, cost-to-go, loading the compiled kernels.
        verify_seconds: the judgement.
    """

    plan: Plan | None
    tree: TreeView
    progress: Progress
    verification: Verification | None
    reason: str
    budget: Budget
    seed: int
    setup_seconds: float
    verify_seconds: float

    @property
    def safe(self) -> bool:
        """Whether the plan keeps its clearance and has a contingency, as verified."""
        return self.verification is not None and not self.verification.problems

    @property
    def solved(self) -> bool:
        """Whether there is a plan that reaches the goal."""
        return self.plan is not None and self.plan.reaches_goal


def budget_of(task: Task) -> Budget:
    """The budget that the task itself gives."""
    return Budget(task.planning.iteration_budget, task.planning.time)


def plan_task(
    task: Task, vehicle: Vehicle, budget: Budget | None = None, seed: int = 0, previous: Previous | None = None
) -> PlanResult:
    """Plan from the task's start, or from within a previous plan, to the goal.

    Args:
        task: scene, start, goal and planning settings.
        vehicle: see `kraft.vehicles.load.load_vehicle`; the task's own reference is not followed.
        budget: instead of the task's.
        seed: the same seed and iterations give the same plan, bit for bit.
        previous: an earlier plan to begin with.

    Raises:
        InputError: if start or goal is in collision or out of bounds, the previous plan is not of this vehicle, or
            there is no such planner.
        Defect: if the plan found does not stand up to exact verification.
    """
    search = search_named(task.planning.planner)
    if previous is not None:
        previous.check(vehicle)
    state = start_state(task, vehicle) if previous is None else previous.state
    check_placement(task, vehicle, state, previous.origin if previous else None)
    began = time.perf_counter()
    dirt = Dirt(vehicle, workspace_of(task, vehicle), goal_of(task), safety_of_task(task), settings_of(task))
    spare = dirt.start(state, seed)
    setup_seconds = time.perf_counter() - began
    budget = budget or budget_of(task)
    reason = _infeasible_start(dirt, state, spare)
    found = SearchResult(None, dirt.progress) if reason else search(dirt, state, budget, seed, previous)
    began = time.perf_counter()
    verification = verify(dirt, found.plan) if found.plan is not None else None
    verify_seconds = time.perf_counter() - began
    plan, unfit = _accepted(found, verification, seed)
    reason = reason or unfit or _failure_reason(task, vehicle, plan, found.progress)
    judged = verification if plan is not None else None
    return PlanResult(plan, dirt.tree(), found.progress, judged, reason, budget, seed, setup_seconds, verify_seconds)


def _accepted(found: SearchResult, verification: Verification | None, seed: int) -> tuple[Plan | None, str]:
    """The plan if it stands up to its verification, else why there is none.

    Raises:
        Defect: if a planner that promises SAFETY broke its promise.
    """
    if found.plan is None or verification is None or not verification.problems:
        return found.plan, ""
    problems = "; ".join(map(str, verification.problems))
    if found.promises_safety:
        raise Defect(f"the plan of seed {seed} fails verification: {problems}")
    collides = any(problem.requirement is Requirement.COLLISION for problem in verification.problems)
    if verification.min_clearance > 0.0 and not collides:
        return found.plan, ""  # free of collisions, and that is all this planner promises
    return None, f"the planner's plan was refused: {problems}"


def _infeasible_start(dirt: Dirt, state: Floats, spare: float) -> str:
    """Why no plan can be found from this start, however long one searches; empty if one might be."""
    x, y = (float(state[dirt.vehicle.index(name)]) for name in ("x", "y"))
    if not reachable(dirt.problem, x, y):
        return UNREACHABLE
    if spare < 0.0:
        exact = dirt.exact.distance(x, y, heading_of(state, dirt.vehicle))
        return f"the start is too near to an obstacle: {exact:.4f} m, which is less than the clearance grid resolves"
    _, beyond_delta = dirt.edge(state, np.zeros(len(dirt.vehicle.controls)), 0.0, 0.0)
    if beyond_delta < 0.0:
        return f"the start lacks {-beyond_delta:.3f} m of the clearance delta that its first cycle asks for"
    return ""


def _failure_reason(task: Task, vehicle: Vehicle, plan: Plan | None, progress: Progress) -> str:
    """Why the search ended without a plan that reaches the goal; empty if there is one."""
    if plan is not None and plan.reaches_goal:
        return ""
    used = f"{counted(progress.iterations, 'iteration')} ({progress.seconds:.3g} s)"
    if plan is not None:
        return f"no plan reaches the goal after {used}; the best one ends {_distance_to_goal(task, vehicle, plan)}"
    unsafe = f", {progress.unsafe} of them because no contingency is safe" if progress.unsafe else ""
    return f"no edge may be executed after {used}, of {counted(progress.edges, 'edge')} tried{unsafe}"


def _distance_to_goal(task: Task, vehicle: Vehicle, plan: Plan) -> str:
    """Where a plan ends relative to the goal region: its distance, and how far its heading is off, for a sentence."""
    goal = task.goal
    x, y, heading = pose_of(plan.states[-1], vehicle)
    distance = math.dist((x, y), goal.center) - goal.radius
    place = f"{distance:.3g} m from the goal region" if distance > 0.0 else "in the goal region"
    if goal.heading is None or goal.heading_tolerance is None:
        return place
    off = math.degrees(abs(math.remainder(heading - goal.heading, math.tau)))
    tolerance = math.degrees(goal.heading_tolerance)
    return (
        f"{place}, {off:.3g} degrees off the heading, of which {tolerance:.3g} are allowed"
        if off > tolerance
        else place
    )
