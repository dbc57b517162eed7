"""Extras between commands and motion: what a lag and friction do, and which of them the data show."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic_logs import CommandSeries, random_commands, synthetic_logs
from benchmarks.sysid import TRUTH
from kraft.errors import Code, InputError
from kraft.sysid import Identification, Settings, identify, prediction_errors
from kraft.sysid.actuators import _integrals, hat_means, through_play
from kraft.sysid.checks import _bounds, notes_of
from kraft.sysid.dynamics import DiscreteModel, Dynamics
from kraft.sysid.parameters import auxiliary_parameters, parameters_of, vehicle_of
from kraft.sysid.problem import ObservationModel
from kraft.sysid.selection import check_free_parameters, selection_note
from kraft.vehicles.config import VehicleConfig, load_vehicle_config
from ompl_ext.kernels import held_signals as held
from ompl_ext.trigonometry import cos, sin
from ompl_ext.vehicle import Footprint, Vehicle, derivative


@cache
def lag() -> VehicleConfig:
    return load_vehicle_config("mushr-lag")


@pytest.mark.parametrize("lag", [0.0, 0.001, 0.08, 2.0])
def test_means_of_a_lagging_signal_are_those_of_its_equation(lag: float) -> None:
    """A hat over the solution of T y' = w - y, integrated finely; and the derivatives by time and by lag."""
    rng = np.random.default_rng(0)
    times, values, h = np.cumsum(rng.uniform(0.01, 0.3, 12)), rng.normal(size=(13, 1)), 0.05
    at = 0.123 + h * np.arange(31)
    found = hat_means(times, values, at[:-1], np.full(30, h), lag)
    fine, n = h / 1000, round((at[-1] + h) / (h / 1000))
    held = values[np.searchsorted(times, fine * (np.arange(n) + 0.5), side="right"), 0]
    y = np.empty(n)
    y[0], stays = held[0], np.exp(-fine / lag) if lag else 0.0
    for i in range(1, n):
        y[i] = held[i] + (y[i - 1] - held[i]) * stays
    middles = fine * (np.arange(n) + 0.5)
    hats = np.maximum(0.0, 1.0 - np.abs(middles - (at[:-1, None] + h / 2)) / h)
    assert found.values[:, 0] == pytest.approx(hats @ y / hats.sum(axis=1), abs=2e-3)
    lags = (hat_means(times, values, at[:-1], np.full(30, h), lag + change).values for change in (9e-6, 11e-6))
    by_lag = np.diff(list(lags), axis=0)[0] / 2e-6
    assert hat_means(times, values, at[:-1], np.full(30, h), lag + 1e-5).by_lag == pytest.approx(
        by_lag, abs=1e-4 * np.abs(by_lag).max()
    )
    shifted = (hat_means(times, values, at[:-1] + change, np.full(30, h), lag).values for change in (-1e-6, 1e-6))
    by_time = np.diff(list(shifted), axis=0)[0] / 2e-6
    assert found.by_time == pytest.approx(by_time, abs=1e-4 * np.abs(by_time).max())


@pytest.mark.parametrize("lag", [0.0, 0.08])
def test_means_weighted_with_a_hat_are_second_differences_of_integrals(lag: float) -> None:
    rng = np.random.default_rng(1)
    times, values = np.cumsum(rng.uniform(0.01, 0.3, 12)), rng.normal(size=(13, 2))
    begin, h = np.sort(rng.uniform(0.2, 1.5, 20)), rng.uniform(0.04, 0.06, 20)
    integrals = _integrals(times, values, begin + np.array([[-0.5], [0.5], [1.5]]) * h, lag)
    found = hat_means(times, values, begin, h, lag)
    for k, means in ((held.TWICE, found.values), (held.ONCE, found.by_time), (held.TWICE_BY_LAG, found.by_lag)):
        assert np.array_equal(means, np.diff(integrals[k], n=2, axis=0)[0] / h[:, None] ** 2)


def test_a_lag_of_nothing_starts_like_a_delay() -> None:
    """Its derivative is there already, so that the optimiser leaves the bound where the data show a lag."""
    times, values, at = np.array([0.1, 0.4, 0.9]), np.array([[0.0], [1.0], [-1.0], [0.5]]), 0.05 * np.arange(25)
    found = hat_means(times, values, at, np.full(25, 0.05), 0.0)
    assert found.by_lag == pytest.approx(-found.by_time)


