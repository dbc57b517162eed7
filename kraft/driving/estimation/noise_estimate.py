"""Noise of poses: as the settings state it, and as the residuals of the identification measure it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.driving.estimation.sliding_window import Identified
from kraft.driving.method import Adaptive
from kraft.sysid.settings import Noise
from ompl_ext.arrays import Floats

PRIOR_POSES: Final = 40.0
"""Number of poses that the stated noise counts for beside the measured residuals."""
PRIOR_CORRELATION: Final = 4.0
"""Number of correlation times of residuals that weigh as much as the stated share."""
LAG: Final = 0.2
"""Time over which the correlation of residuals is measured, s."""
SHARE_MAX: Final = 0.95
"""Largest share of the pose error that counts as correlated."""


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise of poses: variances (3,), of which the share `share` (3,) decays with the time constant `time` (s)."""

    variance: Floats
    share: Floats
    time: float
    stated_variance: Floats
    stated_share: Floats

    @classmethod
    def of(cls, settings: Adaptive) -> NoiseEstimate:
        """Noise that the settings state."""
        sigmas = np.array([settings.position_noise, settings.position_noise, math.radians(settings.heading_noise_deg)])
        share = np.full(3, settings.correlated_share if settings.correlated else 0.0)
        return cls(sigmas**2, share, settings.correlation_time, sigmas**2, share)

    def updated(self, identified: Identified, interval: float) -> NoiseEstimate:
        """Noise measured by residuals, weighed with the stated noise as `PRIOR_POSES` poses."""
        residuals, count = identified.residuals, len(identified.residuals)
        squares = np.minimum(residuals**2, 16.0 * self.variance)  # outliers are the robust loss's
        variance = (PRIOR_POSES * self.stated_variance + squares.sum(axis=0)) / (PRIOR_POSES + count)
        share = self.share
        lag = max(1, round(LAG / interval))
        if self.stated_share.any() and count > 2 * lag:
            products = np.clip(residuals[lag:] * residuals[:-lag], -4.0 * self.variance, 4.0 * self.variance)
            correlation = products.mean(axis=0) / np.maximum(squares.mean(axis=0), 1e-9)
            weight = count * interval / self.time / PRIOR_CORRELATION
            measured = np.clip(correlation * math.exp(lag * interval / self.time), 0.0, SHARE_MAX)
            share = (self.stated_share + weight * measured) / (1.0 + weight)
        return NoiseEstimate(variance, share, self.time, self.stated_variance, self.stated_share)

    def of_one_pose(self, interval: float) -> Noise:
        """Noise of a pose as if poses, `interval` s apart, were independent: with the same information together."""
        kept = math.exp(-interval / self.time)
        inflation = 1.0 - self.share + self.share * (1.0 + kept) / (1.0 - kept)
        sigma = np.sqrt(self.variance * inflation)
        return Noise(float(math.sqrt(0.5 * (sigma[0] ** 2 + sigma[1] ** 2))), float(sigma[2]))
