"""Kalman update by a pose: the compiled functions are the textbook's formulas."""

from __future__ import annotations

import numpy as np
import pytest

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels.pose_fusion import INPUTS, WORK, Sensor, pose_fusion

SIZE = 14  # pose, speed, errors of the pose, one component without effect, floor, further errors, one without effect
SPREAD = np.array([[1.2, -0.4, 0.0], [0.9, 0.5, 0.0], [0.0, 0.0, 2.0]])
CAMERA = np.array([1.0, 3.0, 5.0, 0.2, 0.5, -0.5])
NOISE = np.diag([4e-4, 5e-4, 1e-3])


def state(seed: int = 0) -> tuple[Floats, Matrix]:
    """Mean (n,) and covariance (n, n)."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(SIZE, SIZE)) * 0.05
    mean: Floats = rng.normal(size=SIZE) * 0.1
    return mean, np.ascontiguousarray(root @ root.T + 1e-4 * np.eye(SIZE))


def sensor(camera: Floats) -> Sensor:
    return Sensor(np.array([[0, 1, 2], [4, 5, 6], [10, 11, 12]]), SPREAD, floor=np.array([8, 9]), camera=camera)


def expected(mean: Floats, covariance: Matrix, camera: Floats) -> tuple[Floats, Matrix, Matrix]:
    pose, cross, of_pose = np.empty(3), np.empty((SIZE, 3)), np.empty((3, 3))
    pose_fusion().expect(mean, covariance, sensor(camera), np.empty(WORK), pose, cross, of_pose)
    return pose, cross, of_pose


@pytest.mark.parametrize("camera", [np.zeros(0), CAMERA], ids=["level", "over a slope"])
def test_the_expected_pose_and_its_covariances_are_those_of_its_derivatives(camera: Floats) -> None:
    mean, covariance = state()
    _, cross, of_pose = expected(mean, covariance, camera)
    jacobian = np.empty((3, SIZE))
    for k, step in enumerate(1e-5 * np.eye(SIZE)):
        ahead, behind = (expected(mean + sign * step, covariance, camera)[0] for sign in (1.0, -1.0))
        jacobian[:, k] = (ahead - behind) / 2e-5
    assert cross == pytest.approx(covariance @ jacobian.T, abs=1e-7)
    assert of_pose == pytest.approx(jacobian @ covariance @ jacobian.T, abs=1e-7)


def test_errors_add_to_the_pose_the_first_ones_in_their_own_directions_and_units() -> None:
    mean, covariance = state()
    assert expected(mean, covariance, np.zeros(0))[0] == pytest.approx(mean[:3] + SPREAD @ mean[4:7] + mean[10:13])


def test_a_level_floor_is_seen_as_it_is() -> None:
    seen, jacobian = np.empty(3), np.empty((3, INPUTS))
    pose = np.array([2.0, -1.0, 3.5])
    inputs, work = np.zeros(INPUTS), np.empty((2, INPUTS))
    pose_fusion().linearise(CAMERA, pose[None], inputs, seen[None], jacobian[None], work)
    assert seen == pytest.approx(pose)
    assert jacobian[:, :3] == pytest.approx(np.eye(3), abs=1e-8)
    assert np.abs(jacobian[:2, 3:]).max() > 0.1


def test_a_whitened_innovation_has_its_mahalanobis_distance() -> None:
    mean, covariance = state()
    spread, innovation, whitened = (
        expected(mean, covariance, CAMERA)[2] + NOISE,
        np.array([0.1, -0.2, 0.3]),
        np.empty(3),
    )
    pose_fusion().whiten(spread, innovation, np.empty(WORK), whitened)
    assert whitened @ whitened == pytest.approx(innovation @ np.linalg.solve(spread, innovation))
    pose_fusion().whiten(-spread, innovation, np.empty(WORK), whitened)
    assert np.isnan(whitened).any()


@pytest.mark.parametrize("kept", [[], [8, 9], [0]])
def test_a_correction_is_kalmans_and_right_for_what_is_kept(kept: list[int]) -> None:
    """With any gain K the covariance is (I - K H) P (I - K H)^T + K R K^T; H is found from the covariances."""
    mean, covariance = state(1)
    _, cross, of_pose = expected(mean, covariance, CAMERA)
    by_state = np.linalg.solve(covariance, cross).T
    transposed, after = np.empty((3, SIZE)), np.empty((SIZE, SIZE))
    spread, fixed = of_pose + NOISE, np.array(kept, dtype=np.int64)
    pose_fusion().correct(covariance, cross, spread, fixed, np.empty(WORK), transposed, after)
    gain = transposed.T
    best = cross @ np.linalg.inv(spread)
    best[kept] = 0.0
    assert gain == pytest.approx(best)
    rest = np.eye(SIZE) - gain @ by_state
    assert after == pytest.approx(rest @ covariance @ rest.T + gain @ NOISE @ gain.T, abs=1e-9)
    assert np.array_equal(after, after.T)


def test_replaced_components_move_the_others_by_regression() -> None:
    mean, covariance = state(2)
    known, values, spread = np.array([8, 3]), np.array([0.3, -0.1]), np.array([[2e-3, 1e-3], [1e-3, 3e-3]])
    gains = covariance[:, known] @ np.linalg.inv(covariance[np.ix_(known, known)])
    moved = mean + gains @ (values - mean[known])
    changed = covariance + gains @ (spread - covariance[np.ix_(known, known)]) @ gains.T
    means, covariances = mean[None].copy(), covariance[None].copy()
    pose_fusion().replace(means, covariances, known, values, spread, np.empty((2, SIZE)))
    assert means[0] == pytest.approx(moved)
    assert covariances[0] == pytest.approx(changed, abs=1e-12)
    assert means[0, known] == pytest.approx(values)
    assert covariances[0][np.ix_(known, known)] == pytest.approx(spread)
