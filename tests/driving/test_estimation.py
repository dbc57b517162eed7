"""Estimators: what they believe, from late and noisy poses, compared with a truth that the test knows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.driving import RATE, car, slow_car

from kraft.driving.car_model import CarModel
from kraft.driving.estimation import Estimator, make_estimator
from kraft.driving.estimation.pose_filter import PoseFilter
from kraft.driving.estimator_settings import Filter, Latest
from kraft.driving.messages import Observation
from kraft.errors import Code, InputError
from kraft.scenario import Sensing
from kraft.simulation.camera import MarkerCamera
from ompl_ext.arrays import Floats

START = np.array([1.0, 0.5, 1.2, 0.0])
LATEST, FILTER = Latest(kind="latest"), Filter(kind="filter")
BOTH = pytest.mark.parametrize("choice", [LATEST, FILTER], ids=lambda choice: choice.kind)


def command_at(time: float) -> Floats:
    """Left and right turns at a throttle that changes, the same in every test."""
    return np.array([0.6 + 0.3 * math.sin(0.7 * time), 0.3 * math.sin(1.1 * time)])


@dataclass
class Ride:
    """True states (n + 1, nx) at each tick of RATE and the commands (n, nu) that led there."""

    states: Floats
    commands: Floats

    @classmethod
    def of(cls, model: CarModel, seconds: float, scale: float = 1.0, start: Floats = START) -> Ride:
        """Driven by the model, with the pose moving `scale` times as fast as the model says."""
        states, commands = [start.copy()], []
        for k in range(round(seconds * RATE)):
            commands.append(command_at(k / RATE))
            after = model.advance(states[-1], commands[-1], 1.0 / RATE)
            after[:3] = states[-1][:3] + scale * (after[:3] - states[-1][:3])
            states.append(after)
        return cls(np.array(states), np.array(commands))

    def pose(self, k: int, latency: float = 0.0) -> Observation:
        x, y, theta = self.states[k, :3]
        return Observation(k / RATE, k / RATE + latency, x, y, math.remainder(theta, math.tau))

    def replay(self, estimator: Estimator, poses: list[Observation]) -> Iterator[Floats]:
        """Feed an estimator; yields its error (nx,) at every tick before the command is sent."""
        waiting = sorted(poses, key=lambda pose: pose.arrival)
        for k, command in enumerate(self.commands):
            while waiting and waiting[0].arrival <= k / RATE + 1e-9:
                estimator.observe(waiting.pop(0))
            error = estimator.estimate(k / RATE).state - self.states[k]
            error[2] = math.remainder(error[2], math.tau)
            yield error
            estimator.commanded(k / RATE, command)


def noisy(
    ride: Ride, seed: int, position: float = 0.08, heading: float = 0.1, latency: float = 0.05
) -> list[Observation]:
    rng = np.random.default_rng(seed)
    return [
        Observation(p.time, p.arrival, p.x + dx, p.y + dy, math.remainder(p.theta + dt, math.tau))
        for p, (dx, dy, dt) in (
            (ride.pose(k, latency), rng.normal(size=3) * [position, position, heading])
            for k in range(1, len(ride.commands))
        )
    ]


def rms(errors: Floats) -> Floats:
    value: Floats = np.sqrt(np.mean(errors**2, axis=0))
    return value


# Both


@BOTH
def test_before_the_first_pose_the_start_is_driven_on_by_the_commands(choice: Latest | Filter) -> None:
    ride = Ride.of(car(), 2.0)
    estimator = make_estimator(choice, car(), START)
    assert np.max(np.abs(list(ride.replay(estimator, [])))) < 1e-6
    assert estimator.estimate(2.0).age == math.inf


@BOTH
def test_a_car_that_nobody_commanded_stands(choice: Latest | Filter) -> None:
    estimate = make_estimator(choice, car(), START).estimate(5.0)
    assert estimate.time == 5.0
    assert estimate.state == pytest.approx(START, abs=1e-12)


@BOTH
@pytest.mark.parametrize("latency", [0.0, 0.04, 0.25])
@pytest.mark.parametrize("model", ["prompt", "lagging"])
def test_without_noise_a_late_pose_is_predicted_to_the_truth(
    choice: Latest | Filter, latency: float, model: str
) -> None:
    of = car() if model == "prompt" else slow_car()
    ride = Ride.of(of, 3.0)
    poses = [ride.pose(k, latency) for k in range(1, len(ride.commands))]
    assert np.max(np.abs(list(ride.replay(make_estimator(choice, of, START), poses)))) < 1e-3


@BOTH
def test_the_age_is_that_of_the_newest_pose_that_arrived(choice: Latest | Filter) -> None:
    estimator = make_estimator(choice, car(), START)
    estimator.observe(Observation(0.5, 0.6, 1.0, 0.5, 1.2))
    assert estimator.estimate(0.7).age == pytest.approx(0.2)


@BOTH
@pytest.mark.parametrize("changed", [{"x": math.nan}, {"y": -math.inf}, {"theta": math.nan}, {"time": math.inf}])
def test_a_pose_that_is_not_finite_is_refused_and_changes_nothing(
    choice: Latest | Filter, changed: dict[str, float]
) -> None:
    ride = Ride.of(car(), 1.0)
    subject = make_estimator(choice, car(), START)
    list(ride.replay(subject, noisy(ride, 1)))
    before = subject.estimate(1.1).state
    with pytest.raises(InputError) as refused:
        subject.observe(replace(Observation(1.0, 1.0, 0.0, 0.0, 0.0), **changed))
    (problem,) = refused.value.diagnostics
    assert (problem.file, problem.argument, problem.code) == ("observation", True, Code.VALUE)
    assert np.array_equal(subject.estimate(1.1).state, before)


@BOTH
def test_a_repeated_pose_counts_once(choice: Latest | Filter) -> None:
    ride = Ride.of(car(), 1.0)
    poses = noisy(ride, 1)
    once = list(ride.replay(make_estimator(choice, car(), START), poses))
    twice = list(ride.replay(make_estimator(choice, car(), START), [p for pose in poses for p in (pose, pose)]))
    assert np.array_equal(once, twice)


@BOTH
def test_poses_out_of_order_lead_to_the_same_estimate(choice: Latest | Filter) -> None:
    ride = Ride.of(car(), 1.0)
    one, other = (make_estimator(choice, car(), START) for _ in range(2))
    poses = noisy(ride, 1, latency=0.0)[:20]
    shuffled = [poses[i] for i in (0, 2, 1, 5, 4, 3, *range(6, 15), 19, 18, 16, 17, 15)]
    for estimator, order in ((one, poses), (other, shuffled)):
        for k, command in enumerate(ride.commands):
            estimator.commanded(k / RATE, command)
        for pose in order:
            estimator.observe(pose)
    assert one.estimate(1.0).state == pytest.approx(other.estimate(1.0).state, abs=1e-12)


@BOTH
def test_the_heading_does_not_jump_where_it_passes_half_a_turn(choice: Latest | Filter) -> None:
    start = np.array([0.0, 0.0, 3.0, 0.4])
    estimator = make_estimator(choice, car(), start)
    headings = []
    for k in range(90):
        theta = 3.0 + 0.5 * k / RATE
        estimator.observe(Observation(k / RATE, k / RATE, 0.0, 0.0, math.remainder(theta, math.tau)))
        headings.append(float(estimator.estimate(k / RATE).state[2]))
        estimator.commanded(k / RATE, np.zeros(2))
    assert np.abs(np.diff(headings)).max() < 0.1
    assert headings[-1] == pytest.approx(3.0 + 0.5 * 89 / RATE, abs=0.15)


@BOTH
def test_asking_about_the_future_or_twice_changes_nothing(choice: Latest | Filter) -> None:
    ride = Ride.of(car(), 1.0)
    poses = noisy(ride, 4)
    plain, asked = (make_estimator(choice, car(), START) for _ in range(2))
    errors = list(ride.replay(plain, poses))
    for k, command in enumerate(ride.commands):
        for pose in [p for p in poses if (k - 1) / RATE + 1e-9 < p.arrival <= k / RATE + 1e-9]:
            asked.observe(pose)
        asked.estimate(k / RATE + 0.9)
        asked.estimate(k / RATE)
        error = asked.estimate(k / RATE).state - ride.states[k]
        assert error[:2] == pytest.approx(errors[k][:2], abs=1e-12)
        asked.commanded(k / RATE, command)


@BOTH
def test_commands_that_go_back_in_time_are_refused(choice: Latest | Filter) -> None:
    estimator = make_estimator(choice, car(), START)
    estimator.commanded(1.0, np.zeros(2))
    with pytest.raises(ValueError, match=r"commanded at 0\.5 s after a command at 1\.0 s"):
        estimator.commanded(0.5, np.zeros(2))


@BOTH
def test_a_pose_that_the_camera_lost_for_long_is_taken_up_again(choice: Latest | Filter) -> None:
    ride = Ride.of(car(), 20.0, scale=1.1)
    poses = [ride.pose(k) for k in range(1, len(ride.commands)) if k < 90 or k > 510]
    errors = np.array(list(ride.replay(make_estimator(choice, car(), START), poses)))
    assert np.hypot(*errors[500, :2]) > 0.2
    assert np.hypot(*errors[560, :2]) < 0.05


# Latest


def test_latest_takes_the_newest_pose_at_its_word_and_the_speed_from_the_commands() -> None:
    estimator = make_estimator(LATEST, car(), START)
    estimator.commanded(0.0, np.array([1.0, 0.0]))
    estimator.observe(Observation(2.0, 2.0, -3.0, 4.0, 0.25))
    state = estimator.estimate(2.0).state
    assert state[:3] == pytest.approx([-3.0, 4.0, 0.25], abs=1e-9)
    assert state[3] == pytest.approx(0.6228, abs=1e-6)


def test_latest_ignores_a_pose_older_than_the_newest() -> None:
    estimator = make_estimator(LATEST, car(), START)
    estimator.observe(Observation(1.0, 1.0, 2.0, 2.0, 0.0))
    estimator.observe(Observation(0.9, 1.1, 9.0, 9.0, 0.0))
    assert estimator.estimate(1.1).state[:2] == pytest.approx([2.0, 2.0], abs=1e-9)


def test_for_replanning_latest_takes_the_mean_of_the_poses_in_the_window() -> None:
    estimator = make_estimator(LATEST, car(), START)
    for time, y in ((0.0, 9.0), (1.0, 0.0), (1.2, 0.06), (1.3, 0.0)):  # the first is too old to count
        estimator.observe(Observation(time, time, 0.0, y, 0.0))
    estimate = estimator.replanning_estimate(1.5)
    assert estimate.state[1] == pytest.approx(0.02, abs=1e-9)
    assert estimate.age == pytest.approx(0.2)


def test_headings_far_off_do_not_turn_the_mean() -> None:
    """Two outliers more than half a turn apart leave the headings after them a turn away from those before."""
    estimator = make_estimator(LATEST, car(), np.zeros(4))
    for k, theta in enumerate((0.0, 0.0, 0.0, 0.0, 0.0, 1.75, -1.75, 0.0, 0.0, 0.0)):
        estimator.observe(Observation(k / RATE, k / RATE, 0.0, 0.0, theta))
    theta = float(estimator.replanning_estimate(9 / RATE).state[2])
    assert math.remainder(theta, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_without_a_window_replanning_has_the_newest_pose() -> None:
    estimator = make_estimator(Latest(kind="latest", replanning_window=0.0), car(), START)
    for k in range(5):
        estimator.observe(Observation(k / RATE, k / RATE, 0.1 * k, 0.0, 0.0))
    assert np.array_equal(estimator.replanning_estimate(0.5).state, estimator.estimate(0.5).state)


@BOTH
@pytest.mark.parametrize(("noise", "most"), [(0.0, 1e-3), (0.08, 0.04)])
def test_for_replanning_poses_are_predicted_to_the_truth(choice: Latest | Filter, noise: float, most: float) -> None:
    ride, errors = Ride.of(car(), 15.0), []
    estimator = make_estimator(choice, car(), START)
    for k, pose in enumerate(noisy(ride, 1, noise, noise, latency=0.0), 1):
        estimator.commanded((k - 1) / RATE, ride.commands[k - 1])
        estimator.observe(pose)
        errors.append((estimator.replanning_estimate(k / RATE).state - ride.states[k])[:2])
    assert rms(np.array(errors)).max() < most


def test_after_longer_than_the_window_without_poses_the_estimate_is_the_new_pose() -> None:
    estimator = make_estimator(LATEST, car(), START)
    for time, x in ((1.0, 0.0), (1.1, 0.0), (5.0, 3.0)):
        estimator.observe(Observation(time, time, x, 0.0, 0.0))
    assert estimator.replanning_estimate(5.0).state[0] == pytest.approx(3.0)


# Filter


@pytest.mark.parametrize("seed", range(4))
def test_the_filter_is_far_better_than_the_poses(seed: int) -> None:
    ride = Ride.of(car(), 15.0)
    poses = noisy(ride, seed)
    filtered, raw = (
        rms(np.array(list(ride.replay(make_estimator(choice, car(), START), poses)))[30:])
        for choice in (FILTER, LATEST)
    )
    assert np.all(filtered[:3] < 0.35 * raw[:3])


def test_with_matched_noise_the_filters_covariance_says_how_far_off_it_is() -> None:
    position, heading = 0.08, 0.1
    settings = Filter(
        kind="filter",
        position_noise=position,
        heading_noise_deg=math.degrees(heading),
        drift=1e-3,
        heading_drift_deg=0.05,
        speed_drift=1e-3,
    )
    distances = []
    for seed in range(12):
        ride = Ride.of(car(), 6.0)
        estimator = make_estimator(settings, car(), START)
        assert isinstance(estimator, PoseFilter)
        for k, error in enumerate(ride.replay(estimator, noisy(ride, seed, position, heading, latency=0.0))):
            if k > 60 and k % 20 == 0:
                covariance = estimator.posterior.covariance[:3, :3]
                distances.append(error[:3] @ np.linalg.solve(covariance, error[:3]))
    assert 1.8 < np.mean(distances) < 4.5  # chi-squared with three degrees of freedom


def test_the_filter_finds_out_that_the_car_is_faster_than_its_model() -> None:
    ride = Ride.of(car(), 4.0, scale=1.6)
    estimator = make_estimator(FILTER, car(), START)
    list(ride.replay(estimator, noisy(ride, 2, 0.03, 0.03)))
    true = np.hypot(*(ride.states[-1, :2] - ride.states[-2, :2])) * RATE
    assert true - ride.states[-1, 3] > 0.1
    assert estimator.estimate(4.0).state[3] == pytest.approx(true, abs=0.05)


@pytest.mark.parametrize("far", [0.5, 1.0, 10.0])
def test_a_single_outlier_moves_the_filter_by_little(far: float) -> None:
    ride = Ride.of(car(), 6.0)
    poses = [ride.pose(k) for k in range(1, len(ride.commands))]
    p = poses[119]
    poses[119] = Observation(p.time, p.arrival, p.x + far, p.y, math.remainder(p.theta + 1.5, math.tau))
    errors = np.array(list(ride.replay(make_estimator(FILTER, car(), START), poses)))
    assert np.hypot(*errors[:, :2].T).max() < 0.08
    assert np.abs(errors[:, 2]).max() < 0.15


@pytest.mark.parametrize("jump", [(0.5, 0.0, 0.0), (0.0, -2.0, 0.0), (0.3, 0.3, 2.0)])
def test_the_filter_follows_a_car_that_was_moved_within_a_second(jump: tuple[float, float, float]) -> None:
    before, moved = Ride.of(car(), 3.0), np.zeros(4)
    moved[:3] = jump
    after = Ride.of(car(), 4.0, start=before.states[-1] + moved)
    ride = Ride(np.concatenate([before.states[:-1], after.states]), np.concatenate([before.commands, after.commands]))
    errors = np.array(list(ride.replay(make_estimator(FILTER, car(), START), noisy(ride, 3, 0.02, 0.02, 0.0))))
    assert np.hypot(*errors[90, :2]) > 0.4
    assert np.hypot(*errors[120:, :2].T).max() < 0.08
    assert np.abs(errors[120:, 2]).max() < 0.06


@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_the_filter_beats_the_newest_pose_behind_the_camera_itself(latency: float) -> None:
    ride = Ride.of(car(), 12.0)
    cam = MarkerCamera(Sensing(latency=latency), 0.2, 5)
    poses = []
    for k, state in enumerate(ride.states[:-1]):
        c, s = math.cos(state[2]), math.sin(state[2])
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        pose = cam.expose(k / RATE, np.array([state[0], state[1], 0.2]), rotation)
        poses += [pose] if pose is not None else []
    filtered, raw = (
        rms(np.array(list(ride.replay(make_estimator(choice, car(), START), poses)))) for choice in (FILTER, LATEST)
    )
    # what remains: the camera's bias, its mean error away from itself, and headings that err for half a metre
    assert np.hypot(*filtered[:2]) < 0.6 * np.hypot(*raw[:2])
    assert filtered[2] < 0.7 * raw[2]


def test_the_filter_is_deterministic() -> None:
    ride = Ride.of(car(), 2.0)
    runs = [list(ride.replay(make_estimator(FILTER, car(), START), noisy(ride, 1))) for _ in range(2)]
    assert np.array_equal(*runs)
