"""The adaptive estimator: its covariance says how far off it is, and it finds delay and parameters while it drives."""

from __future__ import annotations

import itertools
import math
import pickle
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from support.adaptive import BEGIN, OTHER, correlated, driven, exciting, pose_at, standing, vehicle
from support.driving import RATE

from kraft.driving.car_model import CarModel
from kraft.driving.estimation import make_estimator
from kraft.driving.estimation.adaptive import AdaptiveEstimator, online_parameters
from kraft.driving.estimation.correlated_filter import MOVED_AFTER
from kraft.driving.estimation.pose_filter import ProcessModel
from kraft.driving.estimation.sliding_window import SIGNIFICANT
from kraft.driving.estimator_settings import Adaptive
from kraft.driving.messages import Estimate, Observation, PoseBelief
from kraft.errors import Code, InputError
from kraft.vehicles.benchmark import BENCHMARK
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import ParameterRange

SIGMAS = np.array([0.03, 0.03, 0.04])
ACCURATE = np.array([0.005, 0.005, 0.01])
DEFAULT = Adaptive(kind="adaptive")
MATCHED = {
    "position_noise": 0.03, "heading_noise_deg": math.degrees(0.04), "position_offset": 1e-4,
    "heading_offset_deg": 0.01, "correlation_time": 0.7, "identify": False, "compensate": False,
}  # fmt: skip


def estimator(settings: Adaptive = DEFAULT) -> AdaptiveEstimator:
    found = make_estimator(settings, CarModel(vehicle()), BEGIN)
    assert isinstance(found, AdaptiveEstimator)
    return found


def squared_error(subject: AdaptiveEstimator, state: Floats) -> float:
    """Normalised squared error of the stated pose; its mean is 3 if the covariance is right."""
    belief = subject.belief
    assert belief is not None
    error = state[:3] - belief.mean
    error[2] = math.remainder(error[2], math.tau)
    return float(error @ np.linalg.solve(belief.covariance, error))


def squared_errors(settings: Adaptive, share: float, seed: int) -> list[float]:
    """Normalised squared errors in a drive of a car that moves by the process model of the filter, its noise included.

    `share` is the correlated share of the variance of the poses.
    """
    rng, model, subject = np.random.default_rng(seed), CarModel(vehicle()), estimator(settings)
    motion, ticks = ProcessModel(model), round(10.0 * RATE)
    start = settings.start_position_noise, settings.start_position_noise, math.radians(settings.start_heading_noise_deg)
    spread = np.array([settings.drift, settings.drift, math.radians(settings.heading_drift_deg), 0.0, 0.0])
    spread[4] = settings.speed_drift
    state, errors = np.append(BEGIN, 0.0), correlated(rng, ticks, SIGMAS, share)
    state[:3] += rng.normal(size=3) * start
    found = []
    for k in range(ticks):
        if k > 0:
            subject.observe(pose_at(k, state, errors[k]))
            if k > 60 and k % 15 == 0:
                found.append(squared_error(subject, state))
        subject.commanded(k / RATE, exciting(k / RATE))
        state = motion.advance(state, [(exciting(k / RATE), 1.0 / RATE)])
        state = state + rng.normal(size=5) * spread * math.sqrt(1.0 / RATE)
    return found


def test_a_pose_that_is_not_finite_is_refused_and_changes_nothing() -> None:
    subject = estimator()
    before = subject.estimate(0.2).state
    with pytest.raises(InputError, match="nan"):
        subject.observe(Observation(0.1, 0.1, math.nan, 0.0, 0.0))
    assert np.array_equal(subject.estimate(0.2).state, before)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_with_matched_noise_the_covariance_says_how_far_off_the_filter_is(share: float) -> None:
    settings = Adaptive(kind="adaptive", correlated_share=share, **MATCHED)  # type: ignore[arg-type]
    assert 2.0 < np.mean([squared_errors(settings, share, seed) for seed in range(12)]) < 4.2


