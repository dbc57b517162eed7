"""Goals and maps that arrive often: the planner gets the newest once for each decision, and goals are reached."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.control import control_and_guard

from kraft.driving.messages import Estimate
from kraft.robot.change_requests import ChangeRequests
from kraft.robot.newest_map import NewestMap
from kraft.robot.protocol import NewGoal, Planned, TaskChange, TaskTaken
from kraft.scenario import Goal, OccupancyMap
from kraft.vehicles.load import load_vehicle

MUSHR = load_vehicle("mushr")
FIRST = NewGoal((1.0, 8.0))
GOAL = FIRST.moved(Goal((0.0, 0.0), 0.25))


def grid(origin: float = 0.0) -> OccupancyMap:
    return OccupancyMap(np.zeros((3, 3), dtype=bool), 0.1, (origin, 0.0, 0.0), name="map")


def estimate(time: float, x: float = 0.0, y: float = 0.0) -> Estimate:
    return Estimate(time, np.array([x, y, 0.0, 0.0]), 0.0)


def test_the_planner_gets_the_newest_goal_and_map_in_one_change_for_each_decision() -> None:
    changes, newest, maps = ChangeRequests(1.0, GOAL), NewestMap(MUSHR), [grid(0.1 * k) for k in range(4)]
    assert changes.next(newest, 4) is None
    newest.take(maps[0], estimate(5.0))
    assert changes.next(newest, 5) == TaskChange(None, maps[0])
    for k in (1, 2):
        newest.take(maps[k], estimate(5.0 + 0.1 * k))
        changes.take(NewGoal((2.0, float(k))))
        assert changes.next(newest, 6) is None
    changes.decided()
    assert changes.next(newest, 6) is None, "it was asked for before"
    changes.answered(TaskTaken(None))
    assert changes.next(newest, 6) is None
    changes.decided()
    change = changes.next(newest, 6)
    assert change is not None
    assert change.goal == NewGoal((2.0, 2.0))
    assert change.map is maps[2]
    changes.answered(TaskTaken(NewGoal((2.0, 2.0))))
    changes.decided()
    assert changes.next(newest, 7) is None


def test_only_a_goal_that_is_not_the_newest_one_already_is_new() -> None:
    changes, newest, second = ChangeRequests(1.0, GOAL), NewestMap(MUSHR), NewGoal((2.0, 7.0))

    def asked(goal: NewGoal) -> TaskChange | None:
        changes.take(goal)
        changes.decided()
        return changes.next(newest, 1)

    assert asked(FIRST) is None
    assert asked(second) == TaskChange(second, None)
    assert asked(second) is None, "it is not answered yet"
    assert changes.open_goals == [second]
    assert changes.answered(TaskTaken(None, refused="it is in an obstacle")) == ["it is in an obstacle"]
    assert changes.open_goals == []
    assert asked(second) == TaskChange(second, None), "it may be free now"
    assert asked(FIRST) is None
    assert changes.open_goals == [second, FIRST], "the planner may take the other one"
    changes.answered(TaskTaken(second))
    assert asked(FIRST) == TaskChange(FIRST, None)


def test_a_goal_that_cannot_be_reached_is_told_once_and_when_it_can_be_reached_again() -> None:
    changes, blocked = ChangeRequests(1.0, GOAL), "the goal (2, 8) is unreachable"
    answers = [
        TaskTaken(None), TaskTaken(None, blocked), TaskTaken(None, blocked), TaskTaken(None, blocked, "out of bounds"),
        TaskTaken(None), TaskTaken(None, blocked),
    ]  # fmt: skip
    told = [changes.answered(answer) for answer in answers]
    assert told == [
        [], [blocked], [], ["out of bounds"], ["the goal can be reached, as far as is known"], [blocked],
    ]  # fmt: skip


@pytest.mark.parametrize(("seconds", "decisions"), [(0.1, 1), (0.8, 4)])
def test_a_change_that_makes_one_decision_late_is_followed_by_decisions_in_time(seconds: float, decisions: int) -> None:
    changes, newest = ChangeRequests(1.0, GOAL), NewestMap(MUSHR)
    newest.take(grid(), estimate(5.0))
    assert changes.next(newest, 5) is not None
    changes.answered(TaskTaken(None, seconds=seconds))
    newest.take(grid(0.1), estimate(6.0))
    for _ in range(decisions):
        assert changes.next(newest, 6) is None
        changes.decided()
    assert changes.next(newest, 6) is not None


def test_a_goal_without_a_heading_is_another_one_at_the_place_of_one_that_has() -> None:
    changes = ChangeRequests(1.0, NewGoal(FIRST.center, 0.0, 0.1).moved(GOAL))
    changes.take(FIRST)
    assert changes.next(NewestMap(MUSHR), 1) == TaskChange(FIRST, None)


def test_of_goals_in_every_tick_the_controller_sends_the_planner_one_for_each_decision(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    control, _tracker, _guard = control_and_guard()
    sent = list[Any]()
    goals = iter([NewGoal((2.0, 7.0 + 0.001 * k)) for k in range(40)])
    answers = list[Any]()
    monkeypatch.setattr(control, "_mailbox", SimpleNamespace(closed=False, send=sent.append, take=lambda: answers))
    monkeypatch.setattr(control, "_requests", SimpleNamespace(answered=lambda _: None, following=1))
    monkeypatch.setattr(control, "_tasks", SimpleNamespace(
        take_goal=lambda: next(goals), take_map=lambda: None, take_goal_problem=lambda: "",
    ))  # fmt: skip
    for k in range(40):
        control._take_task(1.0 + 0.03 * k)
    assert sent == [TaskChange(NewGoal((2.0, 7.0)), None)]
    answers.append(TaskTaken(NewGoal((2.0, 7.0))))
    answers.append(Planned(SimpleNamespace(number=1, time=100.0)))  # type: ignore[arg-type]
    control._take_messages(3.0)
    goals = iter([NewGoal((2.0, 7.5))])
    control._take_task(3.0)
    assert sent[1:] == [TaskChange(NewGoal((2.0, 7.5)), None)]


@pytest.mark.parametrize(
    ("goal", "counts"), [(None, True), ((1.0, 2.0), False), ((0.05, 0.0), True), ((0.0, 0.0), True)]
)
def test_the_goal_counts_as_reached_unless_the_planner_gets_ready_for_one_elsewhere(
    goal: tuple[float, float] | None, counts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a robot that sends maps often, or the place of what it follows, the planner nearly always gets ready.

    The new goal is relative to the first one, in which the vehicle is.
    """
    control, _tracker, _guard = control_and_guard()
    ended = list[str]()
    monkeypatch.setattr(control, "_end", lambda _, outcome, __: ended.append(outcome))
    monkeypatch.setattr(control, "_mailbox", SimpleNamespace(closed=False, send=lambda _: None))
    x, y = control._spec.task.goal.center
    place = None if goal is None else NewGoal((x + goal[0], y + goal[1]))
    monkeypatch.setattr(control, "_tasks", SimpleNamespace(
        take_goal=lambda: place, take_map=grid, take_goal_problem=lambda: "",
    ))  # fmt: skip
    control._take_task(1.0)
    for k in range(3):
        control._look_for_end(1.0 + 0.03 * k, estimate(1.0, x, y))
    assert ended == (["success"] if counts else [])
