"""Geodesic cost-to-go: duration of the shortest path around the obstacles at top speed.

Solves the eikonal equation |grad d| = 1 over the free workspace by fast marching (Sethian, A fast marching level set
method for monotonically advancing fronts, 1996), second order where the stencil allows.  Cells that the body's
inscribed disc cannot occupy are obstacles.  Computed once per goal and map.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ompl_ext.arrays import Bools, Floats, Floats32, Ints32, Matrix, Matrix32, int64
from ompl_ext.jit import compiled, inlined
from ompl_ext.kernels.clearance import ClearanceField
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    BRAKING,
    GOAL_SPEED,
    GOAL_X,
    GOAL_Y,
    GRID_INVERSE,
    GRID_X,
    GRID_Y,
    TOP_SPEED,
    Problem,
)

CELLS_IN_ORDER = 300_000  # number of cells up to which the march takes exactly the nearest cell next
BUCKETS, BUCKETS_PER_CELL = 32, 8  # of the march in larger workspaces: distances below 1 / 8 cell apart are one bucket
UNREACHABLE = 1e9  # seconds; finite, so that interpolation and sorting stay well defined


class CostToGo(NamedTuple):
    """Cost-to-go `seconds[row, column]` at cell centres; `origin` is the lower left corner of cell (0, 0)."""

    seconds: Floats32
    origin: tuple[float, float]
    cell: float


def cost_to_go(
    field: ClearanceField,
    inscribed: float,
    goal: tuple[float, float],
    goal_radius: float,
    top_speed: float,
    bounds: tuple[tuple[float, float], tuple[float, float]] | None = None,
    most_in_order: int = CELLS_IN_ORDER,
) -> CostToGo:
    """Geodesic distance to the goal region divided by `top_speed`, on the clearance field's cells.

    A cell is blocked if each of its points is nearer to an obstacle than the `inscribed` radius (m), or if it lies
    outside the workspace's `bounds`.  Up to `most_in_order` cells are marched in the order of their distances.
    """
    best_in_cell = field.values + np.float32(field.cell * math.sqrt(2.0) + field.loss)
    blocked = best_in_cell < inscribed
    rows, columns = blocked.shape
    if bounds is not None:
        for axis, count, (low, high) in ((0, columns, bounds[0]), (1, rows, bounds[1])):
            left = field.origin[axis] + field.cell * np.arange(count)
            outside = (left + field.cell < low) | (left > high)
            blocked |= outside[None, :] if axis == 0 else outside[:, None]
    distance = np.full((rows, columns), math.inf)
    heap = np.empty(rows * columns * 4, dtype=np.int32)
    heap_index = np.full(rows * columns, -1, dtype=np.int32)
    goal_cell = (
        (goal[0] - field.origin[0]) / field.cell - 0.5,
        (goal[1] - field.origin[1]) / field.cell - 0.5,
    )
    march = _march if rows * columns <= most_in_order else _march_by_buckets
    march(distance, blocked, goal_cell[0], goal_cell[1], max(goal_radius / field.cell, 3.0), heap, heap_index)
    _extend(distance, blocked)
    seconds = np.maximum(distance * field.cell - goal_radius, 0.0) / top_speed
    return CostToGo(np.minimum(seconds, UNREACHABLE).astype(np.float32), field.origin, field.cell)


@inlined
def _sift_up(heap: Ints32, heap_index: Ints32, values: Floats, at: int) -> None:
    item = heap[at]
    value = values[item]
    while at > 0:
        parent = (at - 1) >> 1
        if values[heap[parent]] <= value:
            break
        heap[at] = heap[parent]
        heap_index[heap[at]] = at
        at = parent
    heap[at] = item
    heap_index[item] = at


@inlined
def _pop(heap: Ints32, heap_index: Ints32, values: Floats, size: int) -> int:
    top = heap[0]
    item = heap[size - 1]
    size -= 1
    value, at = values[item], 0
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and values[heap[child + 1]] < values[heap[child]]:
            child += 1
        if values[heap[child]] >= value:
            break
        heap[at] = heap[child]
        heap_index[heap[at]] = at
        at = child
    heap[at] = item
    heap_index[item] = at
    heap_index[top] = -2
    return int(top)


@inlined
def _upwind(
    values: Floats, done: Ints32, row: int, column: int, row_step: int, column_step: int
) -> tuple[float, float]:
    """Upwind value along one axis and the weight of its difference: (4 d1 - d2) / 3 and 9/4 if second order."""
    rows, columns = values.shape
    best, weight = math.inf, 1.0
    for sign in (-1, 1):
        r, c = row + sign * row_step, column + sign * column_step
        if 0 <= r < rows and 0 <= c < columns and done[r * columns + c] == -2 and values[r, c] < best:
            best, weight = values[r, c], 1.0
            r2, c2 = r + sign * row_step, c + sign * column_step
            if 0 <= r2 < rows and 0 <= c2 < columns and done[r2 * columns + c2] == -2 and values[r2, c2] <= best:
                best, weight = (4.0 * values[r, c] - values[r2, c2]) / 3.0, 2.25
    return best, weight


@inlined
def _eikonal(values: Floats, done: Ints32, row: int, column: int) -> float:
    a, wa = _upwind(values, done, row, column, 0, 1)
    b, wb = _upwind(values, done, row, column, 1, 0)
    if a == math.inf or b == math.inf:
        return a + 1.0 / math.sqrt(wa) if b == math.inf else b + 1.0 / math.sqrt(wb)
    # wa (d - a)^2 + wb (d - b)^2 = 1
    total = wa + wb
    mean = (wa * a + wb * b) / total
    discriminant = mean * mean - (wa * a * a + wb * b * b - 1.0) / total
    if discriminant < 0.0:
        return min(a + 1.0 / math.sqrt(wa), b + 1.0 / math.sqrt(wb))
    return mean + math.sqrt(discriminant)


@compiled
def _march(
    distance: Floats,
    blocked: Bools,
    goal_column: float,
    goal_row: float,
    exact: float,
    heap: Ints32,
    heap_index: Ints32,
) -> None:
    """Compute `distance`, in cells; within `exact` cells of the goal it is the straight distance."""
    rows, columns = distance.shape
    flat = distance.reshape(rows * columns)
    size = 0
    for row in range(rows):
        for column in range(columns):
            d = math.hypot(row - goal_row, column - goal_column)
            if d <= exact and not blocked[row, column]:
                distance[row, column] = d
                heap[size] = row * columns + column
                size += 1
                _sift_up(heap, heap_index, flat, size - 1)
    while size > 0:
        cell = _pop(heap, heap_index, flat, size)
        size -= 1
        row, column = cell // columns, cell % columns
        for k in range(4):
            r, c = row + (k == 0) - (k == 1), column + (k == 2) - (k == 3)
            if not (0 <= r < rows and 0 <= c < columns) or blocked[r, c] or heap_index[r * columns + c] == -2:
                continue
            d = _eikonal(distance, heap_index, r, c)
            if d < distance[r, c]:
                distance[r, c] = d
                if heap_index[r * columns + c] < 0:
                    heap[size] = r * columns + c
                    heap_index[r * columns + c] = size
                    size += 1
                _sift_up(heap, heap_index, flat, heap_index[r * columns + c])


@inlined
def _move(links: Ints32, bucket: Ints32, cells: int, cell: int, to: int) -> None:
    """Move a cell to a bucket, from the one that it is in if there is one; `to` is -2 for none.

    `links` has the next cell of each cell, the one before it, and the first cell of each bucket.
    """
    if bucket[cell] >= 0:
        after, before = links[cell], links[cells + cell]
        if before >= 0:
            links[before] = after
        else:
            links[2 * cells + bucket[cell]] = after
        if after >= 0:
            links[cells + after] = before
    bucket[cell] = to
    if to >= 0:
        first = links[2 * cells + to]
        links[cell], links[cells + cell] = first, -1
        if first >= 0:
            links[cells + first] = cell
        links[2 * cells + to] = cell


@inlined
def _lower_neighbours(distance: Floats, blocked: Bools, links: Ints32, bucket: Ints32, cell: int, current: int) -> int:
    """Lower the distances of the neighbours of a final cell; returns how many cells more are in buckets."""
    rows, columns = distance.shape
    row, column, added = cell // columns, cell % columns, 0
    for k in range(4):
        r, c = row + (k == 0) - (k == 1), column + (k == 2) - (k == 3)
        if not (0 <= r < rows and 0 <= c < columns) or blocked[r, c] or bucket[r * columns + c] == -2:
            continue
        d = _eikonal(distance, bucket, r, c)
        if d < distance[r, c]:
            distance[r, c] = d
            number = max(int(d * BUCKETS_PER_CELL), current) % BUCKETS
            added += 1 if bucket[r * columns + c] == -1 else 0
            if bucket[r * columns + c] != number:
                _move(links, bucket, rows * columns, r * columns + c, number)
    return added


@compiled
def _march_by_buckets(
    distance: Floats,
    blocked: Bools,
    goal_column: float,
    goal_row: float,
    exact: float,
    links: Ints32,
    bucket: Ints32,
) -> None:
    """Compute `distance` as `_march`, but take any cell of the nearest bucket next: linear in the number of cells.

    Yatziv, Bartesaghi and Sapiro, O(N) implementation of the fast marching algorithm, 2006.
    """
    rows, columns = distance.shape
    cells = rows * columns
    links[2 * cells : 2 * cells + BUCKETS] = -1
    low_row, high_row = max(int(goal_row - exact), 0), min(int(goal_row + exact) + 2, rows)
    low_column, high_column = max(int(goal_column - exact), 0), min(int(goal_column + exact) + 2, columns)
    for row in range(low_row, high_row):
        for column in range(low_column, high_column):
            d = math.hypot(row - goal_row, column - goal_column)
            if d <= exact and not blocked[row, column]:
                distance[row, column] = d
                bucket[row * columns + column] = -2
    waiting, current = 0, int(exact * BUCKETS_PER_CELL)
    for row in range(low_row, high_row):
        for column in range(low_column, high_column):
            if bucket[row * columns + column] == -2:
                waiting += _lower_neighbours(distance, blocked, links, bucket, row * columns + column, current)
    while waiting > 0:
        cell = int64(links[2 * cells + current % BUCKETS])
        if cell < 0:
            current += 1
            continue
        _move(links, bucket, cells, cell, -2)
        waiting += _lower_neighbours(distance, blocked, links, bucket, cell, current) - 1


@compiled
def _extend(distance: Floats, blocked: Bools) -> None:
    """Set blocked cells beside free ones to their best free neighbour's value, for finite interpolation."""
    rows, columns = distance.shape
    for row in range(rows):
        for column in range(columns):
            if blocked[row, column]:
                best = math.inf
                for r in range(max(row - 1, 0), min(row + 2, rows)):
                    for c in range(max(column - 1, 0), min(column + 2, columns)):
                        if not blocked[r, c]:
                            best = min(best, distance[r, c] + math.hypot(r - row, c - column))
                distance[row, column] = best


