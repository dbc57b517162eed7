"""Cars with terms: their fit over windows, and the choice of terms by what they predict."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.cars import LEVER, STEP, TRUTH, car, drive
from support.logs import RAMPS, needs_real_logs

from kraft.errors import InputError
from kraft.logs.log import Log, Part
from kraft.logs.reader import read_logs
from kraft.sysid import Settings, identify, model_choice, prediction_errors, unexplained
from kraft.sysid.acceptance import useless_objections
from kraft.sysid.actuators import ActuatorModel
from kraft.sysid.base_vehicle import (
    for_commands,
    for_sides,
    for_turns,
    for_wheelbase,
    load_base_vehicle,
    with_recorded_commands,
    with_speed,
)
from kraft.sysid.chains import whole_segment
from kraft.sysid.checks import SteeringInMotion
from kraft.sysid.dynamics import DiscreteModel
from kraft.sysid.model_choice import identify_car, with_wheelbase
from kraft.sysid.parameters import parameters_of
from kraft.sysid.prediction import constant_windows, predict_windows, window_errors
from kraft.sysid.selection import is_shown
from kraft.sysid.smoothing import thinned
from kraft.sysid.structure import StructureSearch
from kraft.sysid.terms import identify_terms, switched_off
from kraft.sysid.unexplained import unexplained_stretches
from kraft.vehicles.config import VehicleConfig, load_vehicle_config
from kraft.vehicles.load import configured, load_vehicle


def car_file() -> VehicleConfig:
    return load_vehicle_config("car")


def test_the_wheels_at_the_beginning_of_a_window_follow_from_the_commands_before_it() -> None:
    model = load_vehicle("car-lag", parameters={**TRUTH, "tau_steer": 0.3, "rate_limit": 0.1})
    log = drive(model, 4, 12.0)
    search = StructureSearch(load_vehicle_config("car-lag"), [log], Settings(), lambda *_: None)
    graph = search.graph(search.candidates)
    p = graph.problem.parameters
    expected = graph.prior_states(
        np.array([model.parameters.get(n, v) for n, v in zip(p.names, p.nominal, strict=True)])
    )
    (part,), delta = log.parts, model.index("delta")
    levels = np.ascontiguousarray(part.commands[:, None, :])
    states = DiscreteModel(model).simulate(np.zeros((1, 6)), levels, model.parameter_array[None], np.array([STEP]))[
        :, 0
    ]
    for window, state in zip(graph.windows.segments, expected, strict=True):
        assert state[delta] == pytest.approx(states[round(window.begin / STEP), delta], abs=0.01)


def test_a_step_is_split_where_a_command_jumps() -> None:
    times, levels = np.array([0.0, 0.11, 0.325]), np.array([[0.2, 0.0], [1.0, 0.0], [-0.5, 0.3]])
    poses = np.zeros((11, 3))
    part = Part(times, levels, np.linspace(0.0, 0.5, 11), poses)
    vehicle = load_vehicle_config("car")
    parameters = parameters_of(vehicle, Settings(), ("delay",))
    actuators = ActuatorModel([whole_segment(part, 0, 0.05)], parameters)
    rho = parameters.nominal.copy()
    rho[parameters.index("delay")] = 0.02
    share, means = actuators.split(rho, halved=False)
    assert share[[2, 6]] == pytest.approx([0.6, 0.9])  # 0.13 and 0.345 s
    np.testing.assert_allclose(means[2], [[0.2, 0.0], [1.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(means[6], [[1.0, 0.0], [-0.5, 0.3]], atol=1e-12)
    others = np.delete(share, [0, 2, 6])
    np.testing.assert_allclose(others, 1.0)
    np.testing.assert_allclose(means[4, 0], [1.0, 0.0], atol=1e-12)
    halves = actuators.split(rho, halved=True)[0]
    np.testing.assert_allclose(np.delete(halves, [0, 2, 6]), 0.5)


def test_neutral_values_switch_the_terms_off() -> None:
    plain = car(friction=0.0)
    controls = np.tile([0.5, 0.0], (200, 1, 1))
    states = DiscreteModel(plain).simulate(np.zeros((1, 4)), controls, plain.parameter_array[None], np.array([0.05]))
    times = 0.05 * np.arange(201)
    steady = 0.5 * TRUTH["a_drive"] / TRUTH["damping"]
    assert states[:, 0, 3] == pytest.approx(steady * (1.0 - np.exp(-TRUTH["damping"] * times)), abs=0.02)
    circle = np.tile([0.5, 1.0], (200, 1, 1))
    turned = DiscreteModel(plain).simulate(np.zeros((1, 4)), circle, plain.parameter_array[None], np.array([0.05]))
    rate = (turned[-1, 0, 2] - turned[-2, 0, 2]) / 0.05
    assert rate == pytest.approx(steady * np.tan(TRUTH["steer"]) / TRUTH["L"], rel=0.01)


def test_the_terms_of_a_car_are_chosen_and_predict_other_drives() -> None:
    model = car()
    fitted, unseen = [drive(model, seed) for seed in range(6)], [drive(model, seed) for seed in (90, 91)]
    choice = identify_terms(car_file(), fitted)
    found = choice.identification
    assert found.converged
    assert "friction" not in found.off
    assert {"slide", "slip", "scrub", "understeer"} & set(found.off)
    assert found.values["lever"] == pytest.approx(LEVER, abs=0.01)
    assert found.values["steer"] == pytest.approx(TRUTH["steer"], rel=0.05)
    errors = prediction_errors(choice.vehicle, unseen, found.values, found.predicting(Settings()))
    constant = window_errors(constant_windows(choice.vehicle, unseen))
    assert errors.position[3.0] < 0.06
    assert errors.position[3.0] < 0.2 * constant.position[3.0]
    assert sum(trial.chosen for trial in found.trials) == 1
    assert len(found.without_log) == len(fitted)


def search_for_slide(slide: float) -> StructureSearch:
    """Search for a limit of the lateral acceleration, in drives of a car that hardly reaches it."""
    model = car(slide=slide)
    open_ = ("slide", "phi_diff", "steer", "a_drive", "damping", "L", "full_throttle", "full_steering", "full_reverse")
    values = {name: value for name, value in model.parameters.items() if name not in open_} | {"lever": LEVER}
    logs = [drive(model, seed, 30.0) for seed in range(5)]
    return StructureSearch(car_file(), logs, Settings(values=values, auxiliary="none"), lambda *_: None)


@pytest.mark.parametrize(("slide", "shown"), [(0.06, True), (0.0, False)])
def test_long_windows_show_a_term_of_an_exact_model_that_short_ones_do_not(slide: float, shown: bool) -> None:
    search = search_for_slide(slide)
    path = search.path()
    without = search.converged(path[-1])
    assert search.completed(without, path).terms == without.terms == ()
    found, longer = search.in_long_windows(without, path)
    assert ("slide" in found.terms) is shown
    assert longer.windows.since.max() > 10.0


def test_long_windows_switch_a_term_off_that_they_do_not_show() -> None:
    search = search_for_slide(0.0)
    path = search.path()
    assert path[0].terms == ("slide",)
    assert search.in_long_windows(search.converged(path[0]), path)[0].terms == ()


def test_a_term_that_predictions_do_not_need_and_no_car_has_so_small_is_switched_off() -> None:
    """The likelihood shows it, as it shows effects of the discrete steps."""
    model = car(friction=0.002)
    open_ = (
        "friction",
        "phi_diff",
        "steer",
        "a_drive",
        "damping",
        "L",
        "full_throttle",
        "full_steering",
        "full_reverse",
    )
    values = {name: value for name, value in model.parameters.items() if name not in open_} | {"lever": LEVER}
    logs = [drive(model, seed, 30.0) for seed in range(5)]
    search = StructureSearch(car_file(), logs, Settings(values=values, auxiliary="none"), lambda *_: None)
    found = search.full()
    gain = search.without(found, "friction").optimum.cost - found.optimum.cost
    assert is_shown(found.graph.problem.parameters, found.optimum, "friction", gain)
    assert search.pruned(found).terms == ()


@pytest.mark.parametrize(
    ("vehicle", "settings"),
    [
        (car_file(), Settings(values={"friction": 0.4})),
        (car_file().with_values({"friction": 0.4}), Settings(frozen=("friction",))),
        (car_file().with_stated({"friction": {"value": 0.4, "fixed": True}}), Settings()),
    ],
    ids=["stated", "frozen", "fixed"],
)
def test_a_term_that_keeps_its_value_is_not_off(vehicle: VehicleConfig, settings: Settings) -> None:
    search = StructureSearch(vehicle, [drive(car(), 0)], settings, lambda *_: None)
    assert "friction" not in search.candidates
    p = search.parameters(["drag"])
    assert (p.nominal[p.index("friction")], "friction" in p.frozen) == (0.4, True)
    off = switched_off(p, p.nominal, ["drag"])
    assert {"friction", "drag", "a_drive"} & set(off) == set()
    assert {"scrub", "slide", "brake"} <= set(off)


def test_a_model_whose_error_grows_is_not_compared_in_long_windows() -> None:
    model = car(drag=0.2)
    values = {name: value for name, value in TRUTH.items() if name != "slide"} | {"lever": LEVER}
    logs = [drive(model, seed, 30.0) for seed in range(5)]
    search = StructureSearch(car_file(), logs, Settings(values=values, auxiliary="none"), lambda *_: None)
    path = search.path()
    assert search.in_long_windows(path[-1], path) == (path[-1], search)


def test_a_drive_that_differs_between_logs_is_found_and_used_in_predictions() -> None:
    """Each log has another battery: the gain of the drive differs by 15 % and the wheels by 15 mrad."""
    rng = np.random.default_rng(7)
    gains, angles = rng.normal(3.0, 0.45, 8), rng.normal(0.0, 0.015, 8)
    logs = [drive(car(a_drive=g, phi_diff=a), k) for k, (g, a) in enumerate(zip(gains, angles, strict=True))]
    choice = identify_terms(car_file(), logs[:6])
    found = choice.identification
    assert found.values["a_drive"] == pytest.approx(gains[:6].mean(), rel=0.15)
    assert found.parameters["a_drive"].variation == pytest.approx(np.std(gains[:6]), rel=0.6)
    assert found.parameters["phi_diff"].variation == pytest.approx(np.std(angles[:6]), rel=0.6)
    varying = prediction_errors(choice.vehicle, logs[6:], found.values, found.predicting(Settings()))
    none = {"a_drive": 0.0, "phi_diff": 0.0}
    same = prediction_errors(choice.vehicle, logs[6:], found.values, Settings(variation=none))
    assert varying.position[3.0] < 0.7 * same.position[3.0]


def test_a_car_takes_commands_as_they_were_recorded() -> None:
    """The fit has converted them; the vehicle that comes out predicts the recorded ones alike."""
    factors = {"throttle": 0.5, "steering": 0.01}
    logs = [drive(car(), seed, seconds=9.0) for seed in range(3)]
    base = for_commands(load_base_vehicle("car"), logs)
    assert isinstance(base.definition, VehicleConfig)
    found = identify_terms(base.definition, logs).identification
    recorded, again = with_recorded_commands(base, found, factors)
    numbers = [
        replace(log, parts=tuple(replace(part, commands=part.commands / [0.5, 0.01]) for part in log.parts))
        for log in logs
    ]
    before = prediction_errors(base.definition, logs, found.values)
    after = prediction_errors(recorded.definition, numbers, again.values)
    assert after.position[1.0] == pytest.approx(before.position[1.0], rel=1e-6)
    assert recorded.vehicle.controls["steering"][1] == pytest.approx(100.0 * base.vehicle.controls["steering"][1])


@pytest.mark.parametrize(("wheelbase", "expected"), [(0.06, 0.06), (4.0, 4.0), (0.25, 0.33)])
def test_a_car_of_another_size_has_a_wheelbase_that_suits_it(wheelbase: float, expected: float) -> None:
    logs = [drive(car(L=wheelbase, steer=0.4), seed) for seed in range(2)]
    base = load_base_vehicle("car")
    found = for_turns(base, logs)
    assert found.vehicle.parameters["L"] == pytest.approx(expected, rel=0.3)
    lever, before = found.parameters["lever"], base.parameters["lever"]
    assert lever.max is not None
    assert before.max is not None
    assert lever.max == pytest.approx(before.max * found.vehicle.parameters["L"] / 0.33)
    assert (found is base) == (wheelbase == 0.25)


def test_a_long_car_whose_wheelbase_is_stated_is_tracked_between_its_axles() -> None:
    """The bound of `lever` in the vehicle file is 1 m, half of the wheelbase is 1.5 m."""
    model = car(L=3.0, steer=0.5).with_parameters({"lever": 1.5 - LEVER})  # drive() adds LEVER
    logs = [drive(model, seed) for seed in range(4)]
    stated = identify_car(logs, Settings(values={"L": 3.0}))
    assert stated.identification.values["lever"] == pytest.approx(1.5, abs=0.03)
    base = load_base_vehicle("car")
    assert for_wheelbase(base, 0.5) is base


@pytest.mark.parametrize(("wheelbase", "understeer"), [(0.33, 0.15), (4.0, 0.0)], ids=["understeer", "large"])
def test_turns_that_understeer_makes_wide_are_not_those_of_a_larger_car(wheelbase: float, understeer: float) -> None:
    speed = {"a_drive": 4.5, "damping": 0.7, "friction": 0.0}
    lags = {"tau_steer": 0.2, "tau_yaw": 0.25, "rate_limit": 0.4}
    model = load_vehicle(
        "car-lag", parameters={**TRUTH, **speed, **lags, "L": wheelbase, "understeer": understeer, "saturation": 1.0}
    )
    logs = [drive(model, seed, seconds=20.0, low=(0.3, -1.0)) for seed in range(4)]
    base = load_base_vehicle("car-lag")
    assert for_turns(base, logs).vehicle.parameters["L"] > 2.0 * base.vehicle.parameters["L"]
    (found,) = with_wheelbase([base], logs, Settings())
    assert found.vehicle.parameters["L"] == pytest.approx(wheelbase, rel=0.5)


@pytest.mark.parametrize(("stated", "kept"), [((0.5, 0.09, 0.09, 0.09), True), ((0.5, 0.11, 0.11, 0.11), False)])
def test_one_fold_alone_does_not_decide_between_wheelbases(
    stated: tuple[float, ...], kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To first order one fold is predicted far off with the wheelbase that suits the turns, as others may be."""
    found = [np.array(stated), np.array([1.0, 0.105, 0.105, 0.105])]
    monkeypatch.setattr(model_choice, "errors_of_all_terms", lambda *_: found.pop(0))
    base = load_base_vehicle("car")
    (chosen,) = with_wheelbase([base], [drive(car(L=4.0, steer=0.5), 0)], Settings())
    assert (chosen is base) == kept


