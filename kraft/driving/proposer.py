"""Proposals for the replanner: a plan for the next cycle, or the reason why there is none.

Alg. 1 runs with the method's margin first and, if it finds no plan, once more without the margin.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kraft.driving.bound import DeviationBound
from kraft.driving.geodesic import geodesic_plan
from kraft.driving.messages import PlanLoss
from kraft.driving.method import PlannerSettings
from kraft.driving.stopping import least_slack
from kraft.errors import Defect
from kraft.planning.workspace import goal_of, settings_of, workspace_of
from kraft.scenario import Task
from kraft.text import counted
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.plan import Plan, TreeView
from ompl_ext.query import Safety, remaining_edges
from ompl_ext.query_tree import Progress
from ompl_ext.retainment import RetainableEdges
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle
from ompl_ext.verification import verify

RECOVERY_MARGIN = 0.005  # by which the required clearance of a recovery is below the present one (m)
MIN_GOAL_RADIUS = 0.01  # of the region that the planner aims for (m)
RETAINED_TOLERANCE = 0.1  # by which the cost of a retained plan may exceed what was left of it: roundings of edges (s)
CORRECTION_ATTEMPTS = 8  # at retaining a rest with different random corrections
STALLED = 0.5  # cost by which a plan exceeds what was left of the last one if there is no progress (s)
HYSTERESIS = 0.8  # share of the clearance of a plan that suffices for its rest
STEADY = 2  # cycles after which a larger share of the bound is tried
ATTEMPT_SEEDS = 1_000_000_007  # between the seeds of two attempts
CONVERGED = 0.1  # fall of the best cost during a quarter of the iterations below which a search has converged (s)


@dataclass(frozen=True)
class Proposal:
    """Plan for the next cycle, not yet committed, or the reason why there is none; and the effort of the search.

    `kept` is the share of the bound that the plan keeps.  `lost` is why the rest of the plan that is being executed was
    not retained.  `switch_refused` is whether a better plan that goes another way was found, but does not save enough.
    """

    plan: Plan | None
    reason: str = ""
    iterations: int = 0
    nodes: int = 0
    retained: int = 0
    seconds: float = 0.0
    missed: bool = False
    lost: PlanLoss = PlanLoss.NONE
    switch_refused: bool = False
    tree: TreeView | None = None
    kept: float = 1.0


@dataclass(frozen=True)
class Solvers:
    """Two solvers of one task: `planning` requires the method's margin and foresight, `checking` only its clearance.

    The margin is not required when a plan is checked again, so that small errors do not reject the plan.
    """

    planning: DirtSolver
    checking: DirtSolver

    @classmethod
    def of(cls, task: Task, vehicle: Vehicle, settings: PlannerSettings) -> Solvers:
        """Make the solvers for a method's settings; without a clearance in the settings, SAFETY is disabled."""
        goal = goal_of(task)
        goal = replace(goal, radius=max(goal.radius - settings.goal_margin, MIN_GOAL_RADIUS))
        workspace, safety, shape = workspace_of(task, vehicle), method_safety(settings), vehicle.footprint
        planner = "sst" if settings.type == "sst" else "dirt"
        search = replace(settings_of(task, vehicle), polish=settings.polish, planner=planner)
        checking = DirtSolver(vehicle, workspace, goal, safety, search, settings.capacity)
        clearance = settings.bound or settings.safety
        foresight = clearance.foresight if clearance else 0.0
        if settings.margin == 0.0 and foresight <= settings.cycle:
            return cls(checking, checking)
        safety = replace(safety, cycle=max(foresight, settings.cycle))
        larger = replace(shape, length=shape.length + 2 * settings.margin, width=shape.width + 2 * settings.margin)
        larger_vehicle = replace(vehicle, footprint=larger)
        return cls(DirtSolver(larger_vehicle, workspace, goal, safety, search, settings.capacity), checking)

    def set_bound(self, bound: DeviationBound) -> None:
        """Set the clearance that SAFETY asks for in both."""
        for dirt in (self.checking, self.planning):
            dirt.set_bound(bound.delta, bound.per_speed, bound.per_time, bound.horizon)

    def set_parameters(self, values: Floats) -> None:
        """Set the parameters of the vehicle (np,) in both."""
        self.checking.set_parameters(values)
        if self.planning is not self.checking:
            self.planning.set_parameters(values)


