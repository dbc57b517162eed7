"""The bundled vehicles: their files fit their models, and the models move as their equations say."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from support.diagnostics import located, raised

from kraft.config import bundled
from kraft.errors import InputError
from kraft.vehicles.benchmark import BENCHMARK
from kraft.vehicles.config import load_vehicle_config
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.mushr import BREAKAWAY, MUSHR, MUSHR_DRIVE, MUSHR_FORCE, MUSHR_LAG
from kraft.vehicles.unicycle2 import UNICYCLE2
from ompl_ext.obstacles import Workspace
from ompl_ext.query import Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

BUNDLED = (BENCHMARK, MUSHR, MUSHR_DRIVE, MUSHR_FORCE, MUSHR_LAG, UNICYCLE2)


def rate(vehicle: Vehicle, state: Iterable[float], control: Iterable[float]) -> list[float]:
    x, u = tuple(map(float, state)), tuple(map(float, control))
    p = tuple(vehicle.parameter_array)
    inputs = u if vehicle.actuation is None else vehicle.actuation(u, p)
    return list(vehicle.derivative(x, inputs, p))


def after(vehicle: Vehicle, state: list[float], control: list[float], seconds: float) -> np.ndarray:
    x, h = np.array(state, dtype=float), 2e-3
    for _ in range(round(seconds / h)):
        x = x + h * np.array(rate(vehicle, x + 0.5 * h * np.array(rate(vehicle, x, control)), control))
    return x


@pytest.mark.parametrize("name", bundled.names("vehicle"))
def test_a_bundled_file_fits_its_model(name: str) -> None:
    config, vehicle = load_vehicle_config(name), load_vehicle(name)
    assert vehicle.name == name
    assert list(vehicle.parameters.items()) == list(config.values.items())
    assert (vehicle.footprint.length, vehicle.footprint.width) == (config.footprint.length, config.footprint.width)
    assert vehicle.top_speed == config.values.get(str(config.top_speed), config.top_speed)


@pytest.mark.parametrize("model", BUNDLED, ids=lambda model: model.name)
def test_a_model_without_its_file_is_the_same_vehicle_up_to_identified_numbers(model: Vehicle) -> None:
    numbers = model.parameters
    loaded = load_vehicle(model.name, parameters=None if model is BENCHMARK else numbers)
    assert list(load_vehicle(model.name).parameters) == list(numbers)
    assert (loaded.parameters, loaded.footprint, loaded.top_speed) == (numbers, model.footprint, model.top_speed)
    assert (loaded.state, loaded.controls, loaded.manoeuvres) == (model.state, model.controls, model.manoeuvres)


@pytest.mark.parametrize("model", BUNDLED, ids=lambda model: model.name)
def test_every_manoeuvre_stops_a_vehicle_that_turns_at_full_speed(model: Vehicle) -> None:
    p = tuple(model.parameter_array)
    assert model.stop is not None
    for k in range(len(model.manoeuvres)):
        state = np.zeros(len(model.state))
        state[model.index("v")] = model.top_speed
        if model.index("omega") >= 0:
            state[model.index("omega")] = -1.5
        for _ in range(100):
            state = after(model, list(state), list(model.stop(tuple(state), p, k)), 0.1)
        assert np.all(np.abs(state[list(model.rest_indices)]) < 0.01), model.manoeuvres[k]


@pytest.mark.parametrize("model", [MUSHR, MUSHR_LAG, MUSHR_DRIVE], ids=lambda model: model.name)
def test_mushr_turns_about_the_circle_of_its_centre(model: Vehicle) -> None:
    steering, wheelbase, offset = 0.3, model.parameters["L"], model.parameters["phi_diff"]
    _, _, turn, _ = rate(model, [0, 0, 0, 0.5], [0.5, steering])
    beta = math.atan(0.5 * math.tan(steering + offset))
    radius = wheelbase / (2 * math.sin(beta))
    assert 0.5 / turn == pytest.approx(radius)


def test_mushr_steers_straight_where_the_offset_is_steered_against() -> None:
    car = MUSHR.with_parameters({"phi_diff": 0.1})
    assert rate(car, [0, 0, 0, 0.5], [1, -0.1])[2] == pytest.approx(0.0, abs=1e-12)


def test_mushr_follows_the_throttle_almost_at_once_and_its_lagging_sister_with_tau() -> None:
    assert after(MUSHR, [0, 0, 0, 0], [1, 0], 0.3)[3] == pytest.approx(0.6228 * (1 - math.exp(-3)), rel=1e-3)
    assert after(MUSHR_LAG, [0, 0, 0, 0], [1, 0], 1.0103)[3] == pytest.approx(0.6228 * (1 - math.exp(-1)), rel=1e-3)


def test_the_lagging_mushr_is_the_benchmark_car_up_to_names_of_its_numbers() -> None:
    mine = rate(MUSHR_LAG, [0, 0, 0.4, 0.3], [0.7, 0.25])
    theirs = rate(BENCHMARK, [0, 0, 0.4, 0.3], [0.7, 0.25 / 0.4203])
    assert mine == pytest.approx(theirs, rel=1e-4)


def coasting(speed: float, seconds: float) -> tuple[float, float]:
    """Speed and way of a car with Coulomb friction that rolls on its own, in closed form: v' = -(k + v) / tau."""
    tau, k = 0.8813, 0.6861 * 0.1274 / (1 - 0.1274)
    t = min(seconds, tau * math.log(1 + speed / k))
    left = (speed + k) * math.exp(-t / tau) - k
    return left, tau * (speed - left) - k * t