def test_a_slow_servo_is_no_disturbance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its wheels turn at 0.7 rad/s at most; the commands of the last 0.4 s alone do not explain the yaw rate."""
    logs = [drive(load_vehicle("car-lag", parameters={"rate_limit": 1.5}), seed) for seed in range(8)]
    assert unexplained_stretches(logs) == ()
    monkeypatch.setattr(unexplained, "SWEEPS", ())
    assert len(unexplained_stretches(logs)) > 3


def test_a_car_that_slides_at_the_limit_of_its_grip_is_no_disturbance(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of six drives is fast: it turns less than steered, and it alone shows the limit."""
    model = car(a_drive=6.0, damping=1.5, slide=0.25)
    logs = [*(drive(model, seed, low=(0.15, -0.5), high=0.5) for seed in range(5)), drive(model, 5, low=(0.15, -0.6))]
    assert unexplained_stretches(logs) == ()
    monkeypatch.setattr(unexplained, "GRIP_SHARE", 100.0)
    assert {s.what for s in unexplained_stretches(logs)} == {"turns otherwise than steered"}


def test_a_variation_names_a_parameter_of_the_model_and_is_not_negative() -> None:
    with pytest.raises(InputError) as refused:
        identify_terms(car_file(), [drive(car(), 0)], Settings(variation={"a_drivee": 0.1, "phi_diff": -0.1}))
    assert sorted(found.file for found in refused.value.diagnostics) == ["variation", "variation"]


