"""Actuators of the vehicle in discrete time: from commands to controls of each step.

A command is held until the next one, reduced by a dead band, and acts after a delay through a first-order
lag; its mean over a step is a difference of integrals.  Where the delay or the lag is unknown, the mean is weighted
with a hat (triangular) function twice as wide as the step instead of a box: the derivative with respect to delay and
lag is then continuous, so that the optimiser does not stop where a jump of the command crosses into the next step.
Both functions have the same area and centre.  What moves a vehicle with a dead zone or brakes is not the mean of two
commands.  `ActuatorModel.split` therefore splits a step where a command jumps; the length of the two parts is a
continuous function of the delay.  Play comes before the dead band: a command moves the wheels at the ends of it alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from kraft.sysid.chains import Segment, pose_steps
from kraft.sysid.parameters import Parameters, steering_offset
from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.kernels import held_signals as held

if TYPE_CHECKING:
    from kraft.logs.log import Part


SPLIT_MIN = 0.01
"""Least share of a step that is split off."""
POSE_SPLIT_MIN = 0.07
"""The same for the beginning or end up to a pose: a chord is as far from the path there as in the middle of a half."""


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
        self._drives = _drives(segments, self._rest)
        self._last: tuple[bytes, Matrix, Floats] | None = None
        self._lags = [parameters.auxiliary_index(f"lag_{control}") for control in self._controls]
        self._dead_bands = [parameters.auxiliary_index(f"dead_band_{control}") for control in self._controls]
        self._plays = [parameters.auxiliary_index(f"play_{control}") for control in self._controls]
        self._offset = steering_offset(parameters)
        alike: dict[tuple[int, ...], list[int]] = {}
        for k, delays in enumerate(self._delays):
            alike.setdefault((self._lags[k], self._dead_bands[k], self._plays[k], *delays), []).append(k)
        self._alike = list(alike.values())
        """controls that are processed alike, together; one with a dead band or a play is like no other"""

    @cached_property
    def _poses(self) -> Floats:
        """(N,) share of each step after which a pose was observed in it, see `_pose_within`."""
        return np.concatenate([_pose_within(s) for s in self._segments])

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
            for controls in self._alike:
                found, rows, columns = self._acting(drive, controls, rho), drive.rows[:, None], np.array(controls)
                means[rows, columns] = found.values
                for j, slope in found.slopes.items():
                    slopes[rows, columns, j] = slope
        return means, slopes

    def split(self, rho: Floats, *, halved: bool) -> tuple[Floats, Floats]:
        """Share (N,) of each step after which it is split, 1 if it is not, and mean controls (N, 2, nu) of its parts.

        A step is split where a command jumps, where the largest of several jumps is; one without a jump in the middle
        if `halved`, else where a pose was observed in it.
        """
        total = sum(s.steps for s in self._segments)
        shares, means = np.empty(total), np.empty((total, 2, len(self._controls)))
        for drive in self._drives:
            share = self._jumps(drive, rho, np.full(len(drive.rows), 0.5) if halved else self._poses[drive.rows])
            shares[drive.rows] = share
            edges = np.stack([drive.begin, drive.begin + share * drive.h, drive.begin + drive.h])
            for k in range(len(self._controls)):
                times, values, _ = self._moved(drive, [k], rho)
                lag = float(rho[self._lags[k]]) if self._lags[k] >= 0 else 0.0
                once = _integrals(times, values, edges - self._delay(k, rho), lag)[held.ONCE, :, :, 0]
                means[drive.rows, :, k] = (np.diff(once, axis=0) / np.maximum(np.diff(edges, axis=0), 1e-12)).T
        return shares, means

    def _jumps(self, drive: _Drive, rho: Floats, without: Floats) -> Floats:
        """Share (n,) of each step of a drive after which its largest jump acts; `without` (n,) where there is none."""
        jumps, sizes = [], []
        for k, full in enumerate(self._ranges):
            times, values = self._commanded(drive, [k])
            change = np.abs(np.diff(values[:, 0])) / full
            jumps.append(times[change > 0.0] + self._delay(k, rho))
            sizes.append(change[change > 0.0])
        order = np.argsort(np.concatenate(jumps), kind="stable")
        at, size = np.concatenate(jumps)[order], np.concatenate(sizes)[order]
        low, high = (np.searchsorted(at, drive.begin + s * drive.h) for s in (SPLIT_MIN, 1.0 - SPLIT_MIN))
        share, largest = without, np.zeros(len(drive.begin))
        for i in range(int((high - low).max(initial=0))):
            own = np.flatnonzero(low + i < high)
            found = low[own] + i
            larger = size[found] > largest[own]
            own, found = own[larger], found[larger]
            largest[own], share[own] = size[found], (at[found] - drive.begin[own]) / drive.h[own]
        return share

    def _commanded(self, drive: _Drive, controls: Sequence[int]) -> tuple[Floats, Matrix]:
        """Times (n,) of the commands, and values (n + 1, m) of m controls before the first and from each on."""
        return drive.part.command_times, drive.values[:, controls]

    def _moved(self, drive: _Drive, controls: Sequence[int], rho: Floats) -> tuple[Floats, Matrix, dict[int, Matrix]]:
        """As `_commanded`, but behind play and dead band of controls that are alike; derivatives by index of rho."""
        (times, values), slopes, k = self._commanded(drive, controls), {}, controls[0]
        if (j := self._plays[k]) >= 0:
            straight = -float(rho[self._offset]) if self._offset >= 0 else 0.0
            moved, by_play, by_straight = through_play(values[:, 0], float(rho[j]), straight)
            values, slopes[j] = moved[:, None], by_play[:, None]
            if self._offset >= 0:
                slopes[self._offset] = -by_straight[:, None]
        if (j := self._dead_bands[k]) >= 0:
            signs = np.where(np.abs(values) > rho[j], np.sign(values), 0.0)
            slopes = {i: np.abs(signs) * slope for i, slope in slopes.items()} | {j: -signs}
            values = signs * (np.abs(values) - rho[j])
        return times, values, slopes

    def _delay(self, k: int, rho: Floats) -> float:
        return sum(float(rho[j]) for j in self._delays[k])

    def _acting(self, drive: _Drive, controls: Sequence[int], rho: Floats) -> _Acting:
        """Means of controls that are alike in the steps of all segments of a drive."""
        (times, values, moved), k = self._moved(drive, controls, rho), controls[0]
        slopes = {j: self._means(drive, times, slope, k, rho).values for j, slope in moved.items()}
        means = self._means(drive, times, values, k, rho)
        slopes |= dict.fromkeys(self._delays[k], -means.by_time)
        if (j := self._lags[k]) >= 0:
            slopes[j] = means.by_lag
        return _Acting(means.values, slopes)

    def _means(self, drive: _Drive, times: Floats, values: Matrix, k: int, rho: Floats) -> Means:
        """Means of signals over the steps of a drive, delayed and lagged as control k is, with derivatives."""
        delays, lag = self._delays[k], self._lags[k]
        begin = drive.begin - self._delay(k, rho)
        if not delays and lag < 0:
            return box_means(times, values, begin, drive.h)
        return hat_means(times, values, begin, drive.h, float(rho[lag]) if lag >= 0 else 0.0)


def through_play(values: Floats, play: float, first: float) -> tuple[Floats, Floats, Floats]:
    """What follows values (n,) that push it at the ends of a play of +-`play`, and slopes (n,) by `play` and `first`.

    It remains at `first` until it is pushed.  Each value limits it to an interval, and limits one after the other are
    limits again: they are combined by two, by four, and so on.
    """
    low, high, by_low, by_high = values - play, values + play, np.full_like(values, -1.0), np.ones_like(values)
    span = 1
    while span < len(values):
        limits = low[span:], high[span:], by_low[span:], by_high[span:]
        lower = _limited(low[:-span], by_low[:-span], *limits)
        upper = _limited(high[:-span], by_high[:-span], *limits)
        low[span:], by_low[span:], high[span:], by_high[span:] = *lower, *upper
        span *= 2
    found, by_play = _limited(np.full_like(values, first), np.zeros_like(values), low, high, by_low, by_high)
    return found, by_play, ((low <= first) & (first <= high)).astype(np.float64)


def _limited(
    values: Floats, slopes: Floats, low: Floats, high: Floats, by_low: Floats, by_high: Floats
) -> tuple[Floats, Floats]:
    """Values (n,) within limits, and their derivatives."""
    return np.clip(values, low, high), np.where(values < low, by_low, np.where(values > high, by_high, slopes))


@dataclass(frozen=True, eq=False)
class _Drive:
    """The n steps of all segments of one part that begin alike: their signals are integrated together."""

    part: Part
    values: Matrix
    """(commands + 1, nu) before the first command and from each on"""
    rows: Ints
    """(n,) indices of the steps among all"""
    begin: Floats
    """(n,) s"""
    h: Floats
    """(n,) durations, s"""


def _pose_within(segment: Segment) -> Floats:
    """(steps,) share of each step of a segment after which a pose was observed in it, 1 if none was."""
    within = np.ones(segment.steps)
    step, share = pose_steps(segment)
    inside = (share > POSE_SPLIT_MIN) & (share < 1.0 - POSE_SPLIT_MIN)
    within[step[inside]] = share[inside]
    return within


def _drives(segments: Sequence[Segment], rest: Floats) -> list[_Drive]:
    """Steps of some segments by part, and by whether the control `rest` (nu,) acted before its first command."""
    first = np.concatenate([[0], np.cumsum([s.steps for s in segments])])
    alike: dict[tuple[int, bool], list[int]] = {}
    for i, segment in enumerate(segments):
        alike.setdefault((id(segment.part), segment.resting), []).append(i)
    return [
        _Drive(
            (part := segments[own[0]].part),
            np.vstack([rest if resting else part.commands[0], part.commands]),
            np.concatenate([np.arange(first[i], first[i + 1]) for i in own]),
            np.concatenate([segments[i].times[:-1] for i in own]),
            np.concatenate([np.full(segments[i].steps, segments[i].h) for i in own]),
        )
        for (_, resting), own in alike.items()
    ]


@dataclass(frozen=True, eq=False)
class _Acting:
    """Means (n, m) of some controls in the steps of a drive, and their derivatives by index of rho."""

    values: Matrix
    slopes: dict[int, Matrix]


@dataclass(frozen=True, eq=False)
class Means:
    """Means (steps, m) of signals between neighbouring times, with derivatives."""

    values: Matrix
    by_time: Matrix
    """derivative with respect to a shift of all times"""
    by_lag: Matrix
    """derivative with respect to the lag"""


def box_means(times: Floats, values: Matrix, begin: Floats, h: Floats) -> Means:
    """Means over steps of h (n,) s from `begin` (n,), of signals without lag, values[i] (m,) before times[i]."""
    found = _integrals(times, values, np.stack([begin, begin + h]), 0.0)
    return Means(*(np.diff(found[k], axis=0)[0] / h[:, None] for k in (held.ONCE, held.NOW, held.ONCE_BY_LAG)))


def hat_means(times: Floats, values: Matrix, begin: Floats, h: Floats, lag: float) -> Means:
    """Means weighted with a hat function that reaches half a step beyond each step; `lag` is in s."""
    knots, columns = _knots(times, float((begin - 0.5 * h).min())), values.shape[1]
    memory, work = np.empty((held.MEMORY, *values.shape)), np.empty((3, held.RESULTS, columns))
    means = np.empty((held.MEANS, len(begin), columns))
    held.hat_means()(knots, np.ascontiguousarray(values), begin, h, lag, memory, work, means)
    return Means(*means)


def _knots(times: Floats, first: float) -> Floats:
    """Times (n + 1,) from which the signals of n `times` are held, of which the first is before `first` (s)."""
    return np.concatenate([[min(float(times[0]), first) - 1.0], times])


def _integrals(times: Floats, values: Matrix, when: Matrix, lag: float) -> Floats:
    """Results (5, j, n, m) of `held_signals` at some times (j, n), of signals with values[i] (m,) before times[i]."""
    knots = _knots(times, float(when.min()))
    memory, out = np.empty((held.MEMORY, *values.shape)), np.empty((held.RESULTS, when.size, values.shape[1]))
    held.integrate()(knots, np.ascontiguousarray(values), when.ravel(), lag, memory, out)
    return out.reshape(held.RESULTS, *when.shape, values.shape[1])
