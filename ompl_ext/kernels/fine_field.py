"""Fine distance field: squared distances at the vertices of a lattice, stored only where a footprint can touch.

The lattice lies in the frame of the map, so that the corners of the map's cells are vertices and distances there are
exact.  Between vertices `distance.interpolated` is a lower bound, at most spacing / sqrt(2) below the distance.  The
lattice is stored in tiles of 16 x 16 cells, and only tiles near obstacles are: the coarse `ClearanceField` decides
everywhere else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Bools, Floats, Floats32, IntMatrix32, Matrix, Matrix32, Words16, Words16Matrix, int64
from ompl_ext.cores import usable_cores
from ompl_ext.jit import compiled, inlined, part
from ompl_ext.kernels.distance import Shapes, column_distance, interpolated, lower_points, near_shapes, shapes
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    FINE_COS,
    FINE_INVERSE,
    FINE_SIN,
    FINE_X,
    FINE_Y,
    Maps,
    Problem,
)
from ompl_ext.obstacles import Circle, Polygon

TILE = 16  # cells along the side of a tile
THREADS = min(4, usable_cores())  # that compute the lattice
TILES = 8  # tiles along the side of a block
VERTICES = (TILE + 1) * (TILE + 1)  # of a tile; neighbours have those on their common side twice
LARGEST_SPACINGS = 255  # distance in spacings that a vertex can store
ROUNDING = 1e-7  # m, subtracted from distances, far above the rounding errors of their computation


class Lattice(NamedTuple):
    """Frame of a lattice: position (m) and heading (cosine, sine) of vertex (0, 0), and the spacing (m)."""

    x: float
    y: float
    cos: float
    sin: float
    spacing: float

    def vertices(self, rows: Floats, columns: Floats) -> tuple[Floats, Floats]:
        """World coordinates x, y of vertices, m."""
        u, v = columns * self.spacing, rows * self.spacing
        return self.x + u * self.cos - v * self.sin, self.y + u * self.sin + v * self.cos

    def coordinates(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Row and column, in spacings, of points in the world."""
        u, v = x - self.x, y - self.y
        return (v * self.cos - u * self.sin) / self.spacing, (u * self.cos + v * self.sin) / self.spacing


class FineField(NamedTuple):
    """Tiles of a fine field: `tile[row, column]` is the number of a tile, -1 where none is stored.

    `squares[tile]` are the squared distances, in squared spacings, at its 17 x 17 vertices.
    """

    lattice: Lattice
    tile: IntMatrix32
    squares: Words16Matrix


@inlined
def fine_distance(problem: Problem | Maps, x: float, y: float) -> float:
    """Lower bound of the distance from (x, y) to the nearest obstacle (m); -1 where no tile is stored."""
    scalar = problem.scalar
    dx, dy, inverse = x - scalar[FINE_X], y - scalar[FINE_Y], scalar[FINE_INVERSE]
    u = (dx * scalar[FINE_COS] + dy * scalar[FINE_SIN]) * inverse
    v = (dy * scalar[FINE_COS] - dx * scalar[FINE_SIN]) * inverse
    column, row = int(u), int(v)
    tile = problem.tile[row // TILE, column // TILE]
    if tile < 0:
        return -1.0
    at = (row % TILE) * (TILE + 1) + column % TILE
    squares = problem.squares
    square = interpolated(
        u - column,
        v - row,
        float(squares[tile, at]),
        float(squares[tile, at + 1]),
        float(squares[tile, at + TILE + 1]),
        float(squares[tile, at + TILE + 2]),
    )
    return math.sqrt(max(square, 0.0)) / inverse - ROUNDING


def fine_field(
    lattice: Lattice,
    shape: tuple[int, int],
    wanted: Bools,
    free: tuple[Words16Matrix, Words16Matrix] | None,
    offset: tuple[int, int],
    divisions: int,
    obstacles: Sequence[Polygon | Circle],
    reach: float,
) -> FineField:
    """Fine field with distances up to `reach` m.

    Args:
        lattice: frame of the tiles.
        shape: rows and columns of tiles.
        wanted: which tiles are stored, bool (rows, columns).
        free: free cells above and below each cell of the map, see `distance.count_free_cells`; None without a map.
        offset: row and column of vertex (0, 0) of the lattice in that of the map.
        divisions: spacings along the side of a cell.
        obstacles: all other obstacles.
        reach: largest distance of interest (m).
    """
    tile = np.full(shape, -1, np.int32)
    tile[wanted] = np.arange(int(wanted.sum()))
    squares = np.empty((max(1, int(wanted.sum())), VERTICES), np.uint16)
    most = max(1, min(LARGEST_SPACINGS, math.floor(reach / lattice.spacing)))
    if free is None:
        squares[:] = most * most
    else:
        window = math.ceil(most / divisions)  # columns of cells
        length = shape[1] * TILE // divisions + 2 * window + 8

        def fill(rows: tuple[int, int]) -> None:
            lines, values = np.empty((2, length), np.float32), np.empty(length * divisions, np.uint16)
            _fill_tiles(*free, divisions, window, most, tile, *rows, *offset, squares, lines, values)

        _in_parallel(fill, shape[0])
    if len(obstacles):
        all_shapes = shapes(obstacles)

        def lower(blocks: tuple[int, int]) -> None:
            numbers = np.empty((3, len(obstacles)), np.int32)
            numbers[2] = np.arange(len(obstacles))
            gap, work = np.empty(len(obstacles)), np.empty((5, VERTICES))
            _lower_tiles(all_shapes, tile, *blocks, squares, np.array(lattice), most, numbers, gap, work)

        _in_parallel(lower, math.ceil(shape[0] / TILES))
    return FineField(lattice, tile, squares)


def _in_parallel(work: Callable[[tuple[int, int]], None], count: int) -> None:
    """Do `work` for `count` rows, in as many ranges from a row to before another as there are threads."""
    cuts = np.linspace(0, count, THREADS + 1).astype(int).tolist()
    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(work, pairwise(cuts)))


