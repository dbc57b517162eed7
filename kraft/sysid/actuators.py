"""Actuator model: the mean control that acts in each step, from the commands.

A command is held until the next one, reduced by a dead band, and acts after a delay through a first-order lag; its mean
over a step is a difference of integrals.  Where the delay or the lag is unknown, the mean is weighted with a hat
(triangular) function twice as wide as the step instead of a box: the derivative with respect to delay and lag is then
continuous, so that the optimiser does not stop where a jump of the command crosses into the next step.  Both functions
have the same area and centre.

What moves a vehicle with a dead zone or brakes is not the mean of two commands.  `ActuatorModel.split` therefore splits
each step where a command jumps; the length of the two parts is a continuous function of the delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_banded

from kraft.sysid.chains import Segment
from kraft.sysid.parameters import Parameters
from ompl_ext.arrays import Floats, Ints, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Part


SPLIT_MIN = 0.01
"""Least share of a step that is split off."""
LAG_MIN = 1e-6
"""Lag below which a control counts as immediate, s."""


class ActuatorModel:
    """Controls that act in the steps of some segments, as functions of delays, lags and dead bands."""

    def __init__(self, segments: Sequence[Segment], parameters: Parameters) -> None:
        """Look up the auxiliary parameters that apply to each control."""
        self._segments, self._size = segments, len(parameters.names)
        self._controls = list(parameters.vehicle.controls)
        bounds = parameters.vehicle.control_bounds
        self._rest = np.clip(0.0, bounds[:, 0], bounds[:, 1])
        self._ranges = np.maximum(np.ptp(bounds, axis=1), 1e-9)
        self._delays = [
            [k for name in ("delay", f"delay_{control}") if (k := parameters.auxiliary_index(name)) >= 0]
            for control in self._controls
        ]
        self._drives = _drives(segments)
        self._last: tuple[bytes, Matrix, Floats] | None = None
        self._lags = [parameters.auxiliary_index(f"lag_{control}") for control in self._controls]
        self._dead_bands = [parameters.auxiliary_index(f"dead_band_{control}") for control in self._controls]

    def mean(self, rho: Floats) -> tuple[Matrix, Floats]:
        """Acting controls (N, nu) of all steps and their derivatives (N, nu, np) with respect to rho.

        The values of the last rho are cached: the cost of a point, its factors and the step from it all need them.
        """
        key = rho.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = (key, *self._mean(rho))
        return self._last[1], self._last[2]

    def _mean(self, rho: Floats) -> tuple[Matrix, Floats]:
        total = sum(s.steps for s in self._segments)
        means, slopes = np.empty((total, len(self._controls))), np.zeros((total, len(self._controls), self._size))
        for drive in self._drives:
            for k in range(len(self._controls)):
                found = self._one(drive, k, rho)
                means[drive.rows, k] = found.values
                for j, slope in found.slopes.items():
                    slopes[drive.rows, k, j] = slope
        return means, slopes

    def split(self, rho: Floats) -> tuple[Floats, Floats]:
        """Share (N,) of each step after which a command jumps, and mean controls (N, 2, nu) before and after that.

        Of several jumps in a step the largest counts; a step without one is split in the middle.
        """
        total = sum(s.steps for s in self._segments)
        shares, means = np.empty(total), np.empty((total, 2, len(self._controls)))
        for drive in self._drives:
            share = self._jumps(drive, rho)
            shares[drive.rows] = share
            edges = np.stack([drive.begin, drive.begin + share * drive.h, drive.begin + drive.h])
            for k in range(len(self._controls)):
                times, values = self._commanded(drive, k)
                if (j := self._dead_bands[k]) >= 0:
                    values = np.sign(values) * np.maximum(np.abs(values) - rho[j], 0.0)
                lag = float(rho[self._lags[k]]) if self._lags[k] >= 0 else 0.0
                once = _integrals(times, values, (edges - self._delay(k, rho)).ravel(), lag).once.reshape(edges.shape)
                means[drive.rows, :, k] = (np.diff(once, axis=0) / np.diff(edges, axis=0)).T
        return shares, means

    def _jumps(self, drive: _Drive, rho: Floats) -> Floats:
        """Share (n,) of each step of a drive after which its largest jump acts, a half for those without one."""
        jumps, sizes = [], []
        for k, full in enumerate(self._ranges):
            times, values = self._commanded(drive, k)
            change = np.abs(np.diff(values)) / full
            jumps.append(times[change > 0.0] + self._delay(k, rho))
            sizes.append(change[change > 0.0])
        order = np.argsort(np.concatenate(jumps), kind="stable")
        at, size = np.concatenate(jumps)[order], np.concatenate(sizes)[order]
        low, high = (np.searchsorted(at, drive.begin + s * drive.h) for s in (SPLIT_MIN, 1.0 - SPLIT_MIN))
        share, largest = np.full(len(drive.begin), 0.5), np.zeros(len(drive.begin))
        for i in range(int((high - low).max(initial=0))):
            own = np.flatnonzero(low + i < high)
            found = low[own] + i
            larger = size[found] > largest[own]
            own, found = own[larger], found[larger]
            largest[own], share[own] = size[found], (at[found] - drive.begin[own]) / drive.h[own]
        return share

    def _commanded(self, drive: _Drive, k: int) -> tuple[Floats, Floats]:
        """Times (n,) of the commands of a control, and its values (n + 1,) before the first and from each on."""
        times, values = drive.part.command_times, drive.part.commands[:, k]
        return times, np.concatenate([[self._rest[k] if drive.resting else values[0]], values])

    def _delay(self, k: int, rho: Floats) -> float:
        return sum(float(rho[j]) for j in self._delays[k])

    def _one(self, drive: _Drive, k: int, rho: Floats) -> _Acting:
        """Means of one control in the steps of all segments of a drive."""
        (times, values), slopes = self._commanded(drive, k), {}
        if (j := self._dead_bands[k]) >= 0:
            signs = np.where(np.abs(values) > rho[j], np.sign(values), 0.0)
            slopes[j] = -self._means(drive, times, signs, k, rho).values
            values = signs * (np.abs(values) - rho[j])
        means = self._means(drive, times, values, k, rho)
        slopes |= dict.fromkeys(self._delays[k], -means.by_time)
        if (j := self._lags[k]) >= 0:
            slopes[j] = means.by_lag
        return _Acting(means.values, slopes)

    def _means(self, drive: _Drive, times: Floats, values: Floats, k: int, rho: Floats) -> Means:
        """Means of control k over the steps of a drive, delayed and lagged, with derivatives."""
        delays, lag = self._delays[k], self._lags[k]
        begin = drive.begin - self._delay(k, rho)
        if not delays and lag < 0:
            return box_means(times, values, begin, drive.h)
        return hat_means(times, values, begin, drive.h, float(rho[lag]) if lag >= 0 else 0.0)


@dataclass(frozen=True, eq=False)
class _Drive:
    """The n steps of all segments of one part that begin alike: their signals are integrated together."""

    part: Part
    resting: bool
    rows: Ints
    """(n,) indices of the steps among all"""
    begin: Floats
    """(n,) s"""
    h: Floats
    """(n,) durations, s"""


def _drives(segments: Sequence[Segment]) -> list[_Drive]:
    """Steps of some segments by part, and by whether no control acted before its first command."""
    first = np.concatenate([[0], np.cumsum([s.steps for s in segments])])
    alike: dict[tuple[int, bool], list[int]] = {}
    for i, segment in enumerate(segments):
        alike.setdefault((id(segment.part), segment.resting), []).append(i)
    return [
        _Drive(
            segments[own[0]].part,
            resting,
            np.concatenate([np.arange(first[i], first[i + 1]) for i in own]),
            np.concatenate([segments[i].times[:-1] for i in own]),
            np.concatenate([np.full(segments[i].steps, segments[i].h) for i in own]),
        )
        for (_, resting), own in alike.items()
    ]


@dataclass(frozen=True, eq=False)
class _Acting:
    """Means (n,) of one control in the steps of a drive, and their derivatives by index of rho."""

    values: Floats
    slopes: dict[int, Floats]


@dataclass(frozen=True, eq=False)
class Means:
    """Means (steps,) of a signal between neighbouring times, with derivatives."""

    values: Floats
    by_time: Floats
    """derivative with respect to a shift of all times"""
    by_lag: Floats
    """derivative with respect to the lag"""


@dataclass(frozen=True, eq=False)
class _Integrals:
    """Value, first and second integral of the lagged signal at some times (n,), and derivatives by the lag."""

    now: Floats
    once: Floats
    twice: Floats
    once_by_lag: Floats
    twice_by_lag: Floats


def box_means(times: Floats, values: Floats, begin: Floats, h: Floats) -> Means:
    """Means over steps of h (n,) s from `begin` (n,), of a signal without lag that has values[i] before times[i]."""
    found = _integrals(times, values, np.concatenate([begin, begin + h]), 0.0)
    return Means(*(np.diff(each.reshape(2, -1), axis=0)[0] / h for each in (found.once, found.now, found.once_by_lag)))


def hat_means(times: Floats, values: Floats, begin: Floats, h: Floats, lag: float) -> Means:
    """Means weighted with a hat function that reaches half a step beyond each step; `lag` is in s."""
    found = _integrals(times, values, np.concatenate([begin - 0.5 * h, begin + 0.5 * h, begin + 1.5 * h]), lag)
    signals = (found.twice, found.once, found.twice_by_lag)
    return Means(*(np.diff(each.reshape(3, -1), 2, axis=0)[0] / h**2 for each in signals))


def _integrals(times: Floats, values: Floats, at: Floats, lag: float) -> _Integrals:
    knots = np.concatenate([[min(times[0], at.min()) - 1.0], times])
    spans = np.diff(knots)
    once = np.concatenate([[0.0], np.cumsum(spans * values[:-1])])
    twice = np.concatenate([[0.0], np.cumsum(spans * (once[:-1] + 0.5 * spans * values[:-1]))])
    i = np.searchsorted(knots, at, side="right") - 1
    d, now = at - knots[i], values[i]
    once, twice = once[i] + d * now, twice[i] + d * (once[i] + 0.5 * d * now)
    behind = _lag_deviation(spans, values, i, d, lag)
    now, gone = now + behind[:, 0], now + behind[:, 0] - values[0]
    once_by_lag = -gone - lag * behind[:, 1]
    once -= lag * gone
    rest = once - values[0] * (at - knots[0])  # integral of `gone`
    return _Integrals(now, once, twice - lag * rest, once_by_lag, -rest - lag * once_by_lag)


def _lag_deviation(spans: Floats, values: Floats, i: Ints, d: Floats, lag: float) -> Matrix:
    """(n, 2) lagged signal less the held one, `d` s after knot `i`, and its derivative with respect to the lag."""
    if lag < LAG_MIN:
        return np.zeros((len(d), 2))
    left = np.exp(-spans / lag)
    # the deviation decays between jumps and changes by each jump: a bidiagonal system
    jumps = np.concatenate([[0.0], -np.diff(values)])
    chain = np.array([np.ones(len(values)), np.append(-left, 0.0)])
    behind = solve_banded((1, 0), chain, jumps, check_finite=False)
    slowed = np.concatenate([[0.0], left * spans / lag**2 * behind[:-1]])
    slope = solve_banded((1, 0), chain, slowed, check_finite=False)
    share = np.exp(-d / lag)
    return np.column_stack([behind[i] * share, (slope[i] + behind[i] * d / lag**2) * share])
