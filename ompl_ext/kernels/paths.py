"""Evenly sampled paths of a reference, one per direction of travel, as `ompl_ext.kernels.tracking.Track` has them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from numba import types

from ompl_ext.arrays import Floats, Ints, Matrix, int64
from ompl_ext.jit import compiled, part
from ompl_ext.kernels.tracking import (
    AHEAD_X,
    AHEAD_Y,
    AT_STEERING,
    AT_THETA,
    AT_THROTTLE,
    AT_V,
    AT_X,
    AT_Y,
    STEERING,
    THETA,
    THROTTLE,
    TIME,
    X,
    Y,
    count_until,
)

SPACING = 0.02  # distance between samples of a path (m)
STANDSTILL_SPEED = 1e-3  # speed below which there is no direction of travel (m/s)
SHORTEST = 1e-6  # length up to which a path has a single sample (m)
COINCIDENT = 1e-9  # distance up to which the heading gives the direction of travel (m)

# Row of `laid` after X, Y, THETA and TIME: arc length from the start of the path (m)
ARC = 4
LAID = 5


@part
def direction_at(speed: float, before: int) -> int:
    """Direction of travel at a speed: 1 forwards, -1 backwards, and at standstill the one before."""
    if speed > STANDSTILL_SPEED:
        return 1
    if speed < -STANDSTILL_SPEED:
        return -1
    return before


@part
def first_direction(states: Matrix, v: int) -> int:
    """Direction of travel of the first state that moves; forwards if none does."""
    for k in range(len(states)):
        direction = direction_at(states[k, v], int64(0))
        if direction != 0:
            return direction
    return int64(1)


@part
def lay(
    states: Matrix, times: Floats, where: Ints, offset: float, first: int, last: int, laid: Matrix, begin: int
) -> float:
    """Lay the point `offset` m ahead of the centre along states `first` to `last`, in columns from `begin` on.

    Headings are unwrapped.  Returns the length of the path, m.
    """
    turns, arc_length = 0.0, 0.0
    for k in range(first, last + 1):
        at, theta = begin + k - first, states[k, where[AT_THETA]]
        if k > first:
            turned = theta - states[k - 1, where[AT_THETA]]
            turns += math.tau * round(turned / math.tau)
        laid[X, at] = states[k, where[AT_X]] + offset * math.cos(theta)
        laid[Y, at] = states[k, where[AT_Y]] + offset * math.sin(theta)
        laid[THETA, at], laid[TIME, at] = theta - turns, times[k]
        if k > first:
            arc_length += math.hypot(laid[X, at] - laid[X, at - 1], laid[Y, at] - laid[Y, at - 1])
        laid[ARC, at] = arc_length
    return arc_length


def _lay_paths(
    states: Matrix,
    times: Floats,
    where: Ints,
    offset: float,
    laid: Matrix,
    begin: Ints,
    first: Ints,
    direction: Ints,
    spacing: Floats,
) -> int:
    count, path, start = len(states), int64(0), int64(0)
    here = first_direction(states, where[AT_V])
    begin[0] = first[0] = 0
    for last in range(count):
        following = direction_at(states[last + 1, where[AT_V]], here) if last + 1 < count else int64(0)
        if following == here:
            continue
        length = lay(states, times, where, here * offset, start, last, laid, begin[path])
        pieces = max(1, math.ceil(length / SPACING)) if length > SHORTEST else 0
        direction[path], spacing[path] = here, length / pieces if pieces > 0 else 0.0
        begin[path + 1] = begin[path] + last + 1 - start
        first[path + 1] = first[path] + pieces + 1
        path, start, here = path + 1, last, following  # the state between two paths is part of both
    return path


@part
def interpolate(laid: Matrix, end: int, at: int, arc_length: float, samples: Matrix, k: int) -> int:
    """Write sample k at an arc length (m), from column `at` on or beyond, before `end`.  Returns its column."""
    while at + 1 < end and laid[ARC, at + 1] <= arc_length:
        at += 1
    for row in range(ARC):
        value = laid[row, at]
        if at + 1 < end:
            slope = (laid[row, at + 1] - value) / (laid[ARC, at + 1] - laid[ARC, at])
            value += slope * (arc_length - laid[ARC, at])
        samples[row, k] = value
    return at


@part
def point_ahead(samples: Matrix, first: int, end: int, direction: int) -> None:
    """Write unit vectors in the direction of travel: from the sample before to the one after, else the heading's."""
    for k in range(first, end):
        before, after = max(k - 1, first), min(k + 1, end - 1)
        dx, dy = samples[X, after] - samples[X, before], samples[Y, after] - samples[Y, before]
        length = math.hypot(dx, dy)
        if length <= COINCIDENT:
            dx, dy = direction * math.cos(samples[THETA, k]), direction * math.sin(samples[THETA, k])
            length = 1.0
        samples[AHEAD_X, k], samples[AHEAD_Y, k] = dx / length, dy / length


def _sample_paths(
    laid: Matrix,
    begin: Ints,
    first: Ints,
    direction: Ints,
    spacing: Floats,
    times: Floats,
    controls: Matrix,
    rest: Floats,
    where: Ints,
    samples: Matrix,
) -> None:
    throttle, steering = where[AT_THROTTLE], where[AT_STEERING]
    for path in range(len(direction)):
        at, end, last = begin[path], begin[path + 1], first[path + 1] - 1
        for k in range(first[path], last + 1):
            arc_length = laid[ARC, end - 1] if k == last else spacing[path] * (k - first[path])
            at = interpolate(laid, end, at, arc_length if last > first[path] else 0.0, samples, k)
            samples[THROTTLE, k], samples[STEERING, k] = rest[throttle], rest[steering]
            if len(controls) > 0:  # at the end of the reference its last control
                held = count_until(times, int64(0), len(times), samples[TIME, k]) - 1
                held = min(max(held, 0), len(controls) - 1)
                samples[THROTTLE, k], samples[STEERING, k] = controls[held, throttle], controls[held, steering]
        point_ahead(samples, first[path], first[path + 1], direction[path])


@dataclass(frozen=True)
class Paths:
    """Compiled functions that lay the paths of a reference of n states, and sample them.

    `lay(states, times, where, offset, laid, begin, first, direction, spacing)` returns their number.  It writes the
    tracked point to `laid` (5, 2 n), in which path k has the columns from `begin[k]` to `begin[k + 1]`, and what
    `Track` has of each path; `begin` and `first` are (n + 2,), `direction` and `spacing` (n + 1,).
    `sample(laid, begin, first, direction, spacing, times, controls, rest, where, samples)` writes the samples.
    """

    lay: Callable[[Matrix, Floats, Ints, float, Matrix, Ints, Ints, Ints, Floats], int]
    sample: Callable[[Matrix, Ints, Ints, Ints, Floats, Floats, Matrix, Floats, Ints, Matrix], None]


@cache
def paths() -> Paths:
    """The compiled functions; compiled, or loaded from the cache, on the first call."""
    number, floats, ints, matrix = types.float64, types.float64[::1], types.int64[::1], types.float64[:, ::1]
    return Paths(
        compiled(_lay_paths, signature=types.int64(matrix, floats, ints, number, matrix, ints, ints, ints, floats)),
        compiled(
            _sample_paths,
            signature=types.void(matrix, ints, ints, ints, floats, floats, matrix, floats, ints, matrix),
        ),
    )
