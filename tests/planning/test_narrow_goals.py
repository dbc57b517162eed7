"""Goals that take many short moves: parking in gaps hardly longer than the vehicle, turning round in small rooms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from kraft.vehicles.load import load_vehicle
from kraft.vehicles.mushr import MUSHR
from ompl_ext.exact import ExactClearance
from ompl_ext.obstacles import Workspace, box
from ompl_ext.query import Goal, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle
from ompl_ext.verification import verify

REVERSING = replace(MUSHR, controls={"throttle": (-1.0, 1.0), "steering": MUSHR.controls["steering"]})


def solver_of(
    vehicle: Vehicle, solids: list[tuple[float, float, float, float]], goal: Goal, size: float, width: float = 1.4
) -> DirtSolver:
    """Solver in a street of size by `width` m, or in a room, with boxes (x, y, length, width)."""
    bounds = ((0.0, size), (0.0, width if solids else size))
    return DirtSolver(vehicle, Workspace(bounds, tuple(box(s[:2], s[2:]) for s in solids)), goal)


def parking(lengths: float, vehicle: Vehicle = REVERSING, left: bool = False, scale: float = 1.0) -> DirtSolver:
    """Parallel parking between two cars, at rest within 5 cm and 5 degrees, all lengths multiplied by `scale`."""
    body, x = vehicle.footprint, 1.6 * scale
    y = body.width / 2 + 0.06 * scale
    y = 1.4 * scale - y if left else y
    apart = (lengths + 1) * body.length / 2
    cars = [(x + side * apart, y, body.length, body.width) for side in (-1, 1)]
    at_rest = dict.fromkeys(vehicle.rest, (-0.05, 0.05))
    goal = Goal((x - body.offset, y), 0.05 * scale, 0.0, math.radians(5), at_rest)
    return solver_of(vehicle, cars, goal, 3.2 * scale, 1.4 * scale)


def start_of(vehicle: Vehicle, x: float, y: float, theta: float) -> np.ndarray:
    state = np.zeros(len(vehicle.state))
    state[[vehicle.index(name) for name in ("x", "y", "theta")]] = x, y, theta
    return state


def check(dirt: DirtSolver, start: np.ndarray, seed: int, iterations: int = 1) -> None:
    """Plan, and check the plan with FCL and independently of the search's fields."""
    dirt.start(start, seed)
    dirt.grow(iterations=iterations)
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    assert dirt.goal is not None
    assert dirt.goal.contains(dirt.vehicle, plan.trajectory[-1])
    assert not verify(dirt, plan).problems
    exact = ExactClearance(dirt.workspace, dirt.vehicle.footprint)
    columns = [dirt.vehicle.index(name) for name in ("x", "y", "theta")]
    assert min(exact.distance(*pose) for pose in plan.trajectory[:, columns]) > 0.0


@pytest.fixture(scope="module")
def narrow() -> DirtSolver:
    return parking(1.3)


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_a_gap_of_1_3_lengths_is_entered_with_any_seed(narrow: DirtSolver, seed: int) -> None:
    check(narrow, start_of(REVERSING, 0.6, 0.7, 0.0), seed)


@pytest.mark.parametrize(("x", "y", "theta"), [(2.3, 0.6, -0.1), (2.6, 0.75, math.pi), (0.9, 0.6, 0.2)])
def test_a_narrow_gap_is_entered_from_several_starts(narrow: DirtSolver, x: float, y: float, theta: float) -> None:
    check(narrow, start_of(REVERSING, x, y, theta), seed=0)


@pytest.mark.parametrize("lengths", [1.3, 1.6])
def test_a_gap_on_the_other_side_is_entered(lengths: float) -> None:
    check(parking(lengths, left=True), start_of(REVERSING, 0.6, 0.7, 0.0), seed=0)


def test_a_car_with_a_drive_train_parks_too() -> None:
    vehicle = load_vehicle("mushr-drive")
    check(parking(1.3, vehicle), start_of(vehicle, 0.6, 0.7, 0.0), seed=0)


