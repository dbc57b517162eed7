"""When the controller asks for which decision, from how long the last ones have taken."""

from __future__ import annotations

import math

import pytest

from kraft.robot.decision_requests import HURRY, LEAD_MAX, RECENT, DecisionRequests

CYCLE, LEAD = 1.0, 0.1


def answered(*delays: float) -> DecisionRequests:
    """Requests of which each was asked as early as possible, and answered after these times (s)."""
    requests = DecisionRequests(CYCLE, LEAD)
    for number, delay in enumerate(delays):
        asked = (number - LEAD_MAX) * CYCLE
        assert requests.ask(asked) == number
        requests.answered(asked + delay)
    return requests


def first_due(requests: DecisionRequests, begins: float) -> float:
    """Time before a cycle that begins at `begins` (s) when its decision is due, in steps of 1 ms."""
    return next(k / 1000 for k in range(int(1000 * CYCLE), -1, -1) if requests.is_due(begins - k / 1000))


def test_a_decision_is_asked_for_the_lead_of_the_method_before_its_cycle() -> None:
    requests = DecisionRequests(CYCLE, LEAD)
    assert not requests.is_due(-LEAD - 0.001)
    assert requests.is_due(-LEAD + 0.001)
    assert first_due(answered(0.01), CYCLE) == pytest.approx(LEAD, abs=0.002)


def test_slow_decisions_are_asked_for_earlier_until_they_are_quick_again() -> None:
    assert first_due(answered(0.2, 0.01), 2 * CYCLE) == pytest.approx(HURRY * 0.2, abs=0.002)
    assert first_due(answered(0.2, *[0.01] * RECENT), (1 + RECENT) * CYCLE) == pytest.approx(LEAD, abs=0.002)


def test_however_slow_decisions_are_a_part_of_the_cycle_is_left_for_the_search() -> None:
    assert first_due(answered(0.9), CYCLE) == pytest.approx(LEAD_MAX * CYCLE, abs=0.002)


def test_nothing_is_asked_while_the_planner_works() -> None:
    requests = DecisionRequests(CYCLE, LEAD)
    requests.ask(0.0)
    assert not requests.is_due(5.0)
    assert requests.waited(5.0) == 5.0
    requests.answered(5.0)
    assert requests.is_due(5.0)
    assert requests.waited(6.0) == 0.0


@pytest.mark.parametrize(("late", "number"), [(-0.051, 3), (-0.049, 4), (0.5, 4)])
def test_a_cycle_that_begins_too_soon_for_a_decision_is_left_out(late: float, number: int) -> None:
    """`late` is the time from the beginning of cycle 3 to the request."""
    requests = DecisionRequests(CYCLE, LEAD)
    assert requests.ask(3 * CYCLE + late) == number
    assert requests.ask(3 * CYCLE + late) == number + 1, "each cycle is asked for once"


def test_the_median_delay_is_that_of_the_answers() -> None:
    assert math.isnan(DecisionRequests(CYCLE, LEAD).median_delay)
    assert answered(0.1, 0.3, 0.2).median_delay == pytest.approx(0.2)
