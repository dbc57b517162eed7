"""Half-planes of free space lead away from obstacles and keep the required distance to them."""

from __future__ import annotations

import numpy as np
import pytest

from ompl_ext.kernels.half_planes import half_planes
from ompl_ext.kernels.kernel_types import GRID_INVERSE, GRID_X, GRID_Y, SCALARS

CELL, FAR = 0.1, 3.0


def planes_beside_a_wall(x: float, required: float) -> tuple[float, float, float]:
    """Half-plane of a point at `x` m from a wall along the y axis."""
    scalar = np.zeros(SCALARS)
    scalar[[GRID_X, GRID_Y, GRID_INVERSE]] = 0.0, -1.0, 1.0 / CELL
    field = np.tile((np.arange(60) + 0.5) * CELL, (20, 1)).astype(np.float32)
    planes = np.empty((1, 1, 3))
    half_planes()(field, scalar, np.array([[x]]), np.zeros((1, 1)), np.array([required]), FAR, planes)
    nx, ny, least = planes[0, 0].tolist()
    return nx, ny, least


@pytest.mark.parametrize("x", [0.32, 1.0, 2.9])
def test_a_point_beside_a_wall_keeps_the_required_distance(x: float) -> None:
    assert planes_beside_a_wall(x, 0.25) == pytest.approx((1.0, 0.0, 0.25), abs=1e-5)


def test_obstacles_that_are_far_away_are_not_looked_for() -> None:
    nx, _, least = planes_beside_a_wall(5.0, 0.25)
    assert nx * 5.0 - least == pytest.approx(FAR - 0.25, abs=1e-5)
