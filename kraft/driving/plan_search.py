"""One search for a plan: Alg. 1 from the predicted start of a cycle, and which plan of its tree is proposed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

from kraft.driving.command_loss import CommandLoss
from kraft.driving.messages import PlanLoss
from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.prediction import least_slack
from kraft.driving.proposal import Proposal
from kraft.driving.remainder import Remainder, has_remainder, retain, retained_plan, start_with_best_corrections
from kraft.driving.search_budget import SearchBudget
from kraft.driving.solvers import Solvers
from kraft.driving.ways import goes_same_way
from kraft.errors import Defect
from kraft.text import counted, listed
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan
from ompl_ext.query_tree import Progress
from ompl_ext.retainment import RetainableEdges
from ompl_ext.solver import DirtSolver
from ompl_ext.verification import violations

CORRECTION_ATTEMPTS: Final = 12
"""Most attempts at retaining a remainder, each with other random corrections."""
CYCLE_SEEDS: Final = 100_003
"""Difference between the seeds of a cycle in two trials whose seeds are consecutive: more than a trial has cycles."""
LOSS_CANDIDATES: Final = 20
"""Next best plans that are examined for room for a loss of commands if the best one has none."""


@dataclass(frozen=True)
class PlanQuery:
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
class GrownPlan:
    """A plan, the solver that found it, and the edges of its tree that the next cycle retains, if any.

    They are taken at once: the search at another level replaces the tree of the solver.
    """

    dirt: DirtSolver
    plan: Plan
    edges: RetainableEdges | None


class PlanSearch:
    """Searches with the solvers of a method, and what the next cycle retains of the plan that is chosen.

    Args:
        solvers: solvers of the task.
        settings: planner settings of the method.
        seed: seed of all plans.
        realtime: limit planning by wall-clock time instead of iterations.
        keep_trees: keep a copy of the tree in each proposal.
        command_timeout: time after the last command when the robot stops itself (s), for which plans leave room; None
            for a robot that loses no commands.
    """

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
        self.realtime = realtime
        self._seed, self._keep_trees = seed, keep_trees
        self._command_timeout = command_timeout
        self.grown: GrownPlan | None = None
        """the plan whose remainder, with its tree, the next cycle retains"""
        self.set_settings(settings)
        self._use(solvers)

    def set_settings(self, settings: PlannerSettings) -> None:
        """Use settings with another budget from the next search on."""
        self.settings = settings
        self.budget = SearchBudget(settings, self.realtime)

    def set_solvers(self, solvers: Solvers) -> None:
        """Use other solvers from the next search on."""
        if self.grown is not None:
            planned = self.grown.dirt is self.solvers.planning
            self.grown = replace(self.grown, dirt=solvers.planning if planned else solvers.checking)
        self._use(solvers)

    def _use(self, solvers: Solvers) -> None:
        self.solvers = solvers
        timeout = self._command_timeout
        self.loss = None if timeout is None else CommandLoss(solvers.checking, timeout)
        """predicts lost commands, for a robot that may lose them"""

    def query(self, number: int, root: Floats, previous: Plan | None, began: float) -> PlanQuery:
        """Query of cycle `number` from `root` (nx,), with the remainder of the plan that is executed until then."""
        return PlanQuery(number, root, self._remainder(previous), began)

    def run(
        self,
        query: PlanQuery,
        dirt: DirtSolver,
        share: float,
        is_last: bool = False,
        attempts: int = CORRECTION_ATTEMPTS,
    ) -> Proposal:
        """Alg. 1 from the predicted root, starting with the remainder of the plan that is being executed.

        Args:
            query: what to plan.
            dirt: the solver, with the clearance that plans keep.
            share: share of the remaining time in which a plan has to be found, by the clock.
            is_last: whether no other search comes after this one.
            attempts: most attempts at retaining the remainder, each with other random corrections.
        """
        root, remainder = query.root, query.remainder
        if dirt.start(root, self.seed_of(query.number)) < 0.0:
            return Proposal(None, "the predicted start of the cycle is in collision or too near to an obstacle")
        if dirt.slack(root) < 0.0:
            return Proposal(None, _lack(dirt, root))
        lost = PlanLoss.NONE if remainder is None else self.retain(query, remainder, dirt, attempts)  # ll. 1-8
        retained = None
        if remainder is not None and self.settings.switch_gain > 0.0:
            retained = retained_plan(dirt, remainder)
        progress = self.budget.grow(dirt, query.left, share, is_last)
        plan, refused = self.choose(dirt, retained)
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

    def retain(self, query: PlanQuery, remainder: Remainder, dirt: DirtSolver, attempts: int) -> PlanLoss:
        """Retain a remainder in the query that `dirt` has started, with the best of several corrections of its tree."""
        begun = remainder.edges is not None and start_with_best_corrections(
            dirt, query.root, remainder, self.seed_of(query.number), attempts
        )
        return retain(dirt, query.root, remainder, begun)

    def keep(self, dirt: DirtSolver, plan: Plan | None) -> None:
        """Let the next cycle retain the remainder of a plan, with its tree if the settings say so.

        That is at most as many edges as the search had iterations: more of the tree of the first plan.
        """
        settings, edges = self.settings, None
        if plan is not None and settings.retain == "tree" and has_remainder(plan, settings.cycle):
            edges = dirt.retainable_edges(plan, settings.cycle, settings.iterations)
        self.grown = None if plan is None else GrownPlan(dirt, plan, edges)

    def forget(self) -> None:
        """Let the next cycle retain nothing of a tree."""
        self.grown = None

    def _remainder(self, previous: Plan | None) -> Remainder | None:
        """Remainder of the plan that is executed, as the settings retain it; None if it ends before the cycle does."""
        settings = self.settings
        if previous is None or not has_remainder(previous, settings.cycle):
            return None
        grown = self.grown
        return Remainder(
            previous, settings.cycle, grown.edges if grown is not None and grown.plan is previous else None
        )

    def seed_of(self, number: int) -> int:
        """Seed of the random numbers of a cycle."""
        return self._seed * CYCLE_SEEDS + number

    def choose(self, dirt: DirtSolver, retained: Plan | None) -> tuple[Plan | None, bool]:
        """Best plan, or the best one that goes the way of the retained plan if leaving it does not save enough."""
        best, gain = dirt.plan(retained), self.settings.switch_gain
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
        cycle = self.settings.cycle
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
        for each in self.loss.slower(plan, root, self.settings.cycle, self.seed_of(number)):
            self._verify(number, self.solvers.checking, each)
            self.keep(self.solvers.checking, each)
            yield each

    def _verify(self, number: int, dirt: DirtSolver, plan: Plan) -> None:
        """Verify with FCL the part of the plan that may be executed before the next plan is committed.

        Raises:
            Defect: if the plan violates what the planner guarantees.
        """
        until = math.inf if self.settings.mode == "one-shot" else self.settings.cycle
        problems = violations(dirt, plan.head(until))
        if problems:
            raise Defect(f"the plan of cycle {number} fails verification: {listed(problems)}")


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
