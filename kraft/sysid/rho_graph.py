"""The factor graph that is left when states and controls are eliminated: one factor per log and the priors, on rho."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from ompl_ext.arrays import Bools, Floats, Matrix

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
    """Change of the free components, the others changing by `fixed`: GTSAM solves the graph on rho."""
    shift = np.where(free, 0.0, fixed)
    graph = gtsam.GaussianFactorGraph()
    for information, gradient in zip(factors.information, factors.gradient, strict=True):
        slope = gradient + information @ shift
        graph.add(gtsam.HessianFactor(RHO, information[np.ix_(free, free)], -slope[free], 0.0))
    prior = factors.prior_information + damping * np.diag(factors.total_information)
    graph.add(gtsam.HessianFactor(RHO, np.diag(prior[free]), -factors.prior_gradient[free], 0.0))
    solution: Floats = graph.optimize().at(RHO)
    return solution
