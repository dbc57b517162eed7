"""The polynomials behind the vehicles' derivatives keep the error bounds that their module states."""

from __future__ import annotations

import math
from collections.abc import Callable

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ompl_ext import trigonometry

angles = st.floats(-1000.0, 1000.0)


@numba.njit
def _apply(function, x, out):  # type: ignore[no-untyped-def]
    for i in range(len(x)):
        out[i] = function(x[i])


def over(function: Callable[[float], float], x: np.ndarray) -> np.ndarray:
    out = np.empty_like(x)
    _apply(function, x, out)
    return out


def around_multiples_of(step: float, most: int) -> np.ndarray:
    n = np.arange(-most, most + 1) * step
    return np.concatenate([np.nextafter(n, -np.inf), n, np.nextafter(n, np.inf), n + 1e-9, n - 1e-9])


DENSE = np.concatenate(
    [
        np.linspace(-1000.0, 1000.0, 400_003),
        np.linspace(-4.0, 4.0, 100_003),
        around_multiples_of(math.pi / 4, 1270),
        np.random.default_rng(1).uniform(-1000.0, 1000.0, 200_000),
    ]
)


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_sine_and_cosine_are_within_1e11_of_numpy_up_to_a_thousand_radians(name: str) -> None:
    x = DENSE[np.abs(DENSE) < 1000.0]
    error = np.abs(over(getattr(trigonometry, name), x) - getattr(np, name)(x))
    assert error.max() < 1e-11, f"{error.max():.2e} at {x[error.argmax()]!r}"


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_beyond_a_thousand_radians_the_error_grows_no_faster_than_the_argument(name: str) -> None:
    x = np.random.default_rng(2).choice([-1, 1], 100_000) * 10 ** np.random.default_rng(3).uniform(3, 9, 100_000)
    error = np.abs(over(getattr(trigonometry, name), x) - getattr(np, name)(x))
    assert (error / np.abs(x)).max() < 1e-14


def test_sine_and_cosine_never_leave_the_unit_interval_by_more_than_their_error() -> None:
    s, c = over(trigonometry.sin, DENSE), over(trigonometry.cos, DENSE)
    assert max(np.abs(s).max(), np.abs(c).max()) <= 1 + 1e-11
    assert np.abs(s * s + c * c - 1).max() < 2e-11


def test_tangent_agrees_with_numpy_away_from_its_poles() -> None:
    x = DENSE[np.abs(np.cos(DENSE)) > 1e-3]
    expected = np.tan(x)
    assert (np.abs(over(trigonometry.tan, x) - expected) / (1 + expected**2)).max() < 2e-11


def test_arc_tangent_is_within_1e9_of_numpy_everywhere() -> None:
    small, large = np.linspace(-3, 3, 200_001), 10 ** np.linspace(-300, 300, 100_001)
    corners = np.array([1.0, math.tan(math.pi / 8), 1 / math.tan(math.pi / 8), math.inf])
    beside = np.concatenate([np.nextafter(corners, 0), corners, np.nextafter(corners, np.inf)])
    x = np.concatenate([small, large, -large, beside, -beside])
    error = np.abs(over(trigonometry.atan, x) - np.arctan(x))
    assert error.max() < 1e-9, f"{error.max():.2e} at {x[error.argmax()]!r}"


def test_arc_tangent_never_reaches_beyond_half_pi() -> None:
    x = np.concatenate([10 ** np.linspace(0, 308, 10_001), [math.inf]])
    assert over(trigonometry.atan, x).max() <= math.pi / 2


@given(angles)
@settings(max_examples=200)
def test_sine_tangent_and_arc_tangent_are_odd_and_cosine_is_even_to_the_last_bit(x: float) -> None:
    assert trigonometry.sin(-x) == -trigonometry.sin(x)
    assert trigonometry.cos(-x) == trigonometry.cos(x)
    assert trigonometry.tan(-x) == -trigonometry.tan(x)
    assert trigonometry.atan(-x) == -trigonometry.atan(x)


def test_special_points_are_exact() -> None:
    assert trigonometry.sin(0.0) == 0.0
    assert trigonometry.cos(0.0) == 1.0
    assert trigonometry.tan(0.0) == 0.0
    assert trigonometry.atan(0.0) == 0.0
    assert trigonometry.sin(math.pi / 2) == 1.0
    assert trigonometry.cos(math.pi) == -1.0
    assert trigonometry.atan(math.inf) == math.pi / 2


@pytest.mark.parametrize("x", [math.nan, math.inf, -math.inf])
def test_what_is_no_angle_has_no_sine(x: float) -> None:
    assert math.isnan(trigonometry.sin(x))
    assert math.isnan(trigonometry.cos(x))


def test_arc_tangent_of_nan_is_nan() -> None:
    assert math.isnan(trigonometry.atan(math.nan))


@given(angles)
@settings(max_examples=200)
def test_the_source_run_by_python_gives_the_bits_of_the_compiled_function(x: float) -> None:
    for function in (trigonometry.sin, trigonometry.cos, trigonometry.atan):
        assert function.py_func(x) == function(x)