def test_a_window_begins_where_the_car_is_although_the_model_does_not_explain_how_it_came_there() -> None:
    """Something moves the car by 0.3 m, 0.8 s before the third window."""
    log = drive(car(), 3)
    (part,) = log.parts
    poses = part.poses + np.where(part.pose_times[:, None] > 5.2, [0.3, 0.0, 0.0], 0.0)
    moved = replace(log, parts=(replace(part, poses=poses),))
    for window in predict_windows(car_file(), [moved], {**TRUTH, "lever": LEVER}):
        assert np.hypot(*(window.predicted[0] - window.poses[0])[:2]) < 0.01


def test_no_logs_are_no_car() -> None:
    with pytest.raises(InputError) as refused:
        identify_car([])
    assert [found.problem for found in refused.value.diagnostics] == ["there are none"]


@pytest.mark.parametrize("seconds", [0.9, 1.4])
def test_a_log_that_is_too_short_to_be_predicted_still_counts(seconds: float) -> None:
    logs = [drive(car(), seed, seconds=8.0) for seed in range(3)]
    found = identify_terms(car_file(), [*logs, drive(car(), 3, seconds=seconds)]).identification
    assert len(found.logs) == 4
    assert found.values["steer"] / found.values["L"] == pytest.approx(TRUTH["steer"] / TRUTH["L"], rel=0.05)


