"""From a task to a verified plan.  `plan_task` is the whole; `Budget` bounds it."""

from __future__ import annotations

from kraft.planning.plan import PlanResult, plan_task
from kraft.planning.search import Budget

__all__ = ["Budget", "PlanResult", "plan_task"]
