"""What the replanner may commit next: the plan for the coming cycle, or the reason why there is none.

Alg. 1 is asked once with the method's margin and, where that leads to nothing, once more without it.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kraft.driving.method import Planner
from kraft.errors import Defect
from kraft.planning.workspace import goal_of, settings_of, workspace_of
from kraft.scenario import Task
from kraft.text import counted
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan, TreeView
from ompl_ext.query import Safety
from ompl_ext.solver import Dirt, Progress
from ompl_ext.vehicle import Vehicle
from ompl_ext.verify import verify

LEEWAY = 0.005  # of a vehicle that leaves with the clearance it has (m)
SMALLEST_GOAL = 0.01  # radius of the region that the planner aims for (m)


@dataclass(frozen=True)
class Proposal:
    """A plan for the coming cycle that nobody has committed yet, or the reason why there is none."""

    plan: Plan | None
    reason: str = ""
    iterations: int = 0
    nodes: int = 0
    retained: int = 0
    seconds: float = 0.0
    missed: bool = False
    tree: TreeView | None = None


@dataclass(frozen=True)
class Planners:
    """`planning` keeps the method's margin and its foresight; `checking` asks for what is safe and no more.

    A plan is made with the margin and checked again without it, so that small errors do not turn it down.
    """

    planning: Dirt
    checking: Dirt

    @classmethod
    def of(cls, task: Task, vehicle: Vehicle, settings: Planner) -> Planners:
        """The planners of a task with a method's settings; without a clearance they are not asked for SAFETY."""
        goal = goal_of(task)
        goal = replace(goal, radius=max(goal.radius - settings.goal_margin, SMALLEST_GOAL))
        workspace, safety, shape = workspace_of(task, vehicle), safety_of(settings), vehicle.footprint
        checking = Dirt(vehicle, workspace, goal, safety, settings_of(task), settings.capacity)
        foresight = settings.safety.foresight if settings.safety else 0.0
        if settings.margin == 0.0 and foresight <= settings.cycle:
            return cls(checking, checking)
        safety = replace(safety, cycle=max(foresight, settings.cycle))
        larger = replace(shape, length=shape.length + 2 * settings.margin, width=shape.width + 2 * settings.margin)
        wide = replace(vehicle, footprint=larger)
        return cls(Dirt(wide, workspace, goal, safety, settings_of(task), settings.capacity), checking)


def safety_of(settings: Planner) -> Safety:
    """SAFETY as a method asks for it."""
    margin = settings.safety
    if margin is None:
        return Safety(enabled=False, cycle=settings.cycle)
    return Safety(cycle=settings.cycle, delta=margin.delta, delta_per_speed=margin.delta_per_speed)


