"""How much each residual counts: variances of poses, dynamics and controls, and the robust loss."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

from kraft.sysid.settings import Noise, Settings
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle

PROCESS_POSITION = 0.001
"""What a model misses of the position, m per square root of a second."""
PROCESS_YAW = 0.002
"""Of the heading, rad per square root of a second."""
PROCESS_OTHER = 0.005
"""Of a speed or another hidden component, in its unit per square root of a second."""
CONTROL_SHARE = 0.01
"""Of a control's range: how far the applied control strays from the command."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Variances, and the robust loss' threshold on a whole pose."""

    noise: Noise
    process: Floats
    """(nx,) standard deviations per square root of a second"""
    control: Floats
    """(nu,) standard deviations"""
    threshold: float
    """Mahalanobis distance of a pose above which it counts less, inf for never"""

    @property
    def pose_sigmas(self) -> Floats:
        """(3,) x, y, yaw."""
        return np.array([self.noise.position, self.noise.position, self.noise.yaw])

    def distance(self, residuals: Matrix) -> Floats:
        """Mahalanobis distances (n,) of pose residuals (n, 3)."""
        distance: Floats = np.sqrt(np.sum((residuals / self.pose_sigmas) ** 2, axis=1))
        return distance

    def weights(self, residuals: Matrix) -> Floats:
        """(n,) weight of each pose by Huber's loss: 1 up to the threshold, then falling with the distance."""
        return (
            self.threshold / np.maximum(self.distance(residuals), self.threshold)
            if self.robust
            else np.ones(len(residuals))
        )

    def loss(self, residuals: Matrix) -> float:
        """Sum of Huber's losses: half the squared distance up to the threshold, then linear."""
        distance = self.distance(residuals)
        if not self.robust:
            return float(0.5 * np.sum(distance**2))
        inside = np.minimum(distance, self.threshold)
        return float(np.sum(inside * (distance - 0.5 * inside)))

    @property
    def robust(self) -> bool:
        """Whether there is a threshold."""
        return math.isfinite(self.threshold)


def noise_model(vehicle: Vehicle, settings: Settings, noise: Noise) -> NoiseModel:
    """The noise that settings state, defaults for the rest."""
    default = {"x": PROCESS_POSITION, "y": PROCESS_POSITION, "theta": PROCESS_YAW}
    process = [settings.process.get(name, default.get(name, PROCESS_OTHER)) for name in vehicle.state]
    control = [
        settings.control_noise.get(name, CONTROL_SHARE * (high - low)) for name, (low, high) in vehicle.controls.items()
    ]
    shown = 3 if vehicle.index("theta") >= 0 else 2
    return NoiseModel(noise, np.array(process), np.array(control), threshold(settings.robust, shown))


def threshold(robust: float | None, shown: int) -> float:
    """Threshold for the `shown` residuals of a pose together that as many good ones exceed as one exceeds `robust`."""
    if robust is None:
        return math.inf
    return math.sqrt(float(chi2.isf(2.0 * float(norm.sf(robust)), shown)))
