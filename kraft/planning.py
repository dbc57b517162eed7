"""Plan a task: check it, grow the tree, and have the plan judged before anybody sees it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from kraft.errors import Defect, InputError
from kraft.placement import check_placement
from kraft.planners import PLANNERS
from kraft.scenario import Task
from kraft.suggest import choose
from kraft.workspace import goal_of, heading_of, safety_of, settings_of, start_state, workspace_of
from ompl_ext import kernel_types as at
from ompl_ext.arrays import Floats
from ompl_ext.costtogo import UNREACHABLE
from ompl_ext.plan import Plan, TreeView
from ompl_ext.solver import Dirt, Progress
from ompl_ext.vehicle import Vehicle
from ompl_ext.verify import Verification, verify

PRESENT: frozenset[str] = frozenset({"dirt"})
"""Those of `kraft.planners.PLANNERS` that `plan_task` can run."""


@dataclass(frozen=True)
class Budget:
    """How long to plan: a number of iterations, which is repeatable, or wall-clock time in s."""

    iterations: int | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Previous:
    """An earlier plan to start from: planning begins where it is after `elapsed` s and keeps what is left of it.

    `origin` is the file it was read from, for messages and for the record.
    """

    plan: Plan
    elapsed: float = 0.0
    origin: str = "<built in code>"

    @property
    def state(self) -> Floats:
        """The state that the plan predicts after `elapsed` s, shape (nx,)."""
        plan = self.plan
        columns = [np.interp(self.elapsed, plan.times, column) for column in plan.trajectory.T]
        return np.array(columns)


@dataclass(frozen=True)
class PlanResult:
    """What came of planning a task.

    Attributes:
        plan: the best plan, or the one that ends closest to the goal, or None if there is none that may be executed.
        tree: a copy of the tree that it was found in.
        progress: iterations, edges, and when which cost was found.
        verification: FCL's judgement of the plan; None without a plan.
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
        vehicle: see `kraft.vehicle.load_vehicle`; the task's own reference is not followed.
        budget: instead of the task's.
        seed: the same seed and iterations give the same plan, bit for bit.
        previous: an earlier plan to begin with.

    Raises:
        InputError: if start or goal is in collision or out of bounds, or the previous plan is not of this vehicle.
        Defect: if the plan found does not stand up to exact verification.
    """
    _check_planner(task.planning.planner)
    budget = budget or budget_of(task)
    state = _first_state(task, vehicle, previous)
    check_placement(task, vehicle, state, previous.origin if previous else None)
    began = time.perf_counter()
    dirt = Dirt(vehicle, workspace_of(task, vehicle), goal_of(task), safety_of(task), settings_of(task))
    spare = dirt.start(state, seed)
    setup = time.perf_counter() - began
    reason = _hopeless(dirt, state, spare)
    if not reason:
        if previous is not None:
            dirt.retain(previous.plan, previous.elapsed)
        dirt.grow(iterations=budget.iterations, seconds=budget.seconds)
        reason = _shortfall(dirt.plan(), dirt.progress)
    plan = dirt.plan()
    began = time.perf_counter()
    verification = _judged(dirt, plan, seed) if plan is not None else None
    return PlanResult(
        plan, dirt.tree(), dirt.progress, verification, reason, budget, seed, setup, time.perf_counter() - began
    )


def _check_planner(name: str) -> None:
    if name not in PRESENT:
        expected = f"expected {' or '.join(PRESENT)}" if name in PLANNERS else choose(name, PRESENT)
        raise InputError.of(name, "is not a planner that `kraft plan` can run", expected)


def _first_state(task: Task, vehicle: Vehicle, previous: Previous | None) -> Floats:
    if previous is None:
        return start_state(task, vehicle)
    columns, controls = previous.plan.trajectory.shape[1], previous.plan.controls.shape[1]
    if (columns, controls) != (len(vehicle.state), len(vehicle.controls)):
        problem = f"the plan has {columns} state components and {controls} controls"
        expected = f"expected a plan of {vehicle.name} with {len(vehicle.state)} and {len(vehicle.controls)}"
        raise InputError.of(previous.origin, problem, expected)
    if not 0.0 <= previous.elapsed < previous.plan.cost:
        problem = f"the plan is over after {previous.plan.cost:.12g} s, asked for is {previous.elapsed:.12g} s"
        raise InputError.of(previous.origin, problem, f"expected from 0 to less than {previous.plan.cost:.12g} s")
    return previous.state


def _hopeless(dirt: Dirt, state: Floats, spare: float) -> str:
    """Why no plan can be found from this start, however long one searches; empty if one might be."""
    x, y = (float(state[dirt.vehicle.index(name)]) for name in ("x", "y"))
    if not reachable(dirt, x, y):
        return "the goal is unreachable: no path from the start is wide enough for the footprint"
    if spare < 0.0:
        exact = dirt.exact.distance(x, y, heading_of(state, dirt.vehicle))
        return f"the start is too near to an obstacle: {exact:.4f} m, which is less than the clearance grid resolves"
    _, beyond_delta = dirt.edge(state, np.zeros(len(dirt.vehicle.controls)), 0.0, 0.0)
    if beyond_delta < 0.0:
        return f"the start lacks {-beyond_delta:.3f} m of the clearance delta that its first cycle asks for"
    return ""


def reachable(dirt: Dirt, x: float, y: float) -> bool:
    """Whether a point is connected to the goal for the disc inscribed in the footprint: necessary, not sufficient."""
    scalar, togo = dirt.problem.scalar, dirt.problem.togo
    column = math.floor((x - scalar[at.GRID_X]) * scalar[at.GRID_INVERSE] - 0.5)
    row = math.floor((y - scalar[at.GRID_Y]) * scalar[at.GRID_INVERSE] - 0.5)
    return bool(togo[row : row + 2, column : column + 2].min() < UNREACHABLE)


def _shortfall(plan: Plan | None, progress: Progress) -> str:
    """Why the search ended without a plan that reaches the goal; empty if there is one."""
    if plan is not None and plan.reaches_goal:
        return ""
    used = f"{progress.iterations} iterations ({progress.seconds:.3g} s)"
    if plan is not None:
        return f"no plan reaches the goal after {used}; the best one ends {plan.cost_to_go:.3g} s short of it"
    unsafe = f", {progress.unsafe} of them because no contingency is safe" if progress.unsafe else ""
    return f"no edge may be executed after {used}: {progress.edges} were tried{unsafe}"


def _judged(dirt: Dirt, plan: Plan, seed: int) -> Verification:
    verification = verify(dirt, plan)
    if verification.problems:
        raise Defect(f"the plan of seed {seed} fails verification: " + "; ".join(verification.problems))
    return verification
