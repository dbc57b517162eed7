"""Contingencies and plans as references: what is tracked, and the emergency when nothing is safe."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.replanner import FARSIGHTED, MARGIN, mushr, replanner, start

from kraft.driving.car_model import CarModel, model_of
from kraft.driving.contingencies import emergency_reference
from kraft.driving.control import make_controller
from kraft.driving.control_settings import Kinodynamic
from kraft.driving.messages import Commitment, Estimate, Reference, ReferenceKind
from kraft.driving.on_board import OnBoard
from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.references import holding_control, manoeuvre_reference, plan_reference
from kraft.driving.replanner import Replanner
from kraft.driving.vehicle_model import stop_control, stop_controls
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats
from ompl_ext.obstacles import Workspace
from ompl_ext.plan import Plan
from ompl_ext.query import Goal, Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle


def along(subject: Replanner, state: Floats, number: int) -> tuple[float, float]:
    """Smallest distance (m) of a manoeuvre to an obstacle, and its speed (m/s) where it hits one."""
    dirt, distance = subject.dirt, math.inf
    for _ in range(round(dirt.safety.horizon / 0.1)):
        samples, _ = dirt.edge(state, stop_control(dirt.vehicle, state, number), 0.1)
        distance = min(distance, float(dirt.exact.distances(samples[:, :3]).min()))
        if distance <= 0.0:
            return 0.0, abs(float(state[3]))
        state = samples[-1]
        if abs(state[3]) <= dirt.safety.rest_speed:
            break
    return distance, 0.0


@pytest.mark.slow
def test_an_emergency_takes_the_manoeuvre_that_keeps_the_most_distance_or_hits_slowest() -> None:
    subject = replanner(model="mushr-lag")  # which coasts for 0.6 m
    subject.begin(start())
    dirt, rng, found, hits = subject.dirt, np.random.default_rng(0), 0, 0
    while found < 20:
        state = np.array(
            [rng.uniform(0.3, 1.9), rng.uniform(-0.5, 4.5), rng.uniform(-3.1, 3.1), rng.uniform(0.4, 0.65)]
        )
        if dirt.exact.distance(*state[:3]) <= 0.01 or dirt.contingency(state) is not None:
            continue
        found += 1
        reference = emergency_reference(dirt, state, 3.0)
        assert (reference.kind, reference.start) == (ReferenceKind.CONTINGENCY, 3.0)
        assert abs(reference.states[-1][3]) <= 0.01
        each = [along(subject, state, number) for number in range(len(dirt.vehicle.manoeuvres))]
        best = max(each, key=lambda pair: (pair[0], -pair[1]))
        ours = [along(subject, state, number) for number in range(len(each))
                if np.array_equal(reference.controls[0], stop_control(dirt.vehicle, state, number))]  # fmt: skip
        assert ours == [best]
        hits += best[0] == 0.0
    assert 0 < hits < found  # some can still be avoided, some cannot


def test_a_contingency_that_is_over_asks_for_nothing() -> None:
    """Brakes that went on would push a car that stands."""
    subject = replanner(model="mushr-drive", safety=FARSIGHTED)
    cycle = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    assert cycle.contingency is not None
    assert cycle.contingency.controls[0][0] < 0.0  # it brakes
    np.testing.assert_array_equal(cycle.contingency.rest, np.zeros(2))
    np.testing.assert_array_equal(emergency_reference(subject.dirt, start(), 0.0).rest, np.zeros(2))


def test_a_reference_interpolates_states_and_holds_controls() -> None:
    reference = Reference(
        ReferenceKind.PLAN,
        np.array([1.0, 2.0, 4.0]),
        np.array([[0.0], [1.0], [5.0]]),
        np.array([[0.1], [0.2]]),
        np.zeros(1),
    )
    assert [float(reference.state_at(t)[0]) for t in (0.0, 1.0, 1.5, 3.0, 4.0, 9.0)] == [0.0, 0.0, 0.5, 3.0, 5.0, 5.0]
    assert [float(reference.control_at(t)[0]) for t in (0.0, 1.0, 2.0, 3.9, 4.0)] == [0.1, 0.1, 0.2, 0.2, 0.0]


def test_a_plan_becomes_a_reference_with_the_control_of_each_step() -> None:
    subject = replanner()
    subject.begin(start())
    plan = subject.dirt.plan()
    assert plan is not None
    reference = plan_reference(subject.dirt.vehicle, plan, 2.0)
    ends = np.cumsum(plan.durations)
    for k, end in enumerate(ends):
        np.testing.assert_array_equal(reference.control_at(2.0 + end - 1e-6), plan.controls[k])
    np.testing.assert_array_equal(reference.control_at(2.0 + plan.cost + 1e-6), np.zeros(2))


def test_a_plan_that_ends_in_its_cycle_is_followed_by_its_contingency_and_a_longer_one_is_not() -> None:
    subject = replanner(safety=MARGIN)
    subject.begin(np.array([1.0, 4.5, math.pi / 2, 0.3]))
    plan = subject.proposal.plan
    assert plan is not None
    assert plan.contingency is not None
    assert plan.reaches_goal
    assert plan.cost < 1.0
    vehicle = subject.dirt.vehicle
    stops, ends = plan_reference(vehicle, plan, 2.0, 1.0), plan_reference(vehicle, plan, 2.0, plan.cost)
    assert ends.end == pytest.approx(2.0 + plan.cost)
    assert stops.end == pytest.approx(2.0 + plan.contingency.times[-1])
    assert (np.diff(stops.times) > 0.0).all()
    assert stops.kind is ReferenceKind.PLAN
    assert abs(ends.states[-1][3]) > 0.1 > abs(stops.states[-1][3])
    stop = vehicle.manoeuvres.index(plan.contingency.manoeuvre)
    expected = stop_control(vehicle, plan.contingency.states[0], stop)
    np.testing.assert_array_equal(stops.control_at(2.0 + plan.cost + 1e-3), expected)
    for time in (2.0, 2.0 + 0.5 * plan.cost):
        np.testing.assert_array_equal(stops.state_at(time), ends.state_at(time))


def test_the_controls_of_a_manoeuvre_are_those_of_its_stop_function_within_their_bounds() -> None:
    states = np.random.default_rng(0).uniform(-2.0, 2.0, (20, 4))
    for vehicle in (mushr(), load_vehicle("mushr-drive")):
        assert vehicle.stop is not None
        low, high = vehicle.control_bounds.T
        values = vehicle.parameter_array
        for number in range(len(vehicle.manoeuvres)):
            wanted = [vehicle.stop(tuple(state), tuple(values), number) for state in states]
            np.testing.assert_array_equal(stop_controls(vehicle, states, number), np.clip(wanted, low, high))


def test_a_vehicle_without_a_stop_function_stops_with_zero_control() -> None:
    coasting = replace(mushr(), stop=None, manoeuvres=("coast",))
    np.testing.assert_array_equal(stop_control(coasting, start(), 0), np.zeros(2))
    np.testing.assert_array_equal(stop_control(mushr(), start(), 3), [0.0, 0.38])


@pytest.mark.parametrize("heading", [0.0, 1.2, -2.0, math.pi])
def test_on_a_slope_the_throttle_holds_a_car_that_stands(heading: float) -> None:
    """0.4 m/s^2 along x, as on a slope of 2.3 degrees: without throttle the car moves down it."""
    vehicle = load_vehicle("mushr-force").with_parameters({"a_x": 0.4})
    state, model = np.array([0.5, -0.3, heading, 0.0]), CarModel(vehicle)
    control = holding_control(vehicle, state)
    assert control[0] * math.cos(heading) < 0.0
    assert control[1] == 0.0
    assert model.advance(state, control, 5.0) == pytest.approx(state, abs=1e-6)
    moved = model.advance(state, np.zeros(2), 5.0) - state
    assert moved[0] > 0.05 * math.cos(heading) ** 2


def test_on_a_steep_slope_the_throttle_holds_as_well_as_its_limit_allows() -> None:
    vehicle = load_vehicle("mushr-force").with_parameters({"a_x": 0.8})
    assert holding_control(vehicle, np.zeros(4)).tolist() == [-0.5, 0.0]


def test_the_holding_throttle_is_that_of_standstill_whatever_the_speed() -> None:
    """Brakes that stay on would push a car that stands."""
    vehicle = load_vehicle("mushr-force").with_parameters({"a_x": 0.2})
    standing, rolling = np.array([0.0, 0.0, 0.4, 0.0]), np.array([0.0, 0.0, 0.4, 0.3])
    assert np.array_equal(holding_control(vehicle, rolling), holding_control(vehicle, standing))
    assert stop_control(vehicle, rolling, 0)[0] < holding_control(vehicle, rolling)[0]


@pytest.mark.parametrize("name", ["mushr", "mushr-lag", "mushr-drive", "mushr-force"])
def test_on_level_ground_a_car_that_stands_is_held_by_no_throttle(name: str) -> None:
    control = holding_control(load_vehicle(name), np.array([0.0, 0.0, 0.4, 0.3]))
    assert control.tolist() == [0.0, 0.0]
    assert not np.signbit(control).any()


def test_on_a_slope_the_reference_of_a_standing_car_holds_it() -> None:
    vehicle = load_vehicle("mushr-force").with_parameters({"a_x": -0.4})
    plan = Plan(
        states=start()[None, :], controls=np.zeros((0, 2)), durations=np.zeros(0), times=np.zeros(1),
        trajectory=start()[None, :], cost=0.0, cost_to_go=0.0, reaches_goal=True, contingency=None,
    )  # fmt: skip
    reference = plan_reference(vehicle, plan, 2.0)
    assert reference.control_at(9.0) == pytest.approx(holding_control(vehicle, start()))


@pytest.mark.parametrize("steering", [0.25, -0.1])
def test_a_stop_before_the_contingency_begins_keeps_the_wheels_as_the_plan_has_them(steering: float) -> None:
    """The contingency on board steers to the other side: that is verified only from the end of the cycle on."""
    model = model_of(mushr())
    vehicle, hard = model.vehicle, model.vehicle.manoeuvres.index("hard-right" if steering > 0.0 else "hard-left")
    times, state = np.arange(0.0, 1.01, 0.1), start() + np.array([0.0, 0.0, 0.0, 0.5])
    plan = Reference(ReferenceKind.PLAN, times, np.tile(state, (11, 1)), np.tile([0.5, steering], (10, 1)), np.zeros(2))
    contingency = manoeuvre_reference(vehicle, hard, np.array([1.0, 1.1]), np.tile(state, (2, 1)))
    settings = PlannerSettings(
        mode="replanning", cycle=1.0, on_board="contingency", contingencies="tracked", safety=MARGIN
    )
    board = OnBoard(settings, Safety(cycle=1.0), model, Commitment(plan))
    board.receive(Commitment(plan, 1.0, contingency), Estimate(0.0, state, 0.0))
    board.stop(Estimate(0.4, state, 0.0))
    stop = board.commitment.reference
    assert (stop.kind, stop.start, board.stops) == (ReferenceKind.CONTINGENCY, 0.4, 1)
    assert stop.controls[:, 1] == pytest.approx(steering)
    assert np.abs(stop.controls[:, 0] - [stop_control(vehicle, each, 0)[0] for each in stop.states[:-1]]).max() == 0.0
    assert abs(stop.states[-1][3]) <= Safety().rest_speed
    assert np.sign(stop.states[-1][2] - state[2]) == np.sign(steering)


def test_a_stop_uses_the_parameters_that_were_identified() -> None:
    """On a floor that pushes the car back, zero throttle would let it roll on after the stop."""
    model = model_of(load_vehicle("mushr-force"))
    parameters = model.parameters.copy()
    parameters[list(model.vehicle.parameters).index("a_x")] = -0.3
    state = np.zeros(len(model.vehicle.state))
    state[model.v] = 0.4
    plan = Reference(ReferenceKind.PLAN, np.array([0.0, 1.0]), np.tile(state, (2, 1)), np.zeros((1, 2)), np.zeros(2))
    settings = PlannerSettings(
        mode="replanning", cycle=1.0, on_board="contingency", contingencies="tracked", safety=MARGIN
    )
    board = OnBoard(settings, Safety(cycle=1.0), model, Commitment(plan))
    law = make_controller(Kinodynamic(kind="kinodynamic"), model, None, 0)  # made before anything is identified
    model.set_parameters(parameters)
    board.stop(Estimate(0.0, state, 0.0))
    stop = board.commitment.reference
    assert stop.end < 2.0
    for _ in range(60):
        time = stop.end + 0.05
        state = model.advance(state, law.command(Estimate(time, state, 0.0), stop), 0.05)
    assert abs(state[model.v]) < 0.01
    assert stop.rest[0] > 0.25
    assert model.present_vehicle.parameters["a_x"] == -0.3


def narrower(vehicle: Vehicle) -> Vehicle:
    """The vehicle whose commands reach a third as far to either side, so that no manoeuvre is driven as it is stated."""
    controls = {name: (0.3 * low, 0.3 * high) for name, (low, high) in vehicle.controls.items()}
    return replace(vehicle, controls=controls)


@pytest.mark.parametrize("name", ["mushr-drive", "mushr-force", "differential", "jackal", "f1tenth"])
@pytest.mark.parametrize("bounds", ["its own", "narrower"])
def test_manoeuvres_are_checked_with_the_controls_that_the_vehicle_can_be_given(name: str, bounds: str) -> None:
    """SAFETY's states are those of the vehicle's own model under commands that are clamped as any command is."""
    vehicle = load_vehicle(name)
    vehicle = narrower(vehicle) if bounds == "narrower" else vehicle
    dirt = DirtSolver(vehicle, Workspace(((0.0, 20.0), (0.0, 20.0))), Goal((18.0, 18.0), 0.5), Safety(horizon=8.0))
    model, state = model_of(vehicle), np.zeros(len(vehicle.state))
    state[:2], state[model.v] = 10.0, 0.9 * vehicle.top_speed
    for number, states in enumerate(dirt.manoeuvres(state)):
        at = state
        for found in states[1:]:
            control = stop_control(vehicle, at, number)
            assert np.array_equal(control, model.clamped(control))
            at = model.advance(at, control, dirt.safety.step)
            assert found == pytest.approx(at, abs=0.01)