@inlined
def _between(grid: Matrix32, u: float, v: float) -> float:
    """Bilinear interpolation `u` columns and `v` rows from the centre of the first cell."""
    column, row = int(u), int(v)
    u, v = u - column, v - row
    low = grid[row, column] * (1.0 - u) + grid[row, column + 1] * u
    high = grid[row + 1, column] * (1.0 - u) + grid[row + 1, column + 1] * u
    return low * (1.0 - v) + high * v


@inlined
def seconds_to_goal(problem: Problem, x: float, y: float) -> float:
    """Bilinear interpolation of the cost-to-go at (x, y) (s); (x, y) must be inside the workspace."""
    togo, scalar = problem.togo, problem.scalar
    u = (x - scalar[GRID_X]) * scalar[GRID_INVERSE] - 0.5
    v = (y - scalar[GRID_Y]) * scalar[GRID_INVERSE] - 0.5
    return _between(togo, u, v)


@inlined
def value_anywhere(grid: Matrix32, scalar: Floats, x: float, y: float) -> float:
    """Bilinear interpolation of cost-to-go or clearance field at (x, y); beyond the border that of the border.

    A place that is not a number counts as the corner.
    """
    u = (x - scalar[GRID_X]) * scalar[GRID_INVERSE] - 0.5
    v = (y - scalar[GRID_Y]) * scalar[GRID_INVERSE] - 0.5
    u, v = min(max(0.0, u), grid.shape[1] - 2.0), min(max(0.0, v), grid.shape[0] - 2.0)
    return _between(grid, u, v)