def test_a_filter_that_takes_correlated_errors_as_independent_is_far_too_certain() -> None:
    settings = Adaptive(kind="adaptive", correlated=False, **MATCHED)  # type: ignore[arg-type]
    assert np.mean([squared_errors(settings, 0.5, seed) for seed in range(6)]) > 8.0


def drive(
    subject: AdaptiveEstimator, states: Matrix, commands: Matrix, errors: Matrix, repeats: int = 1
) -> tuple[list[float], Estimate]:
    """Normalised squared errors after 2 s, and the last estimate for replanning; one is made every second."""
    found, estimate = [], subject.replanning_estimate(0.0)
    for k, command in enumerate(commands):
        if k > 0:
            for _ in range(repeats):
                subject.observe(pose_at(k, states[k], errors[k]))
            if k > 60 and k % 15 == 0:
                found.append(squared_error(subject, states[k]))
        if k % 30 == 27:
            estimate = subject.replanning_estimate(k / RATE)
        subject.commanded(k / RATE, command)
    return found, estimate


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_with_the_default_settings_it_is_not_too_certain(share: float) -> None:
    """Noise, parameters and delay are estimated; a possible offset of the camera makes it cautious."""
    states, commands = driven(exciting, 8.0, {}, 0.0)
    found = []
    for seed in range(8):
        errors = correlated(np.random.default_rng(seed), len(states), SIGMAS, share)
        found += drive(estimator(), states, commands, errors)[0]
    assert 0.2 < np.mean(found) < 4.2


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.2])
def test_the_horizon_converges_to_the_delay(delay: float) -> None:
    states, commands = driven(exciting, 10.0, OTHER, delay)
    subject = estimator()
    assert subject.horizon == 0.0
    _, estimate = drive(subject, states, commands, correlated(np.random.default_rng(1), len(states), ACCURATE, 0.0))
    assert subject.horizon == pytest.approx(delay, abs=0.03)
    assert estimate.uncertainty is not None
    assert estimate.uncertainty.delay < 0.03
    now = (len(commands) - 4) / RATE  # when the last estimate was asked for; in it a command acts a delay later
    assert estimate.time == pytest.approx(now + subject.horizon, abs=0.05)
    assert estimate.age < 0.05


def stating(delay: float, std: float, settings: Adaptive = DEFAULT) -> AdaptiveEstimator:
    """Estimator of a vehicle whose file states the delay of its commands."""
    return AdaptiveEstimator(settings, CarModel(replace(vehicle(), delay=(delay, std))), BEGIN)


def test_a_stated_delay_is_known_from_the_start() -> None:
    subject = stating(0.05, 0.01)
    estimate = subject.replanning_estimate(0.0)
    assert subject.horizon == 0.05
    assert estimate.time == pytest.approx(0.05)
    assert estimate.uncertainty is not None
    assert estimate.uncertainty.delay == 0.01


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.2])
def test_a_stated_delay_that_the_poses_contradict_yields(delay: float) -> None:
    """With a camera that is known to be accurate; errors as large as the default would hide the contradiction."""
    states, commands = driven(exciting, 10.0, OTHER, delay)
    subject = stating(0.03, 0.01, Adaptive(kind="adaptive", position_noise=0.01, heading_noise_deg=1.0))
    _, estimate = drive(subject, states, commands, correlated(np.random.default_rng(1), len(states), ACCURATE, 0.0))
    assert subject.horizon == pytest.approx(delay, abs=0.03)
    assert estimate.uncertainty is not None
    assert abs(subject.horizon - delay) < 3.0 * estimate.uncertainty.delay


