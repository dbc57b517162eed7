"""Distance field that never overestimates, and the footprint's clearance by it.

Each cell stores a lower bound of the distance from *any* point of the cell to the nearest obstacle: the exact distance
of its centre minus half a cell diagonal (the distance function is 1-Lipschitz).  In large workspaces and in those with
a map its cells are large, and a fine field (`fine_field`) decides near obstacles.  The footprint is covered by discs,
so the smallest field(centre of disc) - radius is a lower bound of the footprint's clearance: an accepted pose is free.
`ompl_ext.exact` computes the exact clearance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Floats, Floats32, Ints, Matrix, int64
from ompl_ext.jit import inlined, part
from ompl_ext.kernels.distance import lower_to_shapes
from ompl_ext.kernels.fine_field import (
    TILE,
    VERTICES,
    FineField,
    Lattice,
    fine_distance,
    fine_distance_anywhere,
    fine_field,
)
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    DELTA,
    DELTA_FAR,
    DELTA_FAR_PER_SPEED,
    DELTA_HORIZON,
    DELTA_PER_SPEED,
    DELTA_PER_TIME,
    FINE_INVERSE,
    GRID_INVERSE,
    GRID_X,
    GRID_Y,
    NEAR,
    REACH,
    Maps,
    Problem,
)
from ompl_ext.kernels.map_cells import MAX_FREE_CELLS, MapCells, map_cells
from ompl_ext.memory import check_memory
from ompl_ext.obstacles import Circle, OccupancyGrid, Polygon, Workspace
from ompl_ext.vehicle import Footprint

MAX_CELLS = 1_000_000
BYTES_PER_CELL, BYTES_PER_MAP_CELL, BYTES_PER_TILE = 56, 16, 120  # of working memory and results
FARTHEST = 1e6  # m, the distance where there is no obstacle
BEYOND_REACH = 0.5  # m beyond reach and delta, within which the fine field is stored: room for motion in a step


class ClearanceField(NamedTuple):
    """Clearance field: `values[row, column]` in m; `origin` is the lower left corner of cell (0, 0), m."""

    values: Floats32
    origin: tuple[float, float]
    cell: float
    loss: float = 0.0  # largest underestimate of the distance of a cell's centre

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


GROUP, LARGE = 6, 0.5  # most discs of a group; radius of a disc without one, as a share of the largest


def tight_cover(footprint: Footprint, excess: float) -> Matrix:
    """Discs (n, 3) of centres and radii whose union contains the footprint and exceeds its sides by at most `excess` m.

    Each disc is around a rectangle, and the rectangles fill the footprint.  A disc around a rectangle `deep` m deep and
    `wide` m wide exceeds the side that it lies at by about wide^2 / (4 deep), but it must not exceed another side: the
    rectangles get smaller towards the corners only.
    """
    half = np.array([footprint.length / 2, footprint.width / 2])
    side, long = float(half.min()), int(half[1] > half[0])  # of the squares at the corners; the longer axis
    discs = [(x, y, radius) for x, y, radius in _corner_discs(side, excess)]
    signs = [(a, b) for a in (-1, 1) for b in (-1, 1)]
    found = [(a * (half[0] - x), b * (half[1] - y), radius) for x, y, radius in discs for a, b in signs]
    middle = 2 * float(half.max() - side)
    count = math.ceil(middle / _width_of_slice(2 * side, excess) - 1e-9)
    for k in range(count):
        along = -middle / 2 + (k + 0.5) * middle / count
        radius = math.hypot(middle / count, 2 * side) / 2
        found.append((0.0, along, radius) if long else (along, 0.0, radius))
    found.sort(key=lambda disc: -disc[2])  # a large one detects most collisions
    return np.array([(x + footprint.offset, y, radius) for x, y, radius in found])


def grouped(discs: Matrix) -> Matrix:
    """Discs (m, 4) with the number of discs that follow each one within it: these are free if it is.

    The large ones of `discs` (n, 3) come first, since they detect most collisions; small neighbours are in groups, each
    after a disc around it.
    """
    if len(discs) <= GROUP:
        return np.column_stack([discs, np.zeros(len(discs))])
    large = discs[:, 2] >= LARGE * discs[0, 2]
    found = [np.column_stack([discs[large], np.zeros(np.count_nonzero(large))])]
    waiting = [discs[~large]]
    while waiting:
        some = waiting.pop()
        if len(some) > GROUP:
            axis = int(np.argmax(np.ptp(some[:, :2], axis=0)))
            order = np.argsort(some[:, axis], kind="stable")
            waiting += [some[order[: len(order) // 2]], some[order[len(order) // 2 :]]]
        elif len(some) > 0:
            low, high = (some[:, :2] - some[:, 2:]).min(axis=0), (some[:, :2] + some[:, 2:]).max(axis=0)
            centre = 0.5 * (low + high)
            around = (np.linalg.norm(some[:, :2] - centre, axis=1) + some[:, 2]).max()
            found.append(np.vstack([[*centre, around, len(some)], np.column_stack([some, np.zeros(len(some))])]))
    return np.vstack(found)


def _width_of_slice(deep: float, excess: float) -> float:
    """Width (m) of a rectangle, `deep` m deep, whose disc exceeds it by `excess` m at its narrow sides."""
    return math.sqrt(4 * deep * excess + 4 * excess * excess)


def _corner_discs(side: float, excess: float) -> list[tuple[float, float, float]]:
    """Discs that cover a square of side `side` at a corner of a footprint: distances from both sides, and radius."""
    found: list[tuple[float, float, float]] = []
    while (math.sqrt(2.0) - 1.0) * side / 2 > excess:
        deep = side / 2
        count = math.ceil(deep / _width_of_slice(deep, excess) - 1e-9)
        for k in range(count):
            along, radius = deep + (k + 0.5) * deep / count, math.hypot(deep, deep / count) / 2
            found += [(along, deep / 2, radius), (deep / 2, along, radius)]
        found.append((1.5 * deep, 1.5 * deep, deep / math.sqrt(2.0)))
        side = deep
    found.append((side / 2, side / 2, side / math.sqrt(2.0)))
    return found


def clearance_field(workspace: Workspace, margin: float, cell: float = 0.02) -> ClearanceField:
    """Clearance field over the workspace's bounds widened by `margin` m, which covers a footprint inside the bounds.

    The cell is enlarged if cells of `cell` m would be more than `MAX_CELLS`.
    """
    (x_low, x_high), (y_low, y_high) = workspace.bounds
    cell = max(cell, math.sqrt((x_high - x_low + 2 * margin) * (y_high - y_low + 2 * margin) / MAX_CELLS))
    return _field_of(workspace, None, margin, cell)


def fields(
    workspace: Workspace,
    footprint: Footprint,
    disc_radius: float,
    cell: float,
    delta: float = 0.0,
    spacing: float = math.inf,
) -> tuple[ClearanceField, FineField | None]:
    """Clearance field, and a fine field if the clearance field alone would lose more than `cell` m of clearance.

    The fields are for a footprint that keeps up to `delta` m.  There always is a fine field if its `spacing` is given
    (m); in a large workspace it is wider.

    In a workspace without a map the cells of the clearance field are `cell` m wide if these are at most `MAX_CELLS`,
    and there is no fine field.  Otherwise the clearance field has larger cells, and the fine field, which loses at most
    `cell` m, decides wherever the footprint can touch an obstacle.

    Raises:
        MapTooLargeError: there is not enough memory.
    """
    check_memory(memory_of_fields(workspace, footprint, cell, delta, spacing))
    grid, coarse = _first_map(workspace), coarse_cell(workspace, footprint, cell)
    if grid is None and coarse == cell and spacing == math.inf:
        return clearance_field(workspace, footprint.reach + 2 * cell, cell), None
    touch = footprint.reach + delta + BEYOND_REACH
    spacing = fine_spacing(workspace, footprint, cell, spacing)
    cells = None if grid is None else map_cells(grid, spacing, max(touch, coarse), workspace.bounds)
    field = _field_of(workspace, cells, footprint.reach + 2 * coarse, coarse)
    return field, _fine_field_of(workspace, field, cells, disc_radius, touch, spacing)


def least_spacing(workspace: Workspace, footprint: Footprint) -> float:
    """Spacing of a fine field (m) below which a workspace would have more than four times `MAX_CELLS` vertices."""
    area = math.prod(high - low + 2 * footprint.reach for low, high in workspace.bounds)
    return math.sqrt(area / (4 * MAX_CELLS))


def fine_spacing(workspace: Workspace, footprint: Footprint, cell: float, wanted: float) -> float:
    """Spacing of the fine field (m): `wanted`, or larger in a large workspace, but no loss of more than `cell` m."""
    return min(cell * math.sqrt(2.0), max(wanted, least_spacing(workspace, footprint)))


def coarse_cell(workspace: Workspace, footprint: Footprint, cell: float) -> float:
    """Cell of the clearance field (m): `cell`, or larger in a large workspace, as far as walls stay closed to it."""
    area = math.prod(high - low + 2 * footprint.reach for low, high in workspace.bounds)
    grid = _first_map(workspace)
    thin = 0.0 if grid is None else grid.resolution  # thickness of a wall, which must not fall between larger cells
    widest = (footprint.inscribed + thin / 2) / (0.5 + math.sqrt(0.5))
    return max(cell, math.sqrt(area / (4 * MAX_CELLS)), min(math.sqrt(area / MAX_CELLS), widest))


def memory_of_fields(
    workspace: Workspace, footprint: Footprint, cell: float, delta: float = 0.0, spacing: float = math.inf
) -> int:
    """Memory (bytes) that both fields and a cost-to-go need at most, while they are computed."""
    coarse, grid = coarse_cell(workspace, footprint, cell), _first_map(workspace)
    width, height = (high - low + 2 * (footprint.reach + 2 * coarse) for low, high in workspace.bounds)
    needed = BYTES_PER_CELL * width * height / coarse**2
    if grid is None and coarse == cell and spacing == math.inf:
        return int(needed)
    spacing = fine_spacing(workspace, footprint, cell, spacing)
    side, touch = TILE * spacing, footprint.reach + delta + BEYOND_REACH
    extents = []
    for obstacle in workspace.obstacles:
        if isinstance(obstacle, OccupancyGrid):
            needed += BYTES_PER_MAP_CELL * (obstacle.occupied.size + MAX_FREE_CELLS)
            side = min(side, TILE * obstacle.resolution / math.ceil(obstacle.resolution / spacing))
            extents.append(np.array(obstacle.occupied.shape) * obstacle.resolution)
        elif isinstance(obstacle, Circle):
            extents.append(np.full(2, 2 * obstacle.radius))
        else:
            extents.append(np.ptp(obstacle.vertices, axis=0))
    tiles, near = 2 * width * height / side**2, sum(np.prod((extent + 2 * touch) / side + 2) for extent in extents)
    return int(needed + BYTES_PER_TILE * tiles + 2 * VERTICES * min(tiles, near))


def _first_map(workspace: Workspace) -> OccupancyGrid | None:
    return next((obstacle for obstacle in workspace.obstacles if isinstance(obstacle, OccupancyGrid)), None)


def _field_of(workspace: Workspace, cells: MapCells | None, margin: float, cell: float) -> ClearanceField:
    """Clearance field of all obstacles; `cells` are those of the first map."""
    grids = [obstacle for obstacle in workspace.obstacles if isinstance(obstacle, OccupancyGrid)]
    prepared = [cells or map_cells(grid, cell, margin, workspace.bounds) for grid in grids[:1]]
    prepared += [map_cells(grid, cell, margin, workspace.bounds) for grid in grids[1:]]
    (x_low, x_high), (y_low, y_high) = workspace.bounds
    origin, loss = (x_low - margin, y_low - margin), 0.0
    if prepared:
        origin, cell = prepared[0].aligned(origin, cell)
    columns, rows = (
        math.ceil((high + margin - low) / cell) + 1 for low, high in zip(origin, (x_high, y_high), strict=True)
    )
    xs: Floats = origin[0] + (np.arange(columns, dtype=float) + 0.5) * cell
    ys: Floats = origin[1] + (np.arange(rows, dtype=float) + 0.5) * cell
    distance = np.full((rows, columns), math.inf)
    for each in prepared:
        loss = max(loss, each.lower(distance, xs, ys, cell))
    lower_to_shapes(distance, xs, ys, [o for o in workspace.obstacles if not isinstance(o, OccupancyGrid)])
    np.minimum(distance, FARTHEST, out=distance)
    distance -= cell * math.sqrt(0.5)
    values = distance.astype(np.float32)
    return ClearanceField(np.nextafter(values, np.float32(-np.inf), out=values), origin, cell, loss)


def _fine_field_of(
    workspace: Workspace,
    field: ClearanceField,
    cells: MapCells | None,
    disc_radius: float,
    touch: float,
    spacing: float,
) -> FineField:
    """Fine field on the lattice of the first map, stored where the distance is between `disc_radius` and `touch` m."""
    rows, columns = field.values.shape
    width, height = columns * field.cell, rows * field.cell
    offset, lattice = (0, 0), Lattice(*field.origin, 1.0, 0.0, spacing)
    if cells is not None:
        x = field.origin[0] + np.array([0.0, width, 0.0, width])
        y = field.origin[1] + np.array([0.0, 0.0, height, height])
        v, u = cells.lattice.coordinates(x, y)
        offset = (math.floor(v.min()) - 1, math.floor(u.min()) - 1)
        corner = cells.lattice.vertices(np.array(float(offset[0])), np.array(float(offset[1])))
        lattice = cells.lattice._replace(x=float(corner[0]), y=float(corner[1]))
        width, height = (np.ptp(u) + 2) * lattice.spacing, (np.ptp(v) + 2) * lattice.spacing
    side = TILE * lattice.spacing
    shape = math.ceil(height / side) + 1, math.ceil(width / side) + 1
    middle = (np.indices(shape) + 0.5) * TILE
    x, y = lattice.vertices(middle[0], middle[1])
    u, v = (x - field.origin[0]) / field.cell, (y - field.origin[1]) / field.cell
    at_row, at_column = np.floor(v).astype(int).clip(0, rows - 1), np.floor(u).astype(int).clip(0, columns - 1)
    half = side * math.sqrt(0.5)
    away = half + field.cell * np.maximum(np.maximum(-u, u - columns), np.maximum(-v, v - rows)).clip(0.0)
    value = field.values[at_row, at_column]
    highest = value + field.cell * math.sqrt(2.0) + field.loss
    wanted = (away <= 2 * half) & (value - away < touch) & (highest + away >= disc_radius)
    others: list[Polygon | Circle] = []
    for number, obstacle in enumerate(workspace.obstacles):
        if not isinstance(obstacle, OccupancyGrid):
            others.append(obstacle)
        elif any(isinstance(earlier, OccupancyGrid) for earlier in workspace.obstacles[:number]):
            others += obstacle.boxes()
    free = None if cells is None else (cells.above, cells.below)
    divisions = 1 if cells is None else cells.divisions
    return fine_field(lattice, shape, wanted, free, offset, divisions, others, touch)


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
    slack, k, count = math.inf, 0, len(problem.discs)
    while k < count:
        ahead, aside, radius, members = (
            problem.discs[k, 0],
            problem.discs[k, 1],
            problem.discs[k, 2],
            problem.discs[k, 3],
        )
        px, py = x + ahead * c - aside * s, y + ahead * s + aside * c
        value = field[int((py - oy) * inverse), int((px - ox) * inverse)]
        of_disc = value - radius - required
        if of_disc < 0.0 and scalar[FINE_INVERSE] > 0.0:
            of_disc = max(of_disc, fine_distance(problem, px, py) - radius - required)
        k += 1
        if members > 0.0:
            if of_disc < 0.0:
                continue
            k += int(members)
        slack = min(slack, of_disc)
        if slack < 0.0:
            return slack
    return slack


@inlined
def delta_at(scalar: Floats, time: float) -> tuple[float, float, float]:
    """Clearance that the model gap requires at a time of a query (s): at rest (m), per speed (s), and growth (m)."""
    if time > scalar[NEAR]:
        return scalar[DELTA_FAR], scalar[DELTA_FAR_PER_SPEED], 0.0
    growth = scalar[DELTA_PER_TIME] * min(time, scalar[DELTA_HORIZON])
    return scalar[DELTA], scalar[DELTA_PER_SPEED], growth


@part
def tight_clearance(problem: Problem, px: float, py: float, c: float, s: float) -> float:
    """Lower bound of the footprint's clearance at a pose with this cosine and sine (m), tight everywhere.

    It is at least that of `pose_slack` unless discs are in groups: then a disc around others, which decides there, may
    tell more than they do, by less than what the cells lose (1.5 cells).
    """
    field, discs, scalar = problem.field, problem.discs, problem.scalar
    last_row, last_column = field.shape[0] - 1.0, field.shape[1] - 1.0
    least = math.inf
    for i in range(len(discs)):
        if discs[i, 3] > 0.0:  # around the discs that follow
            continue
        x = px + discs[i, 0] * c - discs[i, 1] * s
        y = py + discs[i, 0] * s + discs[i, 1] * c
        # in this order a place that is not a number counts as the corner, and not as one outside the memory
        row = int(min(max(0.0, (y - scalar[GRID_Y]) * scalar[GRID_INVERSE]), last_row))
        column = int(min(max(0.0, (x - scalar[GRID_X]) * scalar[GRID_INVERSE]), last_column))
        value = float(field[row, column])
        if scalar[FINE_INVERSE] > 0.0:
            value = max(value, fine_distance_anywhere(problem, x, y))
        least = min(least, value - discs[i, 2])
    v = (py - scalar[GRID_Y]) * scalar[GRID_INVERSE]
    u = (px - scalar[GRID_X]) * scalar[GRID_INVERSE]
    if 0.0 <= v < last_row + 1.0 and 0.0 <= u < last_column + 1.0:  # the disc around the body may tell more
        least = max(least, float(field[int(v), int(u)]) - scalar[REACH])
    return least


@part
def clearances(problem: Problem, poses: Matrix, c: Floats, s: Floats, found: Floats) -> None:
    """Find the `tight_clearance` (n,) of poses (n, 3) with these cosines and sines."""
    for k in range(len(poses)):
        found[k] = tight_clearance(problem, poses[k, 0], poses[k, 1], c[k], s[k])


@part
def least_slacks(
    problem: Problem, states: Matrix, c: Floats, s: Floats, where: Ints, since: Floats, ends: Ints, found: Floats
) -> None:
    """Find the least slack (m) of motions: clearance beyond the one that the model gap requires.

    Motion k has the states (n, nx) up to `ends[k]`, from the end of the one before it on; c and s (n,) are cosine and
    sine of their headings, `since` (n,) their times in the query (s).  `where` has the components x, y and speed.
    """
    scalar, row = problem.scalar, int64(0)
    for k in range(len(ends)):
        found[k] = math.inf
        while row < ends[k]:
            delta, per_speed, growth = delta_at(scalar, max(since[row], 0.0))
            required = delta + per_speed * abs(states[row, where[2]]) + growth
            slack = tight_clearance(problem, states[row, where[0]], states[row, where[1]], c[row], s[row]) - required
            if slack < found[k] or math.isnan(slack):
                found[k] = slack
            row += 1


@inlined
def swept_margin(
    dx: float, dy: float, turn: float, c0: float, s0: float, c1: float, s1: float, reach: float, length: float
) -> float:
    """Clearance (m) needed at both ends of a step so that no point of the body hits anything in between.

    The body moves `along` its axis, sideways, and turns.  In a motion along its axis by no more than its length it
    stays inside the union of its two end positions.  `off` bounds all other motion; it moves the corners out of that
    union by at most off (along + off) / (along + 2 off).  This holds for constant rates; docs/planner.md has the
    derivation, `checks.step_margin` adds the effect of changing rates.
    """
    side0 = abs(dy * c0 - dx * s0)
    side1 = abs(dy * c1 - dx * s1)
    side = side0 if side0 > side1 else side1
    along = abs(dx * c0 + dy * s0)
    off = side + abs(turn) * reach
    margin = off * (along + off) / (along + 2.0 * off + 1e-12)
    return margin if along < length else 0.5 * (along + off)
