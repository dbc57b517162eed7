"""A vehicle that cannot go back drives a plan from where it was moved only if it leads away from its estimate too."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.replanner import mushr, planner_settings, replanner, start, turns

from kraft.driving.messages import ContingencyOrigin, Estimate
from kraft.driving.planner_settings import CalibratedBound
from kraft.driving.proposal import Proposal
from kraft.driving.replanner import Replanner
from kraft.driving.room import NEARBY, NEARER, ROOM, can_go_back, free_by, place_with_room, refusal
from kraft.driving.solvers import Solvers
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats
from ompl_ext.obstacles import box
from ompl_ext.plan import Plan

AHEAD = 0.5 * mushr().footprint.length + 0.2
"""Distance from the vehicle's centre to that of a box of 0.4 m that touches its front, m."""


def before_a_box(gap: float, model: str = "mushr") -> Replanner:
    """A replanner whose map has a box `gap` m before the start."""
    settings = {"on_board": "contingency", "bound": CalibratedBound()}
    subject = replanner(model=model, **settings)  # type: ignore[arg-type]
    obstacle = box((start()[0], start()[1] + AHEAD + gap), (0.4, 0.4), 0.0)
    subject.set_solvers(Solvers.of(turns(), load_vehicle(model), planner_settings(**settings), (obstacle,)))
    return subject


def straight(begin: Floats, way: float, heading: float) -> Plan:
    """Plan of 2 s that leads `way` m from `begin` in a direction (rad)."""
    times = np.linspace(0.0, 2.0, 21)
    states = np.repeat(begin[None, :], len(times), axis=0)
    states[:, :2] += np.outer(way * times / 2.0, [math.cos(heading), math.sin(heading)])
    return Plan(
        states[[0, -1]], np.zeros((1, 2)), np.array([2.0]), times, states,
        cost=2.0, cost_to_go=0.0, reaches_goal=True, contingency=None,
    )  # fmt: skip


def test_a_vehicle_with_too_little_room_is_moved_to_where_it_has_some() -> None:
    dirt = before_a_box(0.012).dirt
    moved = place_with_room(dirt, start())
    assert free_by(dirt, moved) >= ROOM > free_by(dirt, start())
    assert 0.0 < math.dist(moved[:2], start()[:2]) <= NEARBY + 1e-9


@pytest.mark.parametrize(
    ("way", "heading", "words"),
    [
        (0.2, math.pi / 2, "nearer to an obstacle than the vehicle stands"),  # into the box
        (0.01, -math.pi / 2, "does not lead away"),
        (0.2, -math.pi / 2, None),  # backwards
        (0.2, 0.0, None),  # along the box
    ],
)
def test_a_plan_from_there_leads_away_from_the_estimated_place(way: float, heading: float, words: str | None) -> None:
    dirt = before_a_box(0.012).dirt
    moved = place_with_room(dirt, start())
    plan = straight(moved, way, heading)
    refused = refusal(dirt, start(), moved, plan, plan.trajectory[:3])
    assert words in refused if words and refused else refused is words


@pytest.mark.parametrize(("model", "goes_back"), [("mushr", False), ("mushr-force", True)])
def test_a_vehicle_that_can_go_back_drives_any_plan(model: str, goes_back: bool) -> None:
    dirt = before_a_box(0.012, model).dirt
    moved = place_with_room(dirt, start())
    plan = straight(moved, 0.2, math.pi / 2)
    assert can_go_back(dirt, start()) is goes_back
    assert (refusal(dirt, start(), moved, plan, plan.trajectory[:3]) is None) is goes_back


def test_the_predicted_motion_counts_as_the_plan_does() -> None:
    dirt = before_a_box(0.012).dirt
    moved = place_with_room(dirt, start())
    plan, nearer = straight(moved, 0.2, -math.pi / 2), moved + np.array([0.0, 2.0 * NEARER, 0.0, 0.0])
    assert refusal(dirt, start(), moved, plan, moved[None, :]) is None
    assert "nearer to an obstacle" in str(refusal(dirt, start(), moved, plan, nearer[None, :]))


def test_a_cornered_vehicle_that_cannot_reverse_stands() -> None:
    """Its plans lead nearer to the box, by less than it was moved back: in each cycle it would creep on."""
    subject = before_a_box(0.012)
    begin = subject.begin(start())
    moved = place_with_room(subject.dirt, start())
    subject.proposal = Proposal(straight(moved, 0.015, math.pi / 2))
    cycle = subject.decide(Estimate(0.0, start(), 0.0), begin)
    assert cycle.contingency_origin is ContingencyOrigin.STANDING
    assert "nearer to an obstacle than the vehicle stands" in cycle.reason
