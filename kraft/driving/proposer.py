"""Proposals for the replanner: a plan for the next cycle, or the reason why there is none.

With a fixed clearance Alg. 1 runs with the method's margin first and, if it finds no plan, once more without it.  Where
the bound of the deviation is measured, it runs at levels of clearance in turn, see `kraft.driving.levels`.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterator
from dataclasses import dataclass, replace

from kraft.driving.bound import DeviationBound
from kraft.driving.command_loss import CommandLoss
from kraft.driving.geodesic import geodesic_plan
from kraft.driving.levels import Levels
from kraft.driving.messages import PlanLoss
from kraft.driving.method import PlannerSettings
from kraft.driving.prediction import least_slack
from kraft.driving.remainder import (  # fmt: skip
    RETAINED_TOLERANCE,
    Remainder,
    has_remainder,
    retain,
    retained_plan,
    start_with_best_corrections,
)
from kraft.driving.search_budget import LEVEL_TIME, SearchBudget
from kraft.driving.solvers import Solvers, goal_region
from kraft.driving.ways import goes_same_way
from kraft.errors import Defect
from kraft.text import counted, listed
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan, TreeView
from ompl_ext.query_tree import Progress
from ompl_ext.retainment import RetainableEdges
from ompl_ext.solver import DirtSolver
from ompl_ext.verification import violations

RECOVERY_MARGIN = 0.005
"""Present clearance less the one that a recovery requires, m."""
STALLED = 0.5
"""Cost of a plan beyond what was left of the last one from which on there is no progress, s."""
LEVEL_GAIN = 0.1
"""Share of its cost that a plan must save to keep less clearance."""
LEAST_GAIN = 0.2
"""Least cost that it must save, s; that is enough where plans cost more than what was left."""
DETOUR = 1.0
"""Cost of a plan beyond the cost-to-go from which on plans that keep less clearance are tried, s."""
RISE = 0.4
"""What a plan may cost to keep more clearance than the last one, s; below `REGRESSION` of `kraft.trial.measures`."""
CORRECTION_ATTEMPTS = 12
"""Most attempts at retaining a remainder, each with other random corrections."""
PROBES = 2
"""Attempts at retaining the remainder to find out whether a higher level is worth a search."""
PROBES_HIGHER = 4
"""Attempts in a search at a level above that of the last plan, whose remainder is the fallback."""
CYCLE_SEEDS = 100_003
"""Difference between the seeds of a cycle in two trials whose seeds are consecutive: more than a trial has cycles."""
LOSS_CANDIDATES = 20
"""Next best plans that are examined for room for a loss of commands if the best one has none."""


@dataclass(frozen=True)
class Proposal:
    """Plan for the next cycle, not yet committed, or the reason why there is none; and the effort of the search.

    `lost` is why the remainder of the plan that is being executed was not retained.  `switch_refused` is whether a
    better plan that goes another way was found, but does not save enough.
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


@dataclass(frozen=True)
class _Query:
    """Predicted `root` (nx,) of cycle `number`, what is left of the last plan, and the time at which it began (s)."""

    number: int
    root: Floats
    remainder: Remainder | None
    began: float

    @property
    def left(self) -> float:
        """Cost that is left of the last plan, infinite without one, s."""
        return math.inf if self.remainder is None else self.remainder.left


@dataclass(frozen=True)
class _Grown:
    """A plan, the solver that found it, and the edges of its tree that the next cycle retains, if any.

    They are taken at once: the search at another level replaces the tree of the solver.
    """

    dirt: DirtSolver
    plan: Plan
    edges: RetainableEdges | None