def stopped(car: Vehicle, control: Callable[[np.ndarray], Iterable[float]]) -> tuple[float, float]:
    """How long (s) and how far (m) a car still drives from its top speed."""
    state, time = np.array([0.0, 0.0, 0.0, car.top_speed]), 0.0
    while abs(state[3]) > 0.01:
        state, time = after(car, list(state), list(control(state)), 0.1), time + 0.1
    return time, float(state[0])


def test_the_drive_trains_derivative_is_its_equation() -> None:
    (wheelbase, offset, fastest, tau, used), rng = MUSHR_DRIVE.parameters.values(), np.random.default_rng(3)
    for _ in range(50):
        x, y, theta, v, u, steering = rng.uniform([-1, -1, -3, -0.5, -0.5, -0.38], [1, 1, 3, 0.7, 1, 0.38])
        beta = math.atan(0.5 * math.tan(steering + offset))
        force = fastest * (u - used * v / math.hypot(v, BREAKAWAY)) / (1 - used)
        expected = [
            v * math.cos(theta + beta), v * math.sin(theta + beta), 2 * v * math.sin(beta) / wheelbase, (force - v) / tau,
        ]  # fmt: skip
        assert rate(MUSHR_DRIVE, [x, y, theta, v], [u, steering]) == pytest.approx(expected, abs=1e-7)


def test_full_throttle_leads_the_drive_train_to_the_top_speed_and_reverse_backwards() -> None:
    assert after(MUSHR_DRIVE, [0, 0, 0, 0], [1, 0], 10.0)[3] == pytest.approx(0.6861, rel=1e-3)
    backwards = 0.6861 * (-0.5 + 0.1274) / (1 - 0.1274)
    assert after(MUSHR_DRIVE, [0, 0, 0, 0], [-0.5, 0], 10.0)[3] == pytest.approx(backwards, rel=0.01)


def test_the_drive_train_coasts_as_friction_and_drag_say_and_rests_in_finite_time() -> None:
    for seconds in (0.3, 0.7, 1.1):
        x, _, _, v = after(MUSHR_DRIVE, [0, 0, 0, 0.6], [0, 0], seconds)
        speed, way = coasting(0.6, seconds)
        assert (v, x) == (pytest.approx(speed, rel=0.03), pytest.approx(way, rel=0.01))
    time, way = stopped(MUSHR_DRIVE, lambda _: (0.0, 0.0))
    ends = 0.8813 * math.log(1 + 0.6861 * (1 - 0.1274) / (0.6861 * 0.1274))
    assert ends < time < ends + 0.4  # the lagging car alone would need 3.7 s with the same time constant
    assert way == pytest.approx(coasting(0.6861, 9.0)[1], rel=0.03)


