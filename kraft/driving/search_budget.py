"""Budget of a cycle's searches: how many iterations, or how much time, each of them spends.

A number of iterations gives the same plan on every run; by the clock the plan depends on the machine.
"""

from __future__ import annotations

import math
import time as clock
from typing import Final

from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.remainder import RETAINED_TOLERANCE
from ompl_ext.query_tree import Progress
from ompl_ext.solver import DirtSolver

CONVERGED: Final = 0.1
"""Fall of the best cost during a quarter of the iterations below which a search has converged, s."""
PATIENCE: Final = 0.4
"""Share of the iterations after which a search at a level without a way to the goal ends."""
LEVEL_TIME: Final = 0.15
"""Share of the remaining time in which a search finds a way at a level, by the clock."""
LEAST_TIME: Final = 0.3
"""Share of the time of a cycle that its searches have whatever else takes time, by the clock."""
RESERVED_TIME: Final = 0.2
"""Share of the time of a cycle that is left for other levels, by the clock."""


class SearchBudget:
    """Grows the trees of a cycle within its budget.

    At levels of clearance all searches of a cycle share the largest budget.  Otherwise each of them spends
    `iterations`, and what remains to the largest budget is spent where a plan is not settled.
    """

    def __init__(self, settings: PlannerSettings, realtime: bool) -> None:
        """`realtime` limits the searches by wall-clock time instead of iterations."""
        self._settings, self._realtime, self._at_levels = settings, realtime, settings.bound is not None
        self._ends = math.inf
        self.taken = 0.0
        """time of a cycle that something else takes, by the clock, s"""
        self.left = 0
        """iterations that the searches of the cycle may still spend; in turn, those beyond the ones that each has"""
        self.spent = 0
        """iterations that they have spent, of those that `left` counts or by the clock"""

    def begin(self, began: float) -> None:
        """Begin a cycle whose planning began at `began` s of the clock."""
        settings = self._settings
        whole = settings.clock_budget
        self._ends, self.spent = began + max(whole - self.taken, LEAST_TIME * whole), 0
        self.left = settings.largest_budget - (0 if self._at_levels else settings.iterations)

    def allow(self, iterations: int) -> None:
        """Allow at least as many `iterations` more."""
        self.left = max(self.left, iterations)

    def grow(self, dirt: DirtSolver, cost_left: float, share: float, is_last: bool) -> Progress:
        """Spend iterations, or by the clock a `share` of the time, and with a plan all of it but what others need.

        `cost_left` is the cost that was left of the last plan (s): a plan that costs more is not settled.  `is_last`
        is whether no level comes after this one.
        """
        if not self._realtime:
            if self._at_levels:
                return self._grow_at_level(dirt, cost_left, is_last)
            return self._grow_iterations(dirt, cost_left)
        progress = dirt.grow(seconds=share * (self._ends - clock.perf_counter()))
        if dirt.plan() is not None:
            reserved = RESERVED_TIME * self._settings.clock_budget if self._at_levels and not is_last else 0.0
            progress = dirt.grow(seconds=self._ends - reserved - clock.perf_counter())
        self.spent += progress.iterations
        return progress

    def _grow_at_level(self, dirt: DirtSolver, cost_left: float, is_last: bool) -> Progress:
        """Spend iterations of the cycle's budget until the plan is settled, or few if they find no way to the goal.

        As many as these few are left of the budget for the levels after it, unless there are none.
        """
        iterations = self._settings.iterations
        quarter, patience = max(1, iterations // 4), max(1, round(PATIENCE * iterations))
        spent, cost, progress = 0, math.inf, dirt.progress
        most = self.left if is_last else min(self.left, max(patience, self.left - patience))
        while spent < most:
            count = min(patience if spent == 0 else quarter, most - spent)
            cost, progress = dirt.best_cost, dirt.grow(iterations=count, timed=False)
            spent += count
            if not (is_last or dirt.best_node()[1]):
                break
            if spent >= iterations and _is_settled(dirt, cost_left, cost):
                break
        self._spend(spent)
        return progress

    def _grow_iterations(self, dirt: DirtSolver, cost_left: float) -> Progress:
        """Spend `iterations`, and what is left of `max_iterations` while the plan is not settled."""
        iterations = self._settings.iterations
        if self.left == 0:
            return dirt.grow(iterations=iterations, timed=False)
        chunk = max(1, iterations // 4)
        if iterations > chunk:
            dirt.grow(iterations=iterations - chunk, timed=False)
        cost = dirt.best_cost
        progress = dirt.grow(iterations=chunk, timed=False)
        while self.left > 0 and not _is_settled(dirt, cost_left, cost):
            cost, count = dirt.best_cost, min(chunk, self.left)
            progress = dirt.grow(iterations=count, timed=False)
            self._spend(count)
        return progress

    def _spend(self, iterations: int) -> None:
        self.left -= iterations
        self.spent += iterations


def _is_settled(dirt: DirtSolver, cost_left: float, before: float) -> bool:
    """Whether the best plan reaches the goal, costs what was left of the last plan, and no longer improves.

    `before` is the best cost before the last iterations, s.
    """
    cost = dirt.best_cost
    return dirt.best_node()[1] and cost <= cost_left + RETAINED_TOLERANCE and before - cost < CONVERGED
