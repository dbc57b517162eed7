"""Ways of plans: whether two plans go the same way, which is near each other and past obstacles on the same side."""

from __future__ import annotations

import numpy as np

from ompl_ext.arrays import Matrix
from ompl_ext.kernels.nearest_points import nearest_points
from ompl_ext.plan import Plan
from ompl_ext.solver import DirtSolver

HORIZON = 5.0
"""Time over which ways are compared, s: about 3 m at the speed of a MuSHR, the next one or two obstacles.

What lies farther ahead is planned again several times before the vehicle gets there, and is no reason to keep to a way.
"""
WIDTH = 0.5
"""Distance at which one plan leaves the way of another, m.

It is for open floor, as an obstacle between two plans separates them at any distance: nearly twice the width of a
MuSHR, more than plans sway by chance.
"""
STEP = 0.02
"""Distance between the places on a way that are compared, where its samples are closer, m."""


def goes_same_way(dirt: DirtSolver, plan: Plan, other: Plan) -> bool:
    """Whether two plans stay near each other in the next seconds and pass every obstacle on the same side."""
    if plan is other or np.array_equal(plan.trajectory, other.trajectory):
        return True
    (one, one_soon), (two, two_soon) = (_places(dirt, each) for each in (plan, other))
    return _follows(dirt, one_soon, two) and _follows(dirt, two_soon, one)


def _places(dirt: DirtSolver, plan: Plan) -> tuple[Matrix, Matrix]:
    """Places (n, 2) on the way of a plan, and those (m, 2) of the next seconds; the start is one of both."""
    positions = plan.trajectory[:, [dirt.vehicle.index("x"), dirt.vehicle.index("y")]]
    steps = np.hypot(*np.diff(positions, axis=0).T).cumsum() // STEP
    apart = np.concatenate([[True], np.diff(steps, prepend=0.0) > 0.0])
    soon = apart & (plan.times <= HORIZON)
    return np.ascontiguousarray(positions[apart]), np.ascontiguousarray(positions[soon])


def _follows(dirt: DirtSolver, points: Matrix, path: Matrix) -> bool:
    """Whether points (n, 2) are near a path (m, 2), with no obstacle between each of them and its nearest point."""
    nearest, away = np.empty(len(points), np.int64), np.empty(len(points))
    nearest_points()(points, path, nearest, away)
    if away.max() > WIDTH:
        return False
    shares = np.linspace(0.0, 1.0, 12)[:, None, None]
    between = points + shares * (path[nearest] - points)
    return not dirt.is_occupied(between.reshape(-1, 2)).any()