@pytest.mark.parametrize("model", ["mushr", "mushr-lag"])
@pytest.mark.parametrize("friction", [0.15, 0.5])
def test_a_coasting_vehicle_with_friction_comes_to_rest_and_stays_there(model: str, friction: float) -> None:
    vehicle = load_vehicle_config(model)
    speeds = []
    for auxiliary in ((), ("friction",)):
        parameters = parameters_of(
            vehicle, Settings(values=dict.fromkeys(auxiliary, friction), auxiliary=auxiliary), auxiliary
        )
        start = np.array([[0.0, 0.0, 0.0, 0.4], [0.0, 0.0, 0.0, 0.0]])
        controls = np.zeros((80, 2, 2))
        states = Dynamics(parameters).simulate(start, controls, parameters.nominal, np.full(2, 0.05))
        speeds.append(states[:, 0, 3])
        assert (states[:, 1] == 0.0).all()
    rolling, braked = speeds
    assert braked[-1] == pytest.approx(0.0, abs=1e-3)
    assert (np.diff(braked) <= 0.0).all()
    assert braked.min() >= 0.0
    assert braked[30] < 0.25 * rolling[30]


@pytest.mark.parametrize("model", ["mushr", "mushr-drive"])
def test_derivatives_with_friction_are_those_of_the_steps_also_about_standstill(model: str) -> None:
    vehicle, auxiliary = load_vehicle_config(model), ("delay", "friction")
    parameters = parameters_of(vehicle, Settings(values={"friction": 0.3}, auxiliary=auxiliary), auxiliary)
    dynamics, rng, h = Dynamics(parameters), np.random.default_rng(0), np.full(30, 0.05)
    x = np.column_stack([*rng.uniform(-1.0, 1.0, (3, 30)), rng.uniform(-0.1, 0.3, 30)])
    u, rho = np.column_stack([rng.uniform(-0.5, 1.0, 30), rng.uniform(-0.3, 0.3, 30)]), parameters.nominal
    _, found = dynamics.linearise(x, u, rho, h)
    for k in range(found.shape[2]):
        change = 1e-5 * np.eye(found.shape[2])[k]
        dx, du, drho = change[:4], change[4:6], change[6:]
        ahead, behind = (dynamics.step(x + s * dx, u + s * du, rho + s * drho, h) for s in (1, -1))
        assert found[:, :, k] == pytest.approx((ahead - behind) / 2e-5, abs=2e-4), k


def test_friction_takes_no_more_from_reverse_than_from_forward() -> None:
    cart = replace(vehicle_of(lag()), controls={"throttle": (-1.0, 0.3), "steering": (-0.4, 0.4)})
    speeds = []
    for values in ({}, {"friction": 0.15}):
        parameters = parameters_of(cart, Settings(values=values, auxiliary=tuple(values)), tuple(values))
        back = np.tile([-1.0, 0.0], (400, 1, 1))
        states = Dynamics(parameters).simulate(np.zeros((1, 4)), back, parameters.nominal, np.array([0.05]))
        speeds.append(states[-1, 0, 3])
    assert speeds[1] == pytest.approx(speeds[0], rel=0.01)


def test_friction_leaves_the_speed_at_full_throttle_as_it_is() -> None:
    vehicle = load_vehicle_config("mushr-lag")
    parameters = parameters_of(vehicle, Settings(values={"friction": 0.2}, auxiliary=("friction",)), ("friction",))
    full = np.tile([1.0, 0.0], (400, 1, 1))
    states = Dynamics(parameters).simulate(np.zeros((1, 4)), full, parameters.nominal, np.array([0.05]))
    assert states[-1, 0, 3] == pytest.approx(vehicle.parameters["v_delta"].value, rel=0.01)


@derivative
def rubbing(x, u, p):  # type: ignore[no-untyped-def]
    """A cart whose friction, a force over mass, and whose lever are its own."""
    return x[3] * cos(x[2]), x[3] * sin(x[2]), x[3] * u[1] / p[1], u[0] - p[0] * x[3]


@derivative
def rolling(x, u, p):  # type: ignore[no-untyped-def]
    """A cart that nobody needs to know anything of."""
    return x[3] * cos(x[2]), x[3] * sin(x[2]), x[3] * u[1], u[0] - x[3]


