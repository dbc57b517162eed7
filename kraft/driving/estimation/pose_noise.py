"""Noise of poses: what the settings state, and what the residuals of the identification measure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.driving.estimation.sliding_window import Identified
from kraft.driving.estimator_settings import Adaptive
from kraft.sysid.interface import Noise
from ompl_ext.arrays import Floats

PRIOR_SAMPLES: Final = 8.0
"""Number of independent poses that the stated noise counts for beside the measured residuals."""
PRIOR_CORRELATION: Final = 4.0
"""Number of correlation times of residuals that weigh as much as the stated share."""
LAG: Final = 0.05
"""Time over which the correlation of residuals is measured, s."""
SHARE_MAX: Final = 0.95
"""Largest share of the pose error that counts as correlated."""


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise of poses: variances (3,), of which the share `share` (3,) decays with the time constant `time` (s).

    With a known camera that of poses straight below it: along and across its line of sight, and of the heading.
    """

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
        """Noise measured by residuals, weighed with the stated noise as `PRIOR_SAMPLES` independent poses.

        Correlated residuals count as fewer independent ones, with the same information together.
        """
        residuals, count = identified.residuals, len(identified.residuals)
        squares = np.minimum(residuals**2, 16.0 * self.variance)  # outliers are the robust loss's
        part = 1.0 / self._inflation(interval)
        total = PRIOR_SAMPLES * self.stated_variance + part * squares.sum(axis=0)
        variance = total / (PRIOR_SAMPLES + part * count)
        share = self.share
        lag = max(1, round(LAG / interval))
        if self.stated_share.any() and count > 2 * lag:
            products = np.clip(residuals[lag:] * residuals[:-lag], -4.0 * self.variance, 4.0 * self.variance)
            correlation = products.mean(axis=0) / np.maximum(squares.mean(axis=0), 1e-9)
            weight = count * interval / self.time / PRIOR_CORRELATION
            measured = np.clip(correlation * math.exp(lag * interval / self.time), 0.0, SHARE_MAX)
            share = (self.stated_share + weight * measured) / (1.0 + weight)
        return NoiseEstimate(variance, share, self.time, self.stated_variance, self.stated_share)

    def _inflation(self, interval: float, length: float = math.inf) -> Floats:
        """Number (3,) of poses, `interval` s apart, with the information of an independent one, see `of_one_pose`."""
        kept = math.exp(-interval / self.time)
        density = (1.0 - kept**2) / (1.0 - 2.0 * kept * math.cos(math.tau * interval / length) + kept**2)
        return 1.0 - self.share + self.share * density

    def of_one_pose(self, interval: float, length: float) -> Noise:
        """Noise of a pose as if poses, `interval` s apart, were independent: with the same information together.

        That is the information on what varies once in `length` s: errors that vary more slowly change little in a
        short motion.  It is the white noise with the same spectral density at that frequency.
        """
        sigma = np.sqrt(self.variance * self._inflation(interval, length))
        return Noise(float(math.sqrt(0.5 * (sigma[0] ** 2 + sigma[1] ** 2))), float(sigma[2]))