def method_safety(settings: PlannerSettings) -> Safety:
    """SAFETY with the clearance of a method, disabled if the method has none."""
    margin = settings.safety
    if settings.bound is not None:  # the clearance is set in every cycle
        return Safety(cycle=settings.cycle)
    if margin is None:
        return Safety(enabled=False, cycle=settings.cycle)
    return Safety(cycle=settings.cycle, delta=margin.delta, delta_per_speed=margin.delta_per_speed)


class Proposer:
    """Searches the plan for the next cycle; `dirt` is the solver without margin."""

    def __init__(
        self,
        solvers: Solvers,
        settings: PlannerSettings,
        seed: int,
        *,
        realtime: bool = False,
        keep_trees: bool = False,
    ) -> None:
        self._settings, self._seed, self._realtime, self._keep_trees = settings, seed, realtime, keep_trees
        self._solvers, self.dirt = solvers, solvers.checking
        self._zero_control = np.zeros(len(self.dirt.vehicle.controls))
        assert self.dirt.goal is not None, "a task has a goal"
        self._goal = self.dirt.goal
        self._delta = self.dirt.safety.delta
        self._recovering = False
        self._bound: DeviationBound | None = None
        self._shares = settings.bound.shares if settings.bound else (1.0,)
        self._kept = 0  # index into the shares
        self._steady = 0  # number of cycles with this share since a larger one was tried
        self._grown: tuple[DirtSolver, Plan] | None = None
        self._extra = 0

    def set_settings(self, settings: PlannerSettings) -> None:
        """Use settings with another budget from the next proposal on."""
        self._settings = settings

    def propose(self, number: int, root: Floats, previous: Plan | None) -> Proposal:
        """Plan for cycle `number` from the predicted root.

        Args:
            number: index of the cycle.
            root: predicted state at the start of the cycle (nx,).
            previous: plan that is executed until then; its remainder is retained.
        """
        began, settings = clock.perf_counter(), self._settings
        if settings.type == "geodesic":
            return self._propose_geodesic(root, previous is not None, began)
        radius, rest = self._goal_radius(root), self._rest(previous)
        self._extra = settings.largest_budget - settings.iterations
        last, self._grown, proposal = self._grown, None, Proposal(None)
        for dirt, share, kept in self._attempts(root, rest is not None):
            dirt.set_goal_radius(radius)
            found = replace(self._search(number, dirt, root, rest, began, share), kept=kept)
            if kept > self._shares[self._kept] and not self._may_keep_more(found, rest):
                continue
            if self._grown is None or self._is_better(found, proposal):
                proposal = found
                self._grown = None if found.plan is None else (dirt, found.plan)
            if proposal.plan is None or (self._bound is not None and not proposal.plan.reaches_goal):
                continue
            if last is None or dirt is last[0] or not self._is_worse(proposal, rest):
                break
        self._keep(proposal, rest)
        seconds = clock.perf_counter() - began
        missed = seconds > settings.cycle - settings.lead
        if self._realtime and missed:
            reason = f"planning took {seconds:.3f} s, longer than the cycle allows"
            return replace(proposal, plan=None, reason=reason, seconds=seconds, missed=True)
        return replace(proposal, seconds=seconds, missed=missed)

    def _propose_geodesic(self, root: Floats, drives: bool, began: float) -> Proposal:
        """Path of least cost-to-go; a vehicle that stopped (not `drives`) keeps less of the bound than before.

        Whether the controller finds a safe way is known only when the replanner predicts it.
        """
        dirt = self.dirt
        dirt.set_goal_radius(self._goal_radius(root))
        if self._bound is not None:
            self._steady = self._steady + 1 if drives else 0
            if not drives:
                self._kept = min(self._kept + 1, len(self._shares) - 1)
            elif self._steady > STEADY:
                self._kept, self._steady = max(self._kept - 1, 0), 0
            self._require(self._bound)
        plan = geodesic_plan(dirt, root)
        reason = "" if plan is not None else "no path leads to the goal from the predicted start of the cycle"
        return Proposal(plan, reason, seconds=clock.perf_counter() - began, kept=self._shares[self._kept])

    def _goal_radius(self, root: Floats) -> float:
        """Radius of the region to aim for (m), at most half the distance of the vehicle to the goal's centre.

        Otherwise a vehicle that is in the goal by its estimate, but not in truth, would wait there.
        """
        goal, vehicle = self._goal, self.dirt.vehicle
        away = math.dist(goal.center, (root[vehicle.index("x")], root[vehicle.index("y")]))
        return max(MIN_GOAL_RADIUS, min(goal.radius, 0.5 * away))

    def _attempts(self, root: Floats, has_rest: bool) -> Iterator[tuple[DirtSolver, float, float]]:
        """Solvers in turn, each with its share of the remaining time and the share of the bound that plans keep.

        The bound is tried in shares from the last one that left a way to the goal, so that its plan can be retained,
        and now and then from the one before.  A rest needs a little less than what it was planned with, because
        estimate and bound change.
        """
        if self._bound is None:
            yield from ((dirt, share, 1.0) for dirt, share in self._solvers_in_turn(root))
            return
        first = self._kept - 1 if self._steady >= STEADY else self._kept
        for number in range(max(first, 0), len(self._shares)):
            eased = HYSTERESIS if number == self._kept and has_rest else 1.0
            bound = self._bound.scaled(self._shares[number] * eased)
            self._delta = bound.delta
            self._solvers.set_bound(bound)
            for dirt, share in self._solvers_in_turn(root, recover=number == len(self._shares) - 1):
                yield dirt, share, self._shares[number]

    def _may_keep_more(self, found: Proposal, rest: Rest | None) -> bool:
        """Whether a plan that keeps more of the bound than the last one did leads to the goal and costs no more."""
        if found.plan is None or not found.plan.reaches_goal:
            return False
        return rest is None or total_cost(found.plan) <= rest.left + RETAINED_TOLERANCE

    def _keep(self, proposal: Proposal, rest: Rest | None) -> None:
        """Ask for the share of the bound that the proposed plan keeps until the next proposal.

        If the vehicle makes no progress, the next plan may keep less.
        """
        if self._bound is not None and proposal.plan is not None and not self._recovering:
            before, self._kept = self._kept, self._shares.index(proposal.kept)
            self._steady = self._steady % STEADY + 1 if self._kept == before else 0
            if rest is not None and total_cost(proposal.plan) > rest.left + STALLED:
                self._kept, self._steady = min(self._kept + 1, len(self._shares) - 1), 0
            self._require(self._bound)

    def set_bound(self, bound: DeviationBound) -> None:
        """Set the bound of the deviation; the share that the last plan kept is asked for until the next proposal."""
        self._bound = bound
        self._require(bound)

    def _require(self, bound: DeviationBound) -> None:
        """Require what suffices when a plan is checked again."""
        assert self._settings.bound is not None, "it was set because of the settings"
        self._solvers.set_bound(bound.scaled(self._shares[self._kept] * self._settings.bound.recheck))
        self._delta = self.dirt.safety.delta

    def _solvers_in_turn(self, root: Floats, recover: bool = True) -> Iterator[tuple[DirtSolver, float]]:
        """Solvers to run in turn, each with its share of the remaining time; the first plan that is found is taken."""
        planning, checking, delta = self._solvers.planning, self._solvers.checking, self._delta
        checking.set_delta(delta)
        was_recovering, self._recovering = self._recovering, False
        if planning is not checking and self._slack(planning, root) >= 0.0:
            yield planning, 0.5
        yield checking, 1.0  # returns at once if the root lacks clearance, which leaves all the time to the recovery
        slack = self._slack(checking, root)
        if self._settings.on_board == "contingency":  # `slack` is that of the first disc that lacks clearance
            slack = min(slack, least_slack(checking, root[None, :], 0.0))
        resting = all(abs(root[k]) <= checking.safety.rest_speed for k in checking.vehicle.rest_indices)
        self._recovering = recover and self._settings.recover and (resting or was_recovering) and -delta < slack < 0.0
        if self._recovering:
            checking.set_delta(max(0.0, delta + slack - RECOVERY_MARGIN))
            yield checking, 1.0

    def _slack(self, dirt: DirtSolver, root: Floats) -> float:
        """Clearance of a state minus the required clearance, m."""
        return dirt.edge(root, self._zero_control, 0.0, 0.0)[1]

    def _rest(self, previous: Plan | None) -> Rest | None:
        """Rest of the plan that is executed, as the settings retain it; None if it ends before the cycle does."""
        settings = self._settings
        if previous is None or previous.cost <= settings.cycle:
            return None
        edges = None
        if settings.retain == "tree" and self._grown is not None and self._grown[1] is previous:
            edges = self._grown[0].retainable_edges(previous, settings.cycle, settings.iterations)
        return Rest(previous, settings.cycle, edges)

    def _is_worse(self, proposal: Proposal, rest: Rest | None) -> bool:
        """Whether a plan replaces a lost rest and costs more; if a gain is required, the rest's solver is asked."""
        if self._settings.switch_gain == 0.0 or rest is None or proposal.lost is PlanLoss.NONE or proposal.plan is None:
            return False
        return total_cost(proposal.plan) > rest.left + RETAINED_TOLERANCE

    def _is_better(self, found: Proposal, proposal: Proposal) -> bool:
        """Whether a plan to the goal that another solver found saves the gain, or alone reaches the goal."""
        if found.plan is None or proposal.plan is None or not found.plan.reaches_goal:
            return False
        gain = self._settings.switch_gain
        return not proposal.plan.reaches_goal or total_cost(found.plan) <= total_cost(proposal.plan) - gain

    def _search(
        self, number: int, dirt: DirtSolver, root: Floats, rest: Rest | None, began: float, share: float
    ) -> Proposal:
        """Alg. 1 from the predicted root, starting with the remainder of the plan that is being executed."""
        if dirt.start(root, self._seed * 100_003 + number) < 0.0:
            return Proposal(None, "the predicted start of the cycle is in collision")
        if self._slack(dirt, root) < 0.0:
            return Proposal(None, "the predicted start of the cycle lacks clearance")
        lost = PlanLoss.NONE
        if rest is not None:
            if rest.edges is not None:
                _start_with_best_corrections(dirt, root, rest, self._seed * 100_003 + number)
            lost = retain(dirt, root, rest)  # ll. 1-8
        kept = None if rest is None or self._settings.switch_gain == 0.0 else _retained_plan(dirt, rest)
        progress = self._grow(dirt, math.inf if rest is None else rest.left, began, share)
        plan, refused = self._choose(dirt, kept)
        if plan is not None:
            self._verify(number, dirt, plan)
        reason = "" if plan is not None else _failure_reason(progress)
        tree = dirt.tree() if self._keep_trees else None
        return Proposal(
            plan, reason, progress.iterations, progress.nodes, progress.retained, 0.0, False, lost, refused, tree
        )

    def _choose(self, dirt: DirtSolver, kept: Plan | None) -> tuple[Plan | None, bool]:
        """Best plan, or the best one that goes the way of the retained plan if leaving it does not save enough."""
        best, gain = dirt.plan(), self._settings.switch_gain
        if kept is None or best is None or best.reaches_goal > kept.reaches_goal:
            return best, False
        if total_cost(best) <= total_cost(kept) - gain or goes_same_way(dirt, best, kept):
            return best, False
        for node in dirt.goal_nodes()[1:]:
            plan = dirt.plan_to(int(node))
            if plan.cost >= total_cost(kept):
                break
            if goes_same_way(dirt, plan, kept):
                return plan, True
        return kept, True

    def _grow(self, dirt: DirtSolver, left: float, began: float, share: float) -> Progress:
        """Spend the budget: iterations, or a share of the remaining time, and all of it once there is a plan.

        `left` is the cost that was left of the last plan (s): a plan that costs more is not settled.
        """
        if not self._realtime:
            return self._grow_iterations(dirt, left)
        ends = began + self._settings.clock_budget
        progress = dirt.grow(seconds=share * (ends - clock.perf_counter()))
        return progress if dirt.plan() is None else dirt.grow(seconds=ends - clock.perf_counter())

    def _grow_iterations(self, dirt: DirtSolver, left: float) -> Progress:
        """Spend `iterations`, and what is left of `max_iterations` while the plan is not settled."""
        iterations = self._settings.iterations
        if self._extra == 0:
            return dirt.grow(iterations=iterations)
        chunk = max(1, iterations // 4)
        if iterations > chunk:
            dirt.grow(iterations=iterations - chunk)
        cost = dirt.best_cost
        progress = dirt.grow(iterations=chunk)
        while self._extra > 0 and not _is_settled(dirt, left, cost):
            cost, count = dirt.best_cost, min(chunk, self._extra)
            progress = dirt.grow(iterations=count)
            self._extra -= count
        return progress

    def _verify(self, number: int, dirt: DirtSolver, plan: Plan) -> None:
        """Verify with FCL the part of the plan that may be executed before the next plan is committed.

        Raises:
            Defect: if the plan violates what the planner guarantees.
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


def _failure_reason(progress: Progress) -> str:
    unsafe = "; many lack a safe contingency" if progress.unsafe else ""
    return f"none of {counted(progress.edges, 'edge')} may be executed{unsafe}"


def _is_settled(dirt: DirtSolver, left: float, before: float) -> bool:
    """Whether the best plan reaches the goal, costs what was `left` of the last plan, and no longer improves.

    `before` is the best cost before the last iterations, s.
    """
    cost = dirt.best_cost
    return dirt.best_node()[1] and cost <= left + RETAINED_TOLERANCE and before - cost < CONVERGED


@dataclass(frozen=True)
class Rest:
    """Rest of a plan after `elapsed` s, with the edges of its tree that are retained too, if any."""

    plan: Plan
    elapsed: float
    edges: RetainableEdges | None = None

    @property
    def left(self) -> float:
        """Cost that is left of the plan, s."""
        return total_cost(self.plan) - self.elapsed


def total_cost(plan: Plan) -> float:
    """Cost of a plan and cost-to-go from its end, s."""
    return plan.cost + plan.cost_to_go


def _retained_plan(dirt: DirtSolver, rest: Rest) -> Plan | None:
    """Plan that consists of what was retained of a rest; None if an edge is missing or a plan may not end there."""
    _, _, durations = remaining_edges(rest.plan.controls, rest.plan.durations, rest.elapsed)
    last = int(dirt.retained_nodes[len(durations) - 1])
    if last < 0:
        return None
    plan = dirt.plan_to(last)
    return plan if plan.reaches_goal or not dirt.safety.enabled or plan.cost >= dirt.safety.cycle else None


def _start_with_best_corrections(dirt: DirtSolver, root: Floats, rest: Rest, seed: int) -> None:
    """Start a query at `root` (nx,) with the seed that retains most of a rest, of several, the cheapest one if all.

    Corrections are random, and each of them is the best one for its own edge only: others pass where one fails.
    """
    assert rest.edges is not None
    edges, best = rest.edges, (-1, -math.inf, seed)
    part = slice(0, edges.rest)
    for attempt in range(CORRECTION_ATTEMPTS):
        dirt.start(root, seed + attempt * ATTEMPT_SEEDS)
        retained = dirt.retain_edges(edges.parents[part], edges.controls[part], edges.durations[part], edges.targets)
        best = max(best, (retained, -dirt.best_cost, seed + attempt * ATTEMPT_SEEDS))
        if retained == edges.rest and dirt.best_cost <= rest.left + RETAINED_TOLERANCE:
            break
    dirt.start(root, best[2])


def retain(dirt: DirtSolver, root: Floats, rest: Rest) -> PlanLoss:
    """Retain the rest of a plan, and edges of its tree if there are any, in a query that begins at `root` (nx,).

    Returns the reason of a loss: of an edge that was not retained or, if all were, of a cost that is higher from the
    new root.  Obstacles do not move, so an edge is in collision from the state that the plan predicted only if more
    distance is required now than when it was planned.
    """
    plan, elapsed, edges = rest.plan, rest.elapsed, rest.edges
    _, controls, durations = remaining_edges(plan.controls, plan.durations, elapsed)
    if edges is None:
        dirt.retain(plan, elapsed, optimised=True)
    else:
        dirt.retain_edges(edges.parents, edges.controls, edges.durations, edges.targets, optimised=True)
    if dirt.retained_nodes[len(durations) - 1] >= 0:
        return PlanLoss.ESTIMATE if dirt.best_cost > rest.left + RETAINED_TOLERANCE else PlanLoss.NONE
    first = int(plan.durations.cumsum().searchsorted(elapsed + 1e-9, side="right"))
    begun = elapsed - float(plan.durations[:first].sum())
    planned = dirt.edge(plan.states[first], plan.controls[first], max(begun, 0.0))[0][-1]
    from_root, from_planned = (_first_loss(dirt, state, controls, durations) for state in (root, planned))
    if PlanLoss.NONE in (from_planned, from_root):
        return PlanLoss.ESTIMATE
    return from_root


def _first_loss(dirt: DirtSolver, state: Floats, controls: Floats, durations: Floats) -> PlanLoss:
    """Reason for which an edge of a path from `state` cannot be executed; none if all can."""
    safety, time = dirt.safety, 0.0
    for control, duration in zip(controls, durations, strict=True):
        samples, slack = dirt.edge(state, control, float(duration))
        if slack < 0.0:
            return PlanLoss.COLLISION
        ends = time + float(duration)
        if safety.enabled and time < safety.cycle:
            if dirt.edge(state, control, float(duration), time)[1] < 0.0:
                return PlanLoss.UNSAFE
            if ends >= safety.cycle:
                leaves, _ = dirt.edge(state, control, min(safety.cycle - time, float(duration)))
                if dirt.contingency(leaves[-1]) is None:
                    return PlanLoss.UNSAFE
        state, time = samples[-1], ends
    if safety.enabled and time < safety.cycle and not math.isclose(time, safety.cycle):
        return PlanLoss.NONE if dirt.contingency(state) is not None else PlanLoss.UNSAFE
    return PlanLoss.NONE


WAY_HORIZON = 5.0  # time over which ways are compared (s)
WAY_WIDTH = 0.5  # distance at which one plan leaves the way of another (m)


def goes_same_way(dirt: DirtSolver, plan: Plan, other: Plan) -> bool:
    """Whether two plans stay near each other in the next seconds and pass every obstacle on the same side."""
    one, two = (_positions(dirt, each) for each in (plan, other))
    return _follows(dirt, one[plan.times <= WAY_HORIZON], two) and _follows(dirt, two[other.times <= WAY_HORIZON], one)


def _positions(dirt: DirtSolver, plan: Plan) -> Matrix:
    positions: Matrix = plan.trajectory[:, [dirt.vehicle.index("x"), dirt.vehicle.index("y")]]
    return positions


def _follows(dirt: DirtSolver, points: Matrix, path: Matrix) -> bool:
    """Whether points (n, 2) are near a path (m, 2), with no obstacle between each of them and its nearest point."""
    away = np.linalg.norm(points[:, None] - path[None], axis=2)
    nearest = away.argmin(axis=1)
    if away[np.arange(len(points)), nearest].max() > WAY_WIDTH:
        return False
    shares = np.linspace(0.0, 1.0, 12)[:, None, None]
    between = points + shares * (path[nearest] - points)
    return not dirt.is_occupied(between.reshape(-1, 2)).any()