def test_a_parameter_of_the_model_is_no_extra_whatever_it_is_called() -> None:
    cart = Vehicle(
        name="cart",
        derivative=rubbing,
        state=("x", "y", "theta", "v"),
        controls={"throttle": (0.0, 1.0), "steering": (-0.4, 0.4)},
        parameters={"friction": 0.5, "lever": 0.3},
        footprint=Footprint(0.3, 0.3),
        top_speed=1.0,
    )
    assert not {"friction", "lever"} & set(auxiliary_parameters(cart))
    parameters = parameters_of(cart, Settings(auxiliary=("delay",)), ("delay",))
    assert [parameters.auxiliary_index(name) for name in ("friction", "lever", "delay")] == [-1, -1, 2]
    x, u = np.array([[0.0, 0.0, 0.1, 0.5]]), np.array([[0.7, 0.1]])
    assert ObservationModel(parameters).predict(x, parameters.nominal) == pytest.approx(x[:, :3])
    plain = DiscreteModel(cart).step(x, u, cart.parameter_array, np.array([0.05]))
    assert Dynamics(parameters).step(x, u, parameters.nominal, np.array([0.05])) == pytest.approx(plain)


def test_a_model_without_parameters_has_nothing_but_extras() -> None:
    prompt = Vehicle(
        name="prompt",
        derivative=rolling,
        state=("x", "y", "theta", "v"),
        controls={"throttle": (0.0, 1.0), "steering": (-0.4, 0.4)},
        parameters={},
        footprint=Footprint(0.3, 0.3),
        top_speed=1.0,
    )
    with pytest.raises(InputError) as error:
        check_free_parameters(prompt, Settings(auxiliary="none"))
    (problem,) = error.value.diagnostics
    assert (problem.file, problem.code, problem.argument) == ("auxiliary", Code.CONFLICT, True)
    check_free_parameters(prompt, Settings())


def test_play_is_moved_at_its_ends_alone() -> None:
    rng = np.random.default_rng(0)
    values = np.round(rng.normal(size=203), 1)
    for play, first in ((0.33, 0.123), (1.77, -0.021)):
        expected, at = [], first
        for value in values:
            at = min(max(at, value - play), value + play)
            expected.append(at)
        found, by_play, by_first = through_play(values, play, first)
        assert found == pytest.approx(expected, abs=1e-15)
        assert by_play == pytest.approx((through_play(values, play + 1e-6, first)[0] - found) / 1e-6)
        assert by_first == pytest.approx((through_play(values, play, first + 1e-6)[0] - found) / 1e-6)


def coasting(count: int, seconds: float = 15.0) -> list[CommandSeries]:
    """CommandSeries that jump about every second, every third without throttle."""
    given = [random_commands(vehicle_of(lag()), seconds, np.random.default_rng(1000 + k)) for k in range(count)]
    return [(times, np.where(np.arange(len(times))[:, None] % 3 == 2, [0.0, 1.0], 1.0) * u) for times, u in given]


def shown_by(name: str, truth: dict[str, float], model: str = "mushr-lag") -> Identification:
    """What eight drives of a car that coasts now and then show of it; `model` made them."""
    made = synthetic_logs(load_vehicle_config(model), truth, range(8), seconds=15.0, commands=coasting(8))
    result = identify(load_vehicle_config(name), made)
    assert result.converged
    return result


@pytest.mark.parametrize(
    "auxiliary",
    [
        {},
        {"delay": 0.06, "lag_steering": 0.1},
        {"lag_throttle": 0.2, "lag_steering": 0.2},
        {"dead_band_throttle": 0.12},
        {"dead_band_steering": 0.04},
        {"play_steering": 0.04},
    ],
    ids=lambda auxiliary: "+".join(auxiliary) or "none",
)
def test_a_lag_is_told_from_a_delay_and_a_dead_band_from_friction_or_play(auxiliary: dict[str, float]) -> None:
    result = shown_by("mushr-lag", {**TRUTH, **auxiliary})
    assert set(result.auxiliary) == set(auxiliary)
    for name, value in {**TRUTH, **auxiliary}.items():
        assert result.values[name] == pytest.approx(value, rel=0.02, abs=0.004)


