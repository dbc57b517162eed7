"""Levenberg-Marquardt optimisation of a factor graph, and the uncertainty of the parameters at the optimum.

The loop is in Python: the optimisers of GTSAM pass a copy of all values to every custom factor, which takes quadratic
time in the size of the graph.

The uncertainty is that under the stated noise (graph), or follows from differences between logs (sandwich).  The
covariance of the graph is the inverse of the information on rho.  It is correct if noise and process noise are as
stated and the model is true.  The sandwich covariance needs neither: it follows from the change that leaving out each
log would cause.  With A the information of all logs and A_l, b_l that of log l and its gradient at the optimum, leaving
log l out moves rho by (A - A_l)^-1 b_l; the spread of these moves is the covariance (the jackknife, known as CR3 for
clusters), and a t quantile with one degree of freedom less than there are logs makes the interval.

A parameter that is held at its bound remains there whichever log is left out, so that the others change with it held.
Its own changes are those with the bound as a constant force: a spread of 0 would mean that it is known exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Protocol

import gtsam
import numpy as np
from scipy.special import ndtri, stdtrit

from kraft.errors import NegativeResult
from kraft.sysid.fit_progress import OnStep, ignore_step
from kraft.sysid.problem import Point, Problem
from ompl_ext.arrays import Bools, Floats, Matrix

RHO = gtsam.symbol("r", 0)
COST_TOLERANCE = 1e-9
"""Relative change of the cost below which the optimiser has converged ..."""
DECREASE_TOLERANCE = 1e-6
"""... if the expected decrease is below this: a change of rho by a thousandth of its standard deviation."""
SETTLED = 6
"""Number of iterations in a row with as small an expected decrease, apart from refused steps, after which rho has
converged: fewer in a row also happen before a step gets past a limit of the model ..."""
SETTLED_TOLERANCE = 1e-4
"""... if the relative changes of the cost are below this: only states still change."""
SHARES = (0.5, 0.25, 0.125, 0.0625)
"""Shares of a step that are tried before it is refused: its direction descends, but models with limited rates curve."""
RELAXATIONS = 2
"""Relaxations of states and controls before a step is refused."""
DAMPING_INITIAL = 1e-4
DAMPING_MIN = 1e-9
DAMPING_MAX = 1e10
"""Damping of the first step, the least one, and the one from which on no step is tried any more.