@compiled
def _fill_tiles(
    above: Words16Matrix,
    below: Words16Matrix,
    divisions: int,
    window: int,
    most: int,
    tile: IntMatrix32,
    first_row: int,
    end_row: int,
    row_offset: int,
    column_offset: int,
    squares: Words16Matrix,
    lines: Matrix32,
    values: Words16,
) -> None:
    """Squared distances from the vertices of stored tiles to the cells of a map, at most `most` squared.

    The tiles are those in the rows from `first_row` to before `end_row`.

    Cells farther than `window` columns away are farther than `most` spacings.
    """
    for row in range(first_row, end_row):
        first = int64(0)
        while first < tile.shape[1]:
            if tile[row, first] < 0:
                first += 1
                continue
            end = first + 1
            while end < tile.shape[1] and tile[row, end] >= 0:
                end += 1
            for line in range(TILE + 1):
                y = row * TILE + line + row_offset
                _fill_line(above, below, divisions, window, most, y, first * TILE + column_offset,
                           end * TILE + column_offset, lines, values)  # fmt: skip
                origin = (first * TILE + column_offset) // divisions * divisions
                for column in range(first, end):
                    x = column * TILE + column_offset - origin
                    stored, computed = squares[tile[row, column], line * (TILE + 1) :], values[x:]
                    for k in range(TILE + 1):
                        stored[k] = computed[k]
            first = end


@inlined
def _fill_line(
    above: Words16Matrix,
    below: Words16Matrix,
    divisions: int,
    window: int,
    most: int,
    y: int,
    x_first: int,
    x_last: int,
    lines: Matrix32,
    values: Words16,
) -> None:
    """Squared distances of the lattice row `y` between two of its vertices.

    `values` receives them, beginning with the vertex at the left side of the first one's cell; `lines` (2, n) is
    working memory.
    """
    rows, columns = above.shape
    limit = np.float32(most * most)
    low, high = x_first // divisions, x_last // divisions + 1
    count, line, heights = high - low, lines[0], lines[1]
    row, above_row = y // divisions, y % divisions
    for k in range(count + 2 * window + 4):
        column = low - window + k
        height = int64(most)
        if 0 <= y <= rows * divisions and 0 <= column < columns:
            height = min(height, column_distance(above, below, divisions, row, above_row, column))
        heights[k] = np.float32(height * height)
    for phase in range(divisions):
        for i in range(count):
            line[i] = limit
        for k in range(-window, window + 1, 4):
            _lower_line(line, heights, k + window, count, _square_gap(k, divisions, phase),
                        _square_gap(k + 1, divisions, phase), _square_gap(k + 2, divisions, phase),
                        _square_gap(k + 3, divisions, phase))  # fmt: skip
        for i in range(count):
            values[i * divisions + phase] = np.uint16(line[i])


@inlined
def _square_gap(k: int, divisions: int, phase: int) -> np.float32:
    """Squared distance from a vertex, `phase` spacings into its column of cells, to the k-th column after that."""
    gap = k * divisions - phase if k > 0 else phase - (k + 1) * divisions
    return np.float32(gap * gap if k != 0 else 0)


