"""Warnings of goals with a heading or limits, for methods that go by the distance of positions."""

from typing import Any

import pytest

from kraft.driving.method import load_method
from kraft.scenario import load_scenario
from kraft.trial.warnings import unguided_goal

HEADING = {"goal.heading_deg": 90, "goal.heading_tolerance_deg": 10}


@pytest.mark.parametrize("name", ["mppi", "nmpc", "dwa"])
@pytest.mark.parametrize(("given", "what"), [(HEADING, "heading"), ({"goal.limits": {"v": [-0.1, 0.1]}}, "limits")])
def test_a_goal_that_a_method_is_not_guided_to_is_said(name: str, given: dict[str, Any], what: str) -> None:
    method, scenario = load_method(name), load_scenario("turns", given)
    assert f"does not know the goal's {what}:" in unguided_goal(scenario, method)
    assert unguided_goal(load_scenario("turns"), method) == ""
    tree = load_method(f"kraft-{name}" if name != "dwa" else "sst")
    assert unguided_goal(scenario, tree) == ""