@compiled
def descend(problem: Problem, around: Matrix, near: float, points: Matrix) -> int:
    """Go down the cost-to-go from the first of `points` (n, 2), each time by the best of the steps `around` (k, 2) (m).

    The descent ends `near` the goal's centre (m), or where no step leads down.  Returns the number of points, 0 if the
    cost-to-go is infinite at the first one.
    """
    togo, scalar, x, y, count = problem.togo, problem.scalar, points[0, 0], points[0, 1], 1
    left = value_anywhere(togo, scalar, x, y)
    if left >= UNREACHABLE:
        return 0
    while count < len(points):
        dx, dy = x - scalar[GOAL_X], y - scalar[GOAL_Y]
        if math.sqrt(dx * dx + dy * dy) <= near:
            break
        best, least = 0, math.inf
        for k in range(len(around)):
            seconds = value_anywhere(togo, scalar, x + around[k, 0], y + around[k, 1])
            if seconds < least:
                best, least = k, seconds
        if least >= left:
            break  # within a cell of the goal region as the cost-to-go knows it
        x, y, left = x + around[best, 0], y + around[best, 1], least
        points[count, 0], points[count, 1] = x, y
        count += 1
    return count


@compiled
def smooth(points: Matrix, reach: int, smoothed: Matrix) -> None:
    """Write points (n, 2), each inner one as the mean of up to `reach` neighbours on both sides; the ends stay."""
    for k in range(len(points)):
        r = min(reach, k, len(points) - 1 - k)
        for axis in range(2):
            total = points[k - r, axis]
            for i in range(k - r + 1, k + r + 1):
                total += points[i, axis]
            smoothed[k, axis] = total / (2 * r + 1)


@inlined
def with_braking(scalar: Floats, seconds: float, speed: float) -> float:
    """Least time for as far as the top speed gets in `seconds`, at least the braking distance, ending at GOAL_SPEED.

    It ends more slowly where that speed cannot be reached on the way.
    """
    rate, top = scalar[BRAKING], scalar[TOP_SPEED]
    speed = min(speed, top)
    last = scalar[GOAL_SPEED]
    distance = max(seconds * top, (speed * speed - last * last) / (2.0 * rate))
    last = min(last, math.sqrt(speed * speed + 2.0 * rate * distance))
    peak = min(math.sqrt(rate * distance + 0.5 * (speed * speed + last * last)), top)
    last = min(last, peak)
    even = distance - (2.0 * peak * peak - speed * speed - last * last) / (2.0 * rate)
    return (2.0 * peak - speed - last) / rate + max(even, 0.0) / top
