"""The control that acts in each step: the mean over the step of the commands as they arrive.

Commands are held until the next one, so their running integral is piecewise linear and a mean over a step is a
difference of two interpolations.  Where commands are delayed by an unknown time, the mean is taken with a hat twice as
wide as the step instead of a box: its derivative with respect to the delay is then continuous, and the optimiser does
not get caught where a jump crosses from one step into the next.  Both have the same area and centre.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kraft.sysid.chains import Stretch
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
            [k for name in ("delay", f"delay_{control}") if (k := parameters.index(name)) >= 0]
            for control in self._controls
        ]
        self._dead_bands = [parameters.index(f"dead_band_{control}") for control in self._controls]

    def mean(self, rho: Floats) -> tuple[Matrix, Floats]:
        """Acting controls (N, nu) of all steps and their derivatives (N, nu, np) with respect to rho."""
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
        delays = self._delays[k]
        at = stretch.times - sum(float(rho[j]) for j in delays)
        mean = _hat_mean if delays else _box_mean
        if self._dead_bands[k] >= 0:
            band = rho[self._dead_bands[k]]
            signs = np.where(np.abs(values) > band, np.sign(values), 0.0)
            slopes[:, self._dead_bands[k]] = -mean(times, signs, at, stretch.h)[0]
            values = signs * (np.abs(values) - band)
        means, slope = mean(times, values, at, stretch.h)
        slopes[:, delays] = -slope[:, None]
        return means


def _box_mean(times: Floats, values: Floats, at: Floats, h: float) -> tuple[Floats, Floats]:
    """Means of a signal between neighbouring times `at`, and their change with `at`."""
    once, _, now = _integrals(times, values, at)
    return np.diff(once) / h, np.diff(now) / h


def _hat_mean(times: Floats, values: Floats, at: Floats, h: float) -> tuple[Floats, Floats]:
    """The same weighted with a hat that is highest in the middle and reaches half a step beyond."""
    middle = at[0] + h * (np.arange(len(at) + 1) - 0.5)
    once, twice, _ = _integrals(times, values, middle)
    return np.diff(twice, 2) / h**2, np.diff(once, 2) / h**2


def _integrals(times: Floats, values: Floats, at: Floats) -> tuple[Floats, Floats, Floats]:
    """First and second integral, and value, at some times, of a signal that is values[i] before times[i]."""
    knots = np.concatenate([[min(times[0], at.min()) - 1.0], times])
    spans = np.diff(knots)
    once = np.concatenate([[0.0], np.cumsum(spans * values[:-1])])
    twice = np.concatenate([[0.0], np.cumsum(spans * (once[:-1] + 0.5 * spans * values[:-1]))])
    i = np.searchsorted(knots, at, side="right") - 1
    d, now = at - knots[i], values[i]
    return once[i] + d * now, twice[i] + d * (once[i] + 0.5 * d * now), now
