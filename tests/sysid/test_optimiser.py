"""The optimiser: what ends it, and parameters that the logs do not determine."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kraft.errors import NegativeResult
from kraft.sysid.optimiser import RhoFactors, bounded_step, optimise
from kraft.sysid.problem import Point


def test_a_singular_system_is_a_negative_result() -> None:
    nothing = RhoFactors(np.zeros((1, 2, 2)), np.zeros((1, 2)), np.zeros(2), np.zeros(2))
    wide = np.ones(2)
    with pytest.raises(NegativeResult):
        bounded_step(nothing, 1.0, -wide, wide, np.ones(2, dtype=bool))


class SlowStates:
    """A graph whose parameter is found at once, and whose states go on, as long as steps are damped enough."""

    point: Point
    problem: Any = SimpleNamespace(
        parameters=SimpleNamespace(low=np.array([-1.0]), high=np.array([1.0]), free=np.array([True]))
    )

    def cost(self, point: Point) -> float:
        return 1000.0 + float(point.states[0, 0])

    def linearise(self, point: Point) -> float:
        self.point = point
        return self.cost(point)

    def reduce(self, damping: float) -> RhoFactors:
        self.damping = damping
        return RhoFactors(np.ones((1, 1, 1)), np.full((1, 1), 1e-6), np.zeros(1), np.zeros(1))

    def moved(self, change: np.ndarray[Any, np.dtype[np.float64]]) -> Point:
        states = 0.9 * self.point.states if self.damping > 5e-6 else self.point.states + 10.0
        return Point(states, self.point.controls, self.point.rho + change)


def test_steps_that_are_refused_do_not_hide_that_the_parameters_have_converged() -> None:
    found = optimise(SlowStates(), Point(np.full((1, 1), 0.5), np.zeros((1, 1)), np.zeros(1)), 40)
    assert found.converged
    assert found.cost > 1000.01