class Proposer:
    """Searches for the plan of the next cycle; `dirt` is the solver without margin, `loss` predicts lost commands."""

    def __init__(
        self,
        solvers: Solvers,
        settings: PlannerSettings,
        seed: int,
        *,
        realtime: bool = False,
        keep_trees: bool = False,
        command_timeout: float | None = None,
    ) -> None:
        self._settings, self._seed, self._realtime, self._keep_trees = settings, seed, realtime, keep_trees
        self._command_timeout = command_timeout
        self._use(solvers)
        self.recovers = False
        """whether the last proposal is for a vehicle that leaves a place with less clearance than required"""
        self._levels = Levels(solvers, settings)
        self._grown: _Grown | None = None
        self._budget = SearchBudget(settings, realtime)

    def set_settings(self, settings: PlannerSettings) -> None:
        """Use settings with another budget from the next proposal on."""
        self._settings = settings
        self._budget = SearchBudget(settings, self._realtime)

    def set_solvers(self, solvers: Solvers) -> None:
        """Use other solvers from the next proposal on, at the level of clearance of the last one."""
        if self._grown is not None:
            planned = self._grown.dirt is self._solvers.planning
            self._grown = replace(self._grown, dirt=solvers.planning if planned else solvers.checking)
        self._use(solvers)
        self._levels.set_solvers(solvers)

    def _use(self, solvers: Solvers) -> None:
        self._solvers, self.dirt = solvers, solvers.checking
        self.loss = None if self._command_timeout is None else CommandLoss(self.dirt, self._command_timeout)
        self._delta = self.dirt.safety.delta

    def propose(self, number: int, root: Floats, previous: Plan | None) -> Proposal:
        """Plan for cycle `number` from the predicted root.

        Args:
            number: index of the cycle.
            root: predicted state at the start of the cycle (nx,).
            previous: plan that is executed until then; its remainder is retained.
        """
        began, settings = clock.perf_counter(), self._settings
        region = goal_region(self._solvers.goal, self.dirt.vehicle, root)
        for dirt in (self._solvers.planning, self._solvers.checking):
            dirt.set_goal_region(*region)
        if settings.type == "geodesic":
            proposal = self._propose_geodesic(root, drives=previous is not None or number == 0)
        else:
            query = _Query(number, root, self._remainder(previous), began)
            proposal = self._propose_in_turn(query) if settings.bound is None else self._propose_at_levels(query)
        seconds = clock.perf_counter() - began
        missed = number > 0 and seconds > settings.cycle - settings.lead  # the first plan is made before the drive
        if self._realtime and missed:
            reason = f"planning took {seconds:.3f} s, longer than the cycle allows"
            return replace(proposal, plan=None, reason=reason, seconds=seconds, missed=True)
        return replace(proposal, seconds=seconds, missed=missed)

    def _propose_in_turn(self, query: _Query) -> Proposal:
        """Plan with a fixed clearance: of the first solver that finds one, or of the one that retains the remainder."""
        self._budget.begin(query.began)
        last, self._grown, proposal = self._grown, None, Proposal(None)
        for dirt, share in self._solvers_in_turn(query.root):
            found = self._search(query, dirt, share)
            if self._grown is None or _is_better(found, proposal, self._settings.switch_gain):
                proposal = found
                self._grown = self._grown_of(dirt, found.plan)
            if proposal.plan is None:
                continue
            if last is None or dirt is last.dirt or not self._is_worse(proposal, query.remainder):
                break
        return proposal

    def _propose_at_levels(self, query: _Query) -> Proposal:
        """Plan of the first level of clearance that leaves a way to the goal, from the level of the last plan on.

        To keep less clearance has to save a share of the cost; to keep more than the last plan may cost `RISE`.
        """
        levels, settings = self._levels, self._settings
        self._budget.begin(query.began)
        was_recovering, self.recovers = self.recovers, False
        proposal = self._search_at_levels(query)
        if proposal.plan is not None:
            levels.require()
        elif self._begin_recovery(query.root, was_recovering):
            self.recovers = True
            self._budget.allow(settings.iterations)  # the levels may have spent all of it
            proposal = self._search(query, self.dirt, 1.0, is_last=True)
            self._grown = self._grown_of(self.dirt, proposal.plan)
        return replace(proposal, iterations=self._budget.spent)

    def _search_at_levels(self, query: _Query) -> Proposal:
        """Plan of the first level that leaves a way to the goal, or of a later one that saves enough."""
        levels = self._levels
        kept, chosen, proposal, refused = levels.kept, levels.kept, Proposal(None), False
        waiting, self._grown = self._first_levels(query), None
        while waiting and self._budget.left > 0:
            number = waiting.pop(0)
            dirt = levels.set(number, eased=query.remainder is not None and number == kept)
            attempts = PROBES_HIGHER if number < kept else CORRECTION_ATTEMPTS
            found = self._search(query, dirt, LEVEL_TIME, is_last=not waiting, attempts=attempts)
            if number < kept and not _leads_to_goal(found):
                continue
            gain = RISE if chosen < kept else self._gain(proposal, query)
            refused = proposal.plan is not None
            if proposal.plan is None or _is_better(found, proposal, gain):
                proposal, chosen, refused = found, number, False
                self._grown = self._grown_of(dirt, found.plan)
            if _leads_to_goal(proposal) and not (waiting and self._is_compared(number, waiting[0], found, query)):
                break
        if proposal.plan is not None:
            cost = proposal.plan.total_cost
            levels.note_progress(cost, rises=chosen < kept)
            levels.note_comparison(refused)
            levels.keep(chosen, stalled=cost > query.left + STALLED or not levels.gets_on)
        elif waiting:
            levels.keep(waiting[0], stalled=False)
        return proposal

    def _gain(self, proposal: Proposal, query: _Query) -> float:
        """What a plan must save to keep less clearance than the one of a proposal, s."""
        if proposal.plan is None or not self._levels.gets_on:
            return 0.0
        cost = proposal.plan.total_cost
        return LEAST_GAIN if cost > query.left + STALLED else max(LEAST_GAIN, LEVEL_GAIN * cost)

    def _is_compared(self, number: int, following: int, found: Proposal, query: _Query) -> bool:
        """Whether the level `following` is tried too, because the plan found at a level is far from the cheapest one.

        That is so if it costs more than what was left, at levels above that of the last plan and, if there was no
        progress at it, at that level itself; and at every level if it costs much more than the cost-to-go and no plan
        was refused in the latest cycles.  Only a vehicle that knows its drive, or does not get on, tries a level
        without the margin for that.
        """
        levels = self._levels
        if found.plan is None:
            return False
        cost, may_be_narrow = found.plan.total_cost, levels.bound.drive_is_known or not levels.gets_on
        if number >= levels.kept and following >= levels.wide and not may_be_narrow:
            return False
        if levels.compares and cost > self._solvers.planning.root_cost_to_go + DETOUR:
            return True
        if query.remainder is None or number > levels.kept or (number == levels.kept and not levels.stalled):
            return False
        gains_foresight = number < levels.farsighted <= levels.kept
        return cost > query.left + (STALLED if gains_foresight else RETAINED_TOLERANCE)

    def _first_levels(self, query: _Query) -> list[int]:
        """Levels to search at, in their order: from that of the last plan on, and now and then from a higher one."""
        levels = self._levels
        waiting = levels.downwards(levels.kept)
        if levels.stalled and levels.kept + 1 not in waiting:
            waiting.insert(1, levels.kept + 1)
        if levels.tries_higher and levels.gets_on:
            higher = levels.upwards()
            while higher[0] > 0 and self._holds(query, higher[0]) and self._holds(query, higher[0] - 1):
                higher[0] -= 1
            return higher + waiting
        return waiting

    def _holds(self, query: _Query, number: int) -> bool:
        """Whether the whole remainder of the last plan can be retained at a level, at no higher cost."""
        dirt, remainder = self._levels.set(number, eased=False), query.remainder
        if (
            remainder is None
            or dirt.start(query.root, self._seed_of(query.number)) < 0.0
            or dirt.slack(query.root) < 0.0
        ):
            return False
        begun = remainder.edges is not None and start_with_best_corrections(
            dirt, query.root, remainder, self._seed_of(query.number), PROBES
        )
        return retain(dirt, query.root, remainder, begun) is PlanLoss.NONE

    def _seed_of(self, number: int) -> int:
        return self._seed * CYCLE_SEEDS + number

    def _propose_geodesic(self, root: Floats, drives: bool) -> Proposal:
        """Path of least cost-to-go; a vehicle that stopped (not `drives`) or does not get on keeps less of the bound.

        Whether the controller finds a safe way is known only when the replanner predicts it.
        """
        dirt, levels = self.dirt, self._levels
        if self._settings.bound is None:
            dirt.set_delta(self._delta)  # the replanner lowers it for a vehicle that stands with less
        else:
            levels.drive_on(drives and levels.gets_on)
            levels.require()
        plan = geodesic_plan(dirt, root)
        if plan is not None:
            levels.note_progress(plan.cost, rises=False)
        reason = "" if plan is not None else "no path leads to the goal from the predicted start of the cycle"
        return Proposal(plan, reason)

    def set_bound(self, bound: DeviationBound) -> None:
        """Set the bound of the deviation; the share that the last plan kept is asked for until the next proposal."""
        self._levels.bound = bound
        self._levels.require()

    def _solvers_in_turn(self, root: Floats) -> Iterator[tuple[DirtSolver, float]]:
        """Solvers to run in turn, each with its share of the remaining time; the first plan that is found is taken."""
        planning, checking = self._solvers.planning, self._solvers.checking
        checking.set_delta(self._delta)
        was_recovering, self.recovers = self.recovers, False
        if planning is not checking and planning.slack(root) >= 0.0:
            yield planning, 0.5
        yield checking, 1.0  # returns at once if the root lacks clearance, which leaves all the time to the recovery
        self.recovers = self._begin_recovery(root, was_recovering)
        if self.recovers:
            yield checking, 1.0

    def _begin_recovery(self, root: Floats, was_recovering: bool) -> bool:
        """Require less than the present clearance if a vehicle without a plan may leave with that; whether it may.

        It lacks clearance now, or once the bound has grown: then no plan could begin here either.
        """
        checking = self._solvers.checking
        safety, slack = checking.safety, checking.slack(root)
        if self._settings.on_board == "contingency":  # `slack` is that of the first disc that lacks clearance
            slack = min(slack, least_slack(checking, root[None, :], 0.0))
        lacks = -safety.delta < slack < safety.delta_per_time * safety.delta_horizon
        may_leave = was_recovering or bool(safety.is_resting(checking.vehicle, root))
        recovers = self._settings.recover and may_leave and lacks
        if recovers:
            checking.set_delta(max(0.0, safety.delta + min(slack, 0.0) - RECOVERY_MARGIN))
        return recovers

    def _remainder(self, previous: Plan | None) -> Remainder | None:
        """Remainder of the plan that is executed, as the settings retain it; None if it ends before the cycle does."""
        settings = self._settings
        if previous is None or not has_remainder(previous, settings.cycle):
            return None
        grown = self._grown
        return Remainder(
            previous, settings.cycle, grown.edges if grown is not None and grown.plan is previous else None
        )

    def _grown_of(self, dirt: DirtSolver, plan: Plan | None) -> _Grown | None:
        """The plan of a solver's tree, with what the next cycle retains of the tree if the settings say so.

        That is at most as many edges as the search had iterations: more of the tree of the first plan.
        """
        settings, edges = self._settings, None
        if plan is None:
            return None
        if settings.retain == "tree" and has_remainder(plan, settings.cycle):
            edges = dirt.retainable_edges(plan, settings.cycle, settings.iterations)
        return _Grown(dirt, plan, edges)

    def _is_worse(self, proposal: Proposal, remainder: Remainder | None) -> bool:
        """Whether a plan replaces a lost remainder and costs more; if a gain is required, the last solver is asked."""
        if self._settings.switch_gain == 0.0 or remainder is None:
            return False
        if proposal.plan is None or proposal.lost is PlanLoss.NONE:
            return False
        return proposal.plan.total_cost > remainder.left + RETAINED_TOLERANCE

    def _search(
        self,
        query: _Query,
        dirt: DirtSolver,
        share: float,
        is_last: bool = False,
        attempts: int = CORRECTION_ATTEMPTS,
    ) -> Proposal:
        """Alg. 1 from the predicted root, starting with the remainder of the plan that is being executed."""
        root, remainder = query.root, query.remainder
        if dirt.start(root, self._seed_of(query.number)) < 0.0:
            return Proposal(None, "the predicted start of the cycle is in collision or too near to an obstacle")
        if dirt.slack(root) < 0.0:
            return Proposal(None, _lack(dirt, root))
        lost, retained = PlanLoss.NONE, None
        if remainder is not None:
            begun = remainder.edges is not None and start_with_best_corrections(
                dirt, root, remainder, self._seed_of(query.number), attempts
            )
            lost = retain(dirt, root, remainder, begun)  # ll. 1-8
            if self._settings.switch_gain > 0.0:
                retained = retained_plan(dirt, remainder)
        progress = self._budget.grow(dirt, query.left, share, is_last)
        plan, refused = self._choose(dirt, retained)
        if plan is not None and self.loss is not None:
            plan = self._with_room_for_loss(dirt, plan, self.loss)
        if plan is not None:
            self._verify(query.number, dirt, plan)
        reason = "" if plan is not None else _failure_reason(progress)
        tree = dirt.tree() if self._keep_trees else None
        return Proposal(
            plan,
            reason,
            iterations=progress.iterations,
            nodes=progress.nodes,
            retained=progress.retained,
            lost=lost,
            switch_refused=refused,
            tree=tree,
        )

    def _choose(self, dirt: DirtSolver, retained: Plan | None) -> tuple[Plan | None, bool]:
        """Best plan, or the best one that goes the way of the retained plan if leaving it does not save enough."""
        best, gain = dirt.plan(retained), self._settings.switch_gain
        if retained is None or best is None or best.reaches_goal > retained.reaches_goal:
            return best, False
        if best.total_cost <= retained.total_cost - gain or goes_same_way(dirt, best, retained):
            return best, False
        for node in dirt.goal_nodes()[1:]:
            plan = dirt.plan_to(int(node))
            if plan.cost >= retained.total_cost:
                break
            if goes_same_way(dirt, plan, retained):
                return plan, True
        return retained, True

    def _with_room_for_loss(self, dirt: DirtSolver, plan: Plan, loss: CommandLoss) -> Plan:
        """The plan, or the next best one of the tree on which the vehicle stops in time if commands are lost.

        If there is none, the plan is driven more slowly when its cycle begins, see `slower`.
        """
        cycle = self._settings.cycle
        if loss.keeps(plan, cycle):
            return plan
        others = (dirt.plan_to(int(node)) for node in dirt.goal_nodes()[1 : LOSS_CANDIDATES + 1])
        return next((each for each in others if loss.keeps(each, cycle)), plan)

    def slower(self, number: int, plan: Plan, root: Floats) -> Iterator[Plan]:
        """The plan of cycle `number` from `root` (nx,) with less and less drive, for a vehicle that may lose commands.

        The last one that was taken is the plan whose remainder the next proposal retains.
        """
        if self.loss is None:
            return
        for each in self.loss.slower(plan, root, self._settings.cycle, self._seed_of(number)):
            self._verify(number, self.dirt, each)
            self._grown = self._grown_of(self.dirt, each)
            yield each

    def _verify(self, number: int, dirt: DirtSolver, plan: Plan) -> None:
        """Verify with FCL the part of the plan that may be executed before the next plan is committed.

        Raises:
            Defect: if the plan violates what the planner guarantees.
        """
        until = math.inf if self._settings.mode == "one-shot" else self._settings.cycle
        problems = violations(dirt, plan.head(until))
        if problems:
            raise Defect(f"the plan of cycle {number} fails verification: {listed(problems)}")


def _leads_to_goal(proposal: Proposal) -> bool:
    return proposal.plan is not None and proposal.plan.reaches_goal


def _is_better(found: Proposal, proposal: Proposal, gain: float) -> bool:
    """Whether a plan to the goal that another solver found saves `gain` (s), or alone reaches the goal."""
    if found.plan is None or proposal.plan is None or not found.plan.reaches_goal:
        return False
    return not proposal.plan.reaches_goal or found.plan.total_cost <= proposal.plan.total_cost - gain


def _lack(dirt: DirtSolver, root: Floats) -> str:
    """Why no plan begins at a root whose clearance is too small: how much of it is missing, where that is known.

    The slack of an edge is that of the first disc that lacks clearance, and other discs may lack more.
    """
    missing = -least_slack(dirt, root[None, :], 0.0)
    if not 0.0 < missing < math.inf:
        return "the predicted start of the cycle lacks clearance"
    return f"the predicted start of the cycle lacks {missing:.3f} m of the clearance delta that the cycle requires"


def _failure_reason(progress: Progress) -> str:
    unsafe = "; many lack a safe contingency" if progress.unsafe else ""
    return f"none of {counted(progress.edges, 'edge')} may be executed{unsafe}"
