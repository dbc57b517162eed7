"""What poses say without any model: how noisy they are, and where the vehicle was in between, and how fast."""

from __future__ import annotations

import numpy as np

from kraft.sysid.settings import Noise
from ompl_ext.arrays import Bools, Floats, Matrix

NEIGHBOURS = 9
"""Poses of a local fit."""
LEAST_POSITION, LEAST_YAW = 1e-4, 1e-4
"""Noise below which nobody measures, m and rad: logs without noise shall not have infinite weight."""
LEAST_POSES = 5
"""Of which noise can be measured."""
FAR = 5.0
"""Standard deviations from the neighbours from which a pose is an outlier."""
MAD = 1.4826  # standard deviation per median absolute deviation of a normal distribution


def measured_noise(times: list[Floats], poses: list[Matrix]) -> Noise:
    """Noise of poses by how far each is from a cubic through its two neighbours on either side.

    A vehicle's own motion is smooth enough not to count.  An outlier spoils the deviations of its neighbours too, so
    these are left out once it is known, and the median absolute deviation keeps out what remains.
    """
    deviations = [_deviations(t, p) for t, p in zip(times, poses, strict=True) if len(t) >= LEAST_POSES]
    if not deviations:
        return Noise(0.01, 0.02)
    first = _spread(np.concatenate(deviations))
    clean = np.concatenate([d[_undisturbed(d, first)] for d in deviations])
    sigma = _spread(clean) if len(clean) else first
    position = float(np.sqrt(0.5 * (sigma[0] ** 2 + sigma[1] ** 2)))
    return Noise(max(position, LEAST_POSITION), max(float(sigma[2]), LEAST_YAW))


def _spread(deviations: Matrix) -> Floats:
    spread: Floats = MAD * np.median(np.abs(deviations), axis=0)
    return spread


def _undisturbed(deviations: Matrix, sigma: Floats) -> Bools:
    """Which deviations (n, 3) are of poses without an outlier among them and their two neighbours on either side."""
    size = np.pad(np.max(np.abs(deviations) / np.maximum(sigma, 1e-12), axis=1), 2)
    around = np.max(np.stack([size[k : len(size) - 4 + k] for k in range(5)]), axis=0)
    outlier = np.pad((size[2:-2] > FAR) & (size[2:-2] == around), 2)
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
    nearest = np.clip(np.searchsorted(times, at) - count // 2, 0, len(times) - count)
    index = nearest[:, None] + np.arange(count)
    since, z = times[index] - at[:, None], poses[index]
    scale = np.max(np.abs(since), axis=1)[:, None] + 1e-9
    tau = since / scale
    weight = (1.0 - 0.9 * np.abs(tau) ** 3)[:, :, None] * np.ones(3)
    middle = np.median(z, axis=1)[:, None]
    spread = np.median(np.abs(z - middle), axis=1)[:, None] + 1e-3
    robust = np.abs(z - middle) < 6.0 * spread  # a first guess of what is an outlier
    basis = np.stack([np.ones_like(tau), tau, tau**2], axis=2)  # (k, m, 3)
    coefficients = np.zeros((len(at), 3, 3))
    for _ in range(3):
        w = weight * robust
        normal = np.einsum("kma,kmb,kmc->kcab", basis, basis, w) + 1e-6 * np.eye(3)
        right = np.einsum("kma,kmc,kmc->kca", basis, w, z - middle)
        coefficients = np.linalg.solve(normal, right[..., None])[..., 0]  # (k, component, 3)
        residual = np.abs(z - middle - np.einsum("kma,kca->kmc", basis, coefficients))
        limit = 4.0 * MAD * np.median(residual, axis=1)[:, None] + 1e-4
        robust = residual < limit
    return middle[:, 0] + coefficients[:, :, 0], coefficients[:, :, 1] / scale