def test_times_that_no_window_reaches_have_no_errors() -> None:
    found = identify_terms(car_file(), [drive(car(), seed, seconds=2.6) for seed in range(6)]).identification
    assert sorted(found.trials[0].errors) == [1.0, 2.0]
    assert all(np.isfinite(list(trial.errors.values())).all() for trial in found.trials)
    with pytest.raises(InputError, match="a third of the horizon"):
        identify_terms(car_file(), [drive(car(), seed, seconds=2.6) for seed in range(6)], Settings(horizon=12.0))


def test_flipped_steering_is_a_negative_gain() -> None:
    model = car()
    logs = [drive(model, seed) for seed in range(5)]
    flipped = [
        replace(log, parts=tuple(replace(part, commands=part.commands * [1.0, -1.0]) for part in log.parts))
        for log in logs
    ]
    found = identify_terms(car_file(), flipped).identification
    assert found.values["steer"] == pytest.approx(-TRUTH["steer"], rel=0.05)


def test_the_terms_of_a_robot_with_two_sides_are_chosen() -> None:
    truth = {"track": 0.5, "gain": 0.9, "imbalance": 0.06, "slip": 0.1, "slide": 0.0, "effort": 0.0, "effort_turn": 0.0}
    model = load_vehicle("differential", parameters=truth)
    logs = [drive(model, seed, 10.0, low=(0.2, 0.2), high=1.6) for seed in range(5)]
    found = identify("differential", logs)
    assert set(next(trial.terms for trial in found.trials if trial.chosen)) == {"imbalance", "slip", "lever"}
    assert found.values == pytest.approx({**found.values, **truth, "lever": LEVER}, rel=0.02, abs=0.002)


