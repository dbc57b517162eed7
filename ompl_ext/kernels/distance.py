"""Exact distances to obstacles: from a lattice of points to shapes, and from a lattice of vertices to occupied cells.

*Shapes* are polygons and discs.  Points are treated in blocks: a shape that is farther from a block's centre than the
nearest one by more than the block's diagonal is nearest to no point of the block.  The result is the minimum over all
shapes, whatever their number.

*Cells.*  The squared distance to a set of squares is the minimum over their columns of (distance to the column)^2 +
(distance to the nearest square of the column)^2 (Felzenszwalb and Huttenlocher, Distance transforms of sampled
functions, 2012).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Bools, Floats, IntMatrix32, Ints, Ints32, Matrix, Words16Matrix, int64
from ompl_ext.jit import compiled, inlined
from ompl_ext.obstacles import Circle, Polygon

FAR = 65535  # cells; farther obstacles count as if they were so near
SUPERBLOCK, BLOCK = 64, 8  # points along the side of a block
ROUNDING = 1e-9  # of a distance (m), by which blocks keep shapes that are just too far


class Shapes(NamedTuple):
    """Polygons and discs: shape k is the polygon `points[start[k] : start[k + 1]]`, or a disc around its only point."""

    points: Matrix
    start: Ints
    radius: Floats


def shapes(obstacles: Sequence[Polygon | Circle]) -> Shapes:
    """Arrays of polygons and discs."""
    points = [np.reshape(o.center, (1, 2)) if isinstance(o, Circle) else np.asarray(o.vertices) for o in obstacles]
    stacked = np.ascontiguousarray(np.vstack([*points, np.zeros((0, 2))]), dtype=float)
    start = np.cumsum([0, *map(len, points)])
    return Shapes(stacked, start, np.array([o.radius if isinstance(o, Circle) else 0.0 for o in obstacles]))


def lower_to_shapes(distance: Matrix, xs: Floats, ys: Floats, obstacles: Sequence[Polygon | Circle]) -> None:
    """Lower `distance[row, column]` to the distance between (xs[column], ys[row]) and the nearest obstacle."""
    count = len(obstacles)
    if count:
        numbers = np.empty((3, count), np.int32)
        numbers[2] = np.arange(count)
        _lower(distance, xs, ys, shapes(obstacles), numbers, np.empty(count), np.empty((5, BLOCK * BLOCK)))


@inlined
def shape_distance(all_shapes: Shapes, shape: int, x: float, y: float) -> float:
    """Distance from a point to a filled shape, 0 inside."""
    points, first, end = all_shapes.points, all_shapes.start[shape], all_shapes.start[shape + 1]
    if end == first + 1:
        return max(math.hypot(x - points[first, 0], y - points[first, 1]) - all_shapes.radius[shape], 0.0)
    nearest, inside = math.inf, False
    ax, ay = points[end - 1, 0], points[end - 1, 1]
    for k in range(first, end):
        bx, by = points[k, 0], points[k, 1]
        ex, ey = bx - ax, by - ay
        t = min(max(((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey), 0.0), 1.0)
        dx, dy = x - ax - t * ex, y - ay - t * ey
        nearest = min(nearest, dx * dx + dy * dy)
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * ex:
            inside = not inside
        ax, ay = bx, by
    return 0.0 if inside else math.sqrt(nearest)


@inlined
def lower_points(all_shapes: Shapes, shape: int, work: Matrix, count: int) -> None:
    """Lower distances to that to a shape: rows of `work` are x, y and distance of `count` points, and working memory.

    The same as `shape_distance` of each point; the loops over the points vectorise.
    """
    points, first, end = all_shapes.points, all_shapes.start[shape], all_shapes.start[shape + 1]
    xs, ys, least, near, inside = work[0], work[1], work[2], work[3], work[4]
    if end == first + 1:
        for i in range(count):
            gap = max(math.hypot(xs[i] - points[first, 0], ys[i] - points[first, 1]) - all_shapes.radius[shape], 0.0)
            least[i] = min(least[i], gap)
        return
    for i in range(count):
        near[i], inside[i] = math.inf, 0.0
    ax, ay = points[end - 1, 0], points[end - 1, 1]
    for k in range(first, end):
        bx, by = points[k, 0], points[k, 1]
        ex, ey = bx - ax, by - ay
        length2, rise = ex * ex + ey * ey, by - ay
        for i in range(count):
            x, y = xs[i], ys[i]
            t = ((x - ax) * ex + (y - ay) * ey) / length2
            t = t if t > 0.0 else 0.0
            t = t if t < 1.0 else 1.0
            dx, dy = x - ax - t * ex, y - ay - t * ey
            square = dx * dx + dy * dy
            near[i] = square if square < near[i] else near[i]
            crosses = ((ay > y) != (by > y)) & (x < ax + (y - ay) / rise * ex)
            inside[i] = 1.0 - inside[i] if crosses else inside[i]
        ax, ay = bx, by
    for i in range(count):
        gap = 0.0 if inside[i] == 1.0 else math.sqrt(near[i])
        least[i] = gap if gap < least[i] else least[i]


@inlined
def near_shapes(
    all_shapes: Shapes, x: float, y: float, half: float, given: Ints32, count: int, chosen: Ints32, gap: Floats
) -> int:
    """Choose, of `count` given shapes, those that may be nearest to a point within `half` m of (x, y); their number."""
    least = math.inf
    for k in range(count):
        gap[k] = shape_distance(all_shapes, given[k], x, y)
        least = min(least, gap[k])
    kept = 0
    for k in range(count):
        if gap[k] <= least + 2.0 * half + ROUNDING:
            chosen[kept] = given[k]
            kept += 1
    return kept


@compiled
def _lower(
    distance: Matrix, xs: Floats, ys: Floats, all_shapes: Shapes, numbers: IntMatrix32, gap: Floats, work: Matrix
) -> None:
    """Distances block by block; `numbers` (3, shapes) are those of blocks, of blocks within them, and all."""
    rows, columns = distance.shape
    half_x, half_y = 0.5 * (xs[-1] - xs[0]) / max(columns - 1, 1), 0.5 * (ys[-1] - ys[0]) / max(rows - 1, 1)
    count = len(all_shapes.radius)
    for top in range(0, rows, SUPERBLOCK):
        for left in range(0, columns, SUPERBLOCK):
            bottom, right = min(top + SUPERBLOCK, rows), min(left + SUPERBLOCK, columns)
            x, y = 0.5 * (xs[left] + xs[right - 1]), 0.5 * (ys[top] + ys[bottom - 1])
            half = math.hypot(half_x * (right - left), half_y * (bottom - top))
            outer = near_shapes(all_shapes, x, y, half, numbers[2], count, numbers[0], gap)
            for row0 in range(top, bottom, BLOCK):
                for column0 in range(left, right, BLOCK):
                    row1, column1 = min(row0 + BLOCK, bottom), min(column0 + BLOCK, right)
                    x, y = 0.5 * (xs[column0] + xs[column1 - 1]), 0.5 * (ys[row0] + ys[row1 - 1])
                    half = math.hypot(half_x * (column1 - column0), half_y * (row1 - row0))
                    inner = near_shapes(all_shapes, x, y, half, numbers[0], outer, numbers[1], gap)
                    width = column1 - column0
                    for row in range(row0, row1):
                        for column in range(column0, column1):
                            at = (row - row0) * width + column - column0
                            work[0, at], work[1, at], work[2, at] = xs[column], ys[row], distance[row, column]
                    for k in range(inner):
                        lower_points(all_shapes, numbers[1, k], work, (row1 - row0) * width)
                    for row in range(row0, row1):
                        for column in range(column0, column1):
                            distance[row, column] = work[2, (row - row0) * width + column - column0]


@compiled
def count_free_cells(occupied: Bools, above: Words16Matrix, below: Words16Matrix) -> None:
    """Number of free cells between each cell and the next occupied one above and below in its column, at most FAR."""
    rows, columns = occupied.shape
    for row in range(rows):
        for column in range(columns):
            before = FAR - 1 if row == 0 else min(int64(below[row - 1, column]), FAR - 1)
            below[row, column] = 0 if occupied[row, column] else before + 1
    for row in range(rows - 1, -1, -1):
        for column in range(columns):
            after = FAR - 1 if row == rows - 1 else min(int64(above[row + 1, column]), FAR - 1)
            above[row, column] = 0 if occupied[row, column] else after + 1


@inlined
def column_distance(
    above: Words16Matrix, below: Words16Matrix, divisions: int, row: int, inside: int, column: int
) -> int:
    """Distance from a row of the lattice to the nearest occupied cell of a column, in spacings of the lattice.

    The row is `inside` spacings above the lower side of the cells' row `row`; the lattice divides the side of a cell
    into `divisions`.  Occupied cells are closed squares.
    """
    nearest = int64(FAR) * divisions
    if row < len(above):
        up = int64(above[row, column])
        nearest = 0 if up == 0 else up * divisions - inside
    if row > 0:
        nearest = min(nearest, int64(below[row - 1, column]) * divisions + inside)
    return nearest


@compiled
def squares_at_vertices(
    above: Words16Matrix,
    below: Words16Matrix,
    divisions: int,
    every: int,
    squares: Matrix,
    height: Floats,
    hull: Ints,
    cut: Floats,
) -> None:
    """Squared distance from every `every`-th vertex of the lattice to the occupied cells, in squared spacings.

    For each row, the lower envelope of one parabola per boundary between columns, with the smaller of its two columns'
    distances.  `height`, `hull` and `cut` are working memory, longer than the number of columns by 2.
    """
    columns = above.shape[1]
    for row in range(squares.shape[0]):
        of_cells, inside = row * every // divisions, row * every % divisions
        count, before = int64(0), math.inf
        for k in range(columns + 1):
            after = math.inf
            if k < columns:
                after = float(column_distance(above, below, divisions, of_cells, inside, k))
            height[k] = min(before, after) ** 2
            before = after
            position = float(k * divisions)
            while count > 0:
                last = hull[count - 1]
                other = float(last * divisions)
                meet = 0.5 * (height[k] - height[last]) / (position - other) + 0.5 * (position + other)
                if meet > cut[count - 1]:
                    break
                count -= 1
            cut[count] = -math.inf if count == 0 else meet
            hull[count] = k
            count += 1
        at = int64(0)
        for column in range(squares.shape[1]):
            x = column * every
            while at + 1 < count and cut[at + 1] <= x:
                at += 1
            off = float(x - hull[at] * divisions)
            squares[row, column] = height[hull[at]] + off * off
            if x % divisions != 0:  # above or below an occupied cell, between its corners
                straight = float(column_distance(above, below, divisions, of_cells, inside, x // divisions))
                squares[row, column] = min(squares[row, column], straight * straight)


@inlined
def interpolated(a: float, b: float, s00: float, s01: float, s10: float, s11: float) -> float:
    """Lower bound of the squared distance at (a, b) in a unit square with the squared distances of its corners.

    The squared distance to a set minus x^2 + y^2 is a minimum of linear functions, hence concave, and a concave
    function is nowhere below the interpolation of its values.
    """
    low, high = s00 + a * (s01 - s00), s10 + a * (s11 - s10)
    return low + b * (high - low) - a * (1.0 - a) - b * (1.0 - b)
