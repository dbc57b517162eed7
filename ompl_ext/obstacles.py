"""Static obstacles of a planar workspace."""

from __future__ import annotations

import math
import pickle
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.triangulate import counter_clockwise


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
        """Check bounds and obstacles: one without finite numbers would be nowhere, and no plan would keep away from it.

        Raises:
            ValueError: with every problem.
        """
        problems = []
        bounds = _finite(self.bounds)
        if bounds is None or bounds.shape != (2, 2) or not np.all(bounds[:, 0] < bounds[:, 1]):
            expected = "((x_low, x_high), (y_low, y_high)), finite with low < high"
            problems.append(f"workspace bounds: {self.bounds}; expected {expected}")
        if not isinstance(self.obstacles, list | tuple):
            kind = type(self.obstacles).__name__
            raise ValueError("; ".join([*problems, f"workspace obstacles: a {kind}; expected a tuple of obstacles"]))
        for number, obstacle in enumerate(self.obstacles):
            problem = _problem(obstacle)
            problems += [f"workspace obstacles[{number}]: {problem}"] if problem else []
        if problems:
            raise ValueError("; ".join(problems))

    def __eq__(self, other: object) -> bool:
        return self._content == other._content if isinstance(other, Workspace) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._content)

    @cached_property
    def _content(self) -> bytes:
        return pickle.dumps((self.bounds, self.obstacles))


def _finite(values: object) -> Floats | None:
    """Array of finite numbers, None if the values are anything else."""
    try:
        array = np.asarray(values)
    except ValueError:  # rows of several lengths
        return None
    numeric = np.issubdtype(array.dtype, np.integer) or np.issubdtype(array.dtype, np.floating)
    return array if numeric and bool(np.isfinite(array).all()) else None


def _problem(obstacle: object) -> str:
    """What is wrong with an obstacle, and what is expected; empty if nothing is."""
    if isinstance(obstacle, Polygon):
        vertices = _finite(obstacle.vertices)
        if vertices is None or vertices.ndim != 2 or vertices.shape[1] != 2 or len(vertices) < 3:
            return "a Polygon needs vertices (n, 2), at least three, of finite numbers"
        try:
            counter_clockwise(vertices)
        except ValueError as error:
            return str(error)
    elif isinstance(obstacle, Circle):
        center, radius = _finite(obstacle.center), _finite(obstacle.radius)
        if center is None or center.shape != (2,) or radius is None or radius.shape != () or radius < 0.0:
            return "a Circle needs a center (2,) and a radius of at least 0, finite numbers"
    elif isinstance(obstacle, OccupancyGrid):
        cells, origin, side = obstacle.occupied, _finite(obstacle.origin), _finite(obstacle.resolution)
        if not isinstance(cells, np.ndarray) or cells.dtype != bool or cells.ndim != 2:
            return "an OccupancyGrid needs occupied (rows, columns), an array of bool"
        if side is None or side.shape != () or side <= 0.0 or origin is None or origin.shape != (3,):
            return "an OccupancyGrid needs a positive resolution and an origin (x, y, yaw), finite numbers"
    else:
        return f"is a {type(obstacle).__name__}; expected a Polygon, a Circle or an OccupancyGrid"
    return ""
