"""Recommended drives: what they are expected to show is what identification finds, and they fit into their area."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kraft.driving.car_model import model_of
from kraft.errors import Code, InputError, NegativeResult
from kraft.logs.log import Log, Part
from kraft.recording import experiment
from kraft.recording.area import Area, extent
from kraft.recording.element import Element, in_words, library, sampled
from kraft.recording.experiment import PlannedDrive, planned_drives
from kraft.recording.manoeuvres import (
    COASTING,
    DURATION,
    NAMES,
    REST,
    Manoeuvre,
    manoeuvre,
    read_commands,
    write_commands,
)
from kraft.sysid import Noise, Settings, identify
from kraft.sysid.command_units import CommandUnit
from kraft.sysid.information import Drives, Knowledge, known_after, known_before
from kraft.vehicles.config import load_vehicle_config
from kraft.vehicles.load import configured, load_vehicle
from kraft_cli.work.next_drives import _as_recorded

MODEL = load_vehicle_config("mushr-lag")
NOISE = Noise(0.005, 0.02)
HALL = Area(8.0, 6.0)
LIMITS = {"throttle": (0.0, 1.0), "steering": (-0.38, 0.38)}


@pytest.fixture(scope="module")
def known() -> Knowledge:
    return known_before(MODEL, NOISE, 30.0)


def random_drives(count: int) -> list[Manoeuvre]:
    generator, to_control = np.random.default_rng(3), model_of(configured(MODEL)).drive_control
    return [manoeuvre(NAMES[k % len(NAMES)], to_control, generator) for k in range(count)]


@pytest.fixture(scope="module")
def planned(known: Knowledge) -> list[PlannedDrive]:
    with short_search():
        return list(planned_drives(known, 2, HALL.room))


@contextmanager
def short_search() -> Iterator[None]:
    """Search among fewer drives, for what holds of any search."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "FIRST", 30)
        patch.setattr(experiment, "ROUNDS", 1)
        yield


def log_of(known: Knowledge, drive: Manoeuvre, seed: int) -> Log:
    """Drive as a log with the noise that is stated, without any error of the model."""
    path = known.simulate([drive]).paths[0]
    times = 0.05 * np.arange(len(path))
    noise = np.random.default_rng(seed).normal(size=path.shape) * [NOISE.position, NOISE.position, NOISE.yaw]
    return Log(f"log{seed}", (), tuple(LIMITS), (Part(drive.times, drive.controls, times, path + noise),))


def test_the_expected_standard_deviations_are_those_that_identification_then_reports() -> None:
    known = known_before(MODEL, NOISE, 20.0)
    drives = random_drives(3)
    expected = known.after(known.simulate(drives).information.sum(axis=0))
    logs = [log_of(known, drive, seed) for seed, drive in enumerate(drives)]
    settings = Settings(noise=NOISE, auxiliary="none", robust=None)
    found = identify(MODEL, logs, settings)
    assert expected.names == found.names
    assert np.sqrt(np.diag(found.graph_covariance)) == pytest.approx(expected.std, rel=0.05)
    after = known_after(MODEL, found, settings, drives, 20.0)
    assert after.std == pytest.approx(np.sqrt(np.diag(found.covariance)))


def test_where_logs_disagree_a_drive_to_come_counts_less(known: Knowledge) -> None:
    information = known.simulate(random_drives(1)).information[0]
    doubtful = replace(known, scale=2.0 * known.scale)
    assert doubtful.after(information).std == pytest.approx(2.0 * known.after(information).std)


def test_the_weight_of_a_prediction_is_that_of_finite_differences(known: Knowledge) -> None:
    """Of a window from rest: the first of a drive that is as long as one window."""
    drive = random_drives(1)[0]
    short = Manoeuvre("", drive.times, drive.controls, 3.1)
    weight, rho = known.prediction_weight([short]), known.parameters.nominal
    paths = []
    for change in (0.0, *1e-5 * np.eye(len(rho))):
        specs = [
            replace(spec, value=spec.value + d)
            for spec, d in zip(known.parameters.specs, np.atleast_1d(change) + np.zeros(len(rho)), strict=True)
        ]
        moved = replace(known, parameters=replace(known.parameters, specs=tuple(specs)))
        paths.append(moved.simulate([short]).paths[0][[20, 40, 60], :2])
    slopes = np.array([(path - paths[0]).ravel() / 1e-5 for path in paths[1:]])
    assert weight == pytest.approx(slopes @ slopes.T / 3.0, rel=1e-2, abs=1e-6)


