"""Uncertainty of the parameters: under the stated noise (graph), or from differences between logs (sandwich).

The covariance of the graph is the inverse of the information on rho.  It is correct if noise and process noise are as
stated and the model is true.  The sandwich covariance needs neither: it follows from the change that leaving out each
log would cause.  With A the information of all logs and A_l, b_l that of log l and its gradient at the optimum, leaving
log l out moves rho by (A - A_l)^-1 b_l; the spread of these moves is the covariance (the jackknife, known as CR3 for
clusters), and a t quantile with one degree of freedom less than there are logs makes the interval.

A parameter that is held at its bound remains there whichever log is left out, so that the others change with it held.
Its own changes are those with the bound as a constant force: a spread of 0 would mean that it is known exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import norm, t

from kraft.sysid.optimiser import RhoFactors
from ompl_ext.arrays import Bools, Floats, Matrix

SANDWICH_LOGS_MIN = 5
"""Least number of logs for the sandwich covariance."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
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


def estimate_uncertainty(factors: RhoFactors, free: Bools, held: Bools) -> Uncertainty:
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
        return Uncertainty("graph", graph, graph, float(norm.ppf(0.975)), np.zeros((logs, len(total))), held[free])
    shifts = np.array(
        [
            _shift(total - information[chosen], gradient[free], held[free])
            for information, gradient in zip(factors.information, factors.gradient, strict=True)
        ]
    )
    if logs < SANDWICH_LOGS_MIN:
        return Uncertainty("graph", graph, graph, float(norm.ppf(0.975)), shifts, held[free])
    centred = shifts - shifts.mean(axis=0)
    sandwich = (logs - 1) / logs * centred.T @ centred
    return Uncertainty("sandwich", graph, sandwich, float(t.ppf(0.975, logs - 1)), shifts, held[free])


def _shift(rest: Matrix, gradient: Floats, held: Bools) -> Floats:
    """Change (free,) of the free parameters if a log is left out; `rest` is the information of the other logs."""
    move = np.array(np.linalg.lstsq(rest, gradient, rcond=None)[0], dtype=np.float64)
    if held.any():
        move[~held] = np.linalg.lstsq(rest[np.ix_(~held, ~held)], gradient[~held], rcond=None)[0]
    return move


def inverse(information: Matrix) -> Matrix:
    """Inverse of a positive definite matrix whose components may differ by many orders of magnitude."""
    scale = 1.0 / np.sqrt(np.diag(information))
    inverse: Matrix = scale[:, None] * np.linalg.inv(scale[:, None] * information * scale[None, :]) * scale[None, :]
    return inverse