@pytest.mark.parametrize("turned", [0.0, 101.0])
def test_where_the_shortest_paths_cannot_be_followed_clear_ones_are(turned: float) -> None:
    """The gap is left of a street whose kerbs are obstacles, and turned; all of the shortest paths touch a corner."""
    vehicle, angle, place = load_vehicle("mushr-drive"), math.radians(turned), np.array([1.3, -7.1])
    length, width, turn = (
        0.44,
        0.28,
        np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]),
    )
    cars = [((side * 1.15 * length, -width / 2), (length, width)) for side in (-1, 1)]
    kerbs = [((0.0, y), (7.3 * length, 0.1)) for y in (0.05, -width - 2.25 * length - 0.05)]
    solids = tuple(box(tuple(place + turn @ center), size, angle) for center, size in cars + kerbs)
    x, y = place + turn @ (-vehicle.footprint.offset, -width / 2 - 0.05 * length)
    goal = Goal((float(x), float(y)), 0.05, angle, math.radians(5), {"v": (-0.05, 0.05)})
    bounds = tuple((float(each) - 6 * length, float(each) + 6 * length) for each in place)
    begin = place + turn @ (-2.2 * length, -width - 1.125 * length)
    check(DirtSolver(vehicle, Workspace(bounds, solids), goal), start_of(vehicle, *begin, angle), seed=0)


@pytest.mark.parametrize("heading", [math.pi / 2, -math.pi / 2])
def test_a_bay_across_the_street_is_entered_ahead_and_astern(heading: float) -> None:
    goal = Goal((1.6, 0.3), 0.05, heading, math.radians(5), {"v": (-0.05, 0.05)})
    cars = [(1.6 + side * 0.35, 0.26, 0.28, 0.4) for side in (-1, 1)]
    check(solver_of(REVERSING, cars, goal, 3.2), start_of(REVERSING, 0.6, 0.9, 0.0), seed=0)


@pytest.mark.parametrize(("name", "lengths"), [("f1tenth", 1.3), ("jackal", 1.3), ("unicycle2", 2.0)])
def test_vehicles_that_leave_a_path_at_speed_park_in_moves(name: str, lengths: float) -> None:
    """Wheels that turn at a limited rate, sides with a lag, and controls that are accelerations."""
    vehicle = load_vehicle(name)
    scale = vehicle.footprint.length / REVERSING.footprint.length
    check(parking(lengths, vehicle, scale=scale), start_of(vehicle, 0.6 * scale, 0.7 * scale, 0.0), seed=0)


@pytest.mark.parametrize(("name", "size"), [("mushr", 1.5), ("mushr", 2.5), ("jackal", 2.0)])
def test_a_vehicle_turns_round_in_a_room(name: str, size: float) -> None:
    vehicle = REVERSING if name == "mushr" else load_vehicle(name)
    limits = dict.fromkeys(vehicle.rest, (-0.05, 0.05))
    goal = Goal((size / 2, size / 2), 0.05, math.pi, math.radians(5), limits)
    check(solver_of(vehicle, [], goal, size), start_of(vehicle, size / 2, size / 2, 0.0), seed=0)


def test_a_closed_gap_is_not_entered() -> None:
    dirt = parking(1.02)
    dirt.start(start_of(REVERSING, 0.6, 0.7, 0.0), 0)
    dirt.grow(iterations=200)
    plan = dirt.plan()
    assert plan is None or not plan.reaches_goal


def test_a_query_without_free_durations_does_not_follow_a_path() -> None:
    goal = Goal((1.5, 1.5), 0.05, math.pi, math.radians(5))
    dirt = DirtSolver(REVERSING, Workspace(((0.0, 3.0), (0.0, 3.0))), goal, settings=Settings(quantum=0.1))
    dirt.start(start_of(REVERSING, 1.5, 1.5, 0.0), 0)
    dirt.grow(iterations=1)
    assert dirt.progress.nodes < 10
