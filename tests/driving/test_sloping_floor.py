"""Cameras that take the floor as level: what they measure on a slope, and what the adaptive estimator makes of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.adaptive import BEGIN, correlated, driven, exciting, pose_at, vehicle
from support.driving import RATE

from kraft.driving.car_model import CarModel
from kraft.driving.estimation import CameraModel
from kraft.driving.estimation.adaptive import HOLDS, AdaptiveEstimator, Learned, online_parameters
from kraft.driving.estimation.drive_history import RecordedDrive
from kraft.driving.estimation.sliding_window import Gaussian, Identified
from kraft.driving.estimation.sloping_floor import SLOPE, ConstantOfDrive, slope_deviations, slope_told
from kraft.driving.estimator_settings import Adaptive
from kraft.scenario import Sensing
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.scenario.truth import Tilt
from kraft.simulation.camera import MarkerCamera
from kraft.simulation.floor_frame import FloorFrame
from kraft.vehicles import GRAVITY, felt_gravity
from ompl_ext.arrays import Floats
from ompl_ext.names import FORCE

CAMERA = CameraModel((1.0, 3.0, 5.0), MARKER_HEIGHT, (0.0, 0.0))
SETTINGS = Adaptive(kind="adaptive", compensate=False)
SLOPES = [np.array([0.0, 0.0]), np.array([0.0, 0.15]), np.array([-0.1, 0.05])]


def poses(count: int = 20) -> Floats:
    rng = np.random.default_rng(0)
    drawn: Floats = np.column_stack([rng.uniform(-2.0, 6.0, (count, 2)), rng.uniform(-math.pi, math.pi, count)])
    return drawn


def observed(camera: CameraModel, pose: Floats, slope: Floats) -> Floats:
    """Pose (3,) that a camera measures of a pose (3,) on a floor with `slope` (2,)."""
    return camera.seen(pose[None], slope)[0]


@pytest.mark.parametrize(("angle", "uphill"), [(9.0, 90.0), (7.0, -90.0), (5.0, 30.0)])
def test_it_measures_what_the_simulated_camera_does(angle: float, uphill: float) -> None:
    """The simulated floor leans about the origin, where this camera takes it to be level."""
    frame = FloorFrame.of(Tilt(angle_deg=angle, uphill_deg=uphill))
    camera = MarkerCamera(Sensing(noise_scale=0.0, dropout=0.0), MARKER_HEIGHT, 0)
    for k, pose in enumerate(poses()):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        rotation = frame.rotation @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        seen = camera.expose(k / 30, frame.to_world(np.array([pose[0], pose[1], MARKER_HEIGHT])), rotation)
        assert seen is not None
        expected = observed(CAMERA, pose, frame.rotation[2, :2])
        assert (seen.x, seen.y) == pytest.approx(expected[:2], abs=1e-3)
        assert math.remainder(seen.theta - expected[2], math.tau) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("slope", SLOPES)
def test_many_poses_are_measured_as_each_is(slope: Floats) -> None:
    each = [CAMERA.linearised(pose[None], slope) for pose in poses()]
    together, jacobians = CAMERA.linearised(poses(), slope)
    for found in (together, CAMERA.seen(poses(), slope)):
        assert np.array_equal(found, [seen for (seen,), _ in each])
    assert np.array_equal(jacobians, [jacobian for _, (jacobian,) in each])


@pytest.mark.parametrize("slope", SLOPES)
def test_the_jacobian_is_that_of_what_is_measured(slope: Floats) -> None:
    for pose in poses(5):
        (seen,), (jacobian,) = CAMERA.linearised(pose[None], slope)
        assert seen == pytest.approx(observed(CAMERA, pose, slope))
        for k, step in enumerate(1e-3 * np.eye(5)):
            ahead = observed(CAMERA, pose + step[:3], slope + step[3:])
            behind = observed(CAMERA, pose - step[:3], slope - step[3:])
            assert (ahead - behind) / 2e-3 == pytest.approx(jacobian[:, k], abs=1e-4)


def uphill(
    subject: AdaptiveEstimator,
    slope: Floats,
    change: tuple[float, dict[str, float]] | None = None,
    seed: int = 1,
) -> tuple[Floats, Floats]:
    """True and estimated state after 10 s on a floor with `slope` (2,), of which the camera knows nothing.

    From the time (s) of a `change` on the vehicle has its parameters.
    """
    share = vehicle().gravity_share
    assert share is not None
    force = -slope * share * GRAVITY
    states, commands = driven(exciting, 10.0, {"a_x": float(force[0]), "a_y": float(force[1])}, 0.0, change)
    errors = correlated(np.random.default_rng(seed), len(states), np.array([0.005, 0.005, 0.01]), 0.0)
    for k, command in enumerate(commands):
        if k > 0:
            seen = observed(camera(), states[k, :3], slope)
            subject.observe(pose_at(k, np.append(seen, states[k, 3]), errors[k]))
        if k % 30 == 27:
            estimate = subject.replanning_estimate(k / RATE)
        subject.commanded(k / RATE, command)
    now = round(estimate.time * RATE)
    return states[now], estimate.state


def camera() -> CameraModel:
    return replace(CAMERA, position=(-1.0, -2.0, 4.0), level_at=(float(BEGIN[0]), float(BEGIN[1])))


def subject(known: CameraModel | None) -> AdaptiveEstimator:
    return AdaptiveEstimator(SETTINGS, CarModel(vehicle()), BEGIN, known)


@pytest.mark.parametrize("slope", [np.array([0.0, 0.15]), np.array([0.12, 0.0])])
def test_the_identified_force_corrects_what_the_camera_measures(slope: Floats) -> None:
    true, estimated = uphill(subject(camera()), slope)
    _, uncorrected = uphill(subject(None), slope)
    error, without = (float(np.linalg.norm(state[:2] - true[:2])) for state in (estimated, uncorrected))
    assert without > 0.15
    assert error < 0.5 * without


def test_on_a_level_floor_the_correction_is_small() -> None:
    true, estimated = uphill(subject(camera()), np.zeros(2))
    assert np.linalg.norm(estimated[:2] - true[:2]) < 0.05


def test_a_force_that_changes_during_the_drive_does_not_tilt_the_floor() -> None:
    """As that of a box which the vehicle pushes."""
    estimator = subject(camera())
    uphill(estimator, np.zeros(2))
    assert estimator.learned is not None
    identified, floor = estimator.learned.identified, estimator.floor
    rho = identified.rho.copy()
    rho[online_parameters(vehicle(), Adaptive(kind="adaptive")).index("a_y")] = -1.0
    estimator.learn(replace(estimator.learned, identified=replace(identified, rho=rho)))
    assert estimator.floor == pytest.approx(floor, abs=1e-9)


def test_a_steering_that_slips_hardly_tilts_the_floor() -> None:
    """A window in which nothing may change explains the turns after it by a slope, among others: 0.038 here."""
    tilts = []
    for seed in range(6):
        for slipped in (0.09, -0.09):
            estimator = subject(camera())
            uphill(estimator, np.zeros(2), (7.5, {"phi_diff": slipped}), seed)
            tilts.append(estimator.floor)
    assert np.sqrt(np.mean(np.square(tilts))) < 0.02


def test_a_vehicle_that_stands_tells_nothing_about_the_floor() -> None:
    """A camera with an error that grows with the distance looks like a slope; the motion tells them apart."""
    estimator = subject(camera())
    for k in range(1, 60):
        estimator.observe(pose_at(k, BEGIN + np.array([0.0, -0.1, 0.0, 0.0]), np.zeros(3)))
        estimator.commanded(k / RATE, np.zeros(2))
    assert estimator.floor == pytest.approx(np.zeros(2))


def test_uncertain_parameters_make_the_heading_of_a_turning_car_uncertain() -> None:
    spreads = []
    for command in (np.array([0.8, 0.3]), np.array([0.0, 0.0])):
        estimator = subject(None)
        for k in range(60):
            estimator.commanded(k / RATE, command)
        uncertainty = estimator.replanning_estimate(2.0).uncertainty
        assert uncertainty is not None
        spreads.append(math.sqrt(uncertainty.state[2, 2]))
    assert spreads[0] > 2.0 * spreads[1]


def test_a_floor_is_no_steeper_than_floors_are() -> None:
    """A vehicle that something else holds, such as a box that it pushes, has an estimate of a slope that is none."""
    subject = AdaptiveEstimator(Adaptive(kind="adaptive"), CarModel(vehicle()), BEGIN, CAMERA)
    subject._filter.set_slope(np.array([3.0, -4.0]), 0.01 * np.eye(2))
    assert np.linalg.norm(subject.floor) == pytest.approx(math.sin(math.radians(40.0)))
    assert subject.floor[0] / subject.floor[1] == pytest.approx(-0.75)
    assert np.isfinite(CAMERA.seen(poses(), subject.floor)).all()


def test_the_force_in_use_is_one_that_the_drive_can_hold() -> None:
    """A car that pushes against a box until it stands seems weak, and pushed back; then no manoeuvre would stop."""
    estimator = subject(camera())
    uphill(estimator, np.zeros(2))
    assert estimator.learned is not None
    identified, parameters = estimator.learned.identified, online_parameters(vehicle(), Adaptive(kind="adaptive"))
    rho = identified.rho.copy()
    strength, along_y = parameters.index("v_delta"), parameters.index("a_y")
    rho[strength], rho[along_y] = 0.1, -1.0
    estimator.learn(replace(estimator.learned, identified=replace(identified, rho=rho)))
    used = estimator._model.parameters
    assert used[strength] == pytest.approx(0.1)
    without = used.copy()
    without[along_y] = 0.0
    assert used[along_y] == pytest.approx(-HOLDS * estimator._model.acceleration_at_rest(without), rel=0.05)
    back = estimator._model.drive_control(1.0, 0.0)
    facing = np.array([0.0, 0.0, 0.5 * math.pi, 0.0])
    assert estimator._model.advance(facing, back, 1.0)[3] > 0.0


def test_windows_of_a_drive_that_do_not_overlap_are_joined() -> None:
    rng, std = np.random.default_rng(0), np.array([0.25, 0.25])
    prior, means, information = np.diag(std**-2), [], []
    for _ in range(3):
        root = rng.normal(size=(2, 2))
        information.append(root @ root.T + np.eye(2))
        means.append(rng.normal(size=2))
    joined = ConstantOfDrive(std)
    for k, (mean, told) in enumerate(zip(means, information, strict=True)):
        of_window = np.linalg.inv(told + prior)
        result = joined.update(10.0 * k, 10.0 * k + 9.0, of_window @ (told @ mean), of_window)
    total = np.linalg.inv(sum(information) + prior)
    assert result[1] == pytest.approx(total)
    assert result[0] == pytest.approx(total @ sum(a @ m for a, m in zip(information, means, strict=True)))


def test_windows_of_a_drive_that_overlap_count_once() -> None:
    joined, mean, covariance = ConstantOfDrive(np.ones(2)), np.array([0.3, -0.1]), 0.1 * np.eye(2)
    for end in (5.0, 5.0, 6.0):
        assert joined.update(0.0, end, mean, covariance) == (pytest.approx(mean), pytest.approx(covariance))
    assert np.trace(joined.update(5.5, 12.0, mean, covariance)[1]) < 0.15


def test_a_window_that_ends_earlier_than_the_last_ones_replaces_them() -> None:
    """Time in which something held the vehicle was left out of it."""
    mean, covariance = np.array([0.1, 0.0]), 0.1 * np.eye(2)
    held, other = ConstantOfDrive(np.ones(2)), ConstantOfDrive(np.ones(2))
    for end in (5.0, 6.0, 7.0, 8.0):
        held.update(0.0, end, mean + 0.1 * max(end - 6.0, 0.0), covariance)
    for joined in (held, other):
        joined.update(0.0, 6.0, mean, covariance)
    one, another = (joined.update(7.5, 12.0, mean, covariance) for joined in (held, other))
    assert one[0] == pytest.approx(another[0])
    assert one[1] == pytest.approx(another[1])


def test_the_slope_is_that_of_the_force_up_to_forces_that_pass() -> None:
    """With the passing force in place of the force, which has the prior of the slope then."""
    parameters = online_parameters(vehicle(), Adaptive(kind="adaptive"), sloping=True)
    free, rng = np.flatnonzero(parameters.free), np.random.default_rng(0)
    root, passing = rng.normal(size=(len(free), len(free))), np.array([[0.3, 0.1], [0.1, 0.2]])
    of_data, prior = root @ root.T, np.diag(parameters.std[free] ** -2.0)
    deviation = 0.1 * parameters.std[free] * rng.normal(size=len(free))
    covariance, mean = np.zeros((len(parameters.std),) * 2), parameters.nominal.copy()
    covariance[np.ix_(free, free)] = np.linalg.inv(of_data + prior)
    mean[free] += deviation
    score = (of_data + prior) @ deviation  # of the data

    names = [parameters.names[k] for k in free]
    force, slope = ([names.index(name) for name in pair] for pair in (FORCE, SLOPE))
    into = np.eye(len(free))  # force = passing force - felt gravity slope
    into[force, slope] = -felt_gravity(vehicle())
    others = np.diag(prior).copy()
    others[force] = 0.0
    information = into.T @ of_data @ into + np.diag(others)
    information[np.ix_(force, force)] += np.linalg.inv(passing)
    expected = np.linalg.inv(information)

    found, spread = slope_told(parameters, mean, covariance, passing)
    assert spread == pytest.approx(expected[np.ix_(slope, slope)], rel=1e-6)
    assert found == pytest.approx((expected @ into.T @ score)[slope], rel=1e-6)


def test_data_that_tell_nothing_leave_the_prior_of_the_slope() -> None:
    parameters = online_parameters(vehicle(), Adaptive(kind="adaptive"), sloping=True)
    prior = np.diag(np.where(parameters.free, parameters.std, 0.0) ** 2)
    mean, covariance = slope_told(parameters, parameters.nominal, prior, 0.01 * np.eye(2))
    assert mean == pytest.approx(np.zeros(2), abs=1e-12)
    assert covariance == pytest.approx(np.diag(slope_deviations(vehicle()) ** 2))


@pytest.mark.parametrize("rise", [0.15, -0.15])
def test_poses_tell_the_slope_along_the_drive_without_the_force(rise: float) -> None:
    """The vehicle seems to become faster or slower with its place, whatever pushes it."""
    estimator = subject(camera())
    uphill(estimator, np.array([0.0, rise]))
    assert estimator.learned is not None
    found, parameters = estimator.learned.identified, online_parameters(vehicle(), SETTINGS, sloping=True)
    told, spread = slope_told(parameters, found.before.mean, found.before.covariance, 1e6 * np.eye(2))
    deviation = math.sqrt(spread[1, 1])
    assert deviation < 0.75 * slope_deviations(vehicle())[1]
    assert abs(told[1] - rise) < 2.0 * deviation


@pytest.mark.parametrize(("turn", "across", "along"), [(0.1, 1.28, 0.10), (1.5, 0.128, 0.16)])
def test_a_force_across_the_drive_is_uncertain_unless_the_vehicle_turns(
    turn: float, across: float, along: float
) -> None:
    """A box that is pushed after a slight turn looks like a force across the drive that was always there."""
    times = np.linspace(0.0, 10.0, 301)
    yaw = 0.5 * math.pi + turn * np.sin(times)
    drive = RecordedDrive(times, np.column_stack([times, times, yaw]), np.zeros((301, 4)), times, np.zeros((301, 2)))
    empty = np.zeros(0)
    identified = Identified(empty, np.zeros((0, 0)), times, np.zeros((301, 3)), Gaussian(empty, np.zeros((0, 0))))
    deviations = np.sqrt(np.diag(Learned.of(identified, drive).passing_force))
    assert deviations == pytest.approx([across, along], rel=0.1)
