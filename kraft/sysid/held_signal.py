"""Means of a signal that is held from each time to the next, seen through a first-order lag; all of it is exact.

The lagged signal y follows the held one w with the time constant T: T y' = w - y, and it is at rest, y = w, before the
first time.  Hence the integral of y is that of w less T y, but for a constant, and so on: no integral of an exponential
is needed, and a lag of nothing is no special case.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_banded

from ompl_ext.arrays import Floats, Ints, Matrix

MOMENT = 1e-6
"""A shorter lag is none, s."""


@dataclass(frozen=True, eq=False)
class Means:
    """Means (steps,) of a signal between neighbouring times, and what they change with."""

    values: Floats
    by_time: Floats
    """with all of the times"""
    by_lag: Floats


@dataclass(frozen=True, eq=False)
class _Integrals:
    """Of the lagged signal at some times (n,): what it is there, its first and second integral, and their slopes."""

    now: Floats
    once: Floats
    twice: Floats
    once_by_lag: Floats
    twice_by_lag: Floats


def box_means(times: Floats, values: Floats, at: Floats, h: float) -> Means:
    """Means between neighbouring times `at`, `h` apart, of a signal without lag: values[i] before times[i]."""
    found = _integrals(times, values, at, 0.0)
    return Means(*(np.diff(each) / h for each in (found.once, found.now, found.once_by_lag)))


def hat_means(times: Floats, values: Floats, at: Floats, h: float, lag: float) -> Means:
    """The same weighted with a hat that is highest in the middle and reaches half a step beyond; `lag` is in s."""
    middle = at[0] + h * (np.arange(len(at) + 1) - 0.5)
    found = _integrals(times, values, middle, lag)
    return Means(*(np.diff(each, 2) / h**2 for each in (found.twice, found.once, found.twice_by_lag)))


def _integrals(times: Floats, values: Floats, at: Floats, lag: float) -> _Integrals:
    knots = np.concatenate([[min(times[0], at.min()) - 1.0], times])
    spans = np.diff(knots)
    once = np.concatenate([[0.0], np.cumsum(spans * values[:-1])])
    twice = np.concatenate([[0.0], np.cumsum(spans * (once[:-1] + 0.5 * spans * values[:-1]))])
    i = np.searchsorted(knots, at, side="right") - 1
    d, now = at - knots[i], values[i]
    once, twice = once[i] + d * now, twice[i] + d * (once[i] + 0.5 * d * now)
    behind = _behind(spans, values, i, d, lag)
    now, gone = now + behind[:, 0], now + behind[:, 0] - values[0]
    once_by_lag = -gone - lag * behind[:, 1]
    once -= lag * gone
    rest = once - values[0] * (at - knots[0])  # integral of `gone`
    return _Integrals(now, once, twice - lag * rest, once_by_lag, -rest - lag * once_by_lag)


def _behind(spans: Floats, values: Floats, i: Ints, d: Floats, lag: float) -> Matrix:
    """(n, 2) how far the lagged signal is from the held one `d` s after knot `i`, and its change with the lag."""
    if lag < MOMENT:
        return np.zeros((len(d), 2))
    left = np.exp(-spans / lag)
    # after each jump the lagged signal is as far behind as it still was, less the jump: a chain, solved at once
    jumps = np.concatenate([[0.0], -np.diff(values)])
    chain = np.array([np.ones(len(values)), np.append(-left, 0.0)])
    behind = solve_banded((1, 0), chain, jumps, check_finite=False)
    slowed = np.concatenate([[0.0], left * spans / lag**2 * behind[:-1]])
    slope = solve_banded((1, 0), chain, slowed, check_finite=False)
    share = np.exp(-d / lag)
    return np.column_stack([behind[i] * share, (slope[i] + behind[i] * d / lag**2) * share])
