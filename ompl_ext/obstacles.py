"""Static obstacles of a planar workspace."""

from __future__ import annotations

import math
import pickle
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ompl_ext.arrays import Bools, Floats, Matrix


@dataclass(frozen=True)
class Polygon:
    """Simple polygon, convex or not; `vertices` has shape (n, 2), m, in either orientation."""

    vertices: Matrix


@dataclass(frozen=True)
class Circle:
    """Disc of `radius` m around `center`, shape (2,)."""

    center: Floats
    radius: float


@dataclass(frozen=True)
class OccupancyGrid:
    """Occupied cells of a map: `occupied[row, column]` row 0 at the bottom; `origin` is x, y, yaw of cell (0, 0)."""

    occupied: Bools
    resolution: float
    origin: tuple[float, float, float]

    def rectangles(self) -> list[tuple[int, int, int, int]]:
        """Disjoint rectangles that cover exactly the occupied cells: (row, column, rows, columns) of each.

        A rectangle is a run of cells in a row, extended upwards while the next row has the same run.
        """
        if not self.occupied.size:
            return []
        change = np.diff(np.pad(self.occupied, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        (row, first), last = np.nonzero(change == 1), np.nonzero(change == -1)[1]
        order = np.lexsort((row, last, first))  # equal runs one after the other, upwards
        row, first, last = row[order], first[order], last[order]
        begins = np.ones(len(row), bool)
        begins[1:] = (np.diff(first) != 0) | (np.diff(last) != 0) | (np.diff(row) != 1)
        start = np.flatnonzero(begins)
        rows = np.diff(np.append(start, len(row)))
        row, first, last = row[start], first[start], last[start]
        order = np.lexsort((last, first, row, row + rows))  # as a sweep over the rows completes them
        found = np.column_stack([row, first, rows, last - first])[order]
        return [(a, b, c, d) for a, b, c, d in found.tolist()]

    def boxes(self) -> list[Polygon]:
        """Disjoint rectangles in the world that cover exactly the occupied cells."""
        x, y, yaw = self.origin
        turn = _rotation(yaw)
        corners = [
            np.array([[column, row], [column + columns, row], [column + columns, row + rows], [column, row + rows]])
            for row, column, rows, columns in self.rectangles()
        ]
        return [Polygon(cells * self.resolution @ turn.T + np.array([x, y])) for cells in corners]


Obstacle = Polygon | Circle | OccupancyGrid


def _rotation(yaw: float) -> Matrix:
    """Matrix that rotates by `yaw` rad."""
    return np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])


def box(center: tuple[float, float], size: tuple[float, float], yaw: float = 0.0) -> Polygon:
    """Rectangle of full `size` around `center`, rotated by `yaw` rad."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(size) / 2
    return Polygon(half @ _rotation(yaw).T + np.array(center))


@dataclass(frozen=True, eq=False)
class Workspace:
    """Bounds of the body frame's position, ((x_low, x_high), (y_low, y_high)), and its obstacles.

    Workspaces with the same content are equal, so that what is computed from one can be cached.
    """

    bounds: tuple[tuple[float, float], tuple[float, float]]
    obstacles: tuple[Obstacle, ...] = ()

    def __post_init__(self) -> None:
        if len(self.bounds) != 2 or not all(-math.inf < low < high < math.inf for low, high in self.bounds):
            expected = "((x_low, x_high), (y_low, y_high)), finite with low < high"
            raise ValueError(f"workspace bounds: {self.bounds}; expected {expected}")

    def __eq__(self, other: object) -> bool:
        return self._content == other._content if isinstance(other, Workspace) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._content)

    @cached_property
    def _content(self) -> bytes:
        return pickle.dumps((self.bounds, self.obstacles))
