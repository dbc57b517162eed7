"""What is said of a start that is no place for the vehicle: what it overlaps, by how much, and where there is room."""

from __future__ import annotations

import dataclasses
import math
import re

import pytest
from support.diagnostics import raised

from kraft.errors import Diagnostic
from kraft.planning import Budget
from kraft.planning.feasibility import check_placement, geodesic_time
from kraft.planning.free_place import fits
from kraft.planning.plan import plan_task
from kraft.planning.workspace import start_state
from kraft.scenario import Task, parse_scenario
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import Footprint

MUSHR = load_vehicle("mushr")
HALF = MUSHR.footprint.length / 2 + MUSHR.footprint.offset
"""Distance of the front from the body frame, m."""


def room(start: str, bounds: str = "{x: [0, 4], y: [0, 4]}", pillar: str = "size: [1, 1]") -> Task:
    text = (
        f"name: room\nbounds: {bounds}\nobstacles:\n  - {{name: pillar, box: {{center: [2, 2], {pillar}}}}}\n"
        f"start: {start}\ngoal: {{center: [3, 3], radius: 0.3}}\n"
    )
    return parse_scenario(text, "room.yaml").task()


def problem_of(task: Task, footprint: Footprint = MUSHR.footprint) -> Diagnostic:
    vehicle = dataclasses.replace(MUSHR, footprint=footprint)
    (problem,) = raised(lambda: check_placement(task, vehicle, start_state(task, vehicle)))
    return problem


@pytest.mark.parametrize("x", [1.35, 1.4, 1.6])
def test_an_overlap_is_as_deep_as_the_shortest_way_out(x: float) -> None:
    problem = problem_of(room(f"{{x: {x}, y: 2, heading_deg: 0}}"))
    found = re.search(r"is in collision with 'pillar', which it overlaps by (\S+) m$", problem.problem)
    assert found is not None
    assert float(found[1]) == pytest.approx(x + HALF - 1.5, rel=0.06), "two digits are printed"


@pytest.mark.parametrize(
    "start", ["{x: 1.4, y: 2, heading_deg: 0}", "{x: 2, y: 2, heading_deg: 30}", "{x: 0.1, y: 0.1, heading_deg: 45}"]
)
def test_a_start_that_is_suggested_can_be_planned_from(start: str) -> None:
    found = re.search(r"such as \((\S+), (\S+)\) with this heading$", problem_of(room(start)).expected)
    assert found is not None
    moved = re.sub("x: .*?, y: .*?,", f"x: {found[1]}, y: {found[2]},", start)
    assert plan_task(room(moved), MUSHR, Budget(iterations=500)).progress.iterations == 500


def test_an_obstacle_that_the_start_touches_is_not_said_to_be_overlapped_by_a_millionth() -> None:
    problem = problem_of(room(f"{{x: {1.5 - HALF + 1e-6:.9f}, y: 2, heading_deg: 0}}")).problem
    assert problem.endswith("is in collision with 'pillar', which it touches")


def test_what_is_beyond_the_bounds_is_said_for_each_side() -> None:
    problem = problem_of(room("{x: 0.1, y: 3.95, heading_deg: 0}"))
    rear, side = MUSHR.footprint.length / 2 - MUSHR.footprint.offset - 0.1, MUSHR.footprint.width / 2 - 0.05
    assert f"is out of bounds: it reaches {rear:.2g} m beyond x = 0 and {side:.2g} m beyond y = 4" in problem.problem


def test_a_vehicle_that_is_larger_than_the_room_is_said_to_be() -> None:
    problem = problem_of(room("{x: 0.5, y: 0.5, heading_deg: 0}"), Footprint(5.0, 4.0))
    assert problem.problem == f"the footprint of {MUSHR.name}, 5 m x 4 m, does not fit into the bounds"
    assert problem.expected == "expected a smaller vehicle or wider bounds"


@pytest.mark.parametrize(
    ("length", "width", "expected"),
    [(4.0, 4.0, True), (4.01, 3.9, False), (4.4, 0.4, True), (5.4, 0.4, False), (0.4, 4.4, True), (1.0, 4.1, True)],
)
def test_a_footprint_fits_if_it_does_at_any_heading(length: float, width: float, expected: bool) -> None:
    task = room("{x: 0.5, y: 0.5, heading_deg: 0}")
    assert fits(task, Footprint(length, width)) == expected


@pytest.mark.parametrize("x", [1.285, 1.2975])
def test_a_start_that_is_too_near_is_told_a_place_that_is_not(x: float) -> None:
    reason = plan_task(room(f"{{x: {x}, y: 2, heading_deg: 0}}"), MUSHR, Budget(iterations=500)).reason
    found = re.match(r"the start is too near to 'pillar': mushr is .* mm away, .* at \((\S+), (\S+)\)", reason)
    assert found is not None
    moved = room(f"{{x: {found[1]}, y: {found[2]}, heading_deg: 0}}")
    assert plan_task(moved, MUSHR, Budget(iterations=500)).progress.iterations == 500


@pytest.mark.parametrize(("x", "y"), [(-0.6, 2.0), (2.0, -0.6), (-2.0, 1.0), (30.0, 1.0), (1.0, 30.0)])
def test_no_way_leads_to_the_goal_from_out_of_the_bounds(x: float, y: float) -> None:
    """As of a vehicle that has driven there, and gets a new goal."""
    task = room("{x: 0.5, y: 0.5, heading_deg: 0}")
    assert geodesic_time(task, MUSHR) < math.inf
    assert geodesic_time(dataclasses.replace(task, start=dataclasses.replace(task.start, x=x, y=y)), MUSHR) == math.inf