def test_drives_at_full_throttle_alone_would_bend_the_parameters(known: Knowledge) -> None:
    drives = random_drives(10)
    weight, reference = known.prediction_weight(drives), 100.0 * known.simulate(drives).information.sum(axis=0)
    full = Manoeuvre("", np.array([0.0, 0.5]), np.array([[0.0, 0.0], [1.0, 0.38]]), 20.0)
    errors = [
        float(known.model_errors(weight, reference, known.simulate(some).information.sum(axis=0)[None])[0])
        for some in (drives, [full])
    ]
    assert errors[0] < 0.2 * errors[1]


def test_a_planned_drive_begins_at_rest_coasts_at_the_end_and_keeps_bounds_and_area(
    planned: list[PlannedDrive],
) -> None:
    assert len(planned) == 2
    for drive in planned:
        commands = drive.commands
        assert commands.control_at(REST - 0.01).tolist() == [0.0, 0.0]
        assert commands.control_at(commands.end - COASTING + 0.01)[0] == 0.0
        assert commands.end <= DURATION + 1e-9
        assert (np.diff(commands.times) > 0).all()
        assert (commands.controls >= [0.0, -0.38]).all()
        assert (commands.controls <= [1.0, 0.38]).all()
        assert HALL.holds(drive.path)
        throttle, steering = commands.controls[-1] + 0.0
        assert drive.words[-1] == f"throttle {throttle:.2g}, steering {steering:.2g} for {COASTING:g} s"
        assert set(drive.shown) <= set(drive.after)


def test_after_a_sine_the_words_hold_the_steering_that_is_commanded() -> None:
    sine = Element(2.0, (0.6, 1.0), (0.6, -1.0), 1.0)
    words = in_words((sine,), model_of(load_vehicle("mushr-lag")))
    *_, (_, _, turn) = sampled(sine)
    assert abs(turn) < 0.5
    assert words[-1] == f"throttle 0, steering {0.38 * turn:.2g} for {COASTING:g} s"


def test_each_planned_drive_reduces_what_the_one_before_left(planned: list[PlannedDrive]) -> None:
    first, second = planned
    assert first.before["L"] == 0.03
    assert second.before == first.after
    for drive in planned:
        assert drive.error_after < drive.error_before
        assert all(drive.after[name] < drive.before[name] for name in drive.before)


def test_two_planned_drives_are_expected_to_predict_better_than_any_two_random_ones(known: Knowledge) -> None:
    many = random_drives(20)
    weight, reference = known.prediction_weight(many), 100.0 * known.simulate(many).information.sum(axis=0)

    def error(drives: list[Manoeuvre]) -> float:
        information = known.simulate(drives).information.sum(axis=0)[None]
        parts = known.uncertainty_errors(weight, information), known.model_errors(weight, reference, information)
        return float(np.hypot(*parts)[0])

    with short_search():
        planned = [drive.commands for drive in planned_drives(known, 2, Area(60.0, 60.0).room)]
    assert error(planned) < min(error(many[k : k + 2]) for k in range(0, 20, 2))


def test_the_same_seed_plans_the_same_drives(known: Knowledge, planned: list[PlannedDrive]) -> None:
    with short_search():
        again = next(planned_drives(known, 1, HALL.room))
    assert again.elements == planned[0].elements
    assert np.array_equal(again.commands.controls, planned[0].commands.controls)


def test_in_a_small_area_drives_are_small_and_in_none_there_are_none(known: Knowledge) -> None:
    small = Area(2.6, 2.6)
    with short_search():
        drive = next(planned_drives(known, 1, small.room))
    assert small.holds(drive.path)
    assert list(planned_drives(known, 1, Area(0.05, 0.05).room)) == []


def test_a_path_fits_at_the_heading_that_suits_it() -> None:
    along = np.linspace(0.0, 4.0, 41)
    diagonal = np.column_stack([along, along, 0.0 * along]) / np.sqrt(2.0)
    assert Area(0.9, 4.5).holds(diagonal)
    assert not Area(0.7, 4.5).holds(diagonal)  # the margin is 0.1 m for each metre from the start
    assert Area(4.5, 0.9).room(1, diagonal) == pytest.approx(4.0)
    assert 1.5 < Area(2.5, 0.9).room(1, diagonal) < 2.5
    assert extent([diagonal, diagonal - 1.0]) == Area(*[float(4 / np.sqrt(2) + 1)] * 2)


def test_only_a_vehicle_that_can_drives_backwards_and_brakes() -> None:
    def least(name: str) -> float:
        return min(min(e.first[0], e.last[0]) for e in library(model_of(load_vehicle(name))))

    assert least("mushr-lag") == 0.0
    assert least("jackal") < 0.0


