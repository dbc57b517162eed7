"""Levenberg-Marquardt over linearisations that Python owns.

GTSAM's own optimisers hand every custom factor a copy of all values, which costs the square of the graph's size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np

from kraft.errors import NegativeResult
from kraft.sysid.problem import Point, Problem
from ompl_ext.arrays import Bools, Floats, Matrix

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


RHO = gtsam.symbol("r", 0)


@dataclass(frozen=True, eq=False)
class RhoFactors:
    """Quadratic costs 0.5 d^T A d + b^T d of a change d of rho."""

    information: Floats
    """(logs, np, np) of each log"""
    gradient: Matrix
    """(logs, np)"""
    prior_information: Floats
    """(np,) diagonal"""
    prior_gradient: Floats
    """(np,)"""

    @property
    def total_information(self) -> Matrix:
        """(np, np)"""
        total: Matrix = np.sum(self.information, axis=0) + np.diag(self.prior_information)
        return total

    @property
    def total_gradient(self) -> Floats:
        """(np,)"""
        total: Floats = np.sum(self.gradient, axis=0) + self.prior_gradient
        return total

    def decrease(self, change: Floats) -> float:
        """How much lower the cost is after a change of rho, states and controls following it."""
        return float(-(self.total_gradient + 0.5 * self.total_information @ change) @ change)


def held_at_bounds(factors: RhoFactors, low: Floats, high: Floats) -> Bools:
    """(np,) whether a component is at a bound and downhill leads out; changes may be from `low` to `high` (np,)."""
    gradient = factors.total_gradient
    held: Bools = ((low >= 0.0) & (gradient > 0.0)) | ((high <= 0.0) & (gradient < 0.0))
    return held


def bounded_step(factors: RhoFactors, damping: float, low: Floats, high: Floats, free: Bools) -> Floats:
    """The best change (np,) of rho with low <= change <= high and 0 where not free.

    Components that the unbounded step would carry out of their bounds are held there, and the others follow.
    """
    change, free = np.zeros(len(free)), free & ~held_at_bounds(factors, low, high)
    while free.any():
        change[free] = _solve(factors, damping, free, change)
        outside = free & ((change < low) | (change > high))
        if not outside.any():
            break
        change = np.where(outside, np.clip(change, low, high), change)
        free &= ~outside
    return change


def _solve(factors: RhoFactors, damping: float, free: Bools, fixed: Floats) -> Floats:
    """Change of the free components, the others changing by `fixed`: GTSAM solves the graph on rho.

    Raises:
        NegativeResult: if the information of the free components is singular.
    """
    shift = np.where(free, 0.0, fixed)
    graph = gtsam.GaussianFactorGraph()
    for information, gradient in zip(factors.information, factors.gradient, strict=True):
        slope = gradient + information @ shift
        graph.add(gtsam.HessianFactor(RHO, information[np.ix_(free, free)], -slope[free], 0.0))
    prior = factors.prior_information + damping * np.diag(factors.total_information)
    graph.add(gtsam.HessianFactor(RHO, np.diag(prior[free]), -factors.prior_gradient[free], 0.0))
    try:
        solution: Floats = graph.optimize().at(RHO)
    except RuntimeError:  # GTSAM's IndeterminantLinearSystemException
        raise NegativeResult(
            "the logs do not determine the parameters: the linear system of the optimiser is singular; "
            "check the units and scales of the commands"
        ) from None
    return solution
