"""Occupied cells of a map, prepared for distances, and the lattice whose vertices include all corners of the cells."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ompl_ext.arrays import Floats, Matrix, Words16Matrix
from ompl_ext.jit import compiled
from ompl_ext.kernels.distance import count_free_cells, interpolated, squares_at_vertices
from ompl_ext.kernels.fine_field import Lattice
from ompl_ext.obstacles import OccupancyGrid

MAX_FREE_CELLS = 1_000_000  # with which a map is widened to the bounds of the workspace, or as many as it has


@dataclass(frozen=True)
class MapCells:
    """Free cells above and below each cell of a map, which has free cells added on all sides.

    `lattice` is in the map's frame, with `divisions` spacings along the side of a cell.
    """

    above: Words16Matrix
    below: Words16Matrix
    lattice: Lattice
    divisions: int

    def every(self, cell: float) -> int:
        """Number of spacings in `cell` m, rounded down; half of them in a turned map, whose vertices are no centres."""
        spacings = cell if self.lattice.sin == 0.0 and self.lattice.cos == 1.0 else cell / 2
        return max(1, math.floor(spacings / self.lattice.spacing + 1e-9))

    def aligned(self, corner: tuple[float, float], cell: float) -> tuple[tuple[float, float], float]:
        """Corner and size of the cells of a field such that their centres are vertices, unless the map is turned.

        The corner is at most a cell below and left of `corner`, m.
        """
        if self.lattice.sin != 0.0 or self.lattice.cos != 1.0:
            return corner, cell
        cell = self.every(cell) * self.lattice.spacing
        place = (self.lattice.x - cell / 2, self.lattice.y - cell / 2)
        x, y = (start + cell * math.floor((low - start) / cell) for start, low in zip(place, corner, strict=True))
        return (x, y), cell

    def lower(self, distance: Matrix, xs: Floats, ys: Floats, cell: float) -> float:
        """Lower `distance[row, column]` to a lower bound of that from (xs[column], ys[row]) to the occupied cells.

        The vertices used are about `cell` m apart.  Returns the largest difference to the distance, m: 0 where the
        points are vertices.
        """
        every, (rows, columns) = self.every(cell), self.above.shape
        shape = rows * self.divisions // every + 1, columns * self.divisions // every + 1
        squares = np.empty(shape)
        height, cut, hull = np.empty(columns + 2), np.empty(columns + 2), np.empty(columns + 2, np.int64)
        squares_at_vertices(self.above, self.below, self.divisions, every, squares, height, hull, cut)
        squares /= every * every
        step = every * self.lattice.spacing
        _lower(distance, xs, ys, np.array(self.lattice), step, squares)
        exact = self.lattice.sin == 0.0 and self.lattice.cos == 1.0 and math.isclose(step, cell)
        return 0.0 if exact else step * math.sqrt(0.5)


def map_cells(
    grid: OccupancyGrid, spacing: float, margin: float, bounds: tuple[tuple[float, float], tuple[float, float]]
) -> MapCells:
    """Cells of a map with a lattice of at most `spacing` m and free cells for `margin` m around it.

    More free cells are added, up to the bounds of the workspace widened by `margin` m, if these are not too many.
    """
    divisions = max(1, math.ceil(grid.resolution / spacing - 1e-9))
    around = math.ceil(margin / grid.resolution) + 1
    up_to_bounds = around + math.ceil(max(0.0, _beyond(grid, bounds)) / grid.resolution)
    rows, columns = grid.occupied.shape
    if (rows + 2 * up_to_bounds) * (columns + 2 * up_to_bounds) <= max(MAX_FREE_CELLS, 2 * rows * columns):
        around = up_to_bounds
    occupied = np.pad(grid.occupied, around)
    shape = len(occupied), len(occupied[0])
    above, below = np.empty(shape, np.uint16), np.empty(shape, np.uint16)
    count_free_cells(occupied, above, below)
    x, y, yaw = grid.origin
    c, s, back = math.cos(yaw), math.sin(yaw), around * grid.resolution
    lattice = Lattice(x - back * (c - s), y - back * (s + c), c, s, grid.resolution / divisions)
    return MapCells(above, below, lattice, divisions)


def _beyond(grid: OccupancyGrid, bounds: tuple[tuple[float, float], tuple[float, float]]) -> float:
    """How far the bounds lie outside the map at most, along the map's axes (m); negative if they are inside."""
    x, y, yaw = grid.origin
    dx, dy = (corner.ravel() for corner in np.meshgrid(np.array(bounds[0]) - x, np.array(bounds[1]) - y))
    u, v = dx * math.cos(yaw) + dy * math.sin(yaw), dy * math.cos(yaw) - dx * math.sin(yaw)
    height, width = (count * grid.resolution for count in grid.occupied.shape)
    return float(max(-u.min(), u.max() - width, -v.min(), v.max() - height))


@compiled
def _lower(distance: Matrix, xs: Floats, ys: Floats, lattice: Floats, step: float, squares: Matrix) -> None:
    """Lower `distance` to the interpolated distances of vertices `step` m apart, `squares` being in squared steps.

    Outside the vertices all cells lie beyond the nearest point of the rectangle of vertices, seen from the point.
    """
    rows, columns = squares.shape
    x0, y0, c, s = lattice[0], lattice[1], lattice[2], lattice[3]
    for row in range(len(ys)):
        for column in range(len(xs)):
            dx, dy = xs[column] - x0, ys[row] - y0
            u, v = (dx * c + dy * s) / step, (dy * c - dx * s) / step
            inner_u, inner_v = min(max(u, 0.0), columns - 1.0), min(max(v, 0.0), rows - 1.0)
            i, j = min(int(inner_u), columns - 2), min(int(inner_v), rows - 2)
            square = interpolated(
                inner_u - i, inner_v - j, squares[j, i], squares[j, i + 1], squares[j + 1, i], squares[j + 1, i + 1]
            )
            outside = (u - inner_u) ** 2 + (v - inner_v) ** 2
            distance[row, column] = min(distance[row, column], math.sqrt(max(square, 0.0) + outside) * step)