def test_the_drive_train_brakes_in_less_time_and_way_than_it_coasts() -> None:
    p, law = tuple(MUSHR_DRIVE.parameter_array), MUSHR_DRIVE.stop
    assert law is not None
    time, way = stopped(MUSHR_DRIVE, lambda state: law(tuple(state), p, 0))
    coasts, rolls = stopped(MUSHR_DRIVE, lambda _: (0.0, 0.0))
    assert time < 0.6 * coasts
    assert way < 0.6 * rolls
    assert (way, rolls) == (pytest.approx(0.24, abs=0.005), pytest.approx(0.43, abs=0.005))


def test_the_brake_is_against_the_motion_within_what_may_be_commanded_and_gentle_at_rest() -> None:
    p, law = tuple(MUSHR_DRIVE.parameter_array), MUSHR_DRIVE.stop
    assert law is not None
    throttles = [law((0.0, 0.0, 0.0, v), p, 0)[0] for v in (0.6, 0.3, 0.1, 0.0, -0.1, -0.4)]
    assert throttles == pytest.approx([-0.5, -0.5, -0.2, 0.0, 0.2, 0.5])


def test_a_throttle_that_friction_uses_up_does_not_move_the_drive_train() -> None:
    for throttle in (-0.1274, -0.06, 0.06, 0.1274):
        assert abs(after(MUSHR_DRIVE, [0, 0, 0, 0], [throttle, 0], 10.0)[3]) <= BREAKAWAY
    assert after(MUSHR_DRIVE, [0, 0, 0, 0], [2 * 0.1274, 0], 10.0)[3] == pytest.approx(0.1, rel=0.06)


@pytest.mark.parametrize(
    ("name", "control"), [("car-lag", [0.6, 0.5]), ("car", [0.6, 0.5]), ("differential", [0.4, 0.8])]
)
def test_the_tracked_point_of_a_model_with_terms_is_fixed_to_the_vehicle(name: str, control: list[float]) -> None:
    lever, offset = 0.15, 0.1
    middle, tracked = load_vehicle(name), load_vehicle(name, parameters={"lever": lever, "yaw_offset": offset})
    start = [0.0] * len(middle.state)
    x, y, yaw, *rest = after(middle, start, control, 1.5)
    seen = after(tracked, [lever, 0.0, offset, *start[3:]], control, 1.5)
    assert abs(yaw) > 0.5
    expected = [x + lever * math.cos(yaw), y + lever * math.sin(yaw), yaw + offset, *rest]
    np.testing.assert_allclose(seen, expected, atol=1e-5)


def test_without_a_force_mushr_force_is_mushr_drive() -> None:
    drive, force = load_vehicle("mushr-drive"), load_vehicle("mushr-force")
    assert dict(list(force.parameters.items())[:5]) == drive.parameters
    assert (force.parameters["a_x"], force.parameters["a_y"]) == (0.0, 0.0)
    assert (force.footprint, force.top_speed, force.controls) == (drive.footprint, drive.top_speed, drive.controls)
    assert force.manoeuvres == drive.manoeuvres
    rng = np.random.default_rng(0)
    for _ in range(50):
        state, control = rng.uniform(-1.0, 1.0, 4), rng.uniform([-0.5, -0.38], [1.0, 0.38])
        assert rate(force, state, control) == rate(drive, state, control)
        for k in range(len(drive.manoeuvres)):
            theirs = drive.stop(tuple(state), tuple(drive.parameter_array), k)  # type: ignore[misc]
            assert force.stop(tuple(state), tuple(force.parameter_array), k) == pytest.approx(theirs)  # type: ignore[misc]


def test_a_force_accelerates_along_its_direction_whatever_the_heading() -> None:
    pushed = MUSHR_FORCE.with_parameters({"a_x": 0.3, "a_y": -0.4})
    for heading in (0.0, 0.9, math.pi / 2, -2.5):
        state, control = (0.0, 0.0, heading, 0.2), (0.5, 0.1)
        more = np.subtract(rate(pushed, state, control), rate(MUSHR_DRIVE, state, control))
        assert more == pytest.approx([0.0, 0.0, 0.0, 0.3 * math.cos(heading) - 0.4 * math.sin(heading)])


