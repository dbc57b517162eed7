"""Terms of the drive of a car: weaker backwards, a speed controller's largest acceleration, coasting at neutral."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.cars import TRUTH, car, drive

from benchmarks.synthetic_logs import synthetic_logs
from kraft.logs.log import Log
from kraft.sysid import Settings, drive_regression, prediction_errors, structure, unexplained
from kraft.sysid.log_motion import reverses
from kraft.sysid.optimiser import RhoFactors
from kraft.sysid.structure import StructureSearch
from kraft.sysid.terms import identify_terms
from kraft.sysid.unexplained import unexplained_stretches
from kraft.vehicles.config import VehicleConfig, load_vehicle_config


def car_file() -> VehicleConfig:
    return load_vehicle_config("car")


def test_a_drive_that_is_weaker_backwards_is_found() -> None:
    logs = [drive(car(reverse=0.5), seed, 20.0, low=(-1.0, -1.0)) for seed in range(6)]
    found = identify_terms(car_file(), logs).identification
    assert found.values["reverse"] == pytest.approx(0.5, rel=0.05)
    assert found.values["brake"] == 1.0
    assert found.values["a_drive"] == pytest.approx(TRUTH["a_drive"], rel=0.05)


def test_throttle_backwards_that_only_brakes_does_not_show_the_drive_backwards() -> None:
    logs = [drive(car(), seed, low=(-0.1, -1.0)) for seed in range(2)]  # friction holds the car against -0.1
    assert not reverses(logs)
    assert reverses([drive(car(), seed, low=(-1.0, -1.0)) for seed in range(2)])
    search = StructureSearch(car_file(), logs, Settings(auxiliary="none"), lambda *_: None)
    assert "brake" in search.candidates
    assert "reverse" not in search.candidates


CONTROLLER = {"a_drive": 18.0, "damping": 6.0, "friction": 0.0, "effort": 0.5}
"""A speed controller: 3 m/s at full command, at most 2 m/s^2."""


def test_the_largest_acceleration_of_a_speed_controller_is_found() -> None:
    logs = [drive(car(**CONTROLLER), seed, low=(-0.3, -1.0)) for seed in range(6)]
    found = identify_terms(car_file(), logs[:5]).identification
    assert found.values["effort"] == pytest.approx(CONTROLLER["effort"], rel=0.03)
    assert found.values["a_drive"] / found.values["damping"] == pytest.approx(3.0, rel=0.02)
    assert prediction_errors(car_file(), logs[5:], found.values).position[3.0] < 0.05


def test_a_limit_that_hides_the_drive_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Friction takes most of the acceleration, and brakes are stronger: without the limit the drive seems weak."""
    model = car(a_drive=4.7, damping=1.1, friction=1.3, drag=0.3, brake=2.0, effort=0.58)
    logs = [drive(model, seed, 20.0, low=(-0.6, -1.0)) for seed in range(5)]
    found = identify_terms(car_file(), logs).identification
    assert found.values["effort"] == pytest.approx(0.58, rel=0.05)
    assert found.values["a_drive"] == pytest.approx(4.7, rel=0.1)
    monkeypatch.setattr(drive_regression, "CLEARLY_BETTER", 0.0)
    hidden = identify_terms(car_file(), logs).identification
    assert hidden.values["effort"] != pytest.approx(0.58, rel=0.05)


