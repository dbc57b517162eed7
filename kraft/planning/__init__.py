"""Planning of a task: `plan_task` returns a verified plan within a `Budget`.

The modules are imported when a name is first used, because many need `kraft.planning.workspace` alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from kraft.planning.plan import PlanResult as PlanResult
    from kraft.planning.plan import plan_task as plan_task
    from kraft.planning.search import Budget as Budget

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submod_attrs={"plan": ["PlanResult", "plan_task"], "search": ["Budget"]}
)
