"""The true car drives as the original's simulated car was measured to, each figure within 15 %."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from support.world import drive, open_world

from kraft.simulation.car import MUSHR

WITHIN = 0.15
Run = dict[str, NDArray[np.float64]]


@cache
def launch(throttle: float) -> Run:
    return drive(open_world(), throttle, 0.0, 9.0)


@pytest.mark.parametrize(
    ("throttle", "speed"), [(1.0, 0.748), (0.75, 0.513), (0.5, 0.302), (0.3, 0.153), (0.15, 0.056)]
)
def test_steady_speed(throttle: float, speed: float) -> None:
    run = launch(throttle)
    assert run["v"][-1] == pytest.approx(speed, rel=WITHIN)
    assert abs(run["v"][-1] - run["v"][-100]) < 0.005


@pytest.mark.parametrize(("throttle", "seconds"), [(1.0, 1.0), (0.3, 0.44), (0.15, 0.44)])
def test_time_to_63_percent_of_the_speed(throttle: float, seconds: float) -> None:
    run = launch(throttle)
    rising = slice(int(np.argmax(run["v"] > 0.8 * run["v"][-1])))
    reached = np.interp(0.63 * run["v"][-1], run["v"][rising], run["t"][rising])
    assert reached == pytest.approx(seconds, rel=WITHIN)


def test_from_full_throttle_to_rest() -> None:
    world = open_world()
    drive(world, 1.0, 0.0, 9.0)
    began, at = world.time, world.pose[0]
    run = drive(world, 0.0, 0.0, 4.0)
    rest = int(np.argmax(run["v"] < 0.005))
    assert run["t"][rest] - began == pytest.approx(2.3, rel=WITHIN)
    assert run["x"][rest] - at == pytest.approx(0.51, rel=WITHIN)
    assert abs(run["v"][-1]) < 0.001


@pytest.mark.parametrize("steering", [MUSHR.steering_max, -MUSHR.steering_max])
@pytest.mark.parametrize("throttle", [0.3, 0.5, 1.0])
def test_turning_radius(throttle: float, steering: float) -> None:
    world = open_world()
    drive(world, throttle, steering, 3.0)
    run = drive(world, throttle, steering, 2.0)
    travelled = np.hypot(np.diff(run["x"]), np.diff(run["y"])).sum()
    turned = np.unwrap(run["theta"])[-1] - run["theta"][0]
    assert travelled / turned == pytest.approx(math.copysign(0.86, steering), rel=0.03)


def test_a_gentle_turn_is_the_bicycles_apart_from_the_linkage() -> None:
    world = open_world()
    drive(world, 0.5, 0.1, 3.0)
    run = drive(world, 0.5, 0.1, 3.0)
    travelled = np.hypot(np.diff(run["x"]), np.diff(run["y"])).sum()
    turned = run["theta"][-1] - run["theta"][0]
    beta = math.atan(0.5 * math.tan(0.89 * 0.1))
    assert turned / travelled == pytest.approx(2 * math.sin(beta) / MUSHR.wheelbase, rel=0.05)


def test_the_inner_wheel_turns_more() -> None:
    left, right = MUSHR.wheel_angles(0.3)
    assert left > 0.3 > right > 0
    assert 1 / math.tan(right) - 1 / math.tan(left) == pytest.approx(0.23 / MUSHR.wheelbase)
    assert MUSHR.wheel_angles(-0.3) == pytest.approx((-right, -left))


def test_the_servo_turns_at_its_rate() -> None:
    world = open_world()
    world.apply((0.0, MUSHR.steering_max))
    world.step(25)
    early = world.data.joint("front right steering").qpos[0]
    world.step(25)
    late = world.data.joint("front right steering").qpos[0]
    assert (late - early) / (25 * world.dt) == pytest.approx(3.2, rel=0.05)
    world.step(100)
    assert world.data.joint("front right steering").qpos[0] == pytest.approx(
        MUSHR.wheel_angles(0.89 * 0.38)[1], abs=0.005
    )


def test_throttle_and_steering_are_clamped_to_the_actuators() -> None:
    much, full = open_world(), open_world()
    assert np.array_equal(drive(much, 7.0, 3.0, 1.0)["x"], drive(full, 1.0, MUSHR.steering_max, 1.0)["x"])
    assert MUSHR.wheel_torque(-2.0) == MUSHR.wheel_torque(-1.0) == -MUSHR.wheel_torque(1.0)


def test_it_drives_backwards_as_well() -> None:
    run = drive(open_world(), -1.0, 0.0, 6.0)
    assert run["v"][-1] == pytest.approx(-launch(1.0)["v"][-1], rel=0.03)


def test_it_starts_with_the_speed_that_the_scenario_says() -> None:
    world = open_world(speed=0.5, heading=90.0)
    assert world.speed == pytest.approx(0.5)
    run = drive(world, 0.75, 0.0, 0.5)
    assert run["v"][0] == pytest.approx(0.5, abs=0.01)
    assert run["y"][-1] == pytest.approx(0.25, abs=0.01)


def test_the_gap_between_car_and_model() -> None:
    weak = drive(open_world("vehicle: {drive_scale: 0.85}"), 1.0, 0.0, 8.0)
    assert weak["v"][-1] < 0.9 * launch(1.0)["v"][-1]
    heavy = drive(open_world("vehicle: {mass_scale: 3.0}"), 1.0, 0.0, 1.0)
    assert heavy["v"][-1] < 0.9 * launch(1.0)["v"][np.argmax(launch(1.0)["t"] >= 1.0)]
    crooked = drive(open_world("vehicle: {steering_offset_deg: 2}"), 0.5, 0.0, 5.0)
    assert crooked["theta"][-1] > 0.1
    lazy = drive(open_world("vehicle: {steering_scale: 0.5}"), 0.5, 0.3, 5.0)
    keen = drive(open_world(), 0.5, 0.15, 5.0)
    assert lazy["theta"][-1] == pytest.approx(keen["theta"][-1], rel=1e-9)


def test_a_heavier_car_stands_still_at_the_start() -> None:
    world = open_world("vehicle: {mass_scale: 1.5}")
    height = world.data.body("car").xpos[2]
    run = drive(world, 0.0, 0.0, 1.0)
    assert world.data.body("car").xpos[2] == pytest.approx(height, abs=3e-4)
    assert np.abs(run["x"]).max() < 1e-4
