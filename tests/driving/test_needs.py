"""What is compiled before a method drives."""

from __future__ import annotations

import pytest

from kraft.driving.method import load_method
from kraft.driving.needs import needs_of
from kraft.planning.compilation import Needs
from kraft.scenario import load_scenario
from kraft.vehicles.load import load_vehicle


@pytest.mark.parametrize(
    ("method", "vehicle", "scenario", "needs"),
    [
        ("kraft", "mushr", "turns", {}),
        ("kraft", "jackal", "posts", {"steps": True}),
        ("kraft", "mushr", "parking", {"polish": True, "poses": True}),
        ("adaptive-kraft", "mushr", "turns", {"steps": True, "poses": True}),
        ("sst", "mushr", "turns", {"steps": True, "modules": ("sst",), "poses": True}),
        ("dwa", "mushr", "turns", {"steps": True, "modules": ("rollouts",)}),
    ],
)
def test_a_method_needs_what_its_estimator_controller_and_planner_compile_and_what_the_goal_asks_for(
    method: str, vehicle: str, scenario: str, needs: dict[str, object]
) -> None:
    loaded = load_vehicle(vehicle)
    found = needs_of(load_method(method), loaded, load_scenario(scenario).goal)
    assert found == Needs(loaded, **needs)  # type: ignore[arg-type]
