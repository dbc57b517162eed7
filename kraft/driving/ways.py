"""Comparison of the ways that two plans go."""

from __future__ import annotations

import numpy as np

from ompl_ext.arrays import Matrix
from ompl_ext.plan import Plan
from ompl_ext.solver import DirtSolver

WAY_HORIZON = 5.0  # time over which ways are compared (s)
WAY_WIDTH = 0.5  # distance at which one plan leaves the way of another (m)


def goes_same_way(dirt: DirtSolver, plan: Plan, other: Plan) -> bool:
    """Whether two plans stay near each other in the next seconds and pass every obstacle on the same side."""
    one, two = (_positions(dirt, each) for each in (plan, other))
    return _follows(dirt, one[plan.times <= WAY_HORIZON], two) and _follows(dirt, two[other.times <= WAY_HORIZON], one)


def _positions(dirt: DirtSolver, plan: Plan) -> Matrix:
    positions: Matrix = plan.trajectory[:, [dirt.vehicle.index("x"), dirt.vehicle.index("y")]]
    return positions


def _follows(dirt: DirtSolver, points: Matrix, path: Matrix) -> bool:
    """Whether points (n, 2) are near a path (m, 2), with no obstacle between each of them and its nearest point."""
    away = np.linalg.norm(points[:, None] - path[None], axis=2)
    nearest = away.argmin(axis=1)
    if away[np.arange(len(points)), nearest].max() > WAY_WIDTH:
        return False
    shares = np.linspace(0.0, 1.0, 12)[:, None, None]
    between = points + shares * (path[nearest] - points)
    return not dirt.is_occupied(between.reshape(-1, 2)).any()
