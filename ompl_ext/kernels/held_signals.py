"""Integrals of signals that are held between times and follow through a first-order lag, and derivatives by the lag."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

from numba import types

from ompl_ext.arrays import Cube, Floats, Matrix
from ompl_ext.jit import compiled, part
from ompl_ext.kernels.tracking import count_until

LAG_MIN = 1e-6  # lag below which a signal follows at once (s)

# Indices of the results: lagged signals, their first and second integrals, and derivatives of these by the lag
NOW, ONCE, TWICE, ONCE_BY_LAG, TWICE_BY_LAG = range(5)
RESULTS = 5

# Indices of the means, and of their derivatives
MEAN, BY_TIME, BY_LAG = range(3)
MEANS = 3

# Indices of the working memory, at the times from which signals are held: first and second integrals of the signals,
# the lagged ones less the held ones, and the derivative of this by the lag
HELD_ONCE, HELD_TWICE, BEHIND, SLOPE = range(4)
MEMORY = 4


@part
def accumulate(times: Floats, values: Matrix, column: int, lag: float, memory: Cube) -> None:
    """Write a column of the working memory, from the first time to the last."""
    once, twice, behind, slope = 0.0, 0.0, 0.0, 0.0
    for k in range(len(times)):
        if k > 0:
            span, held = times[k] - times[k - 1], values[k - 1, column]
            twice += span * (once + 0.5 * span * held)
            once += span * held
            if lag >= LAG_MIN:  # what is behind decays between jumps, and changes by each jump
                left = math.exp(-span / lag)
                slope = left * slope + left * span / lag**2 * behind
                behind = left * behind - (values[k, column] - held)
        memory[HELD_ONCE, k, column], memory[HELD_TWICE, k, column] = once, twice
        memory[BEHIND, k, column], memory[SLOPE, k, column] = behind, slope


@part
def evaluate(
    k: int, d: float, since: float, column: int, lag: float, values: Matrix, memory: Cube, out: Matrix
) -> None:
    """Write the results (5, m) of a column `d` s after time k, and `since` s after the first one."""
    now, first = values[k, column], values[0, column]
    once = memory[HELD_ONCE, k, column] + d * now
    twice = memory[HELD_TWICE, k, column] + d * (memory[HELD_ONCE, k, column] + 0.5 * d * now)
    if lag < LAG_MIN:
        once_by_lag, twice_by_lag = first - now, first * since - once
    else:
        share = math.exp(-d / lag)
        now += memory[BEHIND, k, column] * share
        once_by_lag = first - now - lag * (memory[SLOPE, k, column] + memory[BEHIND, k, column] * d / lag**2) * share
        once -= lag * (now - first)
        rest = once - first * since  # integral of the signal less its first value
        twice -= lag * rest
        twice_by_lag = -rest - lag * once_by_lag
    out[NOW, column], out[ONCE, column], out[TWICE, column] = now, once, twice
    out[ONCE_BY_LAG, column], out[TWICE_BY_LAG, column] = once_by_lag, twice_by_lag


def _integrate(times: Floats, values: Matrix, at: Floats, lag: float, memory: Cube, out: Cube) -> None:
    for column in range(values.shape[1]):
        accumulate(times, values, column, lag, memory)
    for i in range(len(at)):
        k = count_until(times, 0, len(times), at[i]) - 1
        for column in range(values.shape[1]):
            evaluate(k, at[i] - times[k], at[i] - times[0], column, lag, values, memory, out[:, i])


def _hat_means(
    times: Floats, values: Matrix, begin: Floats, h: Floats, lag: float, memory: Cube, work: Cube, means: Cube
) -> None:
    for column in range(values.shape[1]):
        accumulate(times, values, column, lag, memory)
    for i in range(len(begin)):
        for part_of_hat in range(3):
            at = begin[i] + (part_of_hat - 0.5) * h[i]
            k = count_until(times, 0, len(times), at) - 1
            for column in range(values.shape[1]):
                evaluate(k, at - times[k], at - times[0], column, lag, values, memory, work[part_of_hat])
        for column in range(values.shape[1]):
            means[MEAN, i, column] = second_difference(TWICE, column, work) / (h[i] * h[i])
            means[BY_TIME, i, column] = second_difference(ONCE, column, work) / (h[i] * h[i])
            means[BY_LAG, i, column] = second_difference(TWICE_BY_LAG, column, work) / (h[i] * h[i])


@part
def second_difference(result: int, column: int, work: Cube) -> float:
    """Second difference of a result at the three times of a hat function."""
    before, here, after = work[0, result, column], work[1, result, column], work[2, result, column]
    return (after - here) - (here - before)


@cache
def hat_means() -> Callable[[Floats, Matrix, Floats, Floats, float, Cube, Cube, Cube], None]:
    """The compiled function; its arguments are `times`, `values`, `begin`, `h`, `lag`, `memory`, `work` and `means`.

    `means` (3, n, m) receives the means of the signals of `integrate` over steps of `h` (n,) s from `begin` (n,),
    weighted with a hat function that reaches half a step beyond each step, and their derivatives by a shift of all
    times and by the lag.  `work` is (3, 5, m).
    """
    floats, matrix, cube = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
    return compiled(_hat_means, signature=types.void(floats, matrix, floats, floats, types.float64, cube, cube, cube))


@cache
def integrate() -> Callable[[Floats, Matrix, Floats, float, Cube, Cube], None]:
    """The compiled function; its arguments are `times`, `values`, `at`, `lag`, `memory` and `out`.

    `values[k]` (m,) are held from `times[k]` (s) on, ascending.  `out` (5, n, m) receives the results at the times `at`
    (n,), which are not before the first of `times`; integrals begin there.  `memory` is (4, len(times), m), `lag` in s.
    """
    floats, matrix, cube = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
    return compiled(_integrate, signature=types.void(floats, matrix, floats, types.float64, cube, cube))