def test_parameters_of_the_car_appear_in_the_estimate_and_in_the_model() -> None:
    states, commands = driven(exciting, 10.0, OTHER, 0.1)
    model = CarModel(vehicle())
    subject = AdaptiveEstimator(DEFAULT, model, BEGIN)
    assert subject.replanning_estimate(0.0).parameters is None
    curvature = model.curvature(0.3)
    _, estimate = drive(subject, states, commands, correlated(np.random.default_rng(1), len(states), ACCURATE, 0.0))
    assert estimate.parameters is not None
    found = dict(zip(vehicle().parameters, estimate.parameters, strict=True))
    assert found["L"] == pytest.approx(OTHER["L"], abs=0.04)
    assert found["phi_diff"] == pytest.approx(OTHER["phi_diff"], abs=0.02)
    assert model.curvature(0.3) != curvature
    true = CarModel(vehicle().with_parameters(OTHER)).curvature(0.3)
    assert model.curvature(0.3) == pytest.approx(true, rel=0.08)


def test_parameters_change_only_if_they_differ_significantly() -> None:
    """Otherwise plans would cost something else in every cycle, by less than what is known."""
    states, commands = driven(exciting, 10.0, OTHER, 0.1)
    subject, used = estimator(), list[Floats]()
    errors = correlated(np.random.default_rng(1), len(states), ACCURATE, 0.0)
    for k, command in enumerate(commands):
        if k > 0:
            subject.observe(pose_at(k, states[k], errors[k]))
        if k % 15 == 14:
            parameters, learned = subject.replanning_estimate(k / RATE).parameters, subject.learned
            if parameters is not None and learned is not None:
                change = subject._window.parameters.model_values(learned.identified.rho) - parameters
                covariance = subject._covariance_of(learned.identified)
                free = np.flatnonzero(np.diag(covariance) > 0.0)
                assert change[free] @ np.linalg.solve(covariance[np.ix_(free, free)], change[free]) <= SIGNIFICANT
                used.append(parameters)
        subject.commanded(k / RATE, command)
    changes = sum(not np.array_equal(one, two) for one, two in itertools.pairwise(used))
    assert 1 <= changes < 0.5 * len(used)


def test_without_identification_and_compensation_the_model_stays_and_commands_act_at_once() -> None:
    states, commands = driven(exciting, 6.0, OTHER, 0.1)
    subject = estimator(Adaptive(kind="adaptive", identify=False, compensate=False))
    _, estimate = drive(subject, states, commands, correlated(np.random.default_rng(1), len(states), ACCURATE, 0.0))
    assert (estimate.parameters, subject.horizon) == (None, 0.0)
    assert estimate.uncertainty is not None
    assert estimate.uncertainty.delay == 0.0


def test_a_car_that_stands_learns_nothing() -> None:
    states, commands = driven(standing, 6.0, {}, 0.0)
    subject = estimator()
    _, estimate = drive(subject, states, commands, correlated(np.random.default_rng(1), len(states), SIGMAS, 0.0))
    assert (estimate.parameters, subject.horizon) == (None, 0.0)
    assert estimate.uncertainty is not None
    assert estimate.uncertainty.delay == DEFAULT.delay_std


def test_poses_show_a_motion_that_the_filter_does_not_see() -> None:
    """By the parameters in use the drive hardly moves the car."""
    states, commands = driven(exciting, 6.0, {}, 0.0)
    subject = estimator(Adaptive(kind="adaptive", identify=False))
    subject._model.set_parameters(np.array(list({**vehicle().parameters, "v_delta": 0.01}.values())))
    seen = list[bool]()
    for k in range(len(commands)):
        subject._filter.posterior.mean[subject._model.velocities] = 0.0
        subject.observe(pose_at(k, states[k], np.zeros(3)))
        subject._filter.posterior.mean[subject._model.velocities] = 0.0
        seen.append(subject._moves())
        subject.commanded(k / RATE, commands[k])
    assert not any(seen[:10])
    assert np.mean(seen[round(1.5 * RATE) :]) > 0.8


