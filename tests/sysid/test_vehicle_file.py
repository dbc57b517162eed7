"""An identified vehicle file is one like every other: loaded, checked, planned with; and it says where it comes from."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.sysid import estimated, fake_evaluation, fake_identification, fake_log, fake_windows

from kraft.config import bundled
from kraft.driving.estimation.adaptive import online_parameters
from kraft.driving.estimation.dead_reckoning import with_identified_drift
from kraft.driving.estimator_settings import Adaptive
from kraft.errors import Code, InputError
from kraft.logs.log import Log
from kraft.sysid.acceptance import (
    PredictionEvaluation,
    PredictionPair,
    errors_by_speed,
    fitted_warnings,
    objections,
    odd_log_warning,
    prediction_warnings,
    replacement_objections,
)
from kraft.sysid.base_vehicle import BaseVehicle, load_base_vehicle, with_recorded
from kraft.sysid.data import LogSplit, split_logs
from kraft.sysid.interface import ModelTrial, Noise, ParameterEstimate, Settings
from kraft.sysid.parameters import parameters_of
from kraft.sysid.prediction import Window
from kraft.sysid.vehicle_file import (
    check_vehicle_target,
    identification_record,
    updated_parameter,
    vehicle_text,
    write_vehicle,
)
from kraft.vehicles.config import Parameter, VehicleConfig, load_vehicle_config
from kraft.vehicles.identification_record import SpeedPrediction
from kraft.vehicles.load import RecordedVehicle, load_vehicle, natural_robot
from kraft_cli.main import main

LOGS = tuple(fake_log(f"run_{k}", 0.1 * k) for k in range(1, 5))
SPLIT = LogSplit(LOGS[:3], LOGS[3:], "")
RESULT = fake_identification(LOGS[:3], warnings=("a: b, c # d",), interval="sandwich")
EVALUATION = fake_evaluation(SPLIT)
RECORD = identification_record("mushr", RESULT, SPLIT, EVALUATION)
CODE = """from ompl_ext.vehicle import Footprint, Vehicle, derivative


@derivative
def motion(x, u, p):
    return u[0] * p[0], u[1], 0.0


ROBOT = Vehicle(name="robot", derivative=motion, state=("x", "y", "theta"), controls={"a": (0.0, 1.0), "b": (-1.0, 1.0)},
                parameters={"gain": 2.0}, rest=(), footprint=Footprint(0.4, 0.3, 0.1), top_speed=2.5)