def test_a_lag_that_forgets_where_it_began_leaves_no_information_that_is_negative() -> None:
    """The wheels stand still, unseen, for half a second; then the car creeps."""
    lag = known_before(load_vehicle_config("car-lag"), NOISE, 30.0)
    times = np.arange(0.5, 8.5, 0.1)
    controls = np.stack([0.25 * ((times - 0.5) % 4.0), np.full(len(times), -0.19)], axis=1)
    ramp = Manoeuvre("ramp", np.concatenate([[0.0], times]), np.concatenate([np.zeros((1, 2)), controls]), 12.0)
    information = lag.simulate([ramp]).information[0]
    size = np.sqrt(np.maximum(np.diag(information), 1e-9))
    assert np.linalg.eigvalsh(information / np.outer(size, size)).min() > -1e-6


def test_parameters_that_no_pose_depends_on_are_refused(known: Knowledge, monkeypatch: pytest.MonkeyPatch) -> None:
    simulate = Knowledge.simulate

    def blind(self: Knowledge, drives: list[Manoeuvre]) -> Drives:
        found = simulate(self, drives)
        return Drives(found.paths, 1e-12 * found.information)

    monkeypatch.setattr(Knowledge, "simulate", blind)
    monkeypatch.setattr(experiment, "FIRST", 5)
    with pytest.raises(NegativeResult, match="L, phi_diff, v_delta, tau"):
        next(planned_drives(known, 1, HALL.room))


def test_a_model_without_free_parameters_is_refused(known: Knowledge) -> None:
    frozen = replace(known, parameters=replace(known.parameters, frozen=frozenset(known.names)))
    with pytest.raises(InputError) as caught:
        next(planned_drives(frozen, 1, HALL.room))
    assert [(d.file, d.code) for d in caught.value.diagnostics] == [("mushr-lag", Code.MISSING)]


def test_a_file_of_commands_gives_back_the_drive(planned: list[PlannedDrive], tmp_path: Path) -> None:
    file = tmp_path / "drive_1" / "commands.csv"
    write_commands(file, tuple(LIMITS), planned[0].commands)
    read = read_commands(file, LIMITS)
    assert (read.name, read.end) == ("drive_1", pytest.approx(planned[0].commands.end))
    for time in np.arange(0.0, read.end, 0.05):
        assert read.control_at(time).tolist() == planned[0].commands.control_at(time).tolist()
    rounded = {name: (low + 1e-6, high - 1e-6) for name, (low, high) in LIMITS.items()}
    assert read_commands(file, rounded).controls.tolist() == read.controls.tolist()  # of a file with fewer digits


@pytest.mark.parametrize(
    ("text", "line", "code"),
    [
        ("t,throttle\n0,0\n1,0\n", 1, Code.MISSING),
        ("t,throttle,steering\n0,0,0\n1,2,0\n", 3, Code.DATA),
        ("t,throttle,steering\n0,0,0\n1,0,0\n1,0,0\n", 4, Code.DATA),
        ("t,throttle,steering\n0,0,0\n1,0,x\n", 3, Code.DATA),
        ("t,throttle,steering\n0,0,0\n", None, Code.DATA),
        ("t,throttle,steering\n5,0,0\n9,0,0\n1e308,0,0\n", 4, Code.DATA),
        ("t,throttle,steering\n5,0,0\n3605.1,0,0\n", 3, Code.DATA),
        ("t,throttle,steering\n0,0,0\n1,0.5\n2,0,0\n", 3, Code.SYNTAX),
    ],
)
def test_commands_that_cannot_be_driven_are_refused(text: str, line: int | None, code: Code, tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_commands(file, LIMITS)
    assert [(d.file, d.line, d.code) for d in caught.value.diagnostics] == [(str(file), line, code)]


def test_a_file_of_commands_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        read_commands(tmp_path / "none.csv", LIMITS)
    assert caught.value.diagnostics[0].code == Code.NOT_FOUND


def test_drives_are_told_and_written_in_the_units_of_the_logs(planned: list[PlannedDrive]) -> None:
    model = model_of(load_vehicle("mushr-lag"))
    units = {"throttle": CommandUnit(1500.0, 0.0025), "steering": CommandUnit()}
    told = _as_recorded(planned[0], model, units)
    assert _as_recorded(planned[0], model, {name: CommandUnit() for name in units}) is planned[0]
    np.testing.assert_allclose(told.commands.controls[:, 0], 1500.0 + planned[0].commands.controls[:, 0] / 0.0025)
    np.testing.assert_array_equal(told.commands.controls[:, 1], planned[0].commands.controls[:, 1])
    assert told.words[-1].startswith("throttle 1500, steering ")
