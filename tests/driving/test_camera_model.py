"""What is known of a camera: errors by the place of the marker are those that the simulated camera makes."""

from __future__ import annotations

import numpy as np
import pytest

from kraft.driving.car_model import CarModel
from kraft.driving.estimation import CameraModel
from kraft.driving.estimation.adaptive import AdaptiveEstimator
from kraft.driving.estimation.camera_model import LEAST_ACROSS, SINGLE_TAG
from kraft.driving.estimator_settings import Adaptive
from kraft.driving.messages import Observation
from kraft.scenario import Scenario, Sensing, load_scenario
from kraft.simulation.camera import MarkerCamera
from kraft.trial.plant import camera_model
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats, Matrix

HEIGHT = 0.2
POSITION = (1.0, 3.0, 5.0)
CAMERA = CameraModel(POSITION, HEIGHT, errors=SINGLE_TAG)
PLACES = [(1.0, 3.0), (2.5, 3.0), (1.0, 0.0), (-1.5, 5.0), (4.0, 6.0)]


def frames_at(*places: tuple[float, float]) -> Floats:
    frames = CAMERA.frames(np.array(places))
    assert frames is not None
    return frames


def errors(x: float, y: float, trials: int = 40, frames: int = 200) -> Floats:
    """Errors (trials, frames, 3) of poses without the known mean of the camera, in its frame at the place (m)."""
    frame, found = frames_at((x, y))[0], []
    for seed in range(trials):
        camera = MarkerCamera(Sensing(camera=POSITION, dropout=0.0, correlation_time=0.0), HEIGHT, seed)
        for k in range(frames):
            moved = np.array([x + 0.02 * k / frames, y, HEIGHT])  # a marker that moves has motion blur
            seen = camera.expose(0.005 * k / frames, moved, np.eye(3))
            assert seen is not None
            pose = CAMERA.without_mean(seen)
            found.append(frame @ (pose.x - moved[0], pose.y - moved[1], pose.theta))
    return np.array(found).reshape(trials, frames, 3)


@pytest.mark.parametrize(("x", "y"), PLACES)
def test_errors_in_the_frame_of_a_place_are_those_straight_below_the_camera(x: float, y: float) -> None:
    found = errors(x, y)
    along, across, heading = (found - found.mean(axis=1, keepdims=True)).std(axis=(0, 1))  # without the trial's bias
    assert along == pytest.approx(0.029, rel=0.15)
    assert heading == pytest.approx(0.0178, rel=0.15)
    least = CAMERA.spread(x, y)[:2, 1] @ CAMERA.spread(x, y)[:2, 1] == pytest.approx(LEAST_ACROSS**2)
    assert across < 0.03 if least else across == pytest.approx(0.03, rel=0.25)
    assert abs(found[..., 0].mean()) < 0.01


def test_frames_undo_the_spread() -> None:
    frames = frames_at(*PLACES)
    for frame, place in zip(frames, PLACES, strict=True):
        assert frame @ CAMERA.spread(*place) == pytest.approx(np.eye(3))


def test_errors_are_along_the_line_of_sight_most_of_all() -> None:
    spread = CAMERA.spread(1.0, 0.0)  # the camera looks along -y
    assert abs(spread[1, 0]) > 1.5
    assert abs(spread[0, 1]) == LEAST_ACROSS
    assert spread[0, 0] == pytest.approx(0.0)


def test_a_camera_whose_errors_are_the_same_everywhere_changes_nothing() -> None:
    camera, pose = CameraModel(POSITION, HEIGHT), Observation(1.0, 1.1, 4.0, 6.0, 0.3)
    assert camera.without_mean(pose) == pose
    assert camera.spread(4.0, 6.0) == pytest.approx(np.eye(3))
    assert camera.frames(np.array(PLACES)) is None


def test_the_mean_error_is_away_from_the_camera() -> None:
    pose = Observation(1.0, 1.1, 1.0, 0.0, 0.3)
    corrected = CAMERA.without_mean(pose)
    assert corrected.x == pytest.approx(1.0)
    assert 0.02 < corrected.y < 0.05
    below = Observation(1.0, 1.1, 1.0, 3.0, 0.3)
    assert CAMERA.without_mean(below) == below


def scenario(preset: str) -> Scenario:
    return load_scenario("turns", {"sensing.preset": preset})


@pytest.mark.parametrize(("preset", "level", "by_place"), [
    ("single-tag", True, True), ("planar", True, False), ("rendered", False, True),
])  # fmt: skip
def test_what_a_scenario_tells_of_its_camera(preset: str, level: bool, by_place: bool) -> None:
    camera = camera_model(scenario(preset))
    assert (camera.level_at is not None, camera.errors is not None) == (level, by_place)


def estimated(camera: CameraModel, poses: Matrix, start: Floats) -> AdaptiveEstimator:
    """Estimator of a car that stands, after poses (n, 3), 30 a second."""
    settings = Adaptive(kind="adaptive", compensate=False, start_position_noise=0.2)
    estimator = AdaptiveEstimator(settings, CarModel(load_vehicle("mushr-force")), start, camera)
    for k, (x, y, theta) in enumerate(poses.tolist(), start=1):
        estimator.observe(Observation(k / 30, k / 30, x, y, theta))
    return estimator


def test_poses_from_the_side_tell_less_along_the_line_of_sight() -> None:
    start = np.array([1.0, -1.0, 0.0, 0.0])
    belief = estimated(CAMERA, np.tile(start[:3], (30, 1)), start).belief
    assert belief is not None
    across, along = np.sqrt(np.diag(belief.covariance)[:2])
    assert along > 1.3 * across
