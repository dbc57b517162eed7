"""The model of cars with terms: friction, driving away, reversing and brakes at standstill; speed controllers; coasting."""

from __future__ import annotations

import numpy as np
import pytest
from support.cars import car

from kraft.sysid.dynamics import DiscreteModel
from kraft.vehicles.load import load_vehicle


def test_friction_holds_the_car_at_rest_and_brings_it_to_rest() -> None:
    model = DiscreteModel(car())
    moving = np.array([[0.0, 0.0, 0.0, 1.0]])
    for throttle in (0.0, 0.1):  # 0.3 m/s^2 is less than the friction
        controls = np.tile([throttle, 0.0], (100, 1, 1))
        coasting = model.simulate(moving, controls, car().parameter_array[None], np.array([0.05]))[:, 0]
        assert abs(coasting[-1, 3]) < 1e-3
        assert (np.diff(coasting[:, 3]) <= 1e-9).all()
        resting = model.simulate(0.0 * moving, controls, car().parameter_array[None], np.array([0.05]))[:, 0]
        assert np.abs(resting[:, 3]).max() < 1e-6


@pytest.mark.parametrize("step", [0.01, 0.1])
@pytest.mark.parametrize("friction", [0.1, 0.3, 1.0])
def test_a_car_rolls_out_as_far_as_dry_friction_lets_it(friction: float, step: float) -> None:
    """From 0.5 m/s, without other losses: v^2 / (2 friction), and the car does not swing about standstill."""
    model = car(friction=friction, damping=0.0, lever=0.0)
    start, controls = np.array([[0.0, 0.0, 0.0, 0.5]]), np.zeros((round(8.0 / step), 1, 2))
    states = DiscreteModel(model).simulate(start, controls, model.parameter_array[None], np.array([step]))[:, 0]
    assert states[-1, 0] == pytest.approx(0.5**2 / (2.0 * friction), rel=0.02)
    assert states[:, 3].min() > -1e-3


@pytest.mark.parametrize(("speed", "drive"), [(0.0, 1.05), (0.0, 1.5), (0.5, -1.5), (0.5, -3.0)])
def test_a_car_drives_away_and_reverses_as_dry_friction_lets_it(speed: float, drive: float) -> None:
    """Drive over friction: constant acceleration to either side of standstill, at which friction changes its sense."""
    friction, step, time = 1.0, 0.01, 2.0
    model = car(friction=friction, damping=0.0, back_emf=0.0, dead_zone=0.0, lever=0.0)
    start, count = np.array([[0.0, 0.0, 0.0, speed]]), round(time / step)
    controls = np.tile([drive * friction / model.parameters["a_drive"], 0.0], (count, 1, 1))
    states = DiscreteModel(model).simulate(start, controls, model.parameter_array[None], np.array([step]))[:, 0]
    at_rest = speed / (abs(drive) + friction)  # time of the standstill, s
    after = (abs(drive) - friction) * (time - at_rest)
    assert abs(states[-1, 3]) == pytest.approx(after, abs=0.005)


def test_friction_that_vanishes_has_no_effect_on_a_coasting_car() -> None:
    start, controls = np.array([[0.0, 0.0, 0.0, 0.05]]), np.zeros((40, 1, 2))
    ends = []
    for friction in (0.0, 1e-6):
        model = car(friction=friction)
        ends.append(
            DiscreteModel(model).simulate(start, controls, model.parameter_array[None], np.array([0.05]))[-1, 0]
        )
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-4)


@pytest.mark.parametrize("speed", [1.0, 1.01, 1.02, 1.03])
def test_brakes_that_jump_at_standstill_are_as_exact_with_long_steps(speed: float) -> None:
    model = load_vehicle("car-lag", parameters={"brake": 2.8})
    start, ends = np.zeros((1, 6)), {}
    start[0, model.index("v")] = speed
    for step in (0.05, 0.0005):
        controls = np.tile([-0.5, 0.3], (round(1.5 / step), 1, 1))
        ends[step] = DiscreteModel(model).simulate(start, controls, model.parameter_array[None], np.array([step]))[
            -1, 0
        ]
    assert ends[0.05][model.index("v")] < -0.5
    np.testing.assert_allclose(ends[0.05], ends[0.0005], atol=0.005)


@pytest.mark.parametrize("step", [0.01, 0.1])
def test_a_speed_controller_accelerates_and_brakes_at_its_limit(step: float) -> None:
    """To 3 m/s and back with 2 m/s^2, and then with the time constant 1 / damping."""
    limit, damping = 2.0, 6.0
    model = car(a_drive=3.0 * damping, damping=damping, friction=0.0, effort=1.0 / limit, lever=0.0)
    controls = np.zeros((round(4.0 / step), 1, 2))
    controls[: len(controls) // 2, :, 0] = 1.0
    states = DiscreteModel(model).simulate(
        np.zeros((1, 4)), controls, model.parameter_array[None], np.array([step])
    )[:, 0]  # fmt: skip
    speed = dict(zip(np.round(step * np.arange(len(states)), 6).tolist(), states[:, 3].tolist(), strict=True))
    assert speed[1.0] == pytest.approx(limit, rel=0.02)
    assert speed[2.0] == pytest.approx(3.0, rel=0.02)
    assert speed[3.0] == pytest.approx(3.0 - limit, abs=0.06)
    assert speed[4.0] == pytest.approx(0.0, abs=0.06)


@pytest.mark.parametrize("coast", [-2.0, -0.5, 0.0, 1.5])
def test_only_a_car_at_neutral_throttle_has_the_damping_of_coasting(coast: float) -> None:
    """A coasting car loses its speed exponentially, and never gains any; a driven one does not differ."""
    damping, time, step = 1.2, 0.5, 0.01
    model = car(friction=0.0, damping=damping, coast=coast, dead_zone=0.1, lever=0.0)
    start = np.array([[0.0, 0.0, 0.0, 2.0]])
    ends = {}
    for throttle in (0.0, 0.08, -0.08, 0.3):
        controls = np.tile([throttle, 0.0], (round(time / step), 1, 1))
        states = DiscreteModel(model).simulate(start, controls, model.parameter_array[None], np.array([step]))
        ends[throttle] = states[-1, 0, 3]
    for inside in (0.0, 0.08, -0.08):
        assert ends[inside] == pytest.approx(2.0 * np.exp(-max(damping + coast, 0.0) * time), rel=0.02)
    driven = model.parameters["a_drive"] * 0.2 / damping
    assert ends[0.3] == pytest.approx(driven + (2.0 - driven) * np.exp(-damping * time), rel=0.02)