class Proposer:
    """Plans for the coming cycle; `dirt` checks what is asked for and no more."""

    def __init__(
        self, planners: Planners, settings: Planner, seed: int, *, realtime: bool = False, keep_trees: bool = False
    ) -> None:
        self._settings, self._seed, self._realtime, self._keep_trees = settings, seed, realtime, keep_trees
        self._planners, self.dirt = planners, planners.checking
        self._at_rest = np.zeros(len(self.dirt.vehicle.controls))
        assert self.dirt.goal is not None, "a task has a goal"
        self._goal = self.dirt.goal
        self._delta = self.dirt.safety.delta
        self._recovering = False

    def propose(self, number: int, root: Floats, previous: Plan | None) -> Proposal:
        """Plan for the cycle after cycle `number` - 1, from the predicted root (nx,).

        Args:
            number: of the cycle.
            root: where it is predicted to begin.
            previous: plan that is executed until then; what is left of it is kept.
        """
        began, settings = clock.perf_counter(), self._settings
        proposal = Proposal(None)
        radius = self._goal_radius(root)
        for dirt, share in self._attempts(root):
            dirt.aim_for(radius)
            proposal = self._search(number, dirt, root, previous, began, share)
            if proposal.plan is not None:
                break
        seconds = clock.perf_counter() - began
        missed = seconds > settings.cycle - settings.lead
        if self._realtime and missed:
            reason = f"planning took {seconds:.3f} s, longer than there was time"
            return replace(proposal, plan=None, reason=reason, seconds=seconds, missed=True)
        return replace(proposal, seconds=seconds, missed=missed)

    def _goal_radius(self, root: Floats) -> float:
        """Radius of the region to aim for, m: as long as the trial goes on, nearer to the centre than the vehicle is.

        A vehicle that has arrived by its own estimate, but not in truth, would else wait for ever.
        """
        goal, vehicle = self._goal, self.dirt.vehicle
        away = math.dist(goal.center, (root[vehicle.index("x")], root[vehicle.index("y")]))
        return max(SMALLEST_GOAL, min(goal.radius, 0.5 * away))

    def _attempts(self, root: Floats) -> Iterator[tuple[Dirt, float]]:
        """Planners to ask in turn, with the share of the time that is left; the first that finds a plan decides."""
        wide, exact, delta = self._planners.planning, self._planners.checking, self._delta
        exact.ask_for(delta)
        was_recovering, self._recovering = self._recovering, False
        if wide is not exact and self._spare(wide, root) >= 0.0:
            yield wide, 0.5
        yield exact, 1.0  # it takes no time where it lacks clearance, so that recovering has it all
        spare = self._spare(exact, root)
        resting = all(abs(root[k]) <= exact.safety.rest_speed for k in exact.vehicle.rest_indices)
        self._recovering = self._settings.recover and (resting or was_recovering) and -delta < spare < 0.0
        if self._recovering:
            exact.ask_for(max(0.0, delta + spare - LEEWAY))
            yield exact, 1.0

    def _spare(self, dirt: Dirt, root: Floats) -> float:
        """Clearance of a state beyond what is asked for, m."""
        return dirt.edge(root, self._at_rest, 0.0, 0.0)[1]

    def _search(
        self, number: int, dirt: Dirt, root: Floats, previous: Plan | None, began: float, share: float
    ) -> Proposal:
        """Alg. 1 from the predicted root, beginning with what is left of the plan that is being executed."""
        if dirt.start(root, self._seed * 100_003 + number) < 0.0:
            return Proposal(None, "the predicted start of the cycle is in collision")
        if self._spare(dirt, root) < 0.0:
            return Proposal(None, "the predicted start of the cycle lacks clearance")
        if previous is not None and previous.cost > self._settings.cycle:
            dirt.retain(previous, self._settings.cycle)  # ll. 1-8
        progress = self._grow(dirt, began, share)
        plan = dirt.plan()
        if plan is not None:
            self._verify(number, dirt, plan)
        reason = "" if plan is not None else _shortfall(progress)
        tree = dirt.tree() if self._keep_trees else None
        return Proposal(plan, reason, progress.iterations, progress.nodes, progress.retained, tree=tree)

    def _grow(self, dirt: Dirt, began: float, share: float) -> Progress:
        """Use up the budget: a number of iterations, or by the clock a share of what is left; with a plan all of it."""
        if not self._realtime:
            return dirt.grow(iterations=self._settings.iterations)
        ends = began + self._settings.clock_budget
        progress = dirt.grow(seconds=share * (ends - clock.perf_counter()))
        return progress if dirt.plan() is None else dirt.grow(seconds=ends - clock.perf_counter())

    def _verify(self, number: int, dirt: Dirt, plan: Plan) -> None:
        """FCL's judgement of the part that may be executed before there is another plan.

        Raises:
            Defect: if the plan does not keep what the planner promises.
        """
        ends = np.cumsum(plan.durations)
        until = math.inf if self._settings.mode == "one-shot" else self._settings.cycle
        edges = min(len(ends), int(np.searchsorted(ends, until - 1e-9)) + 1)
        samples = int(np.searchsorted(plan.times, ends[edges - 1] + 1e-9)) if len(ends) else 1
        head = replace(
            plan,
            states=plan.states[: edges + 1],
            controls=plan.controls[:edges],
            durations=plan.durations[:edges],
            times=plan.times[:samples],
            trajectory=plan.trajectory[:samples],
        )
        problems = verify(dirt, head).problems
        if problems:
            raise Defect(f"the plan of cycle {number} fails verification: {'; '.join(map(str, problems))}")


def _shortfall(progress: Progress) -> str:
    unsafe = ", many for want of a safe contingency" if progress.unsafe else ""
    return f"none of {counted(progress.edges, 'edge')} may be executed{unsafe}"