def test_the_uncertainty_grows_until_the_horizon() -> None:
    """The covariance is that of the state in which a command will act, not that of the newest pose."""
    states, commands = driven(exciting, 6.0, {}, 0.0)
    subject = estimator()
    drive(subject, states, commands, correlated(np.random.default_rng(1), len(states), SIGMAS, 0.0))
    belief = subject.belief
    assert belief is not None
    later = subject.replanning_estimate(6.5)
    assert later.uncertainty is not None
    assert np.all(np.diag(later.uncertainty.state)[:3] > np.diag(belief.covariance))


@pytest.mark.parametrize("strength", [0.5, 1.5])
def test_before_it_is_identified_the_speed_of_another_car_is_as_uncertain_as_its_parameters(strength: float) -> None:
    states, commands = driven(lambda time: np.array([0.9, 0.0]), 1.2, {"v_delta": strength * 0.70724}, 0.0)
    subject = estimator()
    _, estimate = drive(subject, states, commands, correlated(np.random.default_rng(2), len(states), SIGMAS, 0.5))
    assert estimate.uncertainty is not None
    off = float(estimate.state[3] - states[27, 3])
    assert 0.04 < abs(off) < 3.0 * math.sqrt(estimate.uncertainty.state[3, 3])


def test_the_drive_is_less_uncertain_once_it_is_identified() -> None:
    states, commands = driven(exciting, 8.0, {}, 0.0)
    subject = estimator()
    before = subject.uncertainty(0.0).acceleration
    drive(subject, states, commands, correlated(np.random.default_rng(1), len(states), ACCURATE, 0.0))
    assert before == pytest.approx(0.5, abs=0.05)
    assert subject.uncertainty(8.0).acceleration < 0.3 * before


# Errors that the noise does not explain


def with_jump(at: float, until: float, jump: Floats) -> tuple[Matrix, Matrix, Matrix]:
    """True states, commands, and errors of poses that are larger by a `jump` (3,) from `at` until `until` (s)."""
    states, commands = driven(exciting, 10.0, {}, 0.0)
    errors = correlated(np.random.default_rng(3), len(states), ACCURATE, 0.0)
    times = np.arange(len(states)) / RATE
    errors[(times >= at) & (times < until)] += jump
    return states, commands, errors


def beliefs_of(
    subject: AdaptiveEstimator, states: Matrix, commands: Matrix, errors: Matrix
) -> Iterator[tuple[Floats, PoseBelief]]:
    """True state and the belief after each pose of a drive."""
    for k, command in enumerate(commands):
        subject.observe(pose_at(k, states[k], errors[k]))
        if k % 30 == 27:
            subject.replanning_estimate(k / RATE)
        subject.commanded(k / RATE, command)
        assert subject.belief is not None
        yield states[k], subject.belief


def distances(subject: AdaptiveEstimator, states: Matrix, commands: Matrix, errors: Matrix) -> tuple[Floats, Floats]:
    """Distance of the estimated from the true position after each pose, and its standard deviation, (n,) m."""
    found, sigmas = [], []
    for state, belief in beliefs_of(subject, states, commands, errors):
        found.append(math.dist(belief.mean[:2], state[:2]))
        sigmas.append(math.sqrt(np.linalg.eigvalsh(belief.covariance[:2, :2])[-1]))
    return np.array(found), np.array(sigmas)


@pytest.mark.parametrize("duration", [0.1, 0.4, 0.8])
def test_errors_of_poses_that_are_large_for_a_while_do_not_move_the_estimate(duration: float) -> None:
    away, sigma = distances(estimator(), *with_jump(5.0, 5.0 + duration, np.array([0.2, -0.4, 0.0])))
    assert away[round(4.0 * RATE) :].max() < 0.08
    assert np.all(away < 3.0 * sigma)


