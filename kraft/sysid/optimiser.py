"""Levenberg-Marquardt over linearisations that Python owns.

GTSAM's own optimisers hand every custom factor a copy of all values, which costs the square of the graph's size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from kraft.sysid.problem import Point, Problem
from kraft.sysid.rho_graph import RhoFactors, bounded_step
from ompl_ext.arrays import Floats

ENOUGH = 1e-9
"""Share of the cost by which a step must change it, else it has converged."""
EXPECTED = 1e-6
"""And the decrease that is then expected: a change of rho by a thousandth of its standard deviation."""
RELAXATIONS = 2
"""Of the states, before a step is refused."""
FIRST_DAMPING = 1e-4
LEAST_DAMPING = 1e-9
MOST_DAMPING = 1e10


Watch = Callable[[int, float], None]
"""Is told how many iterations were made, and the cost."""


class Linearised(Protocol):
    """One of the two forms of the graph."""

    problem: Problem

    def cost(self, point: Point) -> float:
        """What a point costs."""

    def linearise(self, point: Point) -> None:
        """Make the factors at a point."""

    def reduce(self, damping: float) -> RhoFactors:
        """Eliminate all but rho."""

    def moved(self, change: Floats) -> Point:
        """The best point whose rho has changed by `change`."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """Where the optimiser stopped."""

    point: Point
    cost: float
    converged: bool
    iterations: int
    factors: RhoFactors
    """at the point, undamped"""


def unwatched(_: int, __: float) -> None:
    """For those who do not want to be told."""


def optimise(graph: Linearised, start: Point, most: int, watch: Watch = unwatched) -> Optimum:
    """Minimise the cost within the parameters' bounds, in at most `most` iterations; `watch` is told after each."""
    problem = graph.problem
    low, high, free = problem.parameters.low, problem.parameters.high, problem.parameters.free
    point, cost = start, graph.cost(start)
    damping, converged, iterations = FIRST_DAMPING, False, 0
    graph.linearise(point)
    while iterations < most and not converged and damping < MOST_DAMPING:
        factors = graph.reduce(damping)
        change = bounded_step(factors, damping, low - point.rho, high - point.rho, free)
        candidate = graph.moved(change)
        candidate, lower = _relaxed(graph, candidate, cost)
        iterations += 1
        converged = abs(cost - lower) < ENOUGH * cost and factors.decrease(change) < EXPECTED
        if lower <= cost:
            point, cost, damping = candidate, lower, max(0.1 * damping, LEAST_DAMPING)
        else:
            damping *= 10.0
        watch(iterations, cost)
        graph.linearise(point)
    return Optimum(point, cost, converged, iterations, graph.reduce(0.0))


def _relaxed(graph: Linearised, candidate: Point, cost: float) -> tuple[Point, float]:
    """A candidate and its cost; one that costs too much after states and controls followed where the model bends."""
    lower = graph.cost(candidate)
    for _ in range(RELAXATIONS):
        if lower <= cost or not np.isfinite(lower):
            break
        graph.linearise(candidate)
        graph.reduce(0.0)
        candidate = graph.moved(np.zeros_like(candidate.rho))
        lower = graph.cost(candidate)
    return candidate, lower if np.isfinite(lower) else np.inf
