"""Distance field that never overestimates, and the footprint's clearance by it.

Each cell stores a lower bound of the distance from *any* point of the cell to the nearest obstacle: the exact distance
of its centre minus half a cell diagonal (the distance function is 1-Lipschitz).  The footprint is covered by discs, so
the smallest field(centre of disc) - radius is a lower bound of the footprint's clearance: an accepted pose is free.
`ompl_ext.exact` computes the exact clearance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Floats, Floats32, Matrix
from ompl_ext.jit import compiled, inlined
from ompl_ext.kernels.kernel_types import GRID_INVERSE, GRID_X, GRID_Y, REACH, Maps, Problem
from ompl_ext.obstacles import Circle, OccupancyGrid, Polygon, Workspace
from ompl_ext.vehicle import Footprint

MAX_CELLS = 4_000_000


class ClearanceField(NamedTuple):
    """Clearance field: `values[row, column]` in m; `origin` is the lower left corner of cell (0, 0)."""

    values: Floats32
    origin: tuple[float, float]
    cell: float

    def at(self, x: float, y: float) -> float:
        """Lower bound of the distance from (x, y) to the nearest obstacle (m); IndexError outside the field."""
        column, row = int((x - self.origin[0]) // self.cell), int((y - self.origin[1]) // self.cell)
        if min(row, column) < 0:
            raise IndexError(f"({x}, {y}) lies outside the clearance field")
        return float(self.values[row, column])


class DiscCover(NamedTuple):
    """Discs of equal `radius` whose union contains the footprint; `centres` are along the body axis (m)."""

    centres: Floats
    radius: float

    @property
    def discs(self) -> Matrix:
        """Centres in the body frame and radii, shape (n, 3)."""
        count = len(self.centres)
        return np.column_stack([self.centres, np.zeros(count), np.full(count, self.radius)])


def cover(footprint: Footprint, discs: int = 4) -> DiscCover:
    """Cover of the footprint by equal discs, one for each slice of equal length."""
    slice_length = footprint.length / discs
    centres: Floats = footprint.offset + (np.arange(discs, dtype=float) + 0.5) * slice_length - footprint.length / 2
    return DiscCover(centres, math.hypot(slice_length / 2, footprint.width / 2))


def tight_cover(footprint: Footprint, excess: float) -> Matrix:
    """Discs (n, 3) of centres and radii whose union contains the footprint and exceeds it by at most `excess` m.

    The discs are small along the border only: what is inside it may be covered by larger ones.
    """
    half = np.array([footprint.length / 2, footprint.width / 2])
    found: list[tuple[float, float, float]] = []
    while True:
        side = min(excess / (math.sqrt(2.0) - 1.0), half.min())  # half a cell's side
        across = math.ceil(half.min() / side)
        along = math.ceil(half.max() / (half.min() / across))
        nx, ny = (along, across) if half[0] >= half[1] else (across, along)
        cells = [(i, k) for i in range(nx) for k in range(ny)]
        border = [(i, k) for i, k in cells if min(i, k, nx - 1 - i, ny - 1 - k) == 0]
        cell = half / (nx, ny)
        found += [
            (footprint.offset - half[0] + (2 * i + 1) * cell[0], (2 * k + 1) * cell[1] - half[1], math.hypot(*cell))
            for i, k in border
        ]
        if len(border) == len(cells):
            return np.array(found)
        excess += 2 * cell.min()
        half = half - 2 * cell


def clearance_field(workspace: Workspace, margin: float, cell: float = 0.02) -> ClearanceField:
    """Clearance field over the workspace's bounds widened by `margin` m, which covers a footprint inside the bounds.

    The cell is enlarged if cells of `cell` m would be more than `MAX_CELLS`.
    """
    (x_low, x_high), (y_low, y_high) = workspace.bounds
    width, height = x_high - x_low + 2 * margin, y_high - y_low + 2 * margin
    cell = max(cell, math.sqrt(width * height / MAX_CELLS))
    columns, rows = (math.ceil(extent / cell) + 1 for extent in (width, height))
    origin = (x_low - margin, y_low - margin)
    xs: Floats = origin[0] + (np.arange(columns, dtype=float) + 0.5) * cell
    ys: Floats = origin[1] + (np.arange(rows, dtype=float) + 0.5) * cell
    distance = np.full((rows, columns), math.inf)
    for obstacle in workspace.obstacles:
        if isinstance(obstacle, Polygon):
            _lower_to_polygon(distance, xs, ys, np.ascontiguousarray(obstacle.vertices, dtype=float))
        elif isinstance(obstacle, Circle):
            gap = np.hypot(xs[None, :] - obstacle.center[0], ys[:, None] - obstacle.center[1]) - obstacle.radius
            np.minimum(distance, np.maximum(gap, 0.0), out=distance)
        else:
            np.minimum(distance, _distance_to_map(obstacle, xs, ys), out=distance)
    lower = np.minimum(distance, 1e6) - cell * math.sqrt(0.5)
    return ClearanceField(np.nextafter(lower.astype(np.float32), np.float32(-np.inf)), origin, cell)


def _distance_to_map(grid: OccupancyGrid, xs: Floats, ys: Floats) -> Floats:
    """Lower bound of the distance to the occupied cells: that to the nearest centre minus half a cell's diagonal."""
    centres = grid.cell_centres()
    if not len(centres):
        return np.full((len(ys), len(xs)), math.inf)
    from scipy.spatial import cKDTree  # a slow import, needed for maps only

    points = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    nearest, _ = cKDTree(centres).query(points)
    gap: Floats = np.maximum(nearest - grid.resolution * math.sqrt(0.5), 0.0).reshape(len(ys), len(xs))
    return gap


@compiled
def _lower_to_polygon(distance: Floats, xs: Floats, ys: Floats, vertices: Floats) -> None:
    """Lower `distance[row, column]` to the distance between (xs[column], ys[row]) and the filled polygon."""
    count = len(vertices)
    for row in range(len(ys)):
        y = ys[row]
        for column in range(len(xs)):
            x = xs[column]
            nearest, inside = math.inf, False
            ax, ay = vertices[count - 1, 0], vertices[count - 1, 1]
            for k in range(count):
                bx, by = vertices[k, 0], vertices[k, 1]
                ex, ey = bx - ax, by - ay
                t = min(max(((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey), 0.0), 1.0)
                dx, dy = x - ax - t * ex, y - ay - t * ey
                nearest = min(nearest, dx * dx + dy * dy)
                if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * ex:
                    inside = not inside
                ax, ay = bx, by
            distance[row, column] = 0.0 if inside else min(distance[row, column], math.sqrt(nearest))


@inlined
def pose_slack(problem: Problem | Maps, x: float, y: float, c: float, s: float, required: float) -> float:
    """Lower bound of the footprint's clearance at a pose minus `required`; tight only where it is small.

    One cell decides for most poses: far from obstacles the disc around the whole body is free.
    """
    field, scalar = problem.field, problem.scalar
    ox, oy, inverse = scalar[GRID_X], scalar[GRID_Y], scalar[GRID_INVERSE]
    slack = field[int((y - oy) * inverse), int((x - ox) * inverse)] - scalar[REACH] - required
    if slack >= 0.0:
        return slack
    slack = math.inf
    for k in range(len(problem.discs)):
        ahead, aside, radius = problem.discs[k, 0], problem.discs[k, 1], problem.discs[k, 2]
        row, column = (y + ahead * s + aside * c - oy) * inverse, (x + ahead * c - aside * s - ox) * inverse
        slack = min(slack, field[int(row), int(column)] - radius - required)
        if slack < 0.0:
            return slack
    return slack
