"""What a search for the plan of the next cycle has found."""

from __future__ import annotations

from dataclasses import dataclass

from kraft.driving.messages import PlanLoss
from ompl_ext.plan import Plan, TreeView


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

    @property
    def leads_to_goal(self) -> bool:
        """Whether there is a plan, and it reaches the goal."""
        return self.plan is not None and self.plan.reaches_goal

    def is_better_than(self, other: Proposal, gain: float) -> bool:
        """Whether this plan, of another solver, reaches the goal and saves `gain` (s), or alone reaches the goal."""
        if self.plan is None or other.plan is None or not self.plan.reaches_goal:
            return False
        return not other.plan.reaches_goal or self.plan.total_cost <= other.plan.total_cost - gain
