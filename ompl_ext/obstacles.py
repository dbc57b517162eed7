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

    def cell_centres(self) -> Matrix:
        """Centres of the occupied cells in the world, shape (n, 2)."""
        rows, columns = np.nonzero(self.occupied)
        local = (np.column_stack([columns, rows]) + 0.5) * self.resolution
        x, y, yaw = self.origin
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        centres: Matrix = local @ turn.T + np.array([x, y])
        return centres

    def rectangles(self) -> list[tuple[int, int, int, int]]:
        """Disjoint rectangles that cover exactly the occupied cells: (row, column, rows, columns) of each.

        A rectangle is a run of cells in a row, extended upwards while the next row has the same run.
        """
        done: list[tuple[int, int, int, int]] = []
        growing: dict[tuple[int, int], int] = {}  # (first column, past last column) -> first row
        for row in range(self.occupied.shape[0] + 1):
            runs = set(_runs(self.occupied[row])) if row < self.occupied.shape[0] else set()
            for (first, last), start in list(growing.items()):
                if (first, last) not in runs:
                    done.append((start, first, row - start, last - first))
                    del growing[first, last]
            for run in sorted(runs):
                growing.setdefault(run, row)
        return done

    def boxes(self) -> list[Polygon]:
        """Disjoint rectangles in the world that cover exactly the occupied cells."""
        x, y, yaw = self.origin
        turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        corners = [
            np.array([[column, row], [column + columns, row], [column + columns, row + rows], [column, row + rows]])
            for row, column, rows, columns in self.rectangles()
        ]
        return [Polygon(cells * self.resolution @ turn.T + np.array([x, y])) for cells in corners]


def _runs(cells: Bools) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], cells, [False])).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


Obstacle = Polygon | Circle | OccupancyGrid


def box(center: tuple[float, float], size: tuple[float, float], yaw: float = 0.0) -> Polygon:
    """Rectangle of full `size` around `center`, rotated by `yaw` rad."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(size) / 2
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    return Polygon(half @ turn.T + np.array(center))


@dataclass(frozen=True, eq=False)
class Workspace:
    """Bounds of the body frame's position, ((x_low, x_high), (y_low, y_high)), and its obstacles.

    Workspaces with the same content are equal, so that what is computed from one can be cached.
    """

    bounds: tuple[tuple[float, float], tuple[float, float]]
    obstacles: tuple[Obstacle, ...] = ()

    def __post_init__(self) -> None:
        for low, high in self.bounds:
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ValueError(f"workspace bounds must be finite with low < high, got {self.bounds}")

    def __eq__(self, other: object) -> bool:
        return self._content == other._content if isinstance(other, Workspace) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._content)

    @cached_property
    def _content(self) -> bytes:
        return pickle.dumps((self.bounds, self.obstacles))
