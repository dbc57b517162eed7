"""Causes of collisions and timeouts: each is found where it was made, and every failure has one."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.passages import passage

from kraft.driving.messages import ContingencyOrigin, Cycle, PredictedMotion, Reference, ReferenceKind
from kraft.scenario import Goal
from kraft.trial.cause import Cause, CauseKind, collision_cause, estimate_errors, timeout_cause
from kraft.trial.measures import Step
from ompl_ext.vehicle import Footprint

FOOTPRINT = Footprint(0.4, 0.2)
POSE = (0, 1, 2)
GOAL = Goal((50.0, 0.0), 0.2)
PLAN, STOP = ReferenceKind.PLAN, ReferenceKind.CONTINGENCY


def cycle(number: int, **changes: Any) -> Cycle:
    """A cycle of 1 s, along x at 1 m/s, with 0.1 m of clearance."""
    times = number + np.linspace(0.0, 1.0, 11)
    states = np.column_stack([times, np.zeros((11, 3))])
    reference = Reference(changes.pop("kind", PLAN), times, states, np.zeros((10, 2)), np.zeros(2))
    fields: dict[str, Any] = {
        "number": number, "time": float(number), "speed": 1.0, "reason": "", "cost_to_goal": 5.0,
        "passage": passage(0.1), "iterations": 100, "nodes": 50, "retained": 0, "planning_ms": 4.0, "missed": False,
        "reference": reference, "contingency": None, "predicted": PredictedMotion(times, states, 0.1),
        "decided": float(number),
    }  # fmt: skip
    return Cycle(**{**fields, **changes})


def steps(
    until: float, *, aside: float = 0.0, wrong: float = 0.0, speed: float = 1.0, ahead: float = 0.0
) -> list[Step]:
    """Ticks along x, `aside` of it by then, with an estimate that is `wrong` to the side."""
    times = np.arange(0.0, until, 1 / 30)
    found = []
    for time in times.tolist():
        y = aside * time / times[-1]
        later = y + aside * ahead / times[-1]
        estimate = np.array([speed * (time + ahead), later + wrong, 0.0, speed])
        found.append(Step(time, (speed * time, y, 0.0), speed, estimate, np.zeros(2), int(time), ahead=ahead))
    return found


def cause_of(
    cycles: list[Cycle], ticks: list[Step], *, distance: float = 0.0, feedback: bool = True, realtime: bool = False
) -> Cause:
    return collision_cause(cycles, ticks, FOOTPRINT, POSE, distance=distance, feedback=feedback, realtime=realtime)


def collided(cycles: list[Cycle], ticks: list[Step], **options: Any) -> CauseKind:
    return cause_of(cycles, ticks, **options).kind


def timed_out(cycles: list[Cycle], ticks: list[Step], realtime: bool = False) -> CauseKind:
    return timeout_cause(cycles, ticks, FOOTPRINT, POSE, GOAL, realtime=realtime).kind


@pytest.mark.parametrize(
    ("last", "drive", "kind"),
    [
        ({}, {"aside": 0.5}, CauseKind.DEVIATION),
        ({}, {"aside": 0.5, "wrong": 0.1}, CauseKind.DEVIATION),
        ({}, {"aside": 0.5, "wrong": 0.4}, CauseKind.ESTIMATE_WRONG),
        ({}, {"aside": 0.05}, CauseKind.UNSAFE_PLAN),
        ({"passage": passage(0.0)}, {"aside": 0.5}, CauseKind.UNSAFE_PLAN),
        ({"kind": STOP, "passage": passage(0.0)}, {}, CauseKind.CONTINGENCY_TOO_LATE),
        ({"kind": STOP, "contingency_origin": ContingencyOrigin.EMERGENCY}, {"aside": 9.0}, CauseKind.CONTINGENCY_TOO_LATE),
        ({"kind": STOP, "contingency_origin": ContingencyOrigin.SAFE}, {"aside": 0.5}, CauseKind.DEVIATION),
        ({"delivered": False}, {"aside": 0.5}, CauseKind.MESSAGE_LOST),
    ],
)  # fmt: skip
def test_a_collision_has_the_cause_that_the_last_cycle_shows(last: Any, drive: Any, kind: CauseKind) -> None:
    assert collided([cycle(0), cycle(1, **last)], steps(1.9, **drive)) == kind


def test_delta_is_what_a_deviation_is_compared_with_where_the_method_asks_for_one() -> None:
    wide = replace(cycle(1).predicted, delta=np.full(11, 0.6))
    assert collided([cycle(0), cycle(1, predicted=wide)], steps(1.9, aside=0.5)) == CauseKind.UNSAFE_PLAN
    text = cause_of([cycle(0), cycle(1, predicted=wide)], steps(1.9, aside=0.5)).text
    assert "the car was 0.500 m from where it was predicted to be, which the bound of the deviation, " in text
    narrow = replace(wide, delta=np.full(11, 0.02))
    found = cause_of([cycle(0), cycle(1, predicted=narrow)], steps(1.9, aside=0.5))
    assert found.kind == CauseKind.DEVIATION
    assert found.text == (
        "the car was 0.500 m from the prediction, where 0.020 m were allowed, and its estimated pose was wrong by 0.000 m"
    )


def wrong_at(ticks: list[Step], time: float, error: float) -> list[Step]:
    """The ticks with an error of the estimate at the one at a time, to the side."""
    off = np.array([0.0, error, 0.0, 0.0])
    return [replace(step, estimate=step.estimate + off) if abs(step.time - time) < 1e-6 else step for step in ticks]


def test_an_error_of_the_estimate_that_has_passed_is_not_the_cause_of_a_deviation() -> None:
    times = np.linspace(0.0, 4.0, 41)
    states = np.column_stack([times, np.zeros((41, 3))])
    plan = Reference(PLAN, times, states, np.zeros((40, 2)), np.zeros(2))
    once, ticks = [cycle(0, reference=plan, decided=-math.inf)], steps(3.9, aside=0.5)
    assert collided(once, wrong_at(ticks, 2.0, 0.7)) == CauseKind.DEVIATION
    assert cause_of(once, wrong_at(ticks, 2.0, 0.7)).text.endswith("its estimated pose was wrong by 0.000 m")
    assert collided(once, steps(3.9, aside=0.5, wrong=0.4)) == CauseKind.ESTIMATE_WRONG


def test_the_one_estimate_that_a_later_cycle_was_planned_from_is_its_cause() -> None:
    ticks = wrong_at(steps(1.9, aside=0.5), 1.0, 0.4)
    for feedback in (True, False):
        assert collided([cycle(0), cycle(1)], ticks, feedback=feedback) == CauseKind.ESTIMATE_WRONG
    assert collided([cycle(0)], wrong_at(ticks, 0.0, 0.4), feedback=False) == CauseKind.DEVIATION  # from the start


def test_commands_that_use_no_estimate_are_not_led_astray_by_one() -> None:
    found = cause_of([cycle(0)], steps(1.9, aside=0.5, wrong=0.4), feedback=False)
    assert found.kind == CauseKind.DEVIATION
    assert found.text.endswith("and its commands depended on no estimated pose")


def test_a_contact_beyond_the_footprint_is_that_of_a_part_that_it_does_not_cover() -> None:
    cycles, ticks = [cycle(0), cycle(1, delivered=False)], steps(1.9, aside=0.5, wrong=0.4)
    found = cause_of(cycles, ticks, distance=0.253)
    assert found.kind == CauseKind.UNCOVERED
    assert found.text.endswith("touched the obstacle; the footprint was 0.253 m from every obstacle")
    assert collided(cycles, ticks, distance=0.01) == CauseKind.MESSAGE_LOST


def test_a_missed_deadline_counts_only_by_the_clock() -> None:
    cycles = [cycle(0), cycle(1, missed=True)]
    assert collided(cycles, steps(1.9, aside=0.5)) == CauseKind.DEVIATION
    assert collided(cycles, steps(1.9, aside=0.5), realtime=True) == CauseKind.DEADLINE_MISSED


def test_a_watchdog_that_stopped_the_car_is_a_lost_message() -> None:
    *before, last = steps(1.9, aside=0.5)
    assert collided([cycle(0), cycle(1)], [*before, replace(last, watchdog=True)]) == CauseKind.MESSAGE_LOST


def test_a_car_that_the_watchdog_stopped_most_of_the_time_is_not_said_to_be_slow() -> None:
    cycles, ticks = [cycle(k) for k in range(30)], steps(30.0)
    mostly = [replace(tick, watchdog=int(10.0 * tick.time) % 10 < 6) for tick in ticks]
    rarely = [replace(tick, watchdog=int(10.0 * tick.time) % 10 < 4) for tick in ticks]
    assert timed_out(cycles, mostly) == CauseKind.MESSAGE_LOST
    assert timed_out(cycles, rarely) == CauseKind.TOO_SLOW


def test_an_estimate_of_a_later_time_is_compared_with_the_pose_at_that_time() -> None:
    errors = estimate_errors(steps(3.0, ahead=0.2), FOOTPRINT, POSE)
    assert max(errors) == pytest.approx(0.0, abs=1e-9)
    assert estimate_errors(steps(3.0, wrong=0.3), FOOTPRINT, POSE)[-1] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("each", "speed", "kind"),
    [
        ({}, 1.0, CauseKind.TOO_SLOW),
        ({}, 0.001, CauseKind.STUCK),
        ({"kind": STOP, "proposed": False, "cost_to_goal": math.inf}, 0.0, CauseKind.NO_PLAN),
        ({"kind": STOP, "cost_to_goal": math.inf}, 0.0, CauseKind.PLANS_REFUSED),
        ({"delivered": False}, 0.0, CauseKind.MESSAGE_LOST),
    ],
)
def test_a_timeout_has_the_cause_that_most_of_the_last_cycles_show(each: Any, speed: float, kind: CauseKind) -> None:
    cycles = [cycle(k, **each) for k in range(30)]
    assert timed_out(cycles, steps(30.0, speed=speed)) == kind
    mended = [cycle(k, **(each if k < 15 else {})) for k in range(30)]
    assert timed_out(mended, steps(30.0)) == CauseKind.TOO_SLOW


def test_a_single_plan_that_ends_off_the_goal_is_a_deviation() -> None:
    found = timeout_cause([cycle(0)], steps(30.0, speed=0.5), FOOTPRINT, POSE, GOAL, realtime=False)
    assert found.kind == CauseKind.DEVIATION
    assert found.text.startswith("the car was 0.500 m from the plan at its end, 1.0 s")
    assert timed_out([cycle(0, kind=STOP, reason="none")], steps(30.0)) == CauseKind.NO_PLAN


@pytest.mark.parametrize(
    ("goal", "text"),
    [
        (
            Goal((0.0, 0.1), 0.2, math.radians(70.0), math.radians(10.0)),
            "a heading 70 degrees off, of which 10 are allowed",
        ),
        (Goal((0.0, 0.1), 0.2, 0.0, 0.1, {"hitch": (0.5, 0.6)}), "but not within goal.limits"),
        (Goal((0.0, 0.3), 0.2, math.radians(70.0), math.radians(10.0)), "with plans in 10 cycles"),
    ],
)
def test_a_car_that_stands_in_the_disc_of_the_goal_is_said_to_lack_the_rest_of_it(goal: Goal, text: str) -> None:
    found = timeout_cause([cycle(k) for k in range(30)], steps(30.0, speed=0.0), FOOTPRINT, POSE, goal, realtime=False)
    assert found.kind == CauseKind.STUCK
    assert found.text.endswith(text)
