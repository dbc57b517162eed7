"""Paths of a reference: what they sample, where they are cut, and what they hold at their ends."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.kernels.paths import LAID, SPACING, paths
from ompl_ext.kernels.tracking import AHEAD_X, AHEAD_Y, ROWS, STEERING, THETA, THROTTLE, TIME, X, Y

WHERE = np.array([0, 1, 2, 3, 0, 1, 25])
REST = np.array([0.7, -0.3])


def sampled(
    states: Matrix, controls: Matrix | None = None, offset: float = 0.0
) -> tuple[Matrix, Ints, Ints, Floats, Floats]:
    """Samples, first, direction, spacing and times of the paths of states (n, 4), a tenth of a second apart."""
    count = len(states)
    times: Floats = 5.0 + 0.1 * np.arange(count)
    laid, begin, first = np.empty((LAID, 2 * count)), np.empty(count + 2, np.int64), np.empty(count + 2, np.int64)
    direction, spacing = np.empty(count + 1, np.int64), np.empty(count + 1)
    number = paths().lay(states, times, WHERE, offset, laid, begin, first, direction, spacing)
    first, direction, spacing = first[: number + 1], direction[:number], spacing[:number]
    samples = np.empty((ROWS, first[-1]))
    held = np.zeros((0, 2)) if controls is None else controls
    paths().sample(laid, begin, first, direction, spacing, times, held, REST, WHERE, samples)
    return samples, first, direction, spacing, times


def arc(count: int = 40, speed: float = 0.5, radius: float = 0.8) -> Matrix:
    """States (count, 4) on a circle that passes the heading of half a turn."""
    theta = 3.0 + np.sign(speed) * 0.1 * abs(speed) / radius * np.arange(count)
    wrapped = np.angle(np.exp(1j * theta))
    return np.column_stack([radius * np.sin(theta), -radius * np.cos(theta), wrapped, np.full(count, speed)])


@pytest.mark.parametrize("speed", [0.5, -0.5])
@pytest.mark.parametrize("offset", [0.0, 0.17])
def test_a_path_is_what_numpy_interpolates_by_arc_length(speed: float, offset: float) -> None:
    states = arc(speed=speed)
    controls = np.random.default_rng(0).normal(size=(len(states) - 1, 2))
    samples, first, direction, spacing, times = sampled(states, controls, offset)
    theta, sign = np.unwrap(states[:, 2]), math.copysign(1.0, speed)
    x, y = states[:, 0] + sign * offset * np.cos(theta), states[:, 1] + sign * offset * np.sin(theta)
    lengths = np.concatenate([[0.0], np.hypot(np.diff(x), np.diff(y)).cumsum()])
    even = np.linspace(0.0, lengths[-1], math.ceil(lengths[-1] / SPACING) + 1)
    assert (first.tolist(), direction.tolist()) == ([0, len(even)], [sign])
    assert spacing[0] == pytest.approx(even[1])
    for row, values in ((X, x), (Y, y), (THETA, theta), (TIME, times)):
        assert samples[row] == pytest.approx(np.interp(even, lengths, values))
    held = controls[np.minimum(np.searchsorted(times, samples[TIME], side="right") - 1, len(controls) - 1)]
    assert samples[[THROTTLE, STEERING]].T.tolist() == held.tolist()
    ahead = np.gradient(samples[[X, Y]], axis=1)
    assert samples[[AHEAD_X, AHEAD_Y]] == pytest.approx(ahead / np.hypot(*ahead))


def test_headings_count_on_over_half_a_turn() -> None:
    samples, *_ = sampled(arc())
    assert samples[THETA, 0] == pytest.approx(3.0)
    assert samples[THETA, -1] > math.pi
    assert np.abs(np.diff(samples[THETA])).max() < 0.1


def test_a_change_of_direction_begins_a_path_where_the_last_one_ends() -> None:
    forth = np.column_stack([0.05 * np.arange(11), np.zeros(11), np.zeros(11), np.full(11, 0.5)])
    back = forth[::-1] * [1.0, 1.0, 1.0, -1.0]
    samples, first, direction, _, times = sampled(np.vstack([forth, back[1:]]))
    assert direction.tolist() == [1, -1]
    assert samples[X, first[1] - 1] == samples[X, first[1]] == pytest.approx(0.5)
    assert samples[TIME, [0, first[1] - 1, first[1], -1]] == pytest.approx(times[[0, 10, 10, 20]])
    assert samples[AHEAD_X, first[1] + 1] == pytest.approx(-1.0)


def test_standing_states_belong_to_the_direction_before_them() -> None:
    speeds = np.array([0.0, 0.0, 0.4, 0.0, -0.4, 0.0])
    states = np.column_stack([np.cumsum(0.1 * speeds), np.zeros((6, 2)), speeds])
    _, _, direction, _, _ = sampled(states)
    assert direction.tolist() == [1, -1]


@pytest.mark.parametrize("count", [1, 4])
def test_a_vehicle_that_stands_has_one_sample_which_heads_where_it_does(count: int) -> None:
    samples, first, direction, spacing, times = sampled(np.tile([1.0, 2.0, 0.6, 0.0], (count, 1)))
    assert (first.tolist(), direction.tolist(), spacing.tolist()) == ([0, 1], [1], [0.0])
    assert samples[[X, Y, THETA, TIME], 0] == pytest.approx([1.0, 2.0, 0.6, times[-1]])
    assert samples[[AHEAD_X, AHEAD_Y], 0] == pytest.approx([math.cos(0.6), math.sin(0.6)])
    assert samples[[THROTTLE, STEERING], 0].tolist() == REST.tolist()