def test_the_unicycle_never_exceeds_its_speeds_nor_drives_backwards() -> None:
    rng = np.random.default_rng(1)
    state = np.zeros(5)
    for _ in range(200):
        state = after(UNICYCLE2, list(state), list(rng.choice([-1.0, 1.0], 2)), 0.2)
        assert -1e-9 <= state[3] <= 0.6 + 1e-9
        assert abs(state[4]) <= 2.0 + 1e-9


def test_the_unicycle_accelerates_as_commanded_away_from_its_limits() -> None:
    assert rate(UNICYCLE2, [0, 0, 0, 0.3, 0], [0.5, -0.5])[3:] == [0.5, -2.0]


def test_the_unicycle_fades_smoothly_and_returns_from_beyond_its_limits() -> None:
    def acceleration(v: float, u: float) -> float:
        return rate(UNICYCLE2, [0, 0, 0, v, 0], [u, 0])[3]

    speeds = np.linspace(0.0, 0.6, 6001)
    for u in (1.0, 0.3, -0.4, -1.0):
        curve = np.array([acceleration(v, u) for v in speeds])
        bends = np.abs(np.diff(curve, 2))
        assert bends.max() <= 6.0**2 / 2 / abs(u) * 1e-8 * 1.01  # the parabola's own; a kink has 6e-4
        assert curve[-1 if u > 0 else 0] == 0.0
    assert acceleration(0.7, 0.0) == acceleration(0.7, 1.0) == pytest.approx(-0.6)
    assert acceleration(-0.1, 0.0) == pytest.approx(0.6)
    assert acceleration(0.25, 0.0) == 0.0


@pytest.mark.parametrize("model", [UNICYCLE2, BENCHMARK, MUSHR_DRIVE], ids=lambda model: model.name)
def test_ten_steps_an_edge_stay_within_three_millimetres_of_the_exact_motion(model: Vehicle) -> None:
    rng = np.random.default_rng(5)
    room = Workspace(((-20.0, 20.0), (-20.0, 20.0)), ())
    coarse = DirtSolver(model, room, None, Safety(enabled=False), Settings(), capacity=1)
    low, high = model.control_bounds.T
    for _ in range(100):
        planned = exact = np.zeros(len(model.state))
        for _ in range(16):
            control = low + (high - low) * np.clip(rng.uniform(-1.0, 2.0, len(low)), 0.0, 1.0)
            duration = rng.uniform(0.5, 1.0)
            planned = coarse.edge(planned, control, duration)[0][-1]
            for _ in range(12):
                exact = coarse.edge(exact, control, duration / 12)[0][-1]
            assert math.dist(planned[:2], exact[:2]) < 3e-3


def test_a_top_speed_that_is_a_parameter_follows_it() -> None:
    assert load_vehicle("mushr", parameters={"v_delta": 1.0}).top_speed == 1.0
    assert load_vehicle("unicycle2", parameters={"v_max": 0.3}).top_speed == 0.3
    assert load_vehicle("benchmark", parameters={"gain": 0.3}).top_speed == 0.6228


@pytest.mark.parametrize(("value", "is_allowed"), [(100.0, True), (100.5, False)])
def test_a_top_speed_that_is_a_parameter_has_the_limit_of_one_that_is_given(
    value: float, is_allowed: bool, tmp_path: Path
) -> None:
    path = tmp_path / "fast.yaml"
    text = bundled.find("vehicle", "unicycle2").read_text()
    path.write_text(
        re.sub(
            r"v_max: \{value: .*?, unit: m/s, min: .*?, max: [^,]*",
            f"v_max: {{value: {value}, unit: m/s, min: 0.05, max: 200",
            text,
        )
    )
    if is_allowed:
        assert load_vehicle(path).top_speed == value
    else:
        with pytest.raises(InputError, match=r"top_speed: is 100\.5 m/s; expected .* at most 100"):
            load_vehicle(path)


def test_parameters_are_checked_against_the_files_limits() -> None:
    assert located(raised(lambda: load_vehicle("mushr", parameters={"L": 9.0}))) == ["parameters.L.value value"]
    assert located(raised(lambda: load_vehicle("mushr", parameters={"tau": 1.0}))) == ["unknown"]
