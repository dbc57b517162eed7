"""Proposals for the replanner: a plan for the next cycle, or the reason why there is none.

With a fixed clearance Alg. 1 runs with the method's margin first and, if it finds no plan, once more without it.  Where
the bound of the deviation is measured, it runs at levels of clearance in turn, see `kraft.driving.level_search`.
"""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

from kraft.driving.bound import DeviationBound
from kraft.driving.command_loss import CommandLoss
from kraft.driving.geodesic import geodesic_plan
from kraft.driving.level_search import LevelSearch
from kraft.driving.messages import PlanLoss
from kraft.driving.plan_search import PlanQuery, PlanSearch
from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.prediction import least_slack
from kraft.driving.proposal import Proposal
from kraft.driving.remainder import RETAINED_TOLERANCE, Remainder
from kraft.driving.solvers import Solvers, goal_region
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan
from ompl_ext.solver import DirtSolver

RECOVERY_MARGIN: Final = 0.005
"""Present clearance less the one that a recovery requires, m."""


class Proposer:
    """Proposes the plan of the next cycle, by the searches of a method.

    Args:
        search: one search with the solvers and the planner settings of the method.
    """

    def __init__(self, search: PlanSearch) -> None:
        self.search = search
        self.level_search = LevelSearch(self.search)
        self.levels = self.level_search.levels
        self.recovers = False
        """whether the last proposal is for a vehicle that leaves a place with less clearance than required"""
        self._delta = self.dirt.safety.delta

    @property
    def dirt(self) -> DirtSolver:
        """The solver without margin."""
        return self.search.solvers.checking

    @property
    def loss(self) -> CommandLoss | None:
        """What predicts lost commands, for a robot that may lose them."""
        return self.search.loss

    def set_settings(self, settings: PlannerSettings) -> None:
        """Use settings with another budget from the next proposal on."""
        self.search.set_settings(settings)

    def set_solvers(self, solvers: Solvers) -> None:
        """Use other solvers from the next proposal on, at the level of clearance of the last one."""
        self.search.set_solvers(solvers)
        self.levels.set_solvers(solvers)
        self._delta = self.dirt.safety.delta

    def set_bound(self, bound: DeviationBound) -> None:
        """Set the bound of the deviation; the share that the last plan kept is asked for until the next proposal."""
        self.levels.bound = bound
        self.levels.require()

    def propose(self, number: int, root: Floats, previous: Plan | None, taken: float = 0.0) -> Proposal:
        """Plan for cycle `number` from the predicted root.

        Args:
            number: index of the cycle.
            root: predicted state at the start of the cycle (nx,).
            previous: plan that is executed until then; its remainder is retained.
            taken: time of the cycle that something else takes, by which the search is shorter by the clock, s.
        """
        began, settings = clock.perf_counter(), self.search.settings
        self.search.budget.taken = taken
        region = goal_region(self.search.solvers.goal, self.dirt.vehicle, root)
        for dirt in (self.search.solvers.planning, self.search.solvers.checking):
            dirt.set_goal_region(*region)
        if settings.type == "geodesic":
            proposal = self._propose_geodesic(root, drives=previous is not None or number == 0)
        else:
            query = self.search.query(number, root, previous, began)
            proposal = self._propose_in_turn(query) if settings.bound is None else self._propose_at_levels(query)
        seconds = clock.perf_counter() - began
        missed = number > 0 and seconds > settings.cycle - settings.lead  # the first plan is made before the drive
        if self.search.realtime and missed:
            reason = f"planning took {seconds:.3f} s, longer than the cycle allows"
            return replace(proposal, plan=None, reason=reason, seconds=seconds, missed=True)
        return replace(proposal, seconds=seconds, missed=missed)

    def _propose_in_turn(self, query: PlanQuery) -> Proposal:
        """Plan with a fixed clearance: of the first solver that finds one, or of the one that retains the remainder."""
        self.search.budget.begin(query.began)
        last, proposal = self.search.grown, Proposal(None)
        self.search.forget()
        for dirt, share in self._solvers_in_turn(query.root):
            found = self.search.run(query, dirt, share)
            if self.search.grown is None or found.is_better_than(proposal, self.search.settings.switch_gain):
                proposal = found
                self.search.keep(dirt, found.plan)
            if proposal.plan is None:
                continue
            if last is None or dirt is last.dirt or not self._is_worse(proposal, query.remainder):
                break
        return proposal

    def _propose_at_levels(self, query: PlanQuery) -> Proposal:
        """Plan of a level of clearance; where none leaves a way, one that leaves a place with too little of it."""
        levels, settings = self.levels, self.search.settings
        self.search.budget.begin(query.began)
        was_recovering, self.recovers = self.recovers, False
        proposal = self.level_search.find(query)
        if proposal.plan is not None:
            levels.require()
        elif self._begin_recovery(query.root, was_recovering):
            self.recovers = True
            self.search.budget.allow(settings.iterations)  # the levels may have spent all of it
            proposal = self.search.run(query, self.dirt, 1.0, is_last=True)
            self.search.keep(self.dirt, proposal.plan)
        return replace(proposal, iterations=self.search.budget.spent)

    def _propose_geodesic(self, root: Floats, drives: bool) -> Proposal:
        """Path of least cost-to-go; a vehicle that stopped (not `drives`) or does not get on keeps less of the bound.

        Whether the controller finds a safe way is known only when the replanner predicts it.
        """
        dirt, levels = self.dirt, self.levels
        if self.search.settings.bound is None:
            dirt.set_delta(self._delta)  # the replanner lowers it for a vehicle that stands with less
        else:
            levels.drive_on(drives and levels.gets_on)
            levels.require()
        plan = geodesic_plan(dirt, root)
        if plan is not None:
            levels.note_progress(plan.cost, rises=False)
        reason = "" if plan is not None else "no path leads to the goal from the predicted start of the cycle"
        return Proposal(plan, reason)

    def _solvers_in_turn(self, root: Floats) -> Iterator[tuple[DirtSolver, float]]:
        """Solvers to run in turn, each with its share of the remaining time; the first plan that is found is taken."""
        planning, checking = self.search.solvers.planning, self.search.solvers.checking
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
        checking = self.search.solvers.checking
        safety, slack = checking.safety, checking.slack(root)
        if self.search.settings.car_switches:  # `slack` is that of the first disc that lacks clearance
            slack = min(slack, least_slack(checking, root[None, :], 0.0))
        lacks = -safety.delta < slack < safety.delta_per_time * safety.delta_horizon
        may_leave = was_recovering or bool(safety.is_resting(checking.vehicle, root))
        recovers = self.search.settings.recover and may_leave and lacks
        if recovers:
            checking.set_delta(max(0.0, safety.delta + min(slack, 0.0) - RECOVERY_MARGIN))
        return recovers

    def _is_worse(self, proposal: Proposal, remainder: Remainder | None) -> bool:
        """Whether a plan replaces a lost remainder and costs more; if a gain is required, the last solver is asked."""
        if self.search.settings.switch_gain == 0.0 or remainder is None:
            return False
        if proposal.plan is None or proposal.lost is PlanLoss.NONE:
            return False
        return proposal.plan.total_cost > remainder.left + RETAINED_TOLERANCE
