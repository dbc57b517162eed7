"""What the OMPL planner `DIRT` knows of its search while and after it runs."""

from __future__ import annotations

from ompl_ext.compiled_search import CompiledSearch
from ompl_ext.kernels import kernel_types as at
from ompl_ext.planner import DIRT


def costs_over_time(planner: DIRT) -> tuple[tuple[float, float], ...]:
    """(seconds, cost) of each better solution of the last query, of a compiled search."""
    search = planner._search
    return search.dirt.progress.history if isinstance(search, CompiledSearch) else ()


def has_solution(planner: DIRT) -> bool:
    """Whether a running search has found a plan that reaches the goal."""
    return planner._search is not None and planner._search.count(at.BEST) >= 0
