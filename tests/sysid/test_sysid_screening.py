"""Logs before an identification: units of commands, columns, clocks, two cars, and stretches that no model explains."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.disturbances import Disturbance, drive
from benchmarks.synthetic_logs import synthetic_logs
from kraft.errors import Code, InputError
from kraft.logs.log import Finding, Log
from kraft.logs.reader import read_logs
from kraft.recording.recorder import Recorder, write_recording
from kraft.scenario import load_scenario
from kraft.sysid import identify, prediction_errors
from kraft.sysid.command_units import CommandUnit, command_units, sign_warnings, unit_notes, with_units
from kraft.sysid.screening import check_consistency, check_direction, two_cars
from kraft.sysid.smoothing import thinned
from kraft.sysid.unexplained import Stretch, unexplained_stretches, without
from kraft.vehicles.config import VehicleConfig, load_vehicle_config
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import Footprint

TRUTH = {"L": 0.3, "v_delta": 0.9, "tau": 0.5}
Change = Callable[[np.ndarray], np.ndarray]


@cache
def lag() -> VehicleConfig:
    return load_vehicle_config("mushr-lag")


@cache
def logs() -> tuple[Log, ...]:
    return tuple(synthetic_logs(lag(), {**TRUTH, "delay": 0.1}, range(6), seconds=12.0))


@cache
def unseen() -> tuple[Log, ...]:
    return tuple(synthetic_logs(lag(), {**TRUTH, "delay": 0.1}, range(50, 53), seconds=12.0))


def commanded(given: Sequence[Log], throttle: Change = np.asarray, steering: Change = np.asarray) -> list[Log]:
    """The logs with other numbers for the same commands."""
    return [
        replace(
            log,
            parts=tuple(
                replace(p, commands=np.column_stack([throttle(p.commands[:, 0]), steering(p.commands[:, 1])]))
                for p in log.parts
            ),
        )
        for log in given
    ]


def later(given: Sequence[Log], time: float) -> list[Log]:
    """The logs with commands that are recorded later."""
    return [
        replace(log, parts=tuple(replace(p, command_times=p.command_times + time) for p in log.parts)) for log in given
    ]


UNITS: dict[str, tuple[Change, Change]] = {
    "pulse widths": (lambda u: 1500 + 400 * u, lambda s: 1500 - 900 * s),
    "per cent and degrees": (lambda u: 100 * u, np.rad2deg),
    "share of the full steering": (np.asarray, lambda s: s / 0.36),
    "angle of a servo": (lambda u: -u, lambda s: 90 - np.rad2deg(s)),
    "ticks": (lambda u: 307 + 100 * u, lambda s: 310 + 250 * s),
}


@pytest.mark.parametrize("unit", UNITS)
def test_commands_in_any_unit_identify_a_car_that_predicts_as_well(unit: str) -> None:
    throttle, steering = UNITS[unit]
    numbers = commanded(logs(), throttle, steering)
    units = command_units(numbers)
    found = identify(lag(), with_units(numbers, units))
    errors = prediction_errors(lag(), with_units(commanded(unseen(), throttle, steering), units), found.values)
    physical = prediction_errors(lag(), unseen(), identify(lag(), logs()).values)
    assert errors.position[3.0] < 1.15 * physical.position[3.0]
    flipped = steering(np.array([1.0]))[0] < steering(np.array([0.0]))[0]
    assert (units["steering"].scale < 0.0) == flipped
    assert any("steering has the opposite sign" in text for text in sign_warnings(units)) == flipped


def test_pulse_widths_are_told_as_a_mapping_file_states_them() -> None:
    throttle, steering = UNITS["pulse widths"]
    units = command_units(commanded(logs(), throttle, steering))
    assert (units["throttle"].neutral, units["steering"].neutral) == (1500.0, 1500.0)
    assert len(unit_notes(units)) == 2
    assert "commands.controls.steering: {column: ..., zero: 1500, scale: -0.00" in unit_notes(units)[1]


def test_the_scale_of_the_steering_is_that_of_a_car_with_the_stated_wheelbase() -> None:
    given = commanded(logs(), *UNITS["pulse widths"])
    assumed, stated = (command_units(given, wheelbase)["steering"] for wheelbase in (0.33, 0.165))
    assert stated.neutral == assumed.neutral
    assert stated.scale == pytest.approx(0.5 * assumed.scale, rel=0.01)


def test_a_neutral_throttle_is_found_although_friction_holds_the_car_at_others() -> None:
    """Ramps in which the car rests up to a third of full throttle; nine tenths of this time have another command."""
    held = load_vehicle("car", parameters={"friction": 1.2, "a_drive": 4.0, "dead_zone": 0.0, "damping": 1.0})
    ramp = np.concatenate([np.zeros(20), np.round(np.abs(np.linspace(-0.5, 0.5, 280)), 3)])
    times = 0.05 * np.arange(len(ramp))
    given = [(times, np.column_stack([ramp, np.sin(times + k)])) for k in range(4)]
    driven = synthetic_logs(held, {}, range(4), seconds=15.0, noise=(0.001, 0.003), commands=given)
    units = command_units(commanded(driven, lambda u: np.round(1500 + 400 * u), lambda s: np.round(1500 + 400 * s)))
    assert units["throttle"].neutral == 1500.0


def test_physical_commands_stay_as_they_are() -> None:
    units = command_units(logs())
    assert units == {"throttle": CommandUnit(), "steering": CommandUnit()}
    assert unit_notes(units) == sign_warnings(units) == ()
    assert with_units(logs(), units) == logs()


def refusal(given: Sequence[Log]) -> str:
    with pytest.raises(InputError) as error:
        check_consistency(given)
    (problem,) = error.value.diagnostics
    assert problem.code == Code.MISMATCH
    return str(problem)


def test_good_logs_pass() -> None:
    for given in (logs(), logs()[:1], later(logs(), 0.05), later(logs(), -0.3)):
        check_consistency(given)


@pytest.mark.parametrize(("time", "said"), [(1.03, "later"), (-1.07, "earlier"), (2.5, "later")])
def test_clocks_that_are_apart_are_said_with_the_offset(time: float, said: str) -> None:
    message = refusal(later(logs(), time))
    found = re.search(r"recorded ([\d.]+) s (\w+) than they act.*zero: (-?[\d.]+)}", message)
    assert found is not None
    assert found[2] == said
    assert float(found[3]) == pytest.approx(time, abs=0.03)
    assert abs(float(found[3])) == float(found[1])


def sides(left: Change = np.asarray, right: Change = np.asarray) -> list[Log]:
    """Logs of a robot with two driven sides, with other numbers for the same commands."""
    return commanded(synthetic_logs(load_vehicle_config("differential"), {}, range(4), seconds=12.0), left, right)


@pytest.mark.parametrize(
    ("left", "right", "neutral", "signs"),
    [
        (lambda u: np.round(1500 + 200 * u), lambda u: np.round(1500 + 200 * u), 1500.0, (1.0, 1.0)),
        (lambda u: np.round(1500 + 200 * u), lambda u: np.round(1500 - 200 * u), 1500.0, (1.0, -1.0)),
        (lambda u: 50 * u, lambda u: 50 * u, 0.0, (1.0, 1.0)),
    ],
)
def test_commands_of_both_sides_in_any_unit_are_shares_of_the_largest(
    left: Change, right: Change, neutral: float, signs: tuple[float, float]
) -> None:
    given = sides(left, right)
    units = command_units(given)
    assert [units[name].neutral for name in ("left", "right")] == pytest.approx([neutral] * 2, abs=0.05 * neutral)
    assert tuple(np.sign([units[name].scale for name in ("left", "right")])) == signs
    assert abs(units["left"].scale) == abs(units["right"].scale)
    numbers = np.concatenate([part.commands for log in with_units(given, units) for part in log.parts])
    assert np.abs(numbers).max() == pytest.approx(1.0, rel=1e-3)
    assert len(sign_warnings(units)) == signs.count(-1.0)


def test_speeds_of_both_sides_stay_as_they_are() -> None:
    assert all(unit.as_is for unit in command_units(sides()).values())
    assert all(unit.as_is for unit in command_units(sides(lambda u: 10 * u, lambda u: 10 * u)).values())


def test_swapped_commands_are_said() -> None:
    swapped = [
        replace(log, parts=tuple(replace(p, commands=p.commands[:, ::-1].copy()) for p in log.parts)) for log in logs()
    ]
    assert "throttle and steering are swapped" in refusal(swapped)


@pytest.mark.parametrize("other", [{"L": 0.45}, {"v_delta": 0.55}])
def test_two_cars_are_told_apart_by_their_logs(other: dict[str, float]) -> None:
    second = synthetic_logs(lag(), {**TRUTH, "delay": 0.1, **other}, range(20, 24), seconds=12.0)
    mixed = [log for pair in zip(logs()[:4], second, strict=True) for log in pair]
    message = refusal(mixed)
    groups = [", ".join(log.name for log in group) for group in (logs()[:4], second)]
    assert all(group in message for group in groups)
    check_consistency(second)
    assert two_cars(mixed) == message.removeprefix("logs: ")
    assert not two_cars(second)


@pytest.mark.parametrize(
    ("car", "top_speed", "half"),
    [
        ({"preset": "f1tenth", "servo": {"rate_deg": 10}}, 3.0, 6.0),
        ({"preset": "f1tenth", "drive": {"top_speed": 5, "time_constant": 0.6}, "tyres": {"friction": 0.3}}, 5.0, 20.0),
    ],
    ids=["slow servo", "slides"],
)
def test_one_car_with_a_slow_servo_or_that_slides_is_not_taken_for_two(
    car: dict[str, Any], top_speed: float, half: float, tmp_path: Path
) -> None:
    hall = {"truth.car": car, "bounds": {"x": [-half, half], "y": [-half, half]}, "obstacles": []}
    scenario = load_scenario("training", hall)
    expected = {"v_delta": top_speed, "tau": 0.5, "L": 0.33, "u_0": 0.02}
    recorder = Recorder(scenario, load_vehicle("kraft.vehicles.mushr:MUSHR_DRIVE", parameters=expected), 0)
    for number in range(1, 11):
        write_recording(tmp_path, scenario, {}, recorder.record(number))
    recorded = read_logs(tmp_path).logs
    check_consistency(recorded)
    assert two_cars(recorded) == ""


def test_a_fast_car_whose_tyres_hold_little_is_not_taken_for_two(tmp_path: Path) -> None:
    """Its yaw rate is that of its steering in slow turns and that of its grip in fast ones."""
    buggy = {
        "length": 0.85, "width": 0.55, "wheelbase": 0.56, "track": 0.42, "mass": 9.5, "tyres": {"friction": 0.4},
        "wheels": {"radius": 0.09, "width": 0.06, "mass": 0.45}, "drive": {"top_speed": 8, "time_constant": 1.2},
        "servo": {"angle_max_deg": 28, "rate_deg": 350},
    }  # fmt: skip
    hall = {"truth.car": buggy, "bounds": {"x": [-30, 30], "y": [-30, 30]}, "obstacles": []}
    expected = {"v_delta": 8.0, "tau": 1.2, "L": 0.56, "u_0": 0.02}
    vehicle = load_vehicle("kraft.vehicles.mushr:MUSHR_DRIVE", parameters=expected)
    wide = replace(vehicle, controls={"throttle": (-0.5, 1.0), "steering": (-0.48, 0.48)})
    scenario = load_scenario("training", hall)
    recorder = Recorder(scenario, replace(wide, footprint=Footprint(0.87, 0.57)), 1)
    for number in range(1, 11):
        write_recording(tmp_path, scenario, {}, recorder.record(number))
    check_consistency(read_logs(tmp_path).logs)


def test_a_yaw_of_something_else_is_refused() -> None:
    astray = [replace(log, findings=(Finding("heading", 1, "yaw of a wheel"),)) for log in logs()]
    with pytest.raises(InputError) as error:
        check_direction(astray)
    assert [(each.file, each.problem) for each in error.value.diagnostics] == [
        (log.name, "yaw of a wheel") for log in logs()
    ]
    check_direction([*astray[:3], *logs()[3:]])


def disturbed(seed: int, kind: str = "") -> Log:
    """A drive of `mushr-lag`, with something that no command explains from 9 to 11 s."""
    given = (Disturbance(kind, 9.0, 11.0),) if kind else ()
    return drive(f"{kind or 'good'}-{seed}", "mushr-lag", seed, given, seconds=24.0)


@cache
def disturbances() -> tuple[Log, ...]:
    kinds = ("held", "carried", "pushed", "turned", "glitch")
    return tuple(disturbed(k, kind) for k, kind in enumerate(kinds)) + tuple(disturbed(k) for k in range(10, 13))


@cache
def stretches() -> tuple[Stretch, ...]:
    return unexplained_stretches(disturbances())


def test_stretches_that_no_model_explains_are_found_with_their_times() -> None:
    found = stretches()
    assert {s.log for s in found} == {log.name for log in disturbances() if not log.name.startswith("good")}
    for s in found:
        assert s.begin > 8.0
        assert s.end < 13.0
    for log in disturbances()[:5]:
        covered = sum(min(s.end, 11.0) - max(s.begin, 9.0) for s in found if s.log == log.name and s.begin < 11.0)
        assert covered > 0.7  # of 2 s; a glitch comes and goes slowly


def test_a_car_that_is_held_is_slower_than_commanded_and_then_faster() -> None:
    held = [s for s in stretches() if s.log.startswith("held")]
    assert held[0].what == "slower than commanded"
    early = drive("early", "mushr-lag", 7, (Disturbance("held", 0.0, 2.5),), seconds=24.0)
    found = unexplained_stretches((early, *disturbances()[5:]))
    assert found[0].log == "early"
    assert found[0].begin < 0.5


def test_nothing_is_left_out_of_good_logs() -> None:
    assert unexplained_stretches(logs()) == ()
    sparse = [replace(log, parts=tuple(thinned(part, 0.2) for part in log.parts)) for log in disturbances()]
    assert unexplained_stretches(sparse) == ()
    assert without(logs(), ()) == logs()


def test_without_those_stretches_the_parameters_predict_better() -> None:
    truth = [disturbed(seed) for seed in range(30, 33)]
    held, carried, good = disturbances()[0], disturbances()[1], disturbances()[-1]
    whole = identify(lag(), (held, carried, good))
    cut = identify(lag(), without((held, carried, good), stretches()))
    errors = [prediction_errors(lag(), truth, found.values).position[3.0] for found in (whole, cut)]
    assert errors[1] < 0.5 * errors[0]
    assert cut.values["L"] == pytest.approx(TRUTH["L"], rel=0.02)
