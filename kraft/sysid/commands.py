"""The control that acts in each step: the mean over the step of the commands as they arrive.

Commands are held until the next one, lose their dead band, and act after a delay through a first-order lag; the mean
of that over a step is a difference of integrals.  Where the delay or the lag is unknown, the mean is taken with a hat
twice as wide as the step instead of a box: its derivative with respect to them is then continuous, and the optimiser
does not get caught where a jump crosses from one step into the next.  Both have the same area and centre.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kraft.sysid.chains import Stretch
from kraft.sysid.held_signal import Means, box_means, hat_means
from kraft.sysid.parameters import Parameters
from ompl_ext.arrays import Floats, Matrix


class Commands:
    """Commands of some stretches, and which extras shift or shrink them."""

    def __init__(self, stretches: Sequence[Stretch], parameters: Parameters) -> None:
        """Look up which extras there are."""
        self._stretches, self._size = stretches, len(parameters.names)
        self._controls = list(parameters.vehicle.controls)
        bounds = parameters.vehicle.control_bounds
        self._rest = np.clip(0.0, bounds[:, 0], bounds[:, 1])
        self._delays = [
            [k for name in ("delay", f"delay_{control}") if (k := parameters.extra(name)) >= 0]
            for control in self._controls
        ]
        self._last: tuple[bytes, Matrix, Floats] | None = None
        self._lags = [parameters.extra(f"lag_{control}") for control in self._controls]
        self._dead_bands = [parameters.extra(f"dead_band_{control}") for control in self._controls]

    def mean(self, rho: Floats) -> tuple[Matrix, Floats]:
        """Acting controls (N, nu) of all steps and their derivatives (N, nu, np) with respect to rho.

        Those of the last rho are kept: a point's cost, its factors and the step from it all ask for them.
        """
        key = rho.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = (key, *self._mean(rho))
        return self._last[1], self._last[2]

    def _mean(self, rho: Floats) -> tuple[Matrix, Floats]:
        total = sum(s.steps for s in self._stretches)
        means, slopes = np.empty((total, len(self._controls))), np.zeros((total, len(self._controls), self._size))
        at = 0
        for stretch in self._stretches:
            rows = slice(at, at + stretch.steps)
            for k in range(len(self._controls)):
                means[rows, k] = self._one(stretch, k, rho, slopes[rows, k])
            at += stretch.steps
        return means, slopes

    def _one(self, stretch: Stretch, k: int, rho: Floats, slopes: Floats) -> Floats:
        """Means of one control of one stretch; its derivatives are written to `slopes` (steps, np)."""
        times, values = stretch.part.command_times, stretch.part.commands[:, k]
        before = self._rest[k] if stretch.resting else values[0]
        values = np.concatenate([[before], values])
        if (j := self._dead_bands[k]) >= 0:
            signs = np.where(np.abs(values) > rho[j], np.sign(values), 0.0)
            slopes[:, j] = -self._means(stretch, times, signs, k, rho).values
            values = signs * (np.abs(values) - rho[j])
        means = self._means(stretch, times, values, k, rho)
        slopes[:, self._delays[k]] = -means.by_time[:, None]
        if (j := self._lags[k]) >= 0:
            slopes[:, j] = means.by_lag
        return means.values

    def _means(self, stretch: Stretch, times: Floats, values: Floats, k: int, rho: Floats) -> Means:
        """Means over a stretch's steps of what control k makes of held values."""
        delays, lag = self._delays[k], self._lags[k]
        at = stretch.times - sum(float(rho[j]) for j in delays)
        if not delays and lag < 0:
            return box_means(times, values, at, stretch.h)
        return hat_means(times, values, at, stretch.h, float(rho[lag]) if lag >= 0 else 0.0)