def test_a_control_that_never_changes_is_refused() -> None:
    straight = drive(car(), 0)
    part = straight.parts[0]
    log = replace(straight, parts=(replace(part, commands=part.commands * [1.0, 0.0]),))
    with pytest.raises(InputError) as refused:
        identify_terms(car_file(), [log])
    assert ["steering" in found.problem for found in refused.value.diagnostics] == [True]


def test_a_constant_throttle_is_said_and_not_the_limits_that_follow_from_it() -> None:
    driven = drive(car(), 0)
    (part,) = driven.parts
    commands = np.column_stack([np.full(len(part.commands), 0.5), part.commands[:, 1]])
    with pytest.raises(InputError) as refused:
        identify_car([replace(driven, parts=(replace(part, commands=commands),))])
    assert [found.problem for found in refused.value.diagnostics] == ["have commands in which throttle is always 0.5"]


def test_steering_that_changes_only_at_rest_is_refused() -> None:
    turning = drive(car(), 0)
    (part,) = turning.parts
    commands = part.commands.copy()
    commands[:50] = 0.0
    commands[50:, 1] = -0.5
    poses = drive(car(), 0).parts[0].poses.copy()
    poses[part.pose_times < 50 * STEP] = poses[0]
    log = replace(turning, parts=(replace(part, commands=commands, poses=poses),))
    with pytest.raises(InputError) as refused:
        identify_terms(car_file(), [log])
    assert ["steering hardly changes while" in found.problem for found in refused.value.diagnostics] == [True]


