"""Obstacles as plain geometry: metres and radians, x forward, y left.

The planner uses the outline alone; ``height`` is for the simulated world and for pictures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ompl_ext.obstacles import OccupancyGrid

Vec2: TypeAlias = tuple[float, float]


@dataclass(frozen=True)
class Box:
    """Rectangle of full ``size`` (length, width) in m, turned by ``yaw`` rad about its ``center``."""

    center: Vec2
    size: Vec2
    yaw: float = 0.0
    height: float = 0.2
    name: str | None = None

    @property
    def corners(self) -> tuple[Vec2, Vec2, Vec2, Vec2]:
        """Four corners, counter-clockwise."""
        (x, y), (length, width) = self.center, self.size
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        a, b = length / 2, width / 2
        q0, q1, q2, q3 = ((x + c * u - s * v, y + s * u + c * v) for u, v in ((a, b), (-a, b), (-a, -b), (a, -b)))
        return q0, q1, q2, q3


@dataclass(frozen=True)
class Circle:
    """Disc."""

    center: Vec2
    radius: float
    height: float = 0.2
    name: str | None = None


@dataclass(frozen=True)
class Polygon:
    """Simple polygon, convex or not; ``vertices`` run counter-clockwise and do not repeat the first."""

    vertices: tuple[Vec2, ...]
    height: float = 0.2
    name: str | None = None


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """Grid of square cells.

    Attributes:
        occupied: read-only bool array [ny, nx]; row 0 lies at the origin, x grows with the column.
            Unknown cells are occupied.
        resolution: side of a cell, m.
        origin: pose (x, y, yaw) of the outer corner of cell [0, 0], m and rad.
    """

    occupied: NDArray[np.bool_]
    resolution: float
    origin: tuple[float, float, float]
    height: float = 0.2
    name: str | None = None

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, OccupancyMap):
            return NotImplemented
        mine = (self.resolution, self.origin, self.height, self.name)
        theirs = (other.resolution, other.origin, other.height, other.name)
        return mine == theirs and np.array_equal(self.occupied, other.occupied)

    def __hash__(self) -> int:
        return hash((self.occupied.tobytes(), self.occupied.shape, self.resolution, self.origin))

    @property
    def grid(self) -> OccupancyGrid:
        """Grid for the planner."""
        return OccupancyGrid(self.occupied, self.resolution, self.origin)

    def boxes(self) -> tuple[Box, ...]:
        """Few disjoint rectangles that cover exactly the occupied cells."""
        return tuple(self._box(*cells) for cells in self.grid.rectangles())

    def _box(self, row: int, column: int, rows: int, columns: int) -> Box:
        x0, y0, yaw = self.origin
        u, v = (column + columns / 2) * self.resolution, (row + rows / 2) * self.resolution
        c, s = math.cos(yaw), math.sin(yaw)
        size = (columns * self.resolution, rows * self.resolution)
        return Box((x0 + c * u - s * v, y0 + s * u + c * v), size, yaw, self.height, self.name)


Obstacle: TypeAlias = Box | Circle | Polygon | OccupancyMap


def signed_area(vertices: NDArray[np.float64]) -> float:
    """Area of a polygon [n, 2] in m^2, positive when it runs counter-clockwise."""
    local = vertices - vertices[0]  # far from the origin of the world the products would lose digits
    x, y = local[:, 0], local[:, 1]
    return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def crossing_edges(vertices: NDArray[np.float64]) -> tuple[int, int] | None:
    """Two edges of a polygon [n, 2] that intersect, or None if it is simple.

    Edge i runs from vertex i to i + 1. Neighbours share one point; if they share more (fold back), they intersect.
    """
    n = len(vertices)
    a, b = vertices, np.roll(vertices, -1, axis=0)
    for i in range(n):
        following = (i + 1) % n
        along, onward = b[i] - a[i], b[following] - a[following]
        if along[0] * onward[1] == along[1] * onward[0] and along @ onward < 0:
            return i, following
        others = np.arange(i + 2, n - (i == 0))
        hit = _meet(a[i], b[i], a[others], b[others])
        if hit.any():
            return i, int(others[np.argmax(hit)])
    return None


def _meet(
    p: NDArray[np.float64], q: NDArray[np.float64], r: NDArray[np.float64], s: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether the segment pq intersects each segment rs [m, 2]; touching counts."""

    def side(o: NDArray[np.float64], d: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = d - o, t - o
        return np.sign(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    straddle = (side(p, q, r) * side(p, q, s) <= 0) & (side(r, s, p) * side(r, s, q) <= 0)
    overlap = (np.minimum(p, q) <= np.maximum(r, s)) & (np.minimum(r, s) <= np.maximum(p, q))
    return np.asarray(straddle & overlap.all(axis=-1), dtype=np.bool_)
