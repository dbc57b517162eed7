"""Search at levels of clearance, where the bound of the deviation is measured: which levels, and which plan of them.

`kraft.driving.levels` has the levels.  To keep less clearance has to save a share of the cost; to keep more than the
last plan may cost `RISE`.
"""

from __future__ import annotations

from typing import Final

from kraft.driving.levels import Levels
from kraft.driving.messages import PlanLoss
from kraft.driving.plan_search import CORRECTION_ATTEMPTS, PlanQuery, PlanSearch
from kraft.driving.proposal import Proposal
from kraft.driving.remainder import RETAINED_TOLERANCE
from kraft.driving.search_budget import LEVEL_TIME

STALLED: Final = 0.5
"""Cost of a plan beyond what was left of the last one from which on there is no progress, s."""
LEVEL_GAIN: Final = 0.1
"""Share of its cost that a plan must save to keep less clearance."""
LEAST_GAIN: Final = 0.2
"""Least cost that it must save, s; that is enough where plans cost more than what was left."""
DETOUR: Final = 1.0
"""Cost of a plan beyond the cost-to-go from which on plans that keep less clearance are tried, s."""
RISE: Final = 0.4
"""What a plan may cost to keep more clearance than the last one, s; below `REGRESSION` of `kraft.trial.measures`."""
PROBES: Final = 2
"""Attempts at retaining the remainder to find out whether a higher level is worth a search.

Few, as each of them costs time at every level above: one that fails by chance only leaves the level to a later cycle.
"""
PROBES_HIGHER: Final = 4
"""Attempts in a search at a level above that of the last plan, whose remainder is the fallback."""


class LevelSearch:
    """Plans at the levels of clearance of a method, see `find`."""

    def __init__(self, search: PlanSearch) -> None:
        self._search = search
        self.levels = Levels(search.solvers, search.settings)

    def find(self, query: PlanQuery) -> Proposal:
        """Plan of the first level that leaves a way to the goal, or of a later one that saves enough."""
        levels = self.levels
        kept, chosen, proposal, refused = levels.kept, levels.kept, Proposal(None), False
        waiting = self._first_levels(query)
        self._search.forget()
        while waiting and self._search.budget.left > 0:
            number = waiting.pop(0)
            dirt = levels.set(number, eased=query.remainder is not None and number == kept)
            attempts = PROBES_HIGHER if number < kept else CORRECTION_ATTEMPTS
            found = self._search.run(query, dirt, LEVEL_TIME, is_last=not waiting, attempts=attempts)
            if number < kept and not found.leads_to_goal:
                continue
            gain = RISE if chosen < kept else self._gain(proposal, query)
            refused = proposal.plan is not None
            if proposal.plan is None or found.is_better_than(proposal, gain):
                proposal, chosen, refused = found, number, False
                self._search.keep(dirt, found.plan)
            if proposal.leads_to_goal and not (waiting and self._is_compared(number, waiting[0], found, query)):
                break
        if proposal.plan is not None:
            cost = proposal.plan.total_cost
            levels.note_progress(cost, rises=chosen < kept)
            levels.note_comparison(refused)
            levels.keep(chosen, stalled=cost > query.left + STALLED or not levels.gets_on)
        elif waiting:
            levels.keep(waiting[0], stalled=False)
        return proposal

    def _gain(self, proposal: Proposal, query: PlanQuery) -> float:
        """What a plan must save to keep less clearance than the one of a proposal, s."""
        if proposal.plan is None or not self.levels.gets_on:
            return 0.0
        cost = proposal.plan.total_cost
        return LEAST_GAIN if cost > query.left + STALLED else max(LEAST_GAIN, LEVEL_GAIN * cost)

    def _is_compared(self, number: int, following: int, found: Proposal, query: PlanQuery) -> bool:
        """Whether the level `following` is tried too, because the plan found at a level is far from the cheapest one.

        That is so if it costs more than what was left, at levels above that of the last plan and, if there was no
        progress at it, at that level itself; and at every level if it costs much more than the cost-to-go and no plan
        was refused in the latest cycles.  Only a vehicle that knows its drive, or does not get on, tries a level
        without the margin for that.
        """
        levels = self.levels
        if found.plan is None:
            return False
        cost, may_be_narrow = found.plan.total_cost, levels.bound.drive_is_known or not levels.gets_on
        if number >= levels.kept and following >= levels.wide and not may_be_narrow:
            return False
        if levels.compares and cost > self._search.solvers.planning.root_cost_to_go + DETOUR:
            return True
        if query.remainder is None or number > levels.kept or (number == levels.kept and not levels.stalled):
            return False
        gains_foresight = number < levels.farsighted <= levels.kept
        return cost > query.left + (STALLED if gains_foresight else RETAINED_TOLERANCE)

    def _first_levels(self, query: PlanQuery) -> list[int]:
        """Levels to search at, in their order: from that of the last plan on, and now and then from a higher one."""
        levels = self.levels
        waiting = levels.downwards(levels.kept)
        if levels.stalled and levels.kept + 1 not in waiting:
            waiting.insert(1, levels.kept + 1)
        if levels.tries_higher and levels.gets_on:
            higher = levels.upwards()
            while higher[0] > 0 and self.holds(query, higher[0]) and self.holds(query, higher[0] - 1):
                higher[0] -= 1
            return higher + waiting
        return waiting

    def holds(self, query: PlanQuery, number: int) -> bool:
        """Whether the whole remainder of the last plan can be retained at a level, at no higher cost."""
        dirt, remainder = self.levels.set(number, eased=False), query.remainder
        if (
            remainder is None
            or dirt.start(query.root, self._search.seed_of(query.number)) < 0.0
            or dirt.slack(query.root) < 0.0
        ):
            return False
        return self._search.retain(query, remainder, dirt, PROBES) is PlanLoss.NONE
