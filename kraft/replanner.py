"""The safe replanner: one step per cycle commits the plan made in the last one, or a contingency, and makes the next.

Fig. 3 of the paper.  Cycle k covers [k, k + 1) cycle durations of the trial.  `step` runs a little before cycle k
begins: it looks at the plan made during cycle k - 1 once more from the latest estimate, commits it or a manoeuvre
that stops, predicts where that leads, and plans from there for cycle k + 1.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kraft.control import Controller
from kraft.driving import Estimate, Kind, Motion, Reference
from kraft.errors import Defect
from kraft.method import Planner
from kraft.rollout import Roller
from kraft.scenario import Task
from kraft.stopping import emergency, plan_reference, stop_reference
from kraft.trial_result import Cycle
from kraft.workspace import goal_of, heading_of, settings_of, workspace_of
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan, TreeView
from ompl_ext.query import Safety
from ompl_ext.solver import Dirt
from ompl_ext.vehicle import Vehicle
from ompl_ext.verify import verify

LEEWAY = 0.005  # of a vehicle that leaves with the clearance it has (m)
SMALLEST_GOAL = 0.01  # radius of the region that the planner aims for (m)
RESERVE = 0.2
"""Share of a cycle that planning by the clock leaves unused, as the original system does."""


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
class Decision:
    """What is committed for a cycle: always a reference; `plan` is None if it is a contingency.

    `motion` is the predicted execution over the cycle and `contingency` what stops the vehicle after it.
    """

    reference: Reference
    motion: Motion
    reason: str
    plan: Plan | None = None
    contingency: Reference | None = None


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


class Replanner:
    """Decides once per cycle what the controller tracks.  See `step`."""

    def __init__(
        self,
        planners: Planners,
        settings: Planner,
        controller: Controller,
        seed: int,
        *,
        period: float,
        realtime: bool = False,
        keep_trees: bool = False,
    ) -> None:
        self._settings, self._seed, self._realtime, self._keep_trees = settings, seed, realtime, keep_trees
        self._planners, self.dirt = planners, planners.checking
        self._roll = Roller(self.dirt, controller, period)
        self._once = settings.mode == "one-shot"
        self._at_rest = np.zeros(len(self.dirt.vehicle.controls))
        assert self.dirt.goal is not None, "a task has a goal"
        self._goal = self.dirt.goal
        self._delta = self.dirt.safety.delta
        self._recovering = False
        self._number = 0
        self._proposal = Proposal(None, "there has been no time to plan")
        self._contingency: Reference | None = None

    def begin(self, state: Floats) -> Reference:
        """Plan the first cycle from the start (nx,) before the trial's clock runs; until then the vehicle stands."""
        self._proposal = self._propose(state, None)
        return Reference(
            Kind.CONTINGENCY, np.zeros(1), state[None, :], np.zeros((0, len(self._at_rest))), self._at_rest
        )

    @property
    def next_step(self) -> float:
        """When `step` is due, s of the trial: `lead` before the next cycle begins; never again after one shot."""
        if self._once and self._number > 0:
            return math.inf
        return max(0.0, self._number * self._settings.cycle - self._settings.lead)

    def step(self, estimate: Estimate, current: Reference) -> Cycle:
        """Commit a plan or a contingency for the coming cycle, and plan for the one after it.

        `current` is what the controller tracks now.  The result's reference begins with the cycle.
        """
        begins = self._number * self._settings.cycle
        here = self._freed(estimate.state)
        root = self._roll(here, estimate.time, begins, current).end
        proposal = self._proposal
        decision = self._decide(root, begins, estimate, current)
        self._contingency = decision.contingency
        cycle = self._record(decision, proposal, estimate)
        self._number += 1
        if not self._once:
            self._proposal = self._propose(decision.motion.end, decision.plan)
        return cycle

    def _decide(self, root: Floats, begins: float, estimate: Estimate, current: Reference) -> Decision:
        """The safety check right before a cycle, from the latest estimate."""
        plan = self._proposal.plan
        if plan is None:
            return self._stop(root, begins, current, self._proposal.reason)
        if self._number > 0 and estimate.age > self._settings.patience:
            return self._stop(root, begins, current, f"the newest observation is {estimate.age:.2f} s old")
        ends = begins + self._settings.cycle
        reference = plan_reference(plan, begins, self._at_rest)
        motion = self._roll(root, begins, ends, reference)
        if self._once:
            return Decision(reference, motion, "", plan)
        if motion.slack < 0.0:
            reason = f"from the latest estimate the plan lacks {-motion.slack:.3f} m of clearance"
            return self._stop(root, begins, current, reason)
        if not self.dirt.safety.enabled:
            return Decision(reference, motion, "", plan)
        stop = self.dirt.contingency(motion.end, ends)  # Alg. 2 where the next cycle will begin
        if stop is None:
            return self._stop(
                root, begins, current, "from the latest estimate no manoeuvre stops safely after the plan"
            )
        return Decision(reference, motion, "", plan, stop_reference(self.dirt.vehicle, stop))

    def _stop(self, root: Floats, begins: float, current: Reference, reason: str) -> Decision:
        """A contingency: one that is safe from here, else the one in hand, else whatever keeps the most distance."""
        ends = begins + self._settings.cycle
        safe = self.dirt.contingency(root, begins)
        in_hand = current if current.kind is Kind.CONTINGENCY else self._contingency
        if safe is not None:
            reference = stop_reference(self.dirt.vehicle, safe)
        elif in_hand is not None and self._is_near(root, in_hand.state_at(begins)):
            reference = in_hand
        else:
            reference = emergency(self.dirt, root, begins)
        motion = self._roll(root, begins, ends, reference)
        return Decision(reference, motion, reason, contingency=reference)

    def _is_near(self, root: Floats, expected: Floats) -> bool:
        """Whether the estimate allows that the vehicle is within delta(v) of where a manoeuvre was verified.

        The vehicle may be delta(v) off its prediction, and its estimate as much off the vehicle (Theorem 1).
        """
        safety, vehicle = self.dirt.safety, self.dirt.vehicle
        places = [vehicle.index("x"), vehicle.index("y")]
        delta = safety.delta + safety.delta_per_speed * abs(float(expected[vehicle.rest_indices[0]]))
        return float(np.hypot(*(root[places] - expected[places]))) <= 2.0 * delta

    def _propose(self, root: Floats, previous: Plan | None) -> Proposal:
        """Plan from the predicted root: with the margin, else without, else perhaps with less clearance."""
        began, cycle = clock.perf_counter(), self._settings.cycle
        proposal = Proposal(None)
        radius = self._goal_radius(root)
        for dirt in self._attempts(root):
            dirt.aim_for(radius)
            proposal = self._search(dirt, root, previous)
            if proposal.plan is not None:
                break
        seconds = clock.perf_counter() - began
        missed = seconds > cycle - self._settings.lead
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

    def _attempts(self, root: Floats) -> Iterator[Dirt]:
        """Planners to ask in turn, the first that finds a plan decides."""
        wide, exact, delta = self._planners.planning, self._planners.checking, self._delta
        exact.ask_for(delta)
        if wide is not exact and self._spare(wide, root) >= 0.0:
            yield wide
        yield exact
        spare = self._spare(exact, root)
        resting = all(abs(root[k]) <= exact.safety.rest_speed for k in exact.vehicle.rest_indices)
        self._recovering = self._settings.recover and (resting or self._recovering) and -delta < spare < 0.0
        if self._recovering:
            exact.ask_for(max(0.0, delta + spare - LEEWAY))
            yield exact

    def _spare(self, dirt: Dirt, root: Floats) -> float:
        """Clearance of a state beyond what is asked for, m."""
        return dirt.edge(root, self._at_rest, 0.0, 0.0)[1]

    def _search(self, dirt: Dirt, root: Floats, previous: Plan | None) -> Proposal:
        """Alg. 1 from the predicted root, beginning with what is left of the plan that is being executed."""
        if dirt.start(root, self._seed * 100_003 + self._number) < 0.0:
            return Proposal(None, "the predicted start of the cycle is in collision")
        if self._spare(dirt, root) < 0.0:
            return Proposal(None, "the predicted start of the cycle lacks clearance")
        if previous is not None and previous.cost > self._settings.cycle:
            dirt.retain(previous, self._settings.cycle)  # ll. 1-8
        if self._realtime:
            progress = dirt.grow(seconds=self._settings.cycle * (1.0 - RESERVE) - self._settings.lead)
        else:
            progress = dirt.grow(iterations=self._settings.iterations)
        plan = dirt.plan()
        if plan is not None:
            self._verify(dirt, plan)
        reason = "" if plan is not None else self._shortfall(dirt)
        tree = dirt.tree() if self._keep_trees else None
        return Proposal(plan, reason, progress.iterations, progress.nodes, progress.retained, tree=tree)

    def _shortfall(self, dirt: Dirt) -> str:
        unsafe = ", many for want of a safe contingency" if dirt.progress.unsafe else ""
        return f"none of {dirt.progress.edges} edges may be executed{unsafe}"

    def _verify(self, dirt: Dirt, plan: Plan) -> None:
        """FCL's judgement of the part that may be executed before there is another plan.

        Raises:
            Defect: if the plan does not keep what the planner promises.
        """
        ends = np.cumsum(plan.durations)
        until = math.inf if self._once else self._settings.cycle
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
            raise Defect(f"the plan of cycle {self._number} fails verification: {'; '.join(problems)}")

    def _freed(self, state: Floats) -> Floats:
        """The nearest state out of collision: a vehicle that still drives is not where an estimate says it collides."""
        vehicle = self.dirt.vehicle
        x, y, theta = (float(state[vehicle.index("x")]), float(state[vehicle.index("y")]), heading_of(state, vehicle))
        if self._free(x, y, theta):
            return state
        for ring in range(1, 16):
            for k in range(24):
                dx, dy = 0.02 * ring * math.cos(k * math.pi / 12), 0.02 * ring * math.sin(k * math.pi / 12)
                if self._free(x + dx, y + dy, theta):
                    moved = state.copy()
                    moved[[vehicle.index("x"), vehicle.index("y")]] = x + dx, y + dy
                    return moved
        return state

    def _free(self, x: float, y: float, theta: float) -> bool:
        (x0, x1), (y0, y1) = self.dirt.workspace.bounds
        return x0 <= x <= x1 and y0 <= y <= y1 and self.dirt.pose_slack(x, y, theta) >= 0.0

    def _record(self, decision: Decision, proposal: Proposal, estimate: Estimate) -> Cycle:
        vehicle, plan = self.dirt.vehicle, decision.plan
        poses = decision.motion.states[:, [vehicle.index(name) for name in ("x", "y", "theta")]]
        return Cycle(
            number=self._number,
            time=self._number * self._settings.cycle,
            speed=float(estimate.state[vehicle.rest_indices[0]]),
            kind=decision.reference.kind,
            reason=decision.reason,
            cost_to_goal=plan.cost + plan.cost_to_go if plan else math.inf,
            clearance=float(self.dirt.exact.distances(poses).min()),
            iterations=proposal.iterations,
            nodes=proposal.nodes,
            retained=proposal.retained,
            planning_ms=1000 * proposal.seconds,
            missed=proposal.missed,
            reference=decision.reference,
            contingency=decision.contingency,
            predicted=decision.motion,
            tree=proposal.tree,
        )
