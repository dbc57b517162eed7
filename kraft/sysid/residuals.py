"""How large the residuals of poses are, beside what the noise lets expect."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from kraft.sysid.problem import Point, Problem


def residual_ratio(problem: Problem, point: Point) -> float:
    """Squared residual of a typical pose in what the noise lets expect, 1 if everything is as stated.

    The median, so that outliers do not count; the states take up some of the noise, one per degree of freedom.
    """
    squares = problem.noise.distance(problem.pose_residuals(point)) ** 2
    shown = 3.0 if problem.observation.turns else 2.0
    taken = problem.dynamics.nx * len(problem.chains.log) / (shown * len(squares))
    return float(np.median(squares) / (chi2.median(shown) * max(1.0 - taken, 0.1)))
