"""Nearest points of a path."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

from numba import types

from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.jit import compiled


def _nearest_points(points: Matrix, path: Matrix, nearest: Ints, away: Floats) -> None:
    for i in range(len(points)):
        least, nearest[i], away[i] = math.inf, 0, math.inf
        for j in range(len(path)):
            dx, dy = points[i, 0] - path[j, 0], points[i, 1] - path[j, 1]
            squared = dx * dx + dy * dy
            if squared < least and math.sqrt(squared) < away[i]:  # of points that round to one distance, the first
                least, nearest[i], away[i] = squared, j, math.sqrt(squared)


@cache
def nearest_points() -> Callable[[Matrix, Matrix, Ints, Floats], None]:
    """Function that writes the nearest point of a path (m, 2) to each of some points (n, 2).

    That is its number (n,) and the distance (n,), m.  The function is compiled, or loaded, on the first call.
    """
    floats, matrix = types.float64[::1], types.float64[:, ::1]
    return compiled(_nearest_points, signature=types.void(matrix, matrix, types.int64[::1], floats))