@inlined
def _lower_line(
    line: Floats32,
    heights: Floats32,
    first: int,
    count: int,
    g0: np.float32,
    g1: np.float32,
    g2: np.float32,
    g3: np.float32,
) -> None:
    """Lower entries of `line` to those of four successive columns; this loop vectorises."""
    h0, h1, h2, h3 = heights[first:], heights[first + 1 :], heights[first + 2 :], heights[first + 3 :]
    for i in range(count):
        s0, s1, s2, s3 = h0[i] + g0, h1[i] + g1, h2[i] + g2, h3[i] + g3
        a, b = s0 if s0 < s1 else s1, s2 if s2 < s3 else s3
        least = a if a < b else b
        line[i] = least if least < line[i] else line[i]


@compiled
def _lower_tiles(
    all_shapes: Shapes,
    tile: IntMatrix32,
    first_block: int,
    end_block: int,
    squares: Words16Matrix,
    lattice: Floats,
    most: int,
    numbers: IntMatrix32,
    gap: Floats,
    work: Matrix,
) -> None:
    """Lower the squares of stored tiles to the squared distances to shapes, rounded down.

    The tiles are those in the rows of blocks from `first_block` to before `end_block`.  `numbers` (3, shapes) are the
    shapes near a block of tiles, near a tile, and all; `gap` (shapes,) and `work` (5, VERTICES) are working memory.
    """
    x0, y0, c, s, spacing = lattice[0], lattice[1], lattice[2], lattice[3], lattice[4]
    count, half = len(gap), 0.5 * TILE * spacing * math.sqrt(2.0)
    for top in range(first_block * TILES, min(end_block * TILES, tile.shape[0]), TILES):
        for left in range(0, tile.shape[1], TILES):
            u, v = (left + 0.5 * TILES) * TILE * spacing, (top + 0.5 * TILES) * TILE * spacing
            x, y = x0 + u * c - v * s, y0 + u * s + v * c
            outer = near_shapes(all_shapes, x, y, half * TILES, numbers[2], count, numbers[0], gap)
            for row in range(top, min(top + TILES, tile.shape[0])):
                for column in range(left, min(left + TILES, tile.shape[1])):
                    number = int64(tile[row, column])
                    if number < 0:
                        continue
                    u, v = (column + 0.5) * TILE * spacing, (row + 0.5) * TILE * spacing
                    x, y = x0 + u * c - v * s, y0 + u * s + v * c
                    inner = near_shapes(all_shapes, x, y, half, numbers[0], outer, numbers[1], gap)
                    least, stored = math.inf, squares[number]
                    for k in range(outer):
                        least = min(least, gap[k])
                    largest = int64(0)
                    for k in range(VERTICES):
                        largest = max(largest, int64(stored[k]))
                    if max(least - half, 0.0) > math.sqrt(float(largest)) * spacing:
                        continue
                    for k in range(VERTICES):
                        u = (column * TILE + k % (TILE + 1)) * spacing
                        v = (row * TILE + k // (TILE + 1)) * spacing
                        work[0, k], work[1, k], work[2, k] = x0 + u * c - v * s, y0 + u * s + v * c, most * spacing
                    for j in range(inner):
                        lower_points(all_shapes, numbers[1, j], work, int64(VERTICES))
                    for k in range(VERTICES):
                        nearest = work[2, k] / spacing
                        if nearest < most and nearest * nearest < stored[k]:
                            stored[k] = np.uint16(nearest * nearest)


@part
def fine_distance_anywhere(problem: Problem, x: float, y: float) -> float:
    """As `fine_distance`, of any point; -1 outside the fine field."""
    side = TILE / problem.scalar[FINE_INVERSE]
    dx, dy = x - problem.scalar[FINE_X], y - problem.scalar[FINE_Y]
    u = dx * problem.scalar[FINE_COS] + dy * problem.scalar[FINE_SIN]
    v = dy * problem.scalar[FINE_COS] - dx * problem.scalar[FINE_SIN]
    if 0.0 <= u < problem.tile.shape[1] * side and 0.0 <= v < problem.tile.shape[0] * side:
        return fine_distance(problem, x, y)
    return -1.0


@compiled
def raise_to_fine(problem: Problem, x: Floats, y: Floats, value: Floats) -> None:
    """Raise lower bounds (n,) of the distance from points to that of the fine field, m, where it is stored."""
    for k in range(len(x)):
        value[k] = max(value[k], fine_distance_anywhere(problem, x[k], y[k]))
