"""Estimates from poses without a vehicle model: noise, smoothed poses and rates, and whether a part begins at rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.sysid.interface import Noise
from ompl_ext.arrays import Bools, Floats, Ints, Matrix
from ompl_ext.times import SAME_TIME

if TYPE_CHECKING:
    from kraft.logs.log import Part


NEIGHBOURS = 9
"""Number of poses in a local fit."""
POSITION_NOISE_MIN, YAW_NOISE_MIN = 1e-4, 1e-4
"""Least noise, m and rad: logs without noise shall not have infinite weight."""
NOISE_POSES_MIN = 5
"""Least number of poses from which noise is measured."""
OUTLIER_DEVIATIONS = 5.0
"""Deviation from the neighbours above which a pose is an outlier, in standard deviations."""
MAD = 1.4826
"""Standard deviation per median absolute deviation of a normal distribution."""
SPEED_INTERVAL: Final = 0.2
"""Time over which a speed is measured, s."""
REST_SPEED_SHARE: Final = 0.1
"""Share of the high speeds of a part below which the vehicle counts as at rest."""
REST_DEVIATIONS: Final = 3.0
"""Standard deviations of the speed at the first pose within which the vehicle may be at rest."""
REST_NOISE_SHARE_MAX: Final = 0.25
"""Largest such noise that distinguishes rest from motion, as a share of the high speeds."""
ROBUST_ITERATIONS: Final = 10
"""Iterations of the robust fit."""
REST_SPANS: Final = (0.25, 0.5, 0.75, 1.0)
"""Times over which the speed at the first pose is fitted, s: the shortest sufficient one, since a start is curved."""


def measured_noise(times: list[Floats], poses: list[Matrix]) -> Noise:
    """Noise of poses from the deviation of each from a cubic through its two neighbours on either side.

    The motion of a vehicle is smooth enough not to contribute.  An outlier also affects the deviations of its
    neighbours, which are therefore left out; the median absolute deviation is robust to the remaining outliers.
    """
    deviations = [_deviations(t, p) for t, p in zip(times, poses, strict=True) if len(t) >= NOISE_POSES_MIN]
    if not deviations:
        return Noise(0.01, 0.02)
    first = _spread(np.concatenate(deviations))
    clean = np.concatenate([d[_undisturbed(d, first)] for d in deviations])
    sigma = _spread(clean) if len(clean) else first
    position = float(np.sqrt(0.5 * (sigma[0] ** 2 + sigma[1] ** 2)))
    return Noise(max(position, POSITION_NOISE_MIN), max(float(sigma[2]), YAW_NOISE_MIN))


def _spread(deviations: Matrix) -> Floats:
    spread: Floats = MAD * np.median(np.abs(deviations), axis=0)
    return spread


def _undisturbed(deviations: Matrix, sigma: Floats) -> Bools:
    """Which deviations (n, 3) are of poses without an outlier among them and their two neighbours on either side."""
    size = np.pad(np.max(np.abs(deviations) / np.maximum(sigma, 1e-12), axis=1), 2)
    around = np.max(np.stack([size[k : len(size) - 4 + k] for k in range(5)]), axis=0)
    outlier = np.pad((size[2:-2] > OUTLIER_DEVIATIONS) & (size[2:-2] == around), 2)
    disturbed: Bools = np.any(np.stack([outlier[k : len(outlier) - 4 + k] for k in range(5)]), axis=0)
    return ~disturbed


def _deviations(t: Floats, poses: Matrix) -> Matrix:
    """(n - 4, 3) deviations from the interpolation through the neighbours, scaled to the noise of one pose."""
    at = t[2:-2]
    others = np.stack([t[:-4], t[1:-3], t[3:-1], t[4:]])
    weights = np.ones_like(others)
    for j in range(4):
        for m in range(4):
            if m != j:
                weights[j] *= (at - others[m]) / (others[j] - others[m])
    around = np.stack([poses[:-4], poses[1:-3], poses[3:-1], poses[4:]])
    deviation = poses[2:-2] - np.einsum("jn,jnc->nc", weights, around)
    scaled: Matrix = deviation / np.sqrt(1.0 + np.sum(weights**2, axis=0))[:, None]
    return scaled


def smoothed(times: Floats, poses: Matrix, at: Floats) -> tuple[Matrix, Matrix]:
    """Poses and their rates (k, 3) at the times `at` (k,): robust parabolas through the nearest poses."""
    count = min(NEIGHBOURS, len(times))
    if count < 3:  # a parabola needs three
        slope = (poses[-1] - poses[0]) / max(times[-1] - times[0], 1e-9)
        return poses[0] + (at - times[0])[:, None] * slope, np.tile(slope, (len(at), 1))
    index = _nearest(times, at, count)
    return _parabolas(times[index] - at[:, None], poses[index])


def smoothed_each(parts: Sequence[Part], at: Floats) -> tuple[Matrix, Matrix]:
    """Pose and its rates (k, 3) of each of k parts at the time `at` (k,): as `smoothed`, of all parts at once."""
    enough = [i for i, part in enumerate(parts) if len(part.pose_times) >= NEIGHBOURS]
    found, rates = np.empty((len(parts), 3)), np.empty((len(parts), 3))
    if enough:
        index = [_nearest(parts[i].pose_times, at[i : i + 1], NEIGHBOURS)[0] for i in enough]
        since = np.stack([parts[i].pose_times[own] - at[i] for i, own in zip(enough, index, strict=True)])
        poses = np.stack([parts[i].poses[own] for i, own in zip(enough, index, strict=True)])
        found[enough], rates[enough] = _parabolas(since, poses)
    for i in set(range(len(parts))) - set(enough):
        one = smoothed(parts[i].pose_times, parts[i].poses, at[i : i + 1])
        found[i], rates[i] = one[0][0], one[1][0]
    return found, rates


def _nearest(times: Floats, at: Floats, count: int) -> Ints:
    """(k, count) indices of the poses about the times `at` (k,)."""
    first = np.clip(np.searchsorted(times, at) - count // 2, 0, len(times) - count)
    index: Ints = first[:, None] + np.arange(count)
    return index


def _parabolas(since: Matrix, z: Floats) -> tuple[Matrix, Matrix]:
    """Poses and their rates (k, 3) at the time 0 of robust parabolas through poses `z` (k, m, 3) at times (k, m)."""
    scale = np.max(np.abs(since), axis=1)[:, None] + 1e-9
    tau = since / scale
    weight = (1.0 - 0.9 * np.abs(tau) ** 3)[:, :, None] * np.ones(3)
    middle = np.median(z, axis=1)[:, None]
    spread = np.median(np.abs(z - middle), axis=1)[:, None] + 1e-3
    robust = np.abs(z - middle) < 6.0 * spread  # initial classification of outliers
    powers = np.stack([tau**n for n in range(5)], axis=1)  # (k, 5, m)
    degree = np.add.outer(np.arange(3), np.arange(3))
    coefficients = np.zeros((len(z), 3, 3))
    for _ in range(3):
        w = weight * robust
        moments = np.swapaxes(powers @ w, 1, 2)  # (k, component, 5)
        right = np.swapaxes(powers[:, :3] @ (w * (z - middle)), 1, 2)
        normal = moments[..., degree] + 1e-6 * np.eye(3)
        coefficients = np.linalg.solve(normal, right[..., None])[..., 0]  # (k, component, 3)
        residual = np.abs(z - middle - np.swapaxes(coefficients @ powers[:, :3], 1, 2))
        limit = 4.0 * MAD * np.median(residual, axis=1)[:, None] + 1e-4
        robust = residual < limit
    return middle[:, 0] + coefficients[:, :, 0], coefficients[:, :, 1] / scale


def begins_at_rest(part: Part) -> bool:
    """Whether the part begins at rest; False if the poses are too few or too noisy to decide."""
    times, poses = part.pose_times, part.poses
    if len(times) < 2:
        return False
    interval = float(np.median(np.diff(times)))
    high = high_speed(part)
    sigma = measured_noise([times], [poses]).position
    for span in REST_SPANS:
        count = 1 + round(span / interval)
        if not 3 <= count <= len(times):
            continue
        basis = np.vander(times[:count] - times[0], 3, increasing=True)
        noise = REST_DEVIATIONS * sigma * _slope_noise(basis)
        if noise <= REST_NOISE_SHARE_MAX * high:
            return _first_speed(basis, poses[:count, :2], sigma) <= max(REST_SPEED_SHARE * high, noise)
    return False


def high_speed(part: Part) -> float:
    """Speed that a tenth of the pairs of poses `SPEED_INTERVAL` from each other exceed, m/s."""
    if len(part.pose_times) < 2:
        return 0.0
    apart = max(1, round(SPEED_INTERVAL / float(np.median(np.diff(part.pose_times)))))
    if len(part.pose_times) <= apart:
        return 0.0
    way = part.poses[apart:, :2] - part.poses[:-apart, :2]
    speeds: Floats = np.hypot(way[:, 0], way[:, 1]) / (part.pose_times[apart:] - part.pose_times[:-apart])
    return float(np.quantile(speeds, 0.9))


def _slope_noise(basis: Matrix) -> float:
    """Standard deviation of the initial slope of a parabola (1/s), per metre of that of x or y of a pose."""
    return float(np.linalg.norm(np.linalg.pinv(basis)[1]))


def _first_speed(basis: Matrix, positions: Matrix, sigma: float) -> float:
    """Speed at the first of the positions (n, 2), m/s; negative if opposite to their displacement.

    The Huber loss, with the threshold `sigma` (m), limits the influence of outliers.
    """
    weight, fit = np.ones(len(positions)), np.zeros((3, 2))
    for _ in range(ROBUST_ITERATIONS):
        root = np.sqrt(weight)[:, None]
        fit[:] = np.linalg.lstsq(root * basis, root * positions, rcond=None)[0]
        off = np.hypot(*(positions - basis @ fit).T)
        weight = 1.0 / np.maximum(off, sigma)
    way = (basis[-1] - basis[0]) @ fit
    return float(fit[1] @ way) / max(math.hypot(*way), 1e-9)


def thinned(part: Part, step: float) -> Part:
    """The part with about one pose per step, if it has more than two: open-loop predictions need no more."""
    every = int(step / max(float(np.median(np.diff(part.pose_times))), 1e-6) + 1e-6) if len(part.pose_times) > 1 else 1
    if every <= 2:
        return part
    return replace(part, pose_times=part.pose_times[::every].copy(), poses=part.poses[::every].copy())


def constant_motion(times: Floats, poses: Matrix, span: float) -> Floats:
    """Pose (x, y, yaw), speed (m/s) and yaw rate (rad/s) at the last pose, by parabolas through those of `span` s."""
    first = min(int(np.searchsorted(times, times[-1] - span - SAME_TIME)), max(len(times) - 3, 0))
    since = times[first:] - times[-1]
    basis = np.vander(since, min(3, len(since)), increasing=True)
    fit = np.linalg.lstsq(basis, poses[first:], rcond=None)[0]
    rates = fit[1] if len(fit) > 1 else np.zeros(3)
    speed = rates[0] * np.cos(fit[0, 2]) + rates[1] * np.sin(fit[0, 2])
    found: Floats = np.array([*fit[0], speed, rates[2]])
    return found
