"""Identification from the outside: what it finds, how sure it is, and how well it predicts."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.lag_logs import changed, lag, logs
from support.logs import needs_real_logs
from support.paths import ROOT

from benchmarks.synthetic_logs import synthetic_logs
from benchmarks.sysid import PLAIN, STATED, TRUTH, real_logs, ten_times_smaller
from kraft.errors import Code, InputError
from kraft.logs.log import Log
from kraft.sysid import Identification, Settings, identify, predict_windows, prediction_errors
from kraft.sysid.fit_progress import FitProgress
from kraft.sysid.parameters import parameter_specs, without_bounds
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import ParameterRange

SKID_STEER = str(ROOT / "examples" / "05_vehicle.py") + ":VEHICLE"
AUXILIARY = {"delay": 0.12, "lever": 0.15, "yaw_offset": 0.05, "dead_band_steering": 0.03}


@cache
def fitted() -> Identification:
    return identify(lag(), logs())


def close(result: Identification, truth: dict[str, float], deviations: float = 5.0) -> None:
    for name, value in truth.items():
        estimated = result.parameters[name]
        assert abs(estimated.value - value) < deviations * estimated.std, (name, estimated)
        assert estimated.std < 0.1 * max(abs(value), 0.1), (name, estimated)


def test_it_finds_the_parameters_that_made_the_logs() -> None:
    result = fitted()
    assert result.converged
    assert result.warnings == ()
    close(result, TRUTH)
    assert result.parameters["L"].unit == "m"
    assert result.noise_measured
    assert result.noise.position == pytest.approx(0.01, rel=0.1)
    assert result.noise.yaw == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("corner", ["min", "max"])
def test_initial_parameters_at_either_end_of_the_bounds_lead_to_the_same_result(corner: str) -> None:
    wild = {name: getattr(p, corner) for name, p in lag().parameters.items()}
    result = identify(lag(), logs(), replace(PLAIN, values=wild))
    assert result.converged
    for name, value in identify(lag(), logs(), PLAIN).values.items():
        assert result.parameters[name].initial == wild[name]
        assert result.values[name] == pytest.approx(value, rel=0.01)


def test_extras_are_found_where_there_are_some_and_only_there() -> None:
    truth = {**TRUTH, **AUXILIARY}
    result = identify(lag(), synthetic_logs(lag(), truth, range(8), seconds=15.0))
    assert set(result.auxiliary) == set(AUXILIARY)
    close(result, truth, 6.0)
    assert result.rear_axle == pytest.approx(0.15 + TRUTH["L"] / 2, abs=0.01)
    assert fitted().auxiliary == ()
    assert "removed: delay" in fitted().notes[0]


def test_an_extra_that_is_asked_for_stays() -> None:
    result = identify(lag(), logs(), Settings(auxiliary=("lever", "side")))
    assert result.auxiliary == ("lever", "side")
    assert abs(result.values["lever"]) < 5 * result.parameters["lever"].std


def test_a_vehicle_from_code_is_identified_without_bounds_or_priors() -> None:
    vehicle = load_vehicle(SKID_STEER)
    truth = {"track": 0.5, "lag": 0.2}
    result = identify(vehicle, synthetic_logs(vehicle, truth, range(6), seconds=10.0))
    assert result.converged
    close(result, truth)


def test_a_vehicle_from_code_is_identified_with_the_bounds_and_priors_that_it_states() -> None:
    ranges = {"track": ParameterRange(0.3, 0.45, 0.02, "m"), "lag": ParameterRange(0.3, 0.3, 0.0)}
    vehicle = replace(load_vehicle(SKID_STEER), ranges=ranges)
    assert without_bounds(vehicle) == ()
    track, lag_spec = parameter_specs(vehicle, ())
    assert (track.min, track.max, track.std, track.unit) == (0.3, 0.45, 0.02, "m")
    assert lag_spec.fixed
    logs_of_another = synthetic_logs(vehicle, {"track": 0.5, "lag": 0.3}, range(2), seconds=10.0)
    assert identify(vehicle, logs_of_another).values == {"track": 0.45, "lag": 0.3}


def test_a_frozen_parameter_keeps_its_value() -> None:
    result = identify(lag(), logs(), replace(PLAIN, frozen=("tau",), values={"tau": 0.8}))
    assert result.values["tau"] == 0.8
    assert result.parameters["tau"].frozen
    assert result.parameters["tau"].ci95 == (0.8, 0.8)
    assert result.names == ("L", "phi_diff", "v_delta")


def test_the_same_logs_give_the_same_bits() -> None:
    again = identify(lag(), logs())
    assert again.values == fitted().values
    assert (again.covariance == fitted().covariance).all()


@pytest.mark.parametrize("auxiliary", [{"delay": 0.1, "lever": 0.1}, {"lag_steering": 0.15, "friction": 0.1}])
def test_both_graphs_agree(auxiliary: dict[str, float]) -> None:
    data = synthetic_logs(lag(), {**TRUTH, **auxiliary}, range(5), seconds=5.0, outliers=0.03)
    settings = Settings(auxiliary=tuple(auxiliary))
    fast = identify(lag(), data, settings)
    paper = identify(lag(), data, replace(settings, graph="paper"))
    assert paper.converged
    for name, value in fast.values.items():
        assert paper.values[name] == pytest.approx(value, rel=1e-4)
    assert paper.cost == pytest.approx(fast.cost, rel=1e-6)
    assert paper.covariance == pytest.approx(fast.covariance, rel=1e-2)
    assert paper.graph_covariance == pytest.approx(fast.graph_covariance, rel=1e-3)
    assert paper.logs[0].parts[0].states == pytest.approx(fast.logs[0].parts[0].states, abs=1e-5)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """Shortened: `python -m benchmarks sysid` has 200 problems."""
    hits = []
    process, control = tuple(STATED.process.values()), tuple(STATED.control_noise.values())
    for seed in range(12):
        seeds = range(100 * seed, 100 * seed + 8)
        data = synthetic_logs(lag(), TRUTH, seeds, seconds=6.0, process=process, control_noise=control)
        for settings in (STATED, ten_times_smaller(STATED)):
            result = identify(lag(), data, settings)
            assert result.interval == "sandwich"
            hits += [low <= TRUTH[n] <= high for n, (low, high) in ((n, e.ci95) for n, e in result.parameters.items())]
    assert 0.85 < np.mean(hits) < 1.0


def test_the_graphs_own_interval_is_far_too_narrow_where_noise_is_stated_too_small() -> None:
    process = tuple(STATED.process.values())
    data = synthetic_logs(lag(), TRUTH, range(12), seconds=8.0, process=process)
    result = identify(lag(), data, ten_times_smaller(STATED))
    ratio = np.sqrt(np.diag(result.covariance) / np.diag(result.graph_covariance))
    assert ratio.min() > 1.5
    assert ratio.mean() > 2.0


def test_below_five_logs_the_interval_is_the_graphs() -> None:
    result = identify(lag(), logs()[:4], STATED)
    assert result.interval == "graph"
    assert (result.covariance == result.graph_covariance).all()
    assert identify(lag(), logs()[:5], STATED).interval == "sandwich"


def test_outliers_hardly_move_the_wheelbase() -> None:
    dirty = synthetic_logs(lag(), TRUTH, range(6), seconds=10.0, outliers=0.05)
    robust = identify(lag(), dirty, PLAIN)
    squares = identify(lag(), dirty, replace(PLAIN, robust=None))
    assert abs(robust.values["L"] / TRUTH["L"] - 1.0) < 0.02
    assert squares.parameters["L"].std > 2.0 * robust.parameters["L"].std
    part = robust.logs[0].parts[0]
    far = np.hypot(part.residuals[:, 0], part.residuals[:, 1]) > 0.3
    assert 0.02 < far.mean() < 0.10
    assert part.weights[far].max() < 0.1
    assert np.median(part.weights[~far]) == 1.0


def test_the_optimiser_says_when_it_has_not_converged() -> None:
    result = identify(lag(), logs(), replace(PLAIN, iterations=1))
    assert not result.converged
    assert "had not converged after 1 iteration: " in result.warnings[0]
    assert result.iterations == 1


def test_iterations_are_counted_alike_wherever_they_are_said() -> None:
    result = identify(lag(), logs(), Settings(iterations=2))
    assert not result.converged
    assert result.iterations > 2
    assert f"had not converged after {result.iterations} iterations: " in result.warnings[0]


def test_whoever_watches_hears_every_iteration_once() -> None:
    heard: list[FitProgress] = []
    result = identify(lag(), logs(), on_iteration=heard.append)
    assert len(heard) == result.iterations
    for before, after in itertools.pairwise(heard):
        same = after.fit == before.fit
        assert after.iteration == (before.iteration + 1 if same else 1)
        assert after.fit - before.fit in (0, 1)
        assert after.cost <= before.cost or not same
    assert heard[0].fit == 1
    assert all(each.fit <= each.fits for each in heard)
    assert heard[-1].cost == result.cost


@pytest.mark.parametrize("count", [2, 5])
def test_a_frozen_model_without_an_extra_that_the_data_show_ends_with_nothing_estimated(count: int) -> None:
    result = identify(lag(), logs()[:count], Settings(values=TRUTH, frozen=tuple(TRUTH)))
    assert (result.names, result.auxiliary, result.unidentified) == ((), (), ())
    assert result.values == TRUTH
    assert result.converged
    assert result.notes[0].startswith("no auxiliary parameter is significant; removed: delay")


def broken(**arrays: object) -> list[Log]:
    return [changed(logs()[0], "broken", **arrays)]


@pytest.mark.parametrize(
    ("data", "settings", "place", "code"),
    [
        ([], Settings(), "logs", Code.MISSING),
        (list(logs()[:1]), Settings(frozen=("Tau",)), "frozen", Code.UNKNOWN),
        (list(logs()[:1]), Settings(auxiliary=("leverage",)), "auxiliary", Code.UNKNOWN),
        (list(logs()[:1]), Settings(process={"theta": -1.0}), "process", Code.VALUE),
        (list(logs()[:1]), Settings(values={"L": 7.0}), "values", Code.VALUE),
        (list(logs()[:1]), Settings(values={"delay": 0.1}, auxiliary="none"), "values", Code.CONFLICT),
        (list(logs()[:1]), Settings(frozen=("side",), auxiliary=("lever",)), "frozen", Code.CONFLICT),
        (list(logs()[:1]), replace(PLAIN, frozen=tuple(TRUTH)), "frozen", Code.CONFLICT),
        ([replace(logs()[0], controls=("left", "right"))], Settings(), "log-000", Code.MISMATCH),
        (broken(poses=np.full_like(logs()[0].parts[0].poses, np.nan)), Settings(), "broken", Code.DATA),
        (broken(poses=np.zeros_like(logs()[0].parts[0].poses)), Settings(), "logs", Code.DATA),
        (broken(pose_times=logs()[0].parts[0].pose_times[::-1].copy()), Settings(), "broken", Code.DATA),
        (broken(pose_times=np.array([0.1]), poses=np.zeros((1, 3))), Settings(), "logs", Code.DATA),
    ],
)
def test_what_cannot_be_used_is_refused(data: list[Log], settings: Settings, place: str, code: Code) -> None:
    with pytest.raises(InputError) as caught:
        identify(lag(), data, settings)
    assert {(problem.file, problem.code) for problem in caught.value.diagnostics} == {(place, code)}


def test_predictions_know_nothing_of_the_future() -> None:
    log = logs()[0]
    part = log.parts[0]
    poses = part.poses.copy()
    later = part.pose_times > part.pose_times[0] + 3.2  # after the second window's beginning
    poses[later] += [0.7, -0.4, 0.3]
    before, after = predict_windows(lag(), [log], TRUTH), predict_windows(lag(), [changed(log, poses=poses)], TRUTH)
    assert (before[0].predicted == after[0].predicted).all()
    assert before[1].predicted == pytest.approx(after[1].predicted, abs=1e-3)  # how noisy poses are is of all of them
    assert not np.allclose(before[2].predicted, after[2].predicted, atol=0.1)


def test_true_parameters_predict_as_well_as_poses_are_seen() -> None:
    clean = synthetic_logs(lag(), TRUTH, range(2), seconds=10.0, noise=(1e-4, 1e-4))
    errors = prediction_errors(lag(), clean, TRUTH)
    assert errors.windows == 2 * 4
    assert set(errors.position) == {1.0, 2.0, 3.0}
    assert errors.position[3.0] < 0.004
    assert errors.yaw[3.0] < 0.004


def test_a_drive_that_was_cut_under_way_is_predicted_as_well_as_the_whole() -> None:
    slow_then_fast = (np.array([0.0, 0.02, 5.0]), np.array([[0.5, 0.1], [0.5, 0.1], [1.0, -0.1]]))
    clean = synthetic_logs(lag(), TRUTH, range(3), seconds=10.0, commands=[slow_then_fast] * 3, noise=(1e-4, 1e-4))
    parts = [log.parts[0] for log in clean]
    cut = [
        changed(log, pose_times=part.pose_times[90:], poses=part.poses[90:])
        for log, part in zip(clean, parts, strict=True)
    ]
    assert prediction_errors(lag(), clean, TRUTH).overall_position < 0.004
    errors = prediction_errors(lag(), cut, TRUTH)
    assert errors.windows == 2 * 3
    assert errors.overall_position < 0.004


def test_what_was_commanded_before_a_drive_was_cut_acts_on_with_a_delay() -> None:
    """Cut at half of the speed that follows, with no command from before: the one that is held acted already."""
    rng = np.random.default_rng(0)
    times = np.array([0.0, *np.arange(5.0, 12.0)])
    drives = [
        (times, np.column_stack([[0.45, *rng.uniform(0.6, 1.0, 7)], rng.uniform(-0.3, 0.3, 8)])) for _ in range(8)
    ]
    truth = {**TRUTH, "delay": 0.4}
    data = synthetic_logs(lag(), truth, range(8), seconds=12.0, commands=drives, noise=(0.001, 0.002))
    cut = []
    for log in data:
        (part,) = log.parts
        held = np.where(part.command_times < 3.0, 3.0, part.command_times)
        cut.append(changed(log, command_times=held, pose_times=part.pose_times[90:], poses=part.poses[90:]))
    found = identify(lag(), cut, Settings(auxiliary=("delay",)))
    assert found.values["delay"] == pytest.approx(0.4, abs=0.005)
    assert found.values["tau"] == pytest.approx(TRUTH["tau"], abs=0.01)


def test_commands_with_late_stamps_have_a_negative_delay_and_that_is_said() -> None:
    late = [changed(log, command_times=log.parts[0].command_times + 0.04) for log in logs()]
    found = identify(lag(), late)
    assert found.values["delay"] == pytest.approx(-0.04, abs=0.01)
    assert found.values["tau"] == pytest.approx(TRUTH["tau"], abs=0.02)
    assert [warning for warning in found.warnings if "40 ms before" in warning or "39 ms before" in warning]
    assert not [warning for warning in fitted().warnings if "before its commands" in warning]


def test_a_slow_camera_counts_beside_a_fast_one() -> None:
    fast, slow = (synthetic_logs(lag(), TRUTH, [k], seconds=10.0, rate=rate) for k, rate in ((0, 30.0), (1, 3.7)))
    both = prediction_errors(lag(), [*fast, *fast, *slow], TRUTH)
    alone = [prediction_errors(lag(), data, TRUTH) for data in (fast, slow)]
    for after in (1.0, 2.0, 3.0):
        assert min(e.position[after] for e in alone) < both.position[after] < max(e.position[after] for e in alone)


def test_initial_values_of_extras_take_part_in_the_initial_prediction() -> None:
    truth = {**TRUTH, "delay": 0.3}
    data = synthetic_logs(lag(), truth, range(2), seconds=6.0)
    given = prediction_errors(lag(), data, {}, Settings(values=truth))
    assert given.position == prediction_errors(lag(), data, truth).position
    assert given.position[1.0] < 0.5 * prediction_errors(lag(), data, TRUTH).position[1.0]


def test_a_result_at_its_bound_can_be_predicted_with() -> None:
    data = synthetic_logs(lag(), {**TRUTH, "v_delta": 0.06}, range(2), seconds=8.0)
    result = identify(lag(), data, PLAIN)
    assert result.values["v_delta"] == lag().parameters["v_delta"].min
    assert prediction_errors(lag(), data, result.values).windows > 0


def test_a_bound_that_holds_a_parameter_does_not_widen_the_intervals_of_the_others() -> None:
    """Against fits to the logs without each of them."""
    data = synthetic_logs(
        lag(), {**TRUTH, "phi_diff": 0.25}, range(8), seconds=8.0, process=tuple(STATED.process.values()),
        control_noise=tuple(STATED.control_noise.values()),
    )  # fmt: skip
    result = identify(lag(), data, STATED)
    assert result.parameters["phi_diff"].at_bound
    shifts = [identify(lag(), [*data[:k], *data[k + 1 :]], STATED).values["L"] for k in range(8)]
    jackknife = np.sqrt(7 / 8 * np.sum((np.array(shifts) - np.mean(shifts)) ** 2))
    assert result.parameters["L"].std == pytest.approx(jackknife, rel=0.2)
    assert result.parameters["phi_diff"].std > 0.0


def test_logs_and_parts_that_are_too_short_are_named() -> None:
    (part,) = logs()[0].parts
    short = replace(part, pose_times=part.pose_times[:4], poses=part.poses[:4])
    mixed = [
        *logs()[:2],
        replace(logs()[2], parts=(short, *logs()[2].parts)),
        replace(logs()[3], name="tiny", parts=(short,)),
    ]
    result = identify(lag(), mixed, PLAIN)
    assert [log.name for log in result.logs] == ["log-000", "log-001", "log-002"]
    assert result.notes == (
        "left out: tiny: has no part with 5 poses, the longest has 4; expected a longer drive",
        "log-002: 1 of 2 parts left out: fewer than 5 poses",
    )


def test_identified_parameters_predict_other_logs_better_than_nominal_ones() -> None:
    unseen = synthetic_logs(lag(), TRUTH, range(50, 53), seconds=10.0)
    before, after = prediction_errors(lag(), unseen), prediction_errors(lag(), unseen, fitted().values)
    assert after.position[2.0] < 0.5 * before.position[2.0]
    assert after.overall_yaw < before.overall_yaw


@needs_real_logs
def test_the_same_defaults_fit_a_real_car() -> None:
    runs = real_logs()
    for first in (0, 1):
        result = identify(lag(), runs[first::2])
        errors = prediction_errors(lag(), runs[1 - first :: 2], result.values)
        assert result.converged
        assert errors.position[3.0] < 0.02
        assert errors.yaw[3.0] < 0.03
        assert result.values["delay"] == pytest.approx(0.1, abs=0.03)
        assert result.rear_axle == pytest.approx(0.15, abs=0.04)
