"""Half-planes of free space at points, by the clearance field: obstacles as linear constraints on points near them."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

from numba import types

from ompl_ext.arrays import Cube, Floats, Matrix, Matrix32
from ompl_ext.jit import compiled
from ompl_ext.kernels.costtogo import value_anywhere
from ompl_ext.kernels.kernel_types import GRID_INVERSE

FLAT = 1e-6  # least slope of the field, where no direction leads away from obstacles


def _half_planes(
    field: Matrix32, scalar: Floats, x: Matrix, y: Matrix, required: Floats, farthest: float, planes: Cube
) -> None:
    cell = 1.0 / scalar[GRID_INVERSE]
    for i in range(x.shape[0]):
        for k in range(x.shape[1]):
            px, py = x[i, k], y[i, k]
            right, left = value_anywhere(field, scalar, px + cell, py), value_anywhere(field, scalar, px - cell, py)
            above, below = value_anywhere(field, scalar, px, py + cell), value_anywhere(field, scalar, px, py - cell)
            dx, dy = (right - left) / (2.0 * cell), (above - below) / (2.0 * cell)
            slope = max(math.hypot(dx, dy), FLAT)
            nx, ny = dx / slope, dy / slope
            slack = min(value_anywhere(field, scalar, px, py), farthest) - required[k]
            planes[i, k, 0], planes[i, k, 1], planes[i, k, 2] = nx, ny, nx * px + ny * py - slack


@cache
def half_planes() -> Callable[[Matrix32, Floats, Matrix, Matrix, Floats, float, Cube], None]:
    """Function that writes the half-plane of each point (x, y), both (n, m), into `planes` (n, m, 3).

    That is its normal, which leads away from obstacles, and the least distance along it: a point there keeps
    `required` (m,) m to the obstacles.  Beyond `farthest` m these are not looked for.  The function reads the clearance
    field and the numbers of a `Problem`; it is compiled, or loaded, on the first call.
    """
    matrix, floats, number = types.float64[:, ::1], types.float64[::1], types.float64
    arrays = types.float32[:, ::1], floats, matrix, matrix, floats
    return compiled(_half_planes, signature=types.void(*arrays, number, types.float64[:, :, ::1]))
