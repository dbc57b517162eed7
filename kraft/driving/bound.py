"""Bound of the deviation of the vehicle from its prediction, from the estimator's covariance, calibrated online.

The bound is delta(t, v) for t s since the commit and a speed of v m/s.  Its shape comes from the covariance: the error
of the estimated pose at any time, the uncertain delay times the speed, and a growth with time by what the model leaves
out.  Its scale is a variance ratio: each cycle compares the deviation of the estimate from the last prediction with the
bound.  The stated scale counts as a number of cycles, so that the calibration begins cautiously.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kraft.driving.messages import PredictedMotion, Uncertainty
from kraft.driving.method import CalibratedBound
from kraft.planning.workspace import displacement
from ompl_ext.arrays import Floats
from ompl_ext.query import Safety
from ompl_ext.vehicle import Vehicle


@dataclass(frozen=True)
class DeviationBound:
    """delta(t, v) = `delta` + `per_speed` |v| + `per_time` t, with t at most `horizon` s (m, s, m/s)."""

    delta: float
    per_speed: float = 0.0
    per_time: float = 0.0
    horizon: float = 0.0

    def at(self, since: Floats, speeds: Floats) -> Floats:
        """Bound (n,) at times (n,) since the commit (s) and speeds (n,), m."""
        safety = Safety(
            delta=self.delta, delta_per_speed=self.per_speed, delta_per_time=self.per_time, delta_horizon=self.horizon
        )
        return safety.clearance(speeds, since)

    def scaled(self, factor: float) -> DeviationBound:
        """Bound times a factor."""
        return DeviationBound(factor * self.delta, factor * self.per_speed, factor * self.per_time, self.horizon)


class BoundCalibration:
    """Bounds for the coming cycle, and their calibration by the cycles before."""

    def __init__(self, settings: CalibratedBound, vehicle: Vehicle) -> None:
        self._settings, self._vehicle = settings, vehicle
        self._quantile = math.sqrt(-2.0 * math.log(1.0 - settings.level))  # of a normal deviation in the plane
        self._ratios, self._count = settings.prior_cycles * settings.initial**2, settings.prior_cycles
        self._last: tuple[PredictedMotion, DeviationBound] | None = None

    @property
    def factor(self) -> float:
        """Scale of the bound, 1 if deviations are as large as the covariance states."""
        low, high = self._settings.limits
        return min(max(math.sqrt(self._ratios / self._count), low), high)

    def bound(self, uncertainty: Uncertainty) -> DeviationBound:
        """Bound for a cycle that is planned from an estimate with this uncertainty."""
        return self._unscaled(uncertainty).scaled(self.factor)

    def committed(self, predicted: PredictedMotion, uncertainty: Uncertainty) -> None:
        """Record the prediction of the committed motion, to be compared with what follows."""
        self._last = predicted, self._unscaled(uncertainty)

    def observe(self, time: float, state: Floats) -> None:
        """Compare an estimated state (nx,) at `time` (s) with the last prediction."""
        if self._last is None or not self._last[0].times[0] < time:
            return
        predicted, bound = self._last
        if time > predicted.times[-1] + 1e-9:
            return
        expected = np.array([np.interp(time, predicted.times, column) for column in predicted.states.T])
        deviation = displacement(state, expected, self._vehicle)
        speed = expected[[self._vehicle.rest_indices[0]]]
        ratio = deviation / float(bound.at(np.array([time - predicted.times[0]]), speed)[0])
        kept = 1.0 - 1.0 / self._settings.memory_cycles
        self._ratios = kept * self._ratios + (ratio / self._settings.expected_ratio) ** 2
        self._count = kept * self._count + 1.0

    def _unscaled(self, uncertainty: Uncertainty) -> DeviationBound:
        vehicle, covariance = self._vehicle, uncertainty.state
        pose = [vehicle.index("x"), vehicle.index("y")]
        position = float(np.linalg.eigvalsh(covariance[np.ix_(pose, pose)])[-1])
        turn = float(covariance[vehicle.index("theta"), vehicle.index("theta")])
        sigma = math.sqrt(position + vehicle.footprint.reach**2 * turn)
        return DeviationBound(
            self._quantile * sigma, self._quantile * uncertainty.delay, self._quantile * self._settings.growth,
            self._settings.horizon,
        )  # fmt: skip