"""


def written(
    path: Path, reference: str = "mushr", parameters: dict[str, ParameterEstimate] | None = None
) -> VehicleConfig:
    write_vehicle(path, load_base_vehicle(reference), parameters or dict(RESULT.parameters), RECORD)
    return load_vehicle_config(path)


def test_the_file_is_the_vehicle_with_other_numbers(tmp_path: Path) -> None:
    config, before = written(tmp_path / "mine.yaml"), load_vehicle_config("mushr")
    assert (config.name, config.model, config.footprint, config.top_speed) == (
        "mine", before.model, before.footprint, before.top_speed,
    )  # fmt: skip
    assert config.values == {"L": 0.33, "phi_diff": 0.004, "v_delta": 0.6}
    assert config.description == "mushr identified from 3 logs"
    vehicle = load_vehicle(str(tmp_path / "mine.yaml"))
    assert vehicle.top_speed == 0.6
    assert main(["validate", str(tmp_path / "mine.yaml")]) == 0


@pytest.mark.parametrize("name", ["300", "1e3", "null", "car-2"])
def test_a_name_that_yaml_would_read_as_something_else_stays_a_name(name: str, tmp_path: Path) -> None:
    assert written(tmp_path / f"{name}.yaml").name == name


def test_the_file_says_where_its_numbers_come_from(tmp_path: Path) -> None:
    found = written(tmp_path / "mine.yaml").identification
    assert found is not None
    write_vehicle(tmp_path / "again.yaml", load_base_vehicle("mushr"), RESULT.parameters, found)
    assert load_vehicle_config(tmp_path / "again.yaml").identification == found  # nine digits are kept
    assert (found.started_from, found.interval) == ("mushr", "sandwich")
    assert np.allclose(found.covariance.matrix, RESULT.covariance)
    assert found.extras["delay"].value == 0.1
    assert found.extras["delay"].description == "time until a command takes effect"
    assert found.held_out is not None
    assert found.held_out_before is not None
    assert found.held_out.overall_position < 0.2 * found.held_out_before.overall_position
    assert sum(errors.windows for errors in found.by_speed) > 0
    assert all(errors.after[0] == 1.0 for errors in found.by_speed)
    assert [(log.name, log.held_out) for log in found.logs] == [
        ("run_1", False), ("run_2", False), ("run_3", False), ("run_4", True),
    ]  # fmt: skip
    assert found.logs[0].files == {"poses.csv": LOGS[0].sources[0].sha256}
    assert found.warnings == ("a: b, c # d",)
    assert {"kraft", "numpy", "gtsam"} <= set(found.versions)


def test_the_same_result_writes_the_same_bytes(tmp_path: Path) -> None:
    written(tmp_path / "mine.yaml")
    before = (tmp_path / "mine.yaml").read_bytes()
    written(tmp_path / "mine.yaml")
    assert (tmp_path / "mine.yaml").read_bytes() == before


def test_it_can_be_planned_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(tmp_path / "mine.yaml")
    written(tmp_path / "mine.yaml")
    assert main(["plan", "turns", "--vehicle", path, "--iterations", "500"]) == 0
    assert "L 0.33, phi_diff 0.004, v_delta 0.6" in capsys.readouterr().out


PARAMETER = Parameter(value=0.36, unit="m", min=0.15, max=0.6, std=0.03)


@pytest.mark.parametrize(
    ("value", "std", "expected"),
    [
        (0.33, 0.004, (0.15, 0.6, 0.012)),  # three times as wide as the estimate
        (0.33, 0.0001, (0.15, 0.6, 0.003)),  # a tenth of before
        (0.33, 0.02, (0.15, 0.6, 0.03)),  # never wider than before
        (0.1, 0.004, (0.1, 0.6, 0.012)),  # what turned out was plausible
        (0.7, 0.004, (0.15, 0.7, 0.012)),
    ],
)
def test_bounds_hold_the_value_and_the_prior_becomes_tighter(
    value: float, std: float, expected: tuple[float, float, float]
) -> None:
    found = updated_parameter(PARAMETER, estimated(value, std))
    assert (found.min, found.max, found.std) == expected
    assert found.value == value


def test_a_frozen_parameter_stays_as_it_is() -> None:
    assert updated_parameter(PARAMETER, estimated(0.36, 0.0, frozen=True)).std == 0.03
    bare = updated_parameter(Parameter(value=1.0, unit="m"), estimated(1.0, 0.0, frozen=True))
    assert (bare.min, bare.max, bare.std) == (None, None, None)
    assert updated_parameter(PARAMETER, estimated(0.33, 0.004), tighten=False).std == 0.03


@pytest.mark.parametrize(("std", "expected"), [(0.01, 0.03), (0.001, 0.018)])
def test_bounds_and_a_prior_that_nobody_stated_follow_from_the_identification(std: float, expected: float) -> None:
    estimate = estimated(0.9, std)
    found = updated_parameter(Parameter(value=1.0, unit="m"), estimate)
    assert (found.min, found.max, found.std) == (estimate.min, estimate.max, expected)
    half = updated_parameter(Parameter(value=1.0, unit="m", min=0.8), estimate)
    assert (half.min, half.max, half.std) == (0.8, max(estimate.max, 0.9), expected)


def test_a_bundled_file_written_anew_keeps_its_head_and_its_priors() -> None:
    before = load_vehicle_config("mushr")
    base = load_base_vehicle("mushr")
    lines = vehicle_text(
        bundled.folder("vehicle"), before.name, before.description, ["# head"], base, RESULT.parameters, RECORD,
        tighten=False,
    ).splitlines()  # fmt: skip
    old = (bundled.folder("vehicle") / "mushr.yaml").read_text().splitlines()
    assert lines[0] == "# head"
    assert lines[1:4] == [line for line in old if not line.startswith("#")][:3]
    assert "  L: {value: 0.33, unit: m, min: 0.15, max: 0.6, std: 0.03, description: wheelbase}" in lines
    assert [line for line in old if line.startswith(("model", "top_speed"))] == [
        line for line in lines if line.startswith(("model", "top_speed"))
    ]


@pytest.mark.parametrize("name", ["jackal", "mushr-force", "f1tenth"])
def test_the_true_robot_and_what_else_the_vehicle_states_is_kept(name: str, tmp_path: Path) -> None:
    before = load_vehicle_config(name)
    known = {symbol: estimated(p.value, 0.1, unit=p.unit) for symbol, p in before.parameters.items()}
    after = written(tmp_path / "mine.yaml", name, known)
    assert (after.gravity_share, after.delay) == (before.gravity_share, before.delay)
    robots = [natural_robot(load_vehicle(each))[0] for each in (name, str(tmp_path / "mine.yaml"))]
    assert robots[0] == robots[1]
    assert name == "mushr-force" or after.truth is not None


def test_a_true_robot_that_is_a_vehicle_file_is_found_from_the_new_file(tmp_path: Path) -> None:
    (tmp_path / "true.yaml").write_text((bundled.folder("vehicle") / "mushr.yaml").read_text())
    text = (bundled.folder("vehicle") / "mushr.yaml").read_text()
    (tmp_path / "base.yaml").write_text(
        text + "truth: {model: true.yaml, parameters: {L: 0.3}, process_noise: {v: 0.01}}\n"
    )
    (tmp_path / "deeper").mkdir()
    known = dict(RESULT.parameters)
    found = written(tmp_path / "deeper" / "mine.yaml", str(tmp_path / "base.yaml"), known).truth
    assert found is not None
    assert (found.model, dict(found.parameters), dict(found.process_noise)) == ("../true.yaml", {"L": 0.3}, {"v": 0.01})


def test_code_becomes_a_file_that_finds_it_from_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "robot.py").write_text(CODE)
    config = written(tmp_path / "out" / "r.yaml", "code/robot.py:ROBOT", {"gain": estimated(1.5, 0.1, unit="")})
    assert config.model == "../code/robot.py:ROBOT"
    assert (config.footprint.offset, config.top_speed, config.parameters["gain"].unit) == (0.1, 2.5, "1")
    assert load_vehicle("out/r.yaml").parameters == {"gain": 1.5}
    again: BaseVehicle = load_base_vehicle("out/r.yaml")
    write_vehicle(tmp_path / "s.yaml", again, {"gain": estimated(1.4, 0.1)}, RECORD)
    assert load_vehicle_config(tmp_path / "s.yaml").model == "code/robot.py:ROBOT"


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("a.yaml", "name: mine\n", Code.EXISTS),
        ("a.json", None, Code.MISMATCH),
    ],
)
def test_a_file_of_somebody_else_is_not_replaced(
    name: str, content: str | None, expected: Code, tmp_path: Path
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError) as caught:
        check_vehicle_target(path)
    assert [(problem.file, problem.code) for problem in caught.value.diagnostics] == [(str(path), expected)]


def test_an_identified_file_may_be_replaced(tmp_path: Path) -> None:
    written(tmp_path / "mine.yaml")
    check_vehicle_target(tmp_path / "mine.yaml")
    unicycle = bundled.folder("vehicle") / "unicycle2.yaml"
    with pytest.raises(InputError) as caught:
        check_vehicle_target(unicycle)
    assert [problem.code for problem in caught.value.diagnostics] == [Code.EXISTS]


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("interval: sandwich", "interval: guess", "identification.interval"),
        ("names: [L, phi_diff, v_delta]", "names: [L, phi_diff]", "identification.covariance.matrix"),
        ("started_from: mushr", "began_with: mushr", "identification.began_with"),
    ],
)
def test_a_damaged_record_is_explained(old: str, new: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    written(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_vehicle_config(path)
    assert expected in [problem.path for problem in caught.value.diagnostics]


@pytest.mark.parametrize(
    ("count", "fraction", "held"),
    [(1, None, 0), (3, None, 0), (4, None, 1), (8, None, 2), (40, None, 10), (41, 0.5, 20), (2, 0.5, 1), (2, 0.99, 1),
     (3, 0.01, 1), (10, 0.0, 0), (1, 0.0, 0)],
)  # fmt: skip
def test_a_quarter_is_held_out_of_four_logs_or_more(count: int, fraction: float | None, held: int) -> None:
    logs = tuple(fake_log(f"run_{k:02d}", 0.1, 1.0) for k in range(count))
    log_split = split_logs(logs, fraction)
    assert len(log_split.held_out) == held
    assert sorted((*log_split.fitted, *log_split.held_out), key=lambda log: log.name) == list(logs)
    assert split_logs(logs, fraction).held_out == log_split.held_out
    assert all(log.name in log_split.note for log in log_split.held_out)


@pytest.mark.parametrize(("count", "fraction"), [(4, 1.0), (4, -0.1), (4, float("nan")), (1, 0.5)])
def test_an_impossible_holdout_is_refused(count: int, fraction: float) -> None:
    with pytest.raises(InputError) as caught:
        split_logs(LOGS[:count], fraction)
    assert [(problem.file, problem.argument) for problem in caught.value.diagnostics] == [("holdout", True)]


def test_what_the_logs_do_not_show_is_an_objection() -> None:
    assert objections(RESULT, EVALUATION) == ()
    assert objections(replace(RESULT, converged=False), EVALUATION) == ("the fit did not converge",)
    assert objections(replace(RESULT, unidentified=("L", "v_delta")), EVALUATION) == (
        "the logs do not identify L, v_delta",
    )
    assert objections(replace(RESULT, unidentified=("delay",)), EVALUATION) == ()  # an extra that planning does not use
    frozen = replace(RESULT, names=(), covariance=np.zeros((0, 0)), graph_covariance=np.zeros((0, 0)))
    assert objections(frozen, EVALUATION) == (
        "every parameter of the model is frozen, and the data show no auxiliary parameter",
    )
    one = RESULT.graph_covariance.copy()
    one[0, 1] = one[1, 0] = -0.995 * np.sqrt(one[0, 0] * one[1, 1])
    assert objections(replace(RESULT, graph_covariance=one), EVALUATION) == ("L and phi_diff are indistinguishable",)


def test_a_known_model_is_written_if_constant_motion_beats_it_only_where_the_user_named_it() -> None:
    useless = PredictionPair(fake_windows(LOGS[3:], 1.0), fake_windows(LOGS[3:], 1.0), fake_windows(LOGS[3:], 0.1))
    evaluation, row = replace(EVALUATION, held_out=useless), ModelTrial("mushr-lag", (), "", {1.0: 1.0}, True)
    assert objections(RESULT, evaluation) == ()
    (said,) = objections(replace(RESULT, models=(row,)), evaluation)
    assert "constant speed and turning rate predict better" in said


@pytest.mark.parametrize(
    ("std", "ci95", "decimals"), [(0.012, (0.336, 0.384), 3), (1e6, (0.1, 2.0), 2), (0.0, (0.36, 0.36), 5)]
)
def test_a_parameter_that_the_data_do_not_bound_is_shown_with_the_digits_of_its_interval(
    std: float, ci95: tuple[float, float], decimals: int
) -> None:
    assert estimated(0.36, std, ci95=ci95).decimals == decimals


@pytest.mark.parametrize(("identified_drift", "warned", "refused"), [(0.1005, 0, 0), (0.11, 1, 0), (0.2, 1, 1)])
def test_values_that_predict_unseen_logs_worse_than_before_are_warned_of_and_far_worse_ones_refused(
    identified_drift: float, warned: int, refused: int
) -> None:
    unseen = PredictionPair(
        fake_windows(LOGS[3:], identified_drift), fake_windows(LOGS[3:], 0.1), fake_windows(LOGS[3:], 1.0)
    )
    noise = Noise(0.001, 0.01)
    assert len(prediction_warnings(unseen, noise)) == warned
    assert len(fitted_warnings(unseen, noise)) == warned
    found = objections(RESULT, replace(EVALUATION, held_out=unseen))
    assert len(found) == refused
    for said in (*prediction_warnings(unseen, noise), *found):
        assert re.search(r"\d\d\.\d\d cm identified, \d\d\.\d\d cm initial", said)
    assert objections(RESULT, replace(EVALUATION, held_out=None)) == ()
    assert len(objections(RESULT, replace(EVALUATION, fitted=unseen, held_out=None))) == refused


@pytest.mark.parametrize(("position", "warned"), [(0.001, 1), (0.02, 1), (0.2, 0)])
def test_values_that_predict_as_well_as_the_noise_of_the_poses_allows_are_not_warned_of(
    position: float, warned: int
) -> None:
    """The drift adds several centimetres to errors, in the square."""
    pair = PredictionPair(fake_windows(LOGS, 0.11), fake_windows(LOGS, 0.1), fake_windows(LOGS, 1.0))
    added = np.sqrt(pair.errors.overall_position**2 - pair.initial_errors.overall_position**2)
    assert 0.02 * np.sqrt(2.0) < added < 0.2 * np.sqrt(2.0)
    assert len(prediction_warnings(pair, Noise(position, 0.01))) == warned
    assert len(fitted_warnings(pair, Noise(position, 0.01))) == warned


@pytest.mark.parametrize(
    ("drifts", "odd"),
    [
        ([0.01, 0.012, 0.011, 0.05], "drive_3"),
        ([0.01, 0.012, 0.03, 0.05], ""),  # the next one is as bad
        ([0.001, 0.001, 0.001, 0.01], ""),  # all are good
        ([0.01, 0.012, 0.05], ""),  # too few
    ],
)
def test_a_log_that_is_predicted_far_worse_than_all_others_is_named(drifts: list[float], odd: str) -> None:
    """Straight drives at 1 m/s, and predictions that drift from them."""
    times = np.arange(0.0, 3.01, 0.1)
    poses = np.column_stack([times, 0.0 * times, 0.0 * times])
    windows = [
        Window(f"drive_{k}", times, poses, poses + np.outer(times, [0.0, drift, 0.0])) for k, drift in enumerate(drifts)
    ]
    fitted, held_out = (PredictionPair(tuple(own), (), ()) for own in (windows[1:], windows[:1]))
    found = odd_log_warning(PredictionEvaluation(fitted, held_out))
    assert [line.split(" ")[0] for line in found] == ([odd] if odd else [])


def test_errors_are_told_apart_by_speed_and_along_the_vehicle() -> None:
    """Drives along y at 20 speeds: predictions are 1 % too far and, of the faster half, 2 cm to the left."""
    times = np.arange(0.0, 3.01, 0.1)
    windows = []
    for k in range(1, 21):
        poses = np.column_stack([np.zeros_like(times), 0.1 * k * times, np.full_like(times, np.pi / 2.0)])
        off = np.column_stack([np.full_like(times, -0.02 if k > 10 else 0.0), 0.001 * k * times, np.zeros_like(times)])
        windows.append(Window("log", times, poses, poses + off))
    slow, fast = errors_by_speed(windows)
    assert (slow.windows, fast.windows) == (10, 10)
    assert slow.speeds == pytest.approx((0.1, 1.0))
    assert slow.across == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert fast.across == pytest.approx((0.02, 0.02, 0.02))
    mean = 0.001 * np.sqrt(np.mean(np.arange(1, 11) ** 2))
    assert slow.along == pytest.approx((mean, 2.0 * mean, 3.0 * mean))
    assert errors_by_speed([]) == ()


def test_the_adaptive_filter_drifts_as_much_as_the_errors_in_the_file_show(tmp_path: Path) -> None:
    after = np.array([1.0, 2.0, 3.0])
    along = np.sqrt(0.05**2 * after + 0.2**2 * after**3 / 3.0)
    found = SpeedPrediction(speeds=(0.1, 1.0), windows=12, after=(1.0, 2.0, 3.0), along=tuple(along),
                            across=(0.0, 0.0, 0.0), yaw=tuple(0.1 * np.sqrt(after)))  # fmt: skip
    record = RECORD.model_copy(update={"by_speed": (found,)})
    write_vehicle(tmp_path / "mine.yaml", load_base_vehicle("mushr"), dict(RESULT.parameters), record)
    stated = Adaptive(kind="adaptive")
    drifting = with_identified_drift(stated, load_vehicle(str(tmp_path / "mine.yaml")))
    assert drifting.drift == pytest.approx(0.05, rel=1e-3)
    assert drifting.speed_drift == pytest.approx(0.2, rel=1e-3)
    assert drifting.heading_drift_deg == pytest.approx(np.degrees(0.1))
    assert with_identified_drift(stated, load_vehicle("mushr")) == stated


def test_what_is_fixed_or_off_in_an_identified_car_is_known_while_it_drives(tmp_path: Path) -> None:
    base = load_base_vehicle("car-lag")
    on = {"phi_diff", "steer", "a_drive", "damping", "friction", "lever", "tau_steer", "tau_yaw"}
    known = {
        name: estimated(
            p.value + 0.01 if name in on else p.value if p.neutral is None else p.neutral, 0.01, unit=p.unit
        )
        for name, p in base.parameters.items()
    }
    write_vehicle(tmp_path / "mine.yaml", base, known, RECORD)
    parameters = online_parameters(load_vehicle(str(tmp_path / "mine.yaml")), Adaptive(kind="adaptive"))
    assert {name for name in parameters.free_names if name != "delay"} == on


def test_parameters_that_a_file_omits_are_written_in_the_units_of_the_model(tmp_path: Path) -> None:
    path = tmp_path / "car.yaml"
    path.write_text(
        "name: car\nmodel: kraft.vehicles.mushr:MUSHR\nparameters: {phi_diff: {value: 0.1, unit: rad}}\n"
        "footprint: {length: 0.4, width: 0.28}\ntop_speed: v_delta\n"
    )
    found = load_base_vehicle(str(path)).parameters
    assert [(name, p.unit) for name, p in found.items()] == [("L", "m"), ("phi_diff", "rad"), ("v_delta", "m/s")]
    assert found["phi_diff"].value == 0.1


def test_a_number_without_a_unit_is_printed_alone() -> None:
    spec = parameters_of(load_vehicle("mushr"), Settings(), ()).specs[0]
    assert [replace(spec, unit=unit).unit_text for unit in ("m", "1", "")] == [" m", "", ""]


def recorded_by(folder: Path, name: str, **changed: object) -> tuple[Log, ...]:
    """Logs whose manifests state the bundled vehicle of that name."""
    vehicle = load_vehicle(name)
    stated = RecordedVehicle.of(vehicle, natural_robot(vehicle)[0]).model_dump(mode="json", exclude_none=True)
    logs = []
    for log in LOGS:
        run = folder / log.name
        run.mkdir(parents=True)
        (run / "manifest.json").write_text(json.dumps({"vehicle": {**stated, **changed}}))
        logs.append(replace(log, sources=(replace(log.sources[0], file=str(run / "poses.csv")),)))
    return tuple(logs)


@pytest.mark.parametrize("name", ["f1tenth", "jackal"])
def test_the_robot_that_was_recorded_is_that_of_the_file(name: str, tmp_path: Path) -> None:
    model = "car-lag" if name == "f1tenth" else "differential"
    base, said = with_recorded(load_base_vehicle(model), recorded_by(tmp_path, name))
    assert f"the recorded {name}: footprint, delay, true robot" in said
    known = {symbol: estimated(p.value, 0.1, unit=p.unit) for symbol, p in base.parameters.items()}
    path, before = tmp_path / "mine.yaml", load_vehicle_config(name)
    write_vehicle(path, base, known, RECORD)
    after = load_vehicle_config(path)
    assert (after.footprint, after.delay) == (before.footprint, before.delay)
    robots = [natural_robot(load_vehicle(each))[0] for each in (name, str(path))]
    assert robots[0] == robots[1]


def test_nothing_is_taken_over_from_a_recording_of_the_same_robot_of_two_or_of_one_that_is_gone(tmp_path: Path) -> None:
    own, said = with_recorded(load_base_vehicle("jackal"), recorded_by(tmp_path / "a", "jackal"))
    assert (own.recorded, said) == (None, "")
    both = (*recorded_by(tmp_path / "b", "jackal"), *recorded_by(tmp_path / "c", "f1tenth"))
    none, said = with_recorded(load_base_vehicle("differential"), both)
    assert none.recorded is None
    assert "(jackal, f1tenth)" in said
    unknown, *_ = recorded_by(tmp_path / "e", "jackal")
    none, said = with_recorded(load_base_vehicle("mushr-lag"), (replace(unknown, sources=()),))
    assert none.recorded is None
    assert "the written one, 0.4 x 0.28 m, the place of its centre and the true robot are those of mushr-lag" in said
    gone = recorded_by(tmp_path / "d", "jackal", truth={"mjcf": str(tmp_path / "gone.xml")})
    none, said = with_recorded(load_base_vehicle("differential"), gone)
    assert none.recorded is None
    assert "gone.xml" in said


def test_a_footprint_stays_where_it_is_on_a_car_whose_tracked_point_is_found(tmp_path: Path) -> None:
    base = load_base_vehicle("car-lag")
    known = {symbol: estimated(p.value, 0.1, unit=p.unit) for symbol, p in base.parameters.items()}
    write_vehicle(tmp_path / "mine.yaml", base, {**known, "lever": estimated(0.12, 0.01)}, RECORD)
    after = load_vehicle_config(tmp_path / "mine.yaml")
    assert after.footprint.offset == pytest.approx(base.footprint.offset - 0.12)
    assert after.parameters["lever"].value == pytest.approx(0.12)


def test_an_identified_delay_is_stated_for_driving(tmp_path: Path) -> None:
    late = written(tmp_path / "late.yaml", parameters={**RESULT.parameters, "delay": estimated(0.08, 0.02, unit="s")})
    assert late.delay is not None
    assert (late.delay.value, late.delay.std) == (0.08, 0.02)
    early = written(
        tmp_path / "early.yaml", parameters={**RESULT.parameters, "delay": estimated(-0.03, 0.01, unit="s")}
    )
    assert early.delay is None


def test_a_file_whose_model_diverges_with_the_commands_of_the_logs_may_be_replaced(tmp_path: Path) -> None:
    logs = [
        replace(log, parts=tuple(replace(p, commands=1500.0 + 400.0 * p.commands) for p in log.parts)) for log in LOGS
    ]
    before = written(tmp_path / "mine.yaml", "car", {
        name: estimated(p.value, 0.1, unit=p.unit) for name, p in load_base_vehicle("car").parameters.items()
    })  # fmt: skip
    assert replacement_objections(before, "mine.yaml", tuple(logs), EVALUATION, Settings()) == ()
