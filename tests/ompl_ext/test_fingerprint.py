"""Text of what a compiled function depends on: it differs whenever the machine code may."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ompl_ext.fingerprint import fingerprint

TABLE = (0.1, [np.array([0.1234567891, 2.0]), {"a": np.arange(2000.0)}])


def made(constant: object) -> Callable[..., object]:
    def function(x: float) -> object:
        return x, constant

    return function


def by_position(default: float) -> Callable[..., float]:
    def function(x: float, k: float = default) -> float:
        return k * x

    return function


def by_name(default: float) -> Callable[..., float]:
    def function(x: float, *, k: float = default) -> float:
        return k * x

    return function


@pytest.mark.parametrize("make", [made, by_position, by_name])
def test_values_count_wherever_a_function_has_them(make: Callable[[object], Callable[..., object]]) -> None:
    assert fingerprint(make(1.0)) == fingerprint(make(1.0))
    assert fingerprint(make(1.0)) != fingerprint(make(5.0))


def test_arrays_count_to_the_last_bit_also_within_other_values() -> None:
    other = (0.1, [np.array([0.1234567899, 2.0]), {"a": np.arange(2000.0)}])
    middle = (0.1, [TABLE[1][0], {"a": np.where(np.arange(2000) == 1000, 0.0, np.arange(2000.0))}])
    texts = {fingerprint(made(value)) for value in (TABLE, other, middle)}
    assert repr(TABLE) == repr(other)
    assert len(texts) == 3
