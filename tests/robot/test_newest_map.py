"""What a new map has in the way of what was decided without it: the vehicle stops, and does not take it on board."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.control import control_and_guard

from kraft.driving.messages import Commitment, Estimate, Reference, ReferenceKind
from kraft.robot.newest_map import NewestMap
from kraft.robot.protocol import Planned
from kraft.scenario import OccupancyMap
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats

MUSHR = load_vehicle("mushr")
SPEED = 0.5


def straight(begin: float, y: float, end: float, decided: float, turn: float = 0.0) -> Commitment:
    """A plan along y from `y` for 1 s, then a contingency on the same way until `end`, which may turn off to the left."""

    def reference(kind: ReferenceKind, times: Floats) -> Reference:
        along = y + SPEED * (times - begin)
        aside = -turn * (times - begin - 1.0).clip(0.0)
        states = np.column_stack([aside, along, np.full(len(times), 0.5 * math.pi), np.full(len(times), SPEED)])
        return Reference(kind, times, states, np.zeros((len(times) - 1, 2)), np.zeros(2))

    plan = reference(ReferenceKind.PLAN, np.linspace(begin, begin + 2.0, 21))
    contingency = reference(ReferenceKind.CONTINGENCY, np.linspace(begin + 1.0, end, 11))
    return Commitment(plan, begin + 1.0, contingency, decided)


def cells(places: Sequence[tuple[float, float]], yaw: float = 0.0, resolution: float = 0.04) -> OccupancyMap:
    """A map with an occupied cell around each of the places (m)."""
    origin = np.array([-3.0, -3.0])
    c, s = math.cos(yaw), math.sin(yaw)
    occupied = np.zeros((300, 200), dtype=bool)
    for place in places:
        column, row = np.floor(np.array([[c, s], [-s, c]]) @ (np.array(place) - origin) / resolution).astype(int)
        occupied[row, column] = True
    return OccupancyMap(occupied, resolution, (*origin.tolist(), yaw), name="map")


def estimate(y: float, time: float) -> Estimate:
    return Estimate(time, np.array([0.0, y, 0.5 * math.pi, SPEED]), 0.0)


FRONT = MUSHR.footprint.ends[1]
SIDE = 0.5 * MUSHR.footprint.width


@pytest.mark.parametrize("yaw", [0.0, 0.4])
@pytest.mark.parametrize(
    ("place", "is_in_the_way"),
    [
        ((0.0, 0.8), True),
        ((0.0, 1.0 + FRONT - 0.03), True),  # where the contingency ends
        ((0.0, 1.0 + FRONT + 0.06), False),  # beyond, where the plan would go on
        ((SIDE - 0.02, 0.8), True),
        ((SIDE + 0.06, 0.8), False),
        ((-SIDE - 0.06, 0.8), False),
        ((0.0, -0.3), False),  # behind it
        ((0.0, 0.1), False),  # under it
    ],
)
def test_a_map_is_in_the_way_where_what_is_driven_touches_it(
    place: tuple[float, float], is_in_the_way: bool, yaw: float
) -> None:
    newest = NewestMap(MUSHR)
    newest.take(cells([place], yaw), estimate(0.0, 5.0))
    found = newest.in_the_way_of(straight(5.0, 0.0, 7.0, 4.7), 5.0)
    assert (found is not None) == is_in_the_way
    if found is not None:
        assert found == pytest.approx(place, abs=0.04)


def test_only_the_rest_of_a_commitment_counts_and_its_contingency_from_the_switch_on() -> None:
    newest = NewestMap(MUSHR)
    assert newest.in_the_way_of(straight(5.0, 0.0, 7.0, 4.7), 5.0) is None, "no map has arrived"
    passed = (SIDE - 0.02, 0.1)
    newest.take(cells([passed]), estimate(0.6, 6.2))
    assert newest.in_the_way_of(straight(5.0, 0.0, 7.0, 4.7), 6.2) is None
    newest.take(cells([(0.0, 1.05)]), estimate(0.0, 5.0))
    assert newest.in_the_way_of(straight(5.0, 0.0, 7.0, 4.7), 5.0) is not None
    assert newest.in_the_way_of(straight(5.0, 0.0, 7.0, 4.7, turn=1.5), 5.0) is None


def test_cycles_that_are_asked_for_after_the_planner_got_the_map_are_decided_with_it() -> None:
    newest = NewestMap(MUSHR)
    assert not newest.is_unknown_to(5), "no map has arrived"
    newest.take(cells([(0.0, 0.8)]), estimate(0.0, 4.9))
    assert newest.is_unknown_to(6)
    newest.hand_over(6)
    assert newest.is_unknown_to(5)
    assert not newest.is_unknown_to(6)
    newest.take(cells([(0.0, 0.9)]), estimate(0.0, 5.9))
    assert newest.is_unknown_to(6)


@pytest.mark.parametrize("is_blocked", [True, False])
def test_the_vehicle_stops_at_once_and_takes_no_plan_into_the_map_on_board(
    is_blocked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    control, tracker, _guard = control_and_guard()
    events = list[Any]()
    tables = SimpleNamespace(row=lambda name, *values: events.append(values) if name == "events" else None, problem="")
    monkeypatch.setattr(control, "_tables", tables)
    monkeypatch.setattr(control, "_trouble", lambda _: "")
    monkeypatch.setattr(tracker, "estimate", lambda now: estimate(0.0, now))
    on_board = straight(5.0, 0.0, 7.0, 4.7)
    tracker.on_board.mirror(on_board, 5.0)
    grids = [cells([(0.0, 0.8)] if is_blocked else [(0.0, 1.0 + FRONT + 0.06)])]
    monkeypatch.setattr(control, "_tasks", SimpleNamespace(
        take_goal=lambda: None, take_map=lambda: grids.pop() if grids else None, take_goal_problem=lambda: "",
    ))  # fmt: skip
    number = control._requests.ask(5.05)
    control._take_task(5.1)
    assert tracker.on_board.is_stopping == is_blocked
    assert [text for _, text in events] == (["the way leads into the newest map at (0.02, 0.82)"] if is_blocked else [])
    following = straight(6.0, 0.5, 8.0, decided=5.3)  # the estimate is ahead by a delay that the planner has identified
    cycle = SimpleNamespace(number=number, time=6.0, commitment=following)
    control._planned.append(Planned(cycle, None))  # type: ignore[arg-type]
    control._adopt(6.0)
    assert tracker.on_board.commitment is not following
    assert events[-1][1] == "the commitment of cycle {} leads into the newest map at (0.02, {})".format(
        number, "0.82" if is_blocked else "1.26"
    )


def test_the_vehicle_stops_for_a_map_also_while_it_drives_on_after_the_end_of_the_planner(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    control, tracker, _guard = control_and_guard()
    monkeypatch.setattr(control, "_mailbox", SimpleNamespace(closed=True, send=lambda _: None))
    monkeypatch.setattr(tracker, "estimate", lambda now: estimate(0.0, now))
    tracker.on_board.mirror(straight(5.0, 0.0, 7.0, 4.7), 5.0)
    control._end(5.05, "stopped", "the planner's process has ended")
    assert not tracker.on_board.is_stopping
    for place, is_stopping in ((FRONT + 1.5, False), (0.8, True)):
        grid = cells([(0.0, place)])
        monkeypatch.setattr(control, "_tasks", SimpleNamespace(
            take_goal=lambda: None, take_map=lambda grid=grid: grid, take_goal_problem=lambda: "",
        ))  # fmt: skip
        control._take_task(5.1)
        assert tracker.on_board.is_stopping == is_stopping