The first step is nearly that of Gauss-Newton, as starting values are good; each step that lowers the cost is followed
by a tenth of the damping, each other one by ten times as much, which is fourteen refusals in a row up to the largest.
"""
RIDGE = 1e-6
"""Share by which the information of each parameter is raised in the choice of terms, so that it is never singular:
drives that only go forward do not tell a dead zone from friction, and predictions do not depend on which it is."""


class LinearisedGraph(Protocol):
    """Interface of the two forms of the factor graph."""

    problem: Problem
    point: Point
    """of the last linearisation"""

    def cost(self, point: Point) -> float:
        """Cost of a point."""

    def linearise(self, point: Point) -> float:
        """Linearise all factors at a point; returns its cost."""

    def reduce(self, damping: float) -> RhoFactors:
        """Eliminate all but rho."""

    def moved(self, change: Floats) -> Point:
        """The point that minimises the linearised problem among those whose rho changes by `change`."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """Last point of the optimiser."""

    point: Point
    cost: float
    converged: bool
    iterations: int
    factors: RhoFactors
    """at the point, undamped"""


def optimise(graph: LinearisedGraph, start: Point, most: int, on_step: OnStep = ignore_step) -> Optimum:
    """Minimise the cost within the bounds of the parameters, in at most `most` iterations."""
    problem = graph.problem
    low, high, free = problem.parameters.low, problem.parameters.high, problem.parameters.free
    point, cost = start, graph.linearise(start)
    damping, converged, iterations, settled = DAMPING_INITIAL, False, 0, 0
    while iterations < most and not converged and damping < DAMPING_MAX:
        factors = graph.reduce(damping)
        change = bounded_step(factors, damping, low - point.rho, high - point.rho, free)
        candidate = graph.moved(change)
        full = candidate
        candidate, lower = _relaxed(graph, candidate, cost)
        if lower > cost:
            candidate, lower = _shortened(graph, point, full, cost)
        iterations += 1
        still, changed = factors.decrease(change) < DECREASE_TOLERANCE, abs(cost - lower)
        if lower <= cost or not still:  # a step that is refused tells nothing about the next one
            settled = settled + 1 if still and changed < SETTLED_TOLERANCE * cost else 0
        converged = (still and changed < COST_TOLERANCE * cost) or settled >= SETTLED
        if lower <= cost:
            point, cost, damping = candidate, lower, max(0.1 * damping, DAMPING_MIN)
        else:
            damping *= 10.0
        if point is not graph.point:
            graph.linearise(point)
        on_step(iterations, cost)
    return Optimum(point, cost, converged, iterations, graph.reduce(0.0))


def _relaxed(graph: LinearisedGraph, candidate: Point, cost: float) -> tuple[Point, float]:
    """A candidate and its cost; if the cost is too high, after states and controls are relaxed with rho fixed.

    Nearly all candidates are accepted, so they are linearised at once; the residuals give the cost as well.
    """
    lower = graph.linearise(candidate)
    for _ in range(RELAXATIONS):
        if lower <= cost or not np.isfinite(lower):
            break
        graph.reduce(0.0)
        candidate = graph.moved(np.zeros_like(candidate.rho))
        lower = graph.linearise(candidate)
    return candidate, lower if np.isfinite(lower) else np.inf


def _shortened(graph: LinearisedGraph, point: Point, full: Point, cost: float) -> tuple[Point, float]:
    """Candidate on the way from `point` to `full` with a lower cost, and that cost; infinite if none is found."""
    for share in SHARES:
        parts = zip((point.states, point.controls, point.rho), (full.states, full.controls, full.rho), strict=True)
        candidate = Point(*((1.0 - share) * before + share * after for before, after in parts))
        lower = graph.cost(candidate)
        if lower < cost:
            return candidate, lower
    return point, math.inf


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
    window_gradient: Matrix | None = None
    """(windows, np) that the gradients of the logs consist of, if logs are cut into windows"""

    @classmethod
    def with_priors(cls, information: Floats, gradient: Matrix, problem: Problem, rho: Floats) -> RhoFactors:
        """Costs of the logs, and those of the priors of a problem at rho (np,); frozen parameters have none."""
        inverse = problem.parameters.inverse_std
        return cls(information, gradient, inverse**2, inverse * problem.prior_residuals(rho))

    @cached_property
    def total_information(self) -> Matrix:
        """(np, np)"""
        total: Matrix = self.information.sum(axis=0) + np.diag(self.prior_information)
        return total

    @cached_property
    def total_gradient(self) -> Floats:
        """(np,)"""
        total: Floats = self.gradient.sum(axis=0) + self.prior_gradient
        return total

    @cached_property
    def led_by_prior(self) -> Bools:
        """(np,) whether the prior tells more of a component than the logs do."""
        led: Bools = np.einsum("lkk->k", self.information) < self.prior_information
        return led

    def decrease(self, change: Floats) -> float:
        """Expected decrease of the cost by a change of rho with optimal states and controls."""
        return float(-(self.total_gradient + 0.5 * self.total_information @ change) @ change)


def held_at_bounds(factors: RhoFactors, low: Floats, high: Floats) -> Bools:
    """(np,) whether a component is at a bound and the descent direction leaves it; changes are in [`low`, `high`]."""
    gradient = factors.total_gradient
    held: Bools = ((low >= 0.0) & (gradient > 0.0)) | ((high <= 0.0) & (gradient < 0.0))
    return held


def bounded_step(factors: RhoFactors, damping: float, low: Floats, high: Floats, free: Bools) -> Floats:
    """The best change (np,) of rho with low <= change <= high and 0 where not free.

    Components that the unbounded step would move out of their bounds are held there; the others are solved again.
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


def step_with(factors: RhoFactors, low: Floats, high: Floats, free: Bools, chosen: Bools) -> Floats:
    """Change of rho that moves the chosen components by `low` and the other free ones to their best."""
    shift = np.where(chosen, low, 0.0)
    moved = RhoFactors(
        factors.information,
        factors.gradient + factors.information @ shift,
        factors.prior_information,
        factors.prior_gradient + factors.prior_information * shift,
    )
    step: Floats = bounded_step(moved, RIDGE, low, high, free & ~chosen) + shift
    return step


