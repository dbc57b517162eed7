"""Controllers: they track what they should, stop when they should, and are defined everywhere."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.driving import (
    START,
    Truth,
    car,
    drive,
    off_path,
    plan_of_turns,
    reversing_car,
    slow_car,
    track,
)

from kraft.driving.car_model import CarModel
from kraft.driving.control import Controller, make_controller
from kraft.driving.control_settings import Geometric, Kinodynamic, OpenLoop
from kraft.driving.messages import Estimate, Reference, ReferenceKind, Stop
from kraft.driving.vehicle_model import stop_control
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats

Settings = OpenLoop | Geometric | Kinodynamic
OPEN, PATH, TRACK = OpenLoop(kind="open_loop"), Geometric(kind="geometric"), Kinodynamic(kind="kinodynamic")
ALL = pytest.mark.parametrize("choice", [OPEN, PATH, TRACK], ids=lambda choice: choice.kind)
CLOSED = pytest.mark.parametrize("choice", [PATH, TRACK], ids=lambda choice: choice.kind)

STRAIGHT = [(0.8, 0.0, 4.0)]
AT_REST = np.array([0.0, 0.0, 0.0, 0.0])
MOVING = np.array([0.0, 0.0, 0.0, 0.5])


def command(
    choice: Settings, state: Floats, reference: Reference, time: float, model: CarModel | None = None
) -> Floats:
    """First command of a new controller."""
    return make_controller(choice, model or car()).command(Estimate(time, np.array(state), 0.0), reference)


def at(time: float, reference: Reference, forward: float = 0.0, left: float = 0.0, turn: float = 0.0) -> Floats:
    """State of the reference at a time, moved in the frame of the car."""
    state = reference.state_at(time)
    c, s = math.cos(state[2]), math.sin(state[2])
    state[:2] += c * forward - s * left, s * forward + c * left
    state[2] += turn
    return state


# Open loop


def test_open_loop_sends_what_is_planned_for_the_time_and_rests_after_it() -> None:
    reference = drive(car(), MOVING, [(0.8, 0.1, 1.0), (0.3, -0.2, 1.0)], begin=5.0)
    sent = [command(OPEN, AT_REST, reference, t).tolist() for t in (4.0, 5.0, 5.95, 6.05, 7.0, 99.0)]
    assert sent == [[0.8, 0.1], [0.8, 0.1], [0.8, 0.1], [0.3, -0.2], [0.0, 0.0], [0.0, 0.0]]


def test_open_loop_clamps_a_plan_that_asks_too_much() -> None:
    reference = Reference(
        ReferenceKind.PLAN, np.arange(2.0), np.zeros((2, 4)), np.array([[3.0, -2.0]]), np.array([-1.0, 0.9])
    )
    assert command(OPEN, AT_REST, reference, 0.5).tolist() == [1.0, -0.38]
    assert command(OPEN, AT_REST, reference, 1.5).tolist() == [0.0, 0.38]


# Tracking on the model itself


def test_kinodynamic_tracks_a_plan_on_its_own_model_to_three_centimetres() -> None:
    reference = plan_of_turns()
    states, _ = track(make_controller(TRACK, car()), Truth(car(), START), reference, reference.end, stop_at_end=True)
    assert off_path(states, reference).max() < 0.03
    assert np.hypot(*(states[-1, :2] - reference.states[-1, :2])) < 0.06


def test_kinodynamic_keeps_the_plans_time() -> None:
    reference = plan_of_turns()
    states, _ = track(make_controller(TRACK, car()), Truth(car(), START), reference, reference.end - 0.2)
    planned = [reference.state_at((k + 1) / 30)[:2] for k in range(len(states))]
    assert np.hypot(*(states[:, :2] - planned).T).max() < 0.05


def test_without_look_ahead_a_prompt_car_is_tracked_to_two_centimetres() -> None:
    reference, choice = plan_of_turns(), Kinodynamic(kind="kinodynamic", look=0.0)
    states, _ = track(make_controller(choice, car()), Truth(car(), START), reference, reference.end, stop_at_end=True)
    assert off_path(states, reference).max() < 0.02


def test_open_loop_strays_where_kinodynamic_does_not() -> None:
    reference = plan_of_turns()
    blind, seeing = (
        track(make_controller(choice, car()), Truth(car(), START, 0.3, 3.2), reference, reference.end, stop_at_end=True)
        for choice in (OPEN, TRACK)
    )
    assert off_path(blind[0], reference).max() > 0.15
    assert off_path(seeing[0], reference).max() < 0.03


@pytest.mark.parametrize(("lag", "delay"), [(0.3, 0), (1.0, 0), (0.3, 3)])
def test_kinodynamic_stays_stable_behind_a_lag_a_servo_and_a_delay(lag: float, delay: int) -> None:
    reference = plan_of_turns()
    truth = Truth(car(), START, lag=lag, servo=3.2, delay=delay)
    states, _ = track(make_controller(TRACK, car()), truth, reference, reference.end + 5.0, stop_at_end=True)
    assert off_path(states, reference).max() < 0.05
    assert len(states) / 30 < reference.end + 2.5  # it arrived


def test_geometric_follows_the_path_and_cuts_its_corners_by_less_than_its_lookahead() -> None:
    reference = plan_of_turns()
    states, _ = track(make_controller(PATH, car()), Truth(car(), START), reference, 12.0, stop_at_end=True)
    assert off_path(states, reference).max() < 0.2
    assert np.hypot(*(states[-1, :2] - reference.states[-1, :2])) < 0.15


@CLOSED
@pytest.mark.parametrize("left", [-0.2, 0.2])
def test_a_car_beside_a_straight_path_comes_back_to_it(choice: Settings, left: float) -> None:
    reference = drive(car(), MOVING, [(0.8, 0.0, 12.0)])
    start = np.array([0.0, left, 0.3, 0.5])
    states, _ = track(make_controller(choice, car()), Truth(car(), start, lag=0.3, servo=3.2), reference, 11.0)
    assert abs(states[-60:, 1]).max() < 0.03


@CLOSED
def test_the_unit_of_the_commands_makes_no_difference(choice: Settings) -> None:
    """Steering in degrees and a throttle of at most 0.1, as a car has them whose logs are in these units."""
    sent = []
    for throttle, steering in ((1.0, 0.4), (0.1, 23.0)):
        values = {"full_throttle": throttle, "full_steering": steering, "steer": 0.4, "L": 0.33, "a_drive": 2.0}
        limits = {"throttle": (-throttle, throttle), "steering": (-steering, steering)}
        model = CarModel(replace(load_vehicle("car", parameters=values), controls=limits))
        reference = drive(model, MOVING, [(0.5 * throttle, 0.1 * steering, 4.0)])
        controller = make_controller(choice, model)
        states = [at(time, reference, forward=-0.05, left=0.03, turn=0.1) for time in (1.0, 1.1, 1.2)]
        commands = [controller.command(Estimate(1.0 + 0.1 * k, x, 0.0), reference) for k, x in enumerate(states)]
        sent.append(np.array(commands) / [throttle, steering])
    np.testing.assert_allclose(sent[0], sent[1], atol=1e-9)
    assert (np.abs(sent[0] - [0.5, 0.1]) > 0.01).all(), "it corrects both"


# Directions of the corrections


@CLOSED
@pytest.mark.parametrize("speed", [0.0, 0.3, 0.6])
def test_left_of_the_path_the_car_steers_right_at_any_speed(choice: Settings, speed: float) -> None:
    reference = drive(car(), MOVING, STRAIGHT)
    for left in (-0.05, 0.05):
        state = at(1.0, reference, left=left)
        state[3] = speed
        assert math.copysign(1.0, command(choice, state, reference, 1.0)[1]) == -math.copysign(1.0, left)


@CLOSED
def test_a_car_that_heads_left_of_the_path_steers_right(choice: Settings) -> None:
    reference = drive(car(), MOVING, STRAIGHT)
    assert command(choice, at(1.0, reference, turn=0.1), reference, 1.0)[1] < 0.0
    assert command(choice, at(1.0, reference, turn=-0.1), reference, 1.0)[1] > 0.0


@pytest.mark.parametrize("turns", [-2, 1, 5])
@CLOSED
def test_whole_turns_of_the_heading_change_nothing(choice: Settings, turns: int) -> None:
    reference = drive(car(), MOVING, [(0.8, 0.1, 4.0)])
    state = at(1.0, reference, left=0.05)
    turned = state + np.array([0.0, 0.0, math.tau * turns, 0.0])
    assert command(choice, turned, reference, 1.0) == pytest.approx(command(choice, state, reference, 1.0), abs=1e-9)


def test_on_the_path_kinodynamic_sends_the_plan() -> None:
    reference = drive(car(), np.array([0.0, 0.0, 0.0, 0.3114]), [(0.5, 0.2, 4.0)])
    assert command(TRACK, at(2.0, reference), reference, 2.0) == pytest.approx([0.5, 0.2], abs=0.02)


def test_kinodynamic_gives_more_throttle_behind_the_plan_and_less_ahead_of_it() -> None:
    reference = drive(car(), MOVING, [(0.6, 0.0, 4.0)])
    throttles = [command(TRACK, at(2.0, reference, forward=d), reference, 2.0)[0] for d in (-0.3, 0.0, 0.3)]
    assert throttles == pytest.approx([0.9, 0.6, 0.3], abs=0.02)


def test_geometric_gives_more_throttle_the_farther_its_waypoint_is() -> None:
    reference = drive(car(), MOVING, [(0.5, 0.0, 4.0)])
    near, far = (command(PATH, at(1.0, reference, left=left), reference, 1.0)[0] for left in (0.0, 0.4))
    assert near == pytest.approx(0.5, abs=0.03)
    assert far > 1.15 * near


# Ends


@CLOSED
def test_a_car_that_stands_at_the_start_of_a_plan_sets_off(choice: Settings) -> None:
    reference = drive(car(), AT_REST, STRAIGHT)
    assert command(choice, AT_REST, reference, 0.0)[0] > 0.5


@CLOSED
def test_a_plan_that_is_late_is_driven_to_its_end_and_no_farther(choice: Settings) -> None:
    reference = drive(car(), AT_REST, [(0.8, 0.1, 4.0)])
    states, commands = track(make_controller(choice, car()), Truth(car(), AT_REST, scale=0.6), reference, 12.0)
    assert np.hypot(*(states[-1, :2] - reference.states[-1, :2])) < 0.1
    assert states[:, 0].max() < reference.states[-1, 0] + 0.01
    assert abs(commands[-1][0]) < 0.05  # what is missing of the path, times the gain: it nears zero, as the car the end
    assert states[-1, 3] < 0.02


@CLOSED
@pytest.mark.parametrize("forward", [0.0, 0.2, 3.0])
def test_at_and_past_the_end_of_the_path_the_car_rests(choice: Settings, forward: float) -> None:
    reference = drive(car(), AT_REST, STRAIGHT)
    assert command(choice, at(4.0, reference, forward=forward), reference, 4.0).tolist() == [0.0, 0.0]
    assert command(choice, at(4.0, reference, forward=forward), reference, 9.0).tolist() == [0.0, 0.0]


def test_the_planned_rest_control_is_what_is_held_at_the_end() -> None:
    moving = drive(car(), AT_REST, STRAIGHT)
    reference = Reference(
        ReferenceKind.CONTINGENCY, moving.times, moving.states, moving.controls, np.array([0.0, 0.19])
    )
    for choice in (OPEN, PATH, TRACK):
        assert command(choice, at(4.0, reference), reference, 4.5).tolist() == [0.0, 0.19]


@ALL
def test_a_reference_of_one_state_is_a_place_to_rest(choice: Settings) -> None:
    one = Reference(ReferenceKind.CONTINGENCY, np.array([2.0]), MOVING[None, :], np.zeros((0, 2)), np.zeros(2))
    for time in (1.0, 2.0, 3.0):
        assert command(choice, MOVING, one, time).tolist() == [0.0, 0.0]


# Contingencies


@CLOSED
def test_a_contingency_is_never_given_more_throttle_than_it_plans(choice: Settings) -> None:
    stop = drive(slow_car(), np.array([0.0, 0.0, 0.0, 0.6]), [(0.0, 0.19, 3.0)], kind=ReferenceKind.CONTINGENCY)
    for time in (0.0, 0.5, 2.0, 2.99):
        for forward in (-0.4, -0.05, 0.0, 0.1):
            state = at(time, stop, forward=forward)
            assert command(choice, state, stop, time, slow_car())[0] == 0.0


@CLOSED
def test_a_stop_that_is_over_drives_no_car_on(choice: Settings) -> None:
    creeping = drive(car(), MOVING, [(0.3, 0.0, 2.0)], kind=ReferenceKind.CONTINGENCY)
    for forward in (-1.0, -0.3, 0.0, 0.3):
        assert command(choice, at(1.0, creeping, forward=forward), creeping, 2.5)[0] == 0.0


@ALL
def test_a_car_that_rolls_farther_than_its_model_comes_to_rest(choice: Settings) -> None:
    stop = drive(car(), np.array([0.0, 0.0, 0.0, 0.6]), [(0.0, 0.38, 1.0)], kind=ReferenceKind.CONTINGENCY)
    truth = Truth(slow_car(), stop.states[0])
    states, commands = track(make_controller(choice, car()), truth, stop, 8.0)
    assert states[-1, 3] < 0.01
    assert commands[:, 0].max() == 0.0


@functools.cache
def braking_car() -> CarModel:
    return CarModel(load_vehicle("f1tenth"))


def braked(speed: float, excess: float = 0.0) -> tuple[float, float]:
    """How far the model brakes from a speed (m), and how far the car does that is faster by `excess` (m/s)."""
    model = braking_car()
    states, controls = [np.array([0.0, 0.0, 0.0, speed, -0.2])], []
    while states[-1][model.v] > 0.01:
        controls.append(stop_control(model.vehicle, states[-1], 0))
        states.append(model.advance(states[-1], controls[-1], 0.1))
    rest = np.zeros(2)
    times = 3.0 + 0.1 * np.arange(len(states), dtype=float)
    kind, path = ReferenceKind.CONTINGENCY, np.array(states)
    reference = Reference(kind, times, path, np.array(controls), rest, Stop(0, times[0]))
    faster = states[0] + np.array([0.0, 0.0, 0.0, excess, 0.0])
    driven, commands = track(make_controller(TRACK, model), Truth(model, faster), reference, 4.0)
    assert driven[-1, model.v] < 0.01
    assert commands[:, 0].min() >= model.low[0]
    return float(path[-1, 0]), float(driven[-1, 0])


@pytest.mark.parametrize("speed", [0.3, 0.9, 2.0])
def test_a_car_that_brakes_in_proportion_to_its_speed_stops_where_its_model_does(speed: float) -> None:
    planned, driven = braked(speed)
    assert driven < planned + 0.03


def test_a_car_that_is_faster_than_its_contingency_brakes_until_it_stands() -> None:
    planned, driven = braked(0.9, excess=0.3)
    assert driven < planned + 0.1  # the excess takes 6 cm to brake


# Reverse


def test_kinodynamic_backs_onto_its_path_from_either_side() -> None:
    model = reversing_car()
    reference = drive(model, np.array([0.0, 0.0, 0.0, -0.5]), [(-0.8, 0.0, 12.0)])
    for left, turn in ((0.15, 0.0), (-0.15, 0.2), (0.0, -0.3)):
        truth = Truth(model, np.array([0.0, left, turn, -0.5]), lag=0.1, servo=3.2)
        states, _ = track(make_controller(TRACK, model), truth, reference, 11.0)
        assert abs(states[-60:, 1]).max() < 0.03
        assert states[-1, 0] < -4.5


@CLOSED
def test_a_plan_that_changes_direction_is_driven_to_its_end(choice: Settings) -> None:
    model = reversing_car()
    reference = drive(model, AT_REST, [(0.8, 0.2, 2.0), (0.0, 0.0, 1.0), (-0.8, -0.2, 3.0), (0.0, 0.0, 1.0)])
    truth = Truth(model, AT_REST, lag=0.1, servo=3.2)
    states, commands = track(make_controller(choice, model), truth, reference, 14.0)
    assert np.hypot(*(states[-1, :2] - reference.states[-1, :2])) < 0.15
    assert commands[:, 0].min() < -0.5


def test_behind_a_plan_that_backs_up_the_throttle_is_more_negative() -> None:
    model = reversing_car()
    reference = drive(model, np.array([0.0, 0.0, 0.0, -0.3]), [(-0.5, 0.0, 4.0)])
    throttles = [command(TRACK, at(2.0, reference, forward=d), reference, 2.0, model)[0] for d in (-0.2, 0.0, 0.2)]
    assert throttles == pytest.approx([-0.3, -0.5, -0.7], abs=0.02)


# What changes between commands


@CLOSED
def test_a_new_reference_is_followed_at_once(choice: Settings) -> None:
    controller = make_controller(choice, car())
    old, state = drive(car(), MOVING, STRAIGHT), MOVING.copy()
    controller.command(Estimate(0.0, state, 0.0), old)
    new = drive(car(), np.array([0.0, 0.3, 0.0, 0.5]), STRAIGHT, begin=1.0)
    assert controller.command(Estimate(1.0, state, 0.0), new)[1] > 0.0


@CLOSED
def test_a_car_that_is_moved_along_the_path_is_found_again(choice: Settings) -> None:
    reference = drive(car(), MOVING, [(0.8, 0.0, 10.0)])
    controller = make_controller(choice, car())
    for place, left in ((0.0, 0.0), (9.0, 0.05), (0.5, -0.05)):
        for k in range(30):
            estimate = Estimate(place + k / 30, at(place, reference, left=left), 0.0)
            steering = controller.command(estimate, reference)[1]
        assert np.sign(steering) == -np.sign(left)


def test_a_path_that_crosses_itself_is_not_cut_short() -> None:
    loop = drive(car(), MOVING, [(0.8, 0.0, 1.5), (0.8, 0.38, 11.0), (0.8, 0.0, 2.0)])
    states, _ = track(make_controller(TRACK, car()), Truth(car(), MOVING), loop, loop.end, stop_at_end=False)
    assert abs(states[:, 2]).max() > 4.0  # it went round
    assert off_path(states, loop).max() < 0.05


@ALL
def test_a_copy_leaves_the_original_as_it_is(choice: Settings) -> None:
    reference, other = drive(car(), MOVING, [(0.8, 0.1, 4.0)]), drive(car(), START, STRAIGHT)
    one, two = make_controller(choice, car()), make_controller(choice, car())
    for controller in (one, two):
        track(controller, Truth(car(), MOVING), reference, 1.0)
    track(copy.deepcopy(one), Truth(car(), START), other, 1.0)
    estimate = Estimate(1.1, at(1.1, reference, left=0.02), 0.0)
    assert np.array_equal(one.command(estimate, reference), two.command(estimate, reference))


# Everywhere

NUMBER = st.floats(-1e6, 1e6)
NEAR = st.floats(-3.0, 3.0)
STATE = st.one_of(st.tuples(NUMBER, NUMBER, NUMBER, NUMBER), st.tuples(NEAR, NEAR, NEAR, NEAR))


@st.composite
def references(draw: Callable[[st.SearchStrategy[object]], object]) -> Reference:
    count = draw(st.integers(1, 6))
    assert isinstance(count, int)
    gaps = np.array(draw(st.lists(st.floats(1e-3, 3.0), min_size=count, max_size=count)))
    points = np.array(draw(st.lists(st.tuples(NEAR, NEAR, NEAR, NEAR), min_size=count, max_size=count)))
    controls = np.array(draw(st.lists(st.tuples(NEAR, NEAR), min_size=count - 1, max_size=count - 1)))
    kind = draw(st.sampled_from(list(ReferenceKind)))
    assert isinstance(kind, ReferenceKind)
    repeated = points[np.maximum(np.arange(count) - int(bool(draw(st.booleans()))), 0)]  # standing still, too
    return Reference(kind, np.cumsum(gaps), repeated, controls.reshape(-1, 2), np.array(draw(st.tuples(NEAR, NEAR))))


@ALL
@settings(max_examples=150)
@given(data=st.data())
def test_commands_are_finite_and_within_bounds_whatever_is_tracked(choice: Settings, data: st.DataObject) -> None:
    model = reversing_car() if data.draw(st.booleans()) else car()
    controller: Controller = make_controller(choice, model)
    for _ in range(3):
        reference = data.draw(references())
        for _ in range(2):
            estimate = Estimate(data.draw(st.floats(-5.0, 30.0)), np.array(data.draw(STATE)), 0.0)
            sent = controller.command(estimate, reference)
            assert np.all((model.low <= sent) & (sent <= model.high)), sent