def test_drives_to_one_side_do_not_bend_what_only_both_sides_show() -> None:
    """A car whose wheels are straight at 0: logs to the left alone must not turn its saturation into an offset."""
    model = car(saturation=1.0)
    logs = [drive(model, seed, seconds=10.0, low=(0.15, 0.3)) for seed in range(5)]
    choice = identify_terms(car_file(), logs)
    held = {"phi_diff", "asymmetry", "yaw_offset"}
    assert not held & set(choice.identification.names)
    assert any("turns to both sides" in note for note in choice.identification.notes)
    unseen = [drive(model, 90, low=(0.15, -1.0))]
    errors = prediction_errors(choice.vehicle, unseen, choice.identification.values)
    assert errors.position[3.0] < 0.1
    both = identify_terms(car_file(), [drive(model, seed, seconds=10.0) for seed in range(3)])
    assert "phi_diff" in both.identification.names


@needs_real_logs
def test_a_real_car_that_was_driven_to_the_left_is_predicted_to_the_right() -> None:
    logs = read_logs(RAMPS, any_command_unit=True).logs
    left = [log for log in logs if "neg" not in log.name]
    right = [log for log in logs if "neg" in log.name]
    found = identify_car(left)
    known = found.identification.predicting(Settings())
    errors = prediction_errors(found.base.definition, right, found.identification.values, known)
    constant = window_errors(constant_windows(found.base.definition, right))
    assert errors.position[3.0] < 0.7 * constant.position[3.0]
    assert errors.position[1.0] < 0.7 * constant.position[1.0]


@pytest.mark.parametrize(("hold", "changes"), [(40, True), (100_000, False)], ids=["levels", "one level"])
def test_a_lag_of_the_steering_shows_where_it_changes_in_motion(hold: int, changes: bool) -> None:
    model = car()
    logs = []
    for seed, log in enumerate(drive(model, seed) for seed in range(3)):
        (part,) = log.parts
        steering = np.where(np.arange(len(part.commands)) < hold, 0.2 * (seed - 1), part.commands[:, 1])
        logs.append(replace(log, parts=(replace(part, commands=np.column_stack([part.commands[:, 0], steering])),)))
    steered = SteeringInMotion.of(logs)
    assert (steered.varies, steered.both_sides, steered.changes) == (True, True, changes)