def test_the_estimate_follows_a_vehicle_that_was_moved() -> None:
    states, commands, errors = with_jump(5.0, 5.0, np.zeros(3))
    states[round(5.0 * RATE) :, :2] += 0.2, -0.4
    away, sigma = distances(estimator(), states, commands, errors)
    assert away[round(5.5 * RATE)] > 0.3
    doubtful = slice(round((5.0 + MOVED_AFTER + 0.1) * RATE), None)
    assert np.all(away[doubtful] < 3.0 * sigma[doubtful])
    assert away[round((5.0 + MOVED_AFTER + 1.0) * RATE) :].max() < 0.12


def turned(states: Matrix, at: float, until: float, rate: float) -> Matrix:
    """Motion (n, nx) of a car that from `at` until `until` (s) turns otherwise than its model, by `rate` rad/s."""
    found, heading = states.copy(), states[:, 2].copy()
    for k in range(1, len(states)):
        heading[k:] += rate / RATE if at <= k / RATE < until else 0.0
        step, turn = states[k, :2] - states[k - 1, :2], heading[k - 1] - states[k - 1, 2]
        ahead = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        found[k, :2] = found[k - 1, :2] + ahead @ step
    found[:, 2] = heading
    return found


@pytest.mark.parametrize("rate", [-20.0, 30.0, 40.0])
def test_a_car_that_turns_otherwise_than_its_model_is_followed(rate: float) -> None:
    """Also if its parameters count as known: a turn of the car comes little by little, errors of poses at once."""
    states, commands = driven(exciting, 10.0, {}, 0.0)
    states = turned(states, 5.0, 5.6, math.radians(rate))
    known = {name: ParameterRange(r.low, r.high, 0.05 * r.std) for name, r in vehicle().ranges.items()}
    subject = make_estimator(DEFAULT, CarModel(replace(vehicle(), ranges=known)), BEGIN)
    assert isinstance(subject, AdaptiveEstimator)
    errors = correlated(np.random.default_rng(3), len(states), ACCURATE, 0.0)
    away = [
        abs(math.degrees(math.remainder(belief.mean[2] - state[2], math.tau)))
        for state, belief in beliefs_of(subject, states, commands, errors)
    ]
    assert max(away[: round(5.0 * RATE)]) < 2.0
    assert max(away) < 7.0
    assert max(away[round(5.7 * RATE) :]) < 4.0


# Bad input


def test_a_vehicle_without_ranges_is_refused() -> None:
    with pytest.raises(InputError) as caught:
        online_parameters(BENCHMARK, DEFAULT)
    (problem,) = caught.value.diagnostics
    assert (problem.file, problem.code) == ("benchmark", Code.MISSING)
    assert all(name in problem.problem for name in BENCHMARK.parameters)


def test_a_vehicle_that_states_some_ranges_is_refused_for_the_others() -> None:
    some = replace(vehicle(), ranges={name: vehicle().ranges[name] for name in ("L", "tau")})
    with pytest.raises(InputError) as caught:
        make_estimator(DEFAULT, CarModel(some), BEGIN)
    assert "phi_diff, v_delta, u_0, a_x, a_y" in caught.value.diagnostics[0].problem


@pytest.mark.parametrize("wrong", [ParameterRange(1.0, 1.0, 0.1), ParameterRange(0.0, 1.0, 0.0)])
def test_a_range_that_is_none_is_refused_in_code(wrong: ParameterRange) -> None:
    with pytest.raises(ValueError, match="range of L"):
        replace(vehicle(), ranges={"L": wrong})
    with pytest.raises(ValueError, match="'M', which is not a parameter"):
        replace(vehicle(), ranges={"M": ParameterRange(0.0, 1.0, 0.1)})


def test_a_repeated_pose_changes_nothing() -> None:
    states, commands = driven(exciting, 5.0, OTHER, 0.1)
    errors = correlated(np.random.default_rng(2), len(states), ACCURATE, 0.0)
    (_, once), (_, twice) = (drive(estimator(), states, commands, errors, repeats) for repeats in (1, 2))
    assert np.array_equal(once.state, twice.state)
    assert once.parameters is not None
    assert twice.parameters is not None
    assert np.array_equal(once.parameters, twice.parameters)


