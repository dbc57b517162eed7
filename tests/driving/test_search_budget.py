"""The time of a cycle that its searches have, by the clock."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.search_budget import LEAST_TIME, SearchBudget

SETTINGS = PlannerSettings(mode="replanning", cycle=1.0, lead=0.3)


@pytest.mark.parametrize(
    ("taken", "left"),
    [(0.0, SETTINGS.clock_budget), (0.2, SETTINGS.clock_budget - 0.2), (5.0, LEAST_TIME * SETTINGS.clock_budget)],
)
def test_searches_have_the_time_that_nothing_else_takes(taken: float, left: float) -> None:
    budget, asked = SearchBudget(SETTINGS, realtime=True), list[float]()

    def grow(seconds: float) -> SimpleNamespace:
        asked.append(seconds)
        return SimpleNamespace(iterations=1)

    budget.taken = taken
    budget.begin(time.perf_counter())
    budget.grow(SimpleNamespace(grow=grow, plan=lambda: None), 0.0, 1.0, is_last=True)  # type: ignore[arg-type]
    assert asked == [pytest.approx(left, abs=0.02)]
