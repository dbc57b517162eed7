"""Bound of the deviation from a prediction, measured while the vehicle drives.

The bound is delta(t, v) for t s since the commit and a speed of v m/s.  Its shape comes from the covariance: the error
of the estimated pose at any time, the uncertain delay times the speed, wrongly predicted turns, and a growth with time
by what the model leaves out.  These are independent, so their squares add up.  Its scale is a variance ratio,
calibrated online: each cycle compares the deviation of the estimate from the last prediction with the bound.  The
stated scale counts as a number of cycles, so that the calibration begins cautiously.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np

from kraft.driving.messages import PredictedMotion, Uncertainty
from kraft.driving.planner_settings import CalibratedBound
from ompl_ext.arrays import Floats
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.poses import displacement
from ompl_ext.query import Safety
from ompl_ext.times import SAME_TIME
from ompl_ext.vehicle import Vehicle

LATER_DELTA: Final = 0.1
"""Bound at rest that is expected for the later part of a plan, at least, m."""
LATER_GROWTH: Final = 0.08
"""Growth of the bound that is expected there, at most, m/s."""
LATER_DELAY: Final = 0.1
"""Part of the bound for the speed that is expected there, at most, s."""
UNCORRECTED: Final = 0.5
"""Time for which a wrong acceleration or curvature moves the vehicle until the controller corrects its effect, s."""
SLOWEST: Final = 0.1
"""Mean speed of drives below which their errors say nothing about turns, m/s."""
RATIOS: Final = 33
"""Number of shapes of an ellipse for which quantiles are tabulated."""
ANGLES: Final = 64
"""Number of directions of a deviation over which its probability is integrated."""
HALVINGS: Final = 50
"""Number of halvings of the interval in which a quantile is looked for."""
LARGEST: Final = 10.0
"""Its end, standard deviations."""


@dataclass(frozen=True)
class DeviationBound:
    """Bound of a deviation, the root of delta^2 + (per_speed v)^2 + (turning v)^2 + (per_time t)^2.

    These parts are independent.  t is at most `horizon` s, and v at most `fastest` m/s (m, s, m/s).  `per_speed` is by
    the unknown delay, `turning` by turns that the model predicts wrongly.
    """

    delta: float
    per_speed: float = 0.0
    per_time: float = 0.0
    horizon: float = 0.0
    fastest: float = math.inf
    turning: float = 0.0

    @property
    def clearance(self) -> Safety:
        """Clearance that is nowhere less than the bound: linear in v and t, as SAFETY needs it; v is at most `fastest`.

        The root is convex in v and in t, and at most the sum of what v and t alone add to `delta`: chords are above it.
        """
        return Safety(
            delta=self.delta,
            delta_per_speed=_chord(self.delta, math.hypot(self.per_speed, self.turning), self.fastest),
            delta_per_time=_chord(self.delta, self.per_time, self.horizon),
            delta_horizon=self.horizon,
        )

    def at(self, speeds: Floats, since: Floats) -> Floats:
        """Clearance (n,) at speeds (n,) and times (n,) since the commit (s), m."""
        return self.clearance.clearance(speeds, since)

    def scaled(self, factor: float) -> DeviationBound:
        """Bound times a factor."""
        return replace(
            self,
            delta=factor * self.delta,
            per_speed=factor * self.per_speed,
            per_time=factor * self.per_time,
            turning=factor * self.turning,
        )

    @property
    def drive_is_known(self) -> bool:
        """Whether delay and drive are known as well as is expected for later."""
        return self.per_time <= LATER_GROWTH and self.per_speed <= LATER_DELAY

    @property
    def later(self) -> DeviationBound:
        """Bound that is expected for the later part of a plan: delay and drive will be known better then."""
        grown = math.hypot(max(self.delta, LATER_DELTA), min(self.per_time, LATER_GROWTH) * self.horizon)
        return replace(self, delta=grown, per_speed=min(self.per_speed, LATER_DELAY), per_time=0.0, horizon=0.0)


class BoundCalibration:
    """Bounds for the coming cycle, and their calibration by the cycles before.

    They are for speeds up to `fastest` m/s: more than `top_speed` of a car that is stronger than its file says.
    """

    def __init__(self, settings: CalibratedBound, vehicle: Vehicle) -> None:
        self._settings, self._vehicle = settings, vehicle
        self.fastest = vehicle.top_speed
        self._ratios, self._count = settings.prior_cycles * settings.initial**2, settings.prior_cycles
        self._last: tuple[PredictedMotion, DeviationBound] | None = None
        self._turning = turning_error(vehicle)
        self._known: tuple[Uncertainty | None, DeviationBound] = None, DeviationBound(0.0)

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
        if time > predicted.times[-1] + SAME_TIME:
            return
        expected = interpolated_rows(time, predicted.times, predicted.states)
        deviation = displacement(state, expected, self._vehicle)
        speed = expected[[self._vehicle.rest_indices[0]]]
        ratio = deviation / float(bound.at(speed, np.array([time - predicted.times[0]]))[0])
        kept = 1.0 - 1.0 / self._settings.memory_cycles
        self._ratios = kept * self._ratios + (ratio / self._settings.expected_ratio) ** 2
        self._count = kept * self._count + 1.0

    def _unscaled(self, uncertainty: Uncertainty) -> DeviationBound:
        """Bound with the scale 1; the last one is kept, because a cycle asks for it twice."""
        known, bound = self._known
        if known is not uncertainty or bound.fastest != self.fastest:
            bound = self._computed(uncertainty)
            self._known = uncertainty, bound
        return bound

    def _computed(self, uncertainty: Uncertainty) -> DeviationBound:
        vehicle, covariance = self._vehicle, uncertainty.state
        pose = [vehicle.index("x"), vehicle.index("y")]
        turn = vehicle.footprint.reach**2 * float(covariance[vehicle.index("theta"), vehicle.index("theta")])
        smaller, larger = np.sqrt(np.linalg.eigvalsh(covariance[np.ix_(pose, pose)]).clip(0.0) + turn).tolist()
        ratios, quantiles = radius_quantiles(self._settings.level)
        quantile = float(np.interp(smaller / larger, ratios, quantiles)) if larger > 0.0 else 0.0
        growth = math.hypot(self._settings.growth, 0.5 * UNCORRECTED * uncertainty.acceleration)
        along = float(quantiles[0])  # of what a wrong delay and a wrong drive change: the way
        return DeviationBound(
            delta=quantile * larger,
            per_speed=along * uncertainty.delay,
            per_time=along * growth,
            horizon=self._settings.horizon,
            fastest=self.fastest,
            turning=along * self._turning,
        )


def turning_error(vehicle: Vehicle) -> float:
    """Standard deviation of the deviation across a vehicle per speed (s) by turns that its model predicts wrongly.

    It follows from the errors of open-loop predictions that its file states, at the speed where they are largest.  A
    wrong curvature moves the vehicle aside with the square of time, until the controller corrects it.
    """
    after_correction = [
        errors.across[0] * (UNCORRECTED / errors.after[0]) ** 2 / max(0.5 * sum(errors.speeds), SLOWEST)
        for errors in vehicle.errors_by_speed
    ]
    return max(after_correction, default=0.0)


def _chord(constant: float, slope: float, end: float) -> float:
    """Slope of the chord from 0 to `end` of the root of `constant`^2 + (`slope` x)^2; without an end it is `slope`."""
    if end == 0.0 or constant == 0.0 or math.isinf(end):
        return slope
    return (math.hypot(constant, slope * end) - constant) / end


@cache
def radius_quantiles(level: float) -> tuple[Floats, Floats]:
    """Ratios (n,) of the axes of an ellipse, and the `level` quantile (n,) of the length of a normal vector with it.

    The quantile is in units of the larger standard deviation.  With the ratio 0 it is that of a deviation along a line,
    with 1 the one of Rayleigh's distribution.
    """
    ratios = np.linspace(0.0, 1.0, RATIOS)
    angles = (np.arange(ANGLES) + 0.5) * math.tau / ANGLES
    variance = np.cos(angles) ** 2 + (ratios[:, None] * np.sin(angles)) ** 2  # of the length, in units of Rayleigh's
    low, high = np.zeros(RATIOS), np.full(RATIOS, LARGEST)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        is_below = np.exp(-0.5 * middle[:, None] ** 2 / variance).mean(axis=1) > 1.0 - level
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    return ratios, high