def test_poses_out_of_order_lead_to_the_same_filter() -> None:
    states, commands = driven(exciting, 1.0, {}, 0.0)
    errors = correlated(np.random.default_rng(3), len(states), SIGMAS, 0.0)
    poses = [pose_at(k, states[k], errors[k]) for k in range(1, 21)]
    shuffled = [poses[i] for i in (0, 2, 1, 5, 4, 3, *range(6, 15), 19, 18, 16, 17, 15)]
    beliefs = []
    for order in (poses, shuffled):
        subject = estimator()
        for k, command in enumerate(commands):
            subject.commanded(k / RATE, command)
        for pose in order:
            subject.observe(pose)
        assert subject.belief is not None
        beliefs.append(subject.belief)
    assert beliefs[0].time == beliefs[1].time == 20 / RATE
    assert beliefs[0].mean == pytest.approx(beliefs[1].mean, abs=1e-9)
    assert beliefs[0].covariance == pytest.approx(beliefs[1].covariance, abs=1e-12)


def test_poses_that_go_back_in_time_do_not_disturb_the_identification() -> None:
    """The window leaves them out, and the drive it is given stays in order."""
    states, commands = driven(exciting, 8.0, OTHER, 0.1)
    errors = correlated(np.random.default_rng(4), len(states), ACCURATE, 0.0)
    subject = estimator()
    for k, command in enumerate(commands):
        late = k - 1 if k % 2 == 0 else k + 1  # each second pose arrives before the one that is older
        if 0 < late < len(states):
            subject.observe(pose_at(late, states[late], errors[late]))
        if k % 30 == 27:
            estimate = subject.replanning_estimate(k / RATE)
        subject.commanded(k / RATE, command)
    assert subject.horizon == pytest.approx(0.1, abs=0.04)
    assert estimate.parameters is not None
    assert estimate.parameters[1] == pytest.approx(OTHER["phi_diff"], abs=0.02)


def test_a_pose_before_the_start_is_ignored() -> None:
    subject = estimator()
    subject.observe(Observation(-1.0, 0.1, 9.0, 9.0, 0.0))
    assert subject.belief is None
    assert subject.replanning_estimate(0.2).state == pytest.approx(BEGIN)


def test_poses_that_stay_where_they_jumped_to_are_half_believed_at_first() -> None:
    subject = estimator()
    beliefs = [(0.0, 0.0)]
    for k in range(1, 300):
        subject.observe(pose_at(k, BEGIN + np.array([1.0 if k > 40 else 0.0, 0.0, 0.0, 0.0]), np.zeros(3)))
        assert subject.belief is not None
        beliefs.append((subject.belief.mean[0] - BEGIN[0], math.sqrt(subject.belief.covariance[0, 0])))
    (before, _), (jumped, jumped_std), (settled, settled_std) = (
        beliefs[60],
        beliefs[42 + round(MOVED_AFTER * RATE)],
        beliefs[-1],
    )
    assert abs(before) < 0.01
    assert 0.3 < jumped < 0.7  # either the car was moved or the poses are wrong
    assert jumped_std > 0.3
    assert settled == pytest.approx(1.0, abs=0.1)
    assert settled_std < 0.1


def test_the_history_of_an_estimator_that_nobody_asks_stays_bounded() -> None:
    """As in the controller and the brake guard of a drive, where the planner identifies."""
    subject = estimator()
    sizes = []
    for k in range(1, 3001):
        time = 0.1 * k
        subject.commanded(time, np.array([0.5, 0.0]))
        subject.observe(Observation(time, time, 0.02 * k, 0.0, 0.0))
        if k % 1000 == 0:
            sizes.append(len(pickle.dumps(subject._history)))
    assert sizes[2] < 1.2 * sizes[0] + 1000