def without_fold(factors: RhoFactors, fold: int) -> RhoFactors:
    """Costs of all logs, or folds, but one."""
    keep = np.arange(len(factors.information)) != fold
    return replace(factors, information=factors.information[keep], gradient=factors.gradient[keep])


def _solve(factors: RhoFactors, damping: float, free: Bools, fixed: Floats) -> Floats:
    """Change of the free components, the others changing by `fixed`: GTSAM solves the graph on rho.

    Raises:
        NegativeResult: if the information of the free components is singular.
    """
    total = factors.total_information
    slope = factors.total_gradient + total @ np.where(free, 0.0, fixed)
    damped, own = total[free][:, free], total.diagonal()[free]
    size = own + damping * own
    np.fill_diagonal(damped, size)
    scale = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))  # units of the parameters differ by orders of magnitude
    graph = gtsam.GaussianFactorGraph()
    graph.add(gtsam.HessianFactor(RHO, scale[:, None] * damped * scale, -scale * slope[free], 0.0))
    try:
        solution: Floats = scale * graph.optimize().at(RHO)
    except RuntimeError:  # GTSAM's IndeterminantLinearSystemException
        raise NegativeResult(
            "the logs do not determine the parameters: the linear system of the optimiser is singular; "
            "check the units and scales of the commands"
        ) from None
    return solution


SANDWICH_LOGS_MIN = 5
"""Least number of logs for the sandwich covariance."""


@dataclass(frozen=True, eq=False)
class ParameterUncertainty:
    """Covariances of the free parameters."""

    kind: Literal["graph", "sandwich"]
    graph: Matrix
    covariance: Matrix
    """of the kind"""
    quantile: float
    """half width of a 95 % interval in standard deviations"""
    shifts: Matrix
    """(logs, free) change of rho without each log"""
    held: Bools
    """(free,) which parameters are held at their bounds"""

    @property
    def std(self) -> Floats:
        """(free,)"""
        std: Floats = np.sqrt(np.diag(self.covariance))
        return std


def estimate_uncertainty(factors: RhoFactors, free: Bools, held: Bools) -> ParameterUncertainty:
    """The sandwich covariance from five logs up, the graph's below.

    Args:
        factors: at the optimum.
        free: (np,) which parameters were estimated.
        held: (np,) which of them are held at their bounds.
    """
    chosen = np.ix_(free, free)
    total = factors.total_information[chosen]
    graph = inverse(total)
    logs = len(factors.information)
    if logs < 2:
        return ParameterUncertainty(
            "graph", graph, graph, float(ndtri(0.975)), np.zeros((logs, len(total))), held[free]
        )
    shifts = np.array(
        [
            _shift(total - information[chosen], gradient[free], held[free])
            for information, gradient in zip(factors.information, factors.gradient, strict=True)
        ]
    )
    if logs < SANDWICH_LOGS_MIN:
        return ParameterUncertainty("graph", graph, graph, float(ndtri(0.975)), shifts, held[free])
    centred = shifts - shifts.mean(axis=0)
    sandwich = (logs - 1) / logs * centred.T @ centred
    return ParameterUncertainty("sandwich", graph, sandwich, float(stdtrit(logs - 1, 0.975)), shifts, held[free])


def _shift(rest: Matrix, gradient: Floats, held: Bools) -> Floats:
    """Change (free,) of the free parameters if a log is left out; `rest` is the information of the other logs."""
    move = np.array(np.linalg.lstsq(rest, gradient, rcond=None)[0], dtype=np.float64)
    if held.any():
        move[~held] = np.linalg.lstsq(rest[np.ix_(~held, ~held)], gradient[~held], rcond=None)[0]
    return move


def inverse(information: Floats) -> Floats:
    """Inverses of positive definite matrices (..., k, k) whose components may differ by many orders of magnitude."""
    size = 1.0 / np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
    both = size[..., :, None] * size[..., None, :]
    inverse: Floats = both * np.linalg.inv(both * information)
    return inverse