def test_steering_of_a_car_that_stands_for_a_part_of_a_log_is_none_in_motion() -> None:
    """Its poses move by the noise alone, and by a tenth of that in most steps."""
    (driven,) = drive(car(), 0, low=(0.5, 0.2)).parts
    noise = np.random.default_rng(0).normal(0.0, 0.001, driven.poses.shape)
    right = np.column_stack([np.zeros(len(driven.commands)), np.where(driven.commands[:, 1] > 0.5, -0.5, -0.9)])
    standing = replace(driven, poses=driven.poses[-1] + noise, commands=right)
    steered = SteeringInMotion.of([Log("log", (), ("throttle", "steering"), (driven, standing))])
    assert (steered.varies, steered.both_sides) == (True, False)


def test_constant_motion_predicts_a_circle() -> None:
    times = 0.05 * np.arange(200)
    yaw = 0.5 * times
    poses = np.column_stack([2.0 * np.sin(yaw), 2.0 - 2.0 * np.cos(yaw), yaw])
    part = Part(times[:1], np.array([[0.5, 0.2]]), times, poses)
    log = Log("circle", (), ("throttle", "steering"), (part,))
    errors = window_errors(constant_windows(configured(car_file()), [log]))
    assert errors.position[3.0] < 0.01
    assert errors.yaw[3.0] < 0.01


def test_thinning_keeps_about_one_pose_per_step() -> None:
    times = 0.01 * np.arange(101)
    part = Part(times[:1], np.zeros((1, 2)), times, np.zeros((101, 3)))
    assert np.diff(thinned(part, 0.05).pose_times) == pytest.approx(0.05)
    slow = replace(part, pose_times=4.0 * times)
    assert thinned(slow, 0.05) is slow


def test_a_robot_with_two_sides_is_planned_with_as_its_logs_command_it() -> None:
    """Without limits of its own it would be planned at up to 2 m/s, whatever it can do."""
    truth = {"track": 0.3, "gain": 0.01, "imbalance": 0.0, "slip": 0.0, "slide": 0.0, "effort": 0.0, "effort_turn": 0.0}
    logs = [
        drive(load_vehicle("differential", parameters=truth), seed, 8.0, low=(-10, -10), high=22) for seed in (0, 1)
    ]
    base = for_sides(load_base_vehicle("differential"), logs)
    given = np.concatenate([part.commands.ravel() for log in logs for part in log.parts])
    limits = (pytest.approx(given.min()), pytest.approx(given.max()))
    assert dict(base.vehicle.controls) == {"left": limits, "right": limits}
    changed = with_speed(base, SimpleNamespace(values={**base.vehicle.parameters, **truth}), logs)  # type: ignore[arg-type]
    assert changed.vehicle.top_speed == pytest.approx(0.01 * given.max(), rel=0.05)


@pytest.mark.parametrize(
    ("position", "yaw", "at_bound", "refused"),
    [(0.9, 0.5, False, False), (1.1, 0.5, False, False), (1.1, 0.5, True, True), (1.3, 0.5, False, True), (0.5, 2.0, False, True)],
)  # fmt: skip
def test_a_model_that_constant_motion_beats_is_not_written(
    position: float, yaw: float, at_bound: bool, refused: bool
) -> None:
    def errors(factor: float, turn: float) -> SimpleNamespace:
        return SimpleNamespace(position={1.0: 0.01, 3.0: factor * 0.4}, yaw={1.0: 0.01, 3.0: turn * 0.3})

    pair = SimpleNamespace(errors=errors(position, yaw), constant_errors=errors(1.0, 1.0))
    found = SimpleNamespace(parameters={"L": SimpleNamespace(at_bound=at_bound)})
    said = useless_objections(found, pair)  # type: ignore[arg-type]
    assert bool(said) == refused
    assert all("constant speed and turning rate predict better" in each for each in said)


@pytest.mark.parametrize("wrong", [{"graph": "fat"}, {"auxiliary": "automatic"}])
def test_settings_that_do_not_exist_are_refused(wrong: dict[str, str]) -> None:
    with pytest.raises(InputError) as caught:
        identify(car_file(), [drive(car(), 0)], Settings(**wrong))  # type: ignore[arg-type]
    assert [d.file for d in caught.value.diagnostics] == list(wrong)
