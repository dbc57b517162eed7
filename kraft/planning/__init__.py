"""Planning of a task: `plan_task` returns a verified plan within a `Budget`."""

from __future__ import annotations

from kraft.planning.plan import PlanResult, plan_task
from kraft.planning.search import Budget

__all__ = ["Budget", "PlanResult", "plan_task"]