def test_the_drive_of_a_car_whose_speed_follows_the_throttle_soon_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its changes of speed, most of them within the delay, look like those of a limited acceleration."""
    truth = {"a_drive": 3.8, "damping": 10.0, "friction": 0.0, "dead_zone": 0.0, "back_emf": 0.0, "drag": 0.0,
             "understeer": 0.0, "slide": 0.0, "slip": 0.0, "steer": 0.18, "delay": 0.11}  # fmt: skip
    throttles, rng = (0.75, 0.875, 1.0), np.random.default_rng(1)
    levels = [[(throttle, steering)] * 3 for steering in (-1.0, -0.5, 0.0, 0.5, 1.0) for throttle in throttles]
    levels += [[(rng.choice(throttles), 0.0) for _ in range(3)] for _ in range(8)]
    levels += [[(throttle, rng.choice([-1.0, 0.0, 1.0])) for _ in range(3)] for throttle in throttles * 4]
    commands = [(np.array([0.02, 1.0, 2.0]), np.array(each)) for each in levels]
    logs = synthetic_logs(
        car_file(), truth, range(len(levels)), seconds=3.0, noise=(0.003, 0.002), rate=40.0, commands=commands
    )
    assert errors_of_all_terms(car_file(), logs) < 0.005
    monkeypatch.setattr(drive_regression, "FOLLOWING_MAX", 0.0)
    monkeypatch.setattr(RhoFactors, "led_by_prior", False)  # steps without such terms find back from the limit as well
    assert errors_of_all_terms(car_file(), logs) > 0.03


def test_the_limit_of_a_quick_drive_is_found_once_its_delay_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The delay of the commands is as long as the drive takes: without it the regression gives a limit far too high."""
    off = {name: spec.neutral for name, spec in car_file().parameters.items() if spec.neutral is not None}
    truth = {"steer": 0.3, "a_drive": 34.6, "damping": 8.5, "back_emf": 3.7, "dead_zone": 0.25, "drag": 0.18,
             "coast": 3.5, "effort": 1.24, "delay": 0.18}  # fmt: skip
    commands = [short_drive(np.random.default_rng(seed)) for seed in range(16)]
    logs = synthetic_logs(
        car_file(), off | truth, range(16), seconds=3.0, noise=(0.003, 0.006), rate=20.0, commands=commands
    )
    assert errors_of_all_terms(car_file(), logs) < 0.006
    regressed = structure.values_with_drive
    made: list[int] = []

    def once(*given: Any) -> list[np.ndarray]:
        made.append(len(made))
        return regressed(*given) if len(made) == 1 else []

    monkeypatch.setattr(structure, "values_with_drive", once)
    assert errors_of_all_terms(car_file(), logs) > 0.01


def short_drive(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Levels of both commands about every 0.8 s, one in eight of the throttle neutral."""
    times = np.array([0.0, *np.cumsum([0.1, *(0.8 * rng.uniform(0.5, 1.5, 10))])])
    levels = rng.uniform([0.3, -1.0], 1.0, (len(times), 2))
    levels[rng.random(len(times)) < 0.12, 0] = 0.0
    levels[0] = 0.5, 0.0
    return times[times < 3.0], levels[times < 3.0]


def errors_of_all_terms(vehicle: VehicleConfig, logs: list[Log]) -> float:
    """Mean error after 2 s of a fit of all terms, m."""
    return float(np.nanmean(StructureSearch(vehicle, logs, Settings(), lambda *_: None).full().errors[:, 1]))


def test_the_time_that_a_speed_controller_takes_is_no_disturbance(monkeypatch: pytest.MonkeyPatch) -> None:
    model = car(**CONTROLLER | {"effort": 0.2})
    logs = [drive(model, seed, 20.0, low=(-0.5, -1.0)) for seed in range(8)]
    assert unexplained_stretches(logs) == ()
    monkeypatch.setattr(unexplained, "SWEEPS", ())
    assert len(unexplained_stretches(logs)) == 2


@pytest.mark.parametrize("coast", [1.5, -1.0])
def test_damping_at_neutral_throttle_is_found_apart(coast: float) -> None:
    model = car(coast=coast)
    logs = [drive(model, seed, neutral=3) for seed in range(6)]
    found = identify_terms(car_file(), logs[:5]).identification
    assert found.values["coast"] == pytest.approx(coast, abs=0.1)
    assert found.values["damping"] == pytest.approx(TRUTH["damping"], rel=0.03)
    assert prediction_errors(car_file(), logs[5:], found.values).position[3.0] < 0.03


def test_a_car_that_coasts_as_it_is_driven_needs_no_such_term() -> None:
    found = identify_terms(car_file(), [drive(car(), seed, neutral=3) for seed in range(5)]).identification
    assert "coast" in found.off


def test_brakes_at_neutral_throttle_are_no_disturbance(monkeypatch: pytest.MonkeyPatch) -> None:
    logs = [drive(car(coast=10.0), seed, 20.0, neutral=9) for seed in range(8)]
    assert unexplained_stretches(logs) == ()
    monkeypatch.setattr(unexplained, "NEUTRAL", -1.0)
    assert len(unexplained_stretches(logs)) > 0