def test_friction_brakes_a_coasting_car_which_a_dead_band_does_not() -> None:
    """The friction that made the logs is sharper about standstill, hence the tolerance."""
    truth = {**TRUTH, "friction": 0.12}
    result = shown_by("mushr-lag", truth)
    assert result.auxiliary == ("friction",)
    for name, value in truth.items():
        assert result.values[name] == pytest.approx(value, rel=0.05, abs=0.016)
    unseen = synthetic_logs(lag(), truth, range(50, 54), seconds=15.0, commands=coasting(4))
    dead = identify(
        lag(),
        synthetic_logs(lag(), truth, range(8), seconds=15.0, commands=coasting(8)),
        Settings(auxiliary=("dead_band_throttle",)),
    )
    after, without = (prediction_errors(lag(), unseen, found.values).position[3.0] for found in (result, dead))
    assert after < 0.7 * without


def test_friction_that_is_asked_for_and_not_there_is_not_shown_by_the_data() -> None:
    made = synthetic_logs(lag(), TRUTH, range(4), seconds=10.0, commands=coasting(4, 10.0))
    result = identify(lag(), made, Settings(values={"friction": 0.4}))
    assert result.auxiliary == ("friction",)
    assert result.parameters["friction"].is_zero
    chosen, without_effect = result.notes
    assert (
        without_effect
        == "friction is 0, its lower bound: the data show no such effect, and a model without it suffices"
    )
    assert not any("friction" in warning for warning in result.warnings)
    assert chosen.startswith(
        "requested auxiliary parameters, kept: friction; no other auxiliary parameter is significant; removed:"
    )


@pytest.mark.parametrize(
    ("tried", "kept", "asked", "said"),
    [
        ((), (), (), "no auxiliary parameter applies to this vehicle"),
        (("delay", "lever"), ("delay", "lever"), (), "significant auxiliary parameters, kept: delay, lever"),
        (("delay", "lever"), ("lever",), (), "significant auxiliary parameters, kept: lever; removed: delay"),
        (("delay",), (), (), "no auxiliary parameter is significant; removed: delay"),
        (("delay",), ("delay",), ("delay", "L"), "requested auxiliary parameters, kept: delay"),
        (("delay", "side"), ("delay", "side"), ("side",), "requested auxiliary parameters, kept: side; significant auxiliary parameters, kept: delay"),
        (("delay", "side"), ("side",), ("side",),
         "requested auxiliary parameters, kept: side; no other auxiliary parameter is significant; removed: delay"),
    ],
)  # fmt: skip
def test_what_became_of_the_extras_is_told_apart_from_what_was_asked_for(
    tried: tuple[str, ...], kept: tuple[str, ...], asked: tuple[str, ...], said: str
) -> None:
    assert selection_note(tried, kept, frozenset(asked)) == said


def test_friction_is_left_out_where_the_model_has_it() -> None:
    result = shown_by("mushr-drive", {**TRUTH, "u_0": 0.12}, "mushr-drive")
    assert result.auxiliary == ()
    assert result.values["u_0"] == pytest.approx(0.12, abs=0.005)


def test_a_lag_of_the_throttle_is_what_a_prompt_model_lacks() -> None:
    result = shown_by("mushr", TRUTH)
    assert "lag_throttle" in result.auxiliary
    assert result.values["lag_throttle"] == pytest.approx(TRUTH["tau"] - 0.1, abs=0.05)


@pytest.mark.parametrize(
    ("name", "value", "warned"), [("tau_yaw", 0.04, False), ("steer", 1.5, True), ("friction", 0.0, False)]
)
def test_a_parameter_at_a_bound_is_warned_of_if_something_can_be_done_about_it(
    name: str, value: float, warned: bool
) -> None:
    parameters = parameters_of(load_vehicle_config("car-lag"), Settings(), ())
    rho = parameters.nominal.copy()
    rho[parameters.names.index(name)] = value
    problem = SimpleNamespace(parameters=parameters, chains=SimpleNamespace(h=np.array([0.05])))
    solved: Any = SimpleNamespace(problem=problem, optimum=SimpleNamespace(point=SimpleNamespace(rho=rho)))
    found = [text for text in _bounds(solved) if text.startswith(f"{name} is at its")]
    assert bool(found) is warned
    assert (
        any(text.startswith(f"{name} is {value:g}") and "its lower bound" in text for text in notes_of(solved))
        is not warned
    )
