"""The robot's model of itself: predictions are the planner's, and its tables invert each other."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support.driving import PROMPT, car, slow_car

from kraft.driving.car_model import SETTLING_TIME, CarModel, model_of
from kraft.errors import Code, InputError
from kraft.vehicles.benchmark import BENCHMARK
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.unicycle2 import UNICYCLE2
from ompl_ext.obstacles import Workspace
from ompl_ext.query import Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

STATE = np.array([0.3, -0.2, 0.7, 0.4])
CONTROL = np.array([0.8, -0.25])


@pytest.mark.parametrize("of", [car, slow_car])
def test_a_prediction_is_the_planners_own(of: Callable[[], CarModel]) -> None:
    model = of()
    dirt = DirtSolver(model.vehicle, Workspace(((-5, 5), (-5, 5)), ()), None, settings=Settings(steps=20, longest=1.0))
    trajectory, _ = dirt.edge(STATE, CONTROL, 1.0)
    assert model.advance(STATE, CONTROL, 1.0) == pytest.approx(trajectory[-1], abs=1e-12)


def test_no_step_is_longer_than_a_twentieth_of_a_second() -> None:
    state = STATE
    for _ in range(20):
        state = car().advance(state, CONTROL, 0.05)
    assert car().advance(STATE, CONTROL, 1.0) == pytest.approx(state, abs=1e-12)


@pytest.mark.parametrize("duration", [0.0, -1.0])
def test_no_time_changes_nothing_and_gives_a_copy(duration: float) -> None:
    after = car().advance(STATE, CONTROL, duration)
    assert after is not STATE
    assert np.array_equal(after, STATE)


def steady_speed(model: CarModel, throttle: float) -> float:
    """Speed after holding a throttle for long, m/s."""
    start = np.zeros(len(model.vehicle.state))
    return float(model.advance(start, model.command(throttle, 0.0), SETTLING_TIME)[model.v])


def test_throttle_for_is_the_inverse_of_the_steady_speed() -> None:
    for throttle in (0.0, 0.31, 0.77, 1.0):
        assert steady_speed(car(), throttle) == pytest.approx(0.6228 * throttle, abs=1e-6)
        assert car().throttle_for(0.6228 * throttle) == pytest.approx(throttle, abs=1e-6)
    assert (car().throttle_for(9.0), car().throttle_for(-9.0)) == (1.0, 0.0)


@pytest.mark.parametrize("offset", [0.0, 0.05])
def test_curvature_and_steering_are_those_of_a_bicycle(offset: float) -> None:
    model = CarModel(PROMPT.with_parameters({"phi_diff": offset}))
    for steering in (-0.3, 0.0, 0.2):
        beta = math.atan(0.5 * math.tan(steering + offset))
        assert model.curvature(steering) == pytest.approx(2 * math.sin(beta) / 0.2965, abs=1e-3)
        assert model.steering_for(model.curvature(steering)) == pytest.approx(steering, abs=1e-9)
    assert model.wheelbase == pytest.approx(0.2965, rel=0.01)
    assert (model.steering_for(50.0), model.steering_for(-50.0)) == (0.38, -0.38)


def test_steering_that_turns_the_car_too_little_for_radians_is_in_another_unit() -> None:
    model = CarModel(PROMPT)
    assert model.steering_per_radian == 1.0
    model._steerings = [math.degrees(steering) for steering in model._steerings]
    length = PROMPT.footprint.length
    assert model.steering_per_radian == pytest.approx(math.degrees(0.2965) / (0.75 * length), rel=0.01)
    assert model.wheelbase == pytest.approx(0.75 * length)


def test_a_command_is_clamped() -> None:
    assert car().command(2.0, -1.0).tolist() == [1.0, -0.38]
    assert car().clamped(np.array([-3.0, 0.1])).tolist() == [0.0, 0.1]


def test_the_benchmark_vehicle_is_a_car_too() -> None:
    model = CarModel(BENCHMARK)
    assert steady_speed(model, 1.0) == pytest.approx(0.6228, abs=1e-6)
    assert model.curvature(1.0) == pytest.approx(2 * math.sin(math.atan(0.5 * math.tan(0.4203))) / 0.2965, rel=1e-3)


def refusal(vehicle: Vehicle) -> tuple[str, Code]:
    """Which vehicle is refused, and for what kind of reason."""
    with pytest.raises(InputError) as caught:
        CarModel(vehicle)
    (diagnostic,) = caught.value.diagnostics
    return diagnostic.file, diagnostic.code


def test_a_vehicle_without_throttle_and_steering_is_refused() -> None:
    assert refusal(UNICYCLE2) == ("unicycle2", Code.MISMATCH)


def test_a_car_without_a_speed_is_refused() -> None:
    assert refusal(replace(PROMPT, rest=())) == ("mushr", Code.MISMATCH)


def test_a_car_that_does_not_move_is_refused() -> None:
    assert refusal(PROMPT.with_parameters({"v_delta": 0.0})) == ("mushr", Code.MISMATCH)


def test_a_copy_is_the_same_model() -> None:
    assert copy.deepcopy(car()) is car()


@pytest.mark.parametrize(
    "changes", [{"L": 0.39, "phi_diff": 0.06, "v_delta": 0.6}, {"tau": 1.1, "u_0": 0.2, "v_delta": 0.8}], ids=str
)
def test_changed_parameters_give_the_tables_of_a_new_model(changes: dict[str, float]) -> None:
    vehicle = load_vehicle("mushr-force")
    model, fresh = CarModel(vehicle), CarModel(vehicle.with_parameters(changes))
    before = model.curvature(0.3), model.throttle_for(0.4)
    model.set_parameters(fresh.vehicle.parameter_array)
    assert (model.curvature(0.3), model.throttle_for(0.4)) != pytest.approx(before, rel=0.02)
    for steering in np.linspace(-0.38, 0.38, 21):
        assert model.curvature(steering) == pytest.approx(fresh.curvature(steering), abs=0.01 * fresh.curvature(0.38))
    for speed in np.linspace(0.05, 0.7, 21):
        assert model.throttle_for(speed) == pytest.approx(fresh.throttle_for(speed), abs=0.01)
    assert model.wheelbase == pytest.approx(fresh.wheelbase, rel=0.01)
    assert np.array_equal(model.advance(STATE, CONTROL, 1.0), fresh.advance(STATE, CONTROL, 1.0))


def test_parameters_with_which_the_car_does_not_move_leave_the_tables_of_the_speed() -> None:
    vehicle = load_vehicle("mushr-force")
    model = CarModel(vehicle)
    before = [model.throttle_for(speed) for speed in (0.1, 0.4, 0.6)]
    model.set_parameters(vehicle.with_parameters({"a_x": -2.0}).parameter_array)
    assert [model.throttle_for(speed) for speed in (0.1, 0.4, 0.6)] == before


def test_changed_parameters_do_not_change_other_models_of_the_vehicle() -> None:
    vehicle = load_vehicle("mushr-force")
    model, other = CarModel(vehicle), CarModel(vehicle)
    curvature = other.curvature(0.3)
    model.set_parameters(vehicle.with_parameters({"L": 0.5}).parameter_array)
    assert other.curvature(0.3) == CarModel(vehicle).curvature(0.3) == curvature


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("mushr-force", {"L", "phi_diff"}),
        ("jackal", {"track", "tau_turn"}),
        ("unicycle2", {"alpha_max"}),
        ("car", {"understeer", "slide"}),  # scrub slows the car down by the angle of its wheels
    ],
)
def test_parameters_that_act_on_turning_alone_are_told_from_those_that_act_on_the_speed(
    name: str, expected: set[str]
) -> None:
    subject = model_of(load_vehicle(name))
    found = {p for p, acts in zip(subject.vehicle.parameters, subject.acts_on_turning(), strict=True) if acts}
    assert found == expected
    assert subject.parameters == pytest.approx(list(subject.vehicle.parameters.values()))


@pytest.mark.parametrize(
    "parameters", [{"friction": 5.0}, {"a_drive": 0.0}, {"dead_zone": 0.5, "friction": 2.0}], ids="-".join
)
def test_a_car_that_seems_not_to_move_keeps_its_tables(parameters: dict[str, float]) -> None:
    """A car that pushes against a box in vain may be identified as one without a drive."""
    model = model_of(load_vehicle("car"))
    assert isinstance(model, CarModel)
    before = [model.curvature(steering) for steering in (-0.2, 0.0, 0.3)]
    model.set_parameters(np.array(list({**model.vehicle.parameters, **parameters}.values())))
    assert [model.curvature(steering) for steering in (-0.2, 0.0, 0.3)] == before
    assert model.steering_for(before[0]) == pytest.approx(-0.2)


@pytest.mark.parametrize(
    ("parameters", "where"),
    [({"friction": 5.0}, "full throttle"), ({"dead_zone": 0.5, "friction": 2.0}, "steering")],
)
def test_a_car_that_does_not_move_has_no_model(parameters: dict[str, float], where: str) -> None:
    with pytest.raises(InputError) as caught:
        model_of(load_vehicle("car").with_parameters(parameters))
    assert [(each.code, where in each.problem) for each in caught.value.diagnostics] == [(Code.MISMATCH, True)]


def test_a_car_that_steers_to_the_right_has_no_model() -> None:
    """Its feedback on the path would have the wrong sign."""
    right = load_vehicle("car").with_parameters({"steer": -load_vehicle("car").parameters["steer"]})
    with pytest.raises(InputError, match="positive to the left") as caught:
        model_of(right)
    assert [each.code for each in caught.value.diagnostics] == [Code.MISMATCH]
