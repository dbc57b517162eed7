"""The tree's two spatial indices: dominance-informed regions that contain a point, and the nearest better node.

*Regions.*  A node is listed on the level whose cell size is the smallest power of two above its region's radius, so
that the regions that contain a point are found in 3 x 3 cells per level.  A better node inside a region shrinks it;
hence no two nodes of a level are much closer than its cell size, and a cell lists a bounded number of nodes: the cost
of a query grows with the number of levels, not of nodes.

*Cells.*  A uniform grid in blocks of 8 x 8 cells; blocks and cells store the smallest f = cost-to-come + cost-to-go of
their nodes.  A search for the nearest better node begins in the 3 x 3 cells around the point, proceeds outward over
rings of blocks and skips every block and cell without a better node.

*Bounds of f.*  In a large tree a node is rarely in a cache, but the cells beside each other share a line of one.  So a
cell has a bound of f beside its first node: for regions of the largest, because only worse nodes are shrunk, for
positions of the smallest.

*Large workspaces.*  The cells keep their size, and the same memory is used for cells that lie a power of two apart: a
list may hold nodes of several far cells.  Every use compares distances, so that this changes nothing but the time, and
cells that few nodes share are as good as cells of their own.

*Closed nodes.*  A node whose region has shrunk below the tree's resolution has a better node right beside it.  It stays
in the tree but leaves both indices, which keeps their lists short, and its radius becomes 0.  In large trees the
resolution falls with the root of the number of nodes inserted, pruned ones included: it never rises again.
"""

from __future__ import annotations

import math

from ompl_ext.arrays import Floats, int64
from ompl_ext.jit import compiled, inlined, part
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    BLOCK_COLUMN_MASK,
    BLOCK_COLUMNS,
    BLOCK_ROW_MASK,
    BLOCK_ROWS,
    BLOCK_STRIDE,
    BOUND,
    CELL_NEXT,
    CELL_SIZE,
    CELLS_X,
    CELLS_Y,
    HEAD,
    LEVEL_COLUMN_MASK,
    LEVEL_COLUMNS,
    LEVEL_COUNT,
    LEVEL_ROW_MASK,
    LEVEL_ROWS,
    LEVEL_START,
    LEVEL_STRIDE,
    MOST_TICKS,
    Q_DIM,
    RADIUS,
    REGION_LEVEL,
    REGION_NEXT,
    REGION_PREVIOUS,
    TICKS,
    VISITS,
    F,
    Tree,
)
from ompl_ext.kernels.rng import uniform

BLOCK = 8  # cells along a block's side
NODES_AT_FULL_RESOLUTION = 100_000.0


@inlined
def clamp(value: int, count: int) -> int:
    """Nearest of 0 .. count - 1."""
    return min(max(value, 0), count - 1)


@part
def distance_squared(tree: Tree, node: int, q: Floats) -> float:
    """Squared distance between a node and a configuration, the first Q_DIM entries of `q`."""
    total = 0.0
    for k in range(Q_DIM):
        difference = tree.value[node, k] - q[k]
        total += difference * difference
    return total


@inlined
def stored_cell(tree: Tree, level: int, row: int, column: int) -> int:
    """Index in region_cells of a cell of a level."""
    row, column = row & tree.level[level, LEVEL_ROW_MASK], column & tree.level[level, LEVEL_COLUMN_MASK]
    return tree.level[level, LEVEL_START] + row * tree.level[level, LEVEL_STRIDE] + column


@inlined
def stored_block(tree: Tree, row: int, column: int) -> int:
    """Number of the block of cells in which those of a block are stored."""
    shape = tree.block_shape
    return (row & shape[BLOCK_ROW_MASK]) * shape[BLOCK_STRIDE] + (column & shape[BLOCK_COLUMN_MASK])


@inlined
def region_cell(tree: Tree, level: int, node: int) -> int:
    """Index in region_cells of the cell that contains a node's position."""
    size, columns, rows = (
        tree.level_cell[level],
        tree.level[level, LEVEL_COLUMNS],
        tree.level[level, LEVEL_ROWS],
    )
    column = clamp(int((tree.value[node, 0] - tree.frame[CELLS_X]) / size), columns)
    row = clamp(int((tree.value[node, 1] - tree.frame[CELLS_Y]) / size), rows)
    return stored_cell(tree, level, row, column)


@inlined
def ticks(f: float) -> float:
    """An f (s) in ticks, in which cells store bounds of it."""
    return min(f * TICKS, MOST_TICKS)


@inlined
def list_region(tree: Tree, node: int) -> None:
    """List a node on the level of its region's radius."""
    level = int64(0)
    while level < len(tree.level_cell) - 1 and tree.level_cell[level] < tree.value[node, RADIUS]:
        level += 1
    cell = region_cell(tree, level, node)
    head = int64(tree.region_cells[cell, HEAD]) - 1
    tree.link[node, REGION_LEVEL] = level
    tree.link[node, REGION_NEXT] = head
    tree.link[node, REGION_PREVIOUS] = -1
    if head >= 0:
        tree.link[head, REGION_PREVIOUS] = node
    tree.region_cells[cell, HEAD] = node + 1
    tree.region_cells[cell, BOUND] = max(int64(tree.region_cells[cell, BOUND]), int(ticks(tree.value[node, F])) + 1)
    tree.level[level, LEVEL_COUNT] += 1


@inlined
def unlist_region(tree: Tree, node: int) -> None:
    """Remove a node from its level's list."""
    level, before, after = (
        tree.link[node, REGION_LEVEL], tree.link[node, REGION_PREVIOUS], tree.link[node, REGION_NEXT],
    )  # fmt: skip
    if before >= 0:
        tree.link[before, REGION_NEXT] = after
    else:
        cell = region_cell(tree, level, node)
        tree.region_cells[cell, HEAD] = after + 1
        if after < 0:
            tree.region_cells[cell, BOUND] = 0
    if after >= 0:
        tree.link[after, REGION_PREVIOUS] = before
    tree.level[level, LEVEL_COUNT] -= 1


@inlined
def level_window(tree: Tree, level: int, q: Floats) -> tuple[int, int, int, int]:
    """The 3 x 3 cells of a level around a point: first and end row, first and end column."""
    size, columns, rows = (
        tree.level_cell[level],
        tree.level[level, LEVEL_COLUMNS],
        tree.level[level, LEVEL_ROWS],
    )
    column = clamp(int((q[0] - tree.frame[CELLS_X]) / size), columns)
    row = clamp(int((q[1] - tree.frame[CELLS_Y]) / size), rows)
    return max(row - 1, 0), min(row + 2, rows), max(column - 1, 0), min(column + 2, columns)


@inlined
def shrink_worse(tree: Tree, node: int, closed: float) -> None:
    """Shrink the region of every worse node whose region contains `node`; below radius `closed`, close that node."""
    better = ticks(tree.value[node, F])
    for level in range(len(tree.level_cell)):
        if tree.level[level, LEVEL_COUNT] == 0:
            continue
        first_row, end_row, first_column, end_column = level_window(tree, level, tree.value[node])
        for row in range(first_row, end_row):
            for column in range(first_column, end_column):
                cell = stored_cell(tree, level, row, column)
                if tree.region_cells[cell, BOUND] <= better:
                    continue  # none is worse
                other = int64(tree.region_cells[cell, HEAD]) - 1
                while other >= 0:
                    following = tree.link[other, REGION_NEXT]
                    if tree.value[other, F] > tree.value[node, F]:
                        distance = math.sqrt(distance_squared(tree, other, tree.value[node]))
                        if distance < tree.value[other, RADIUS]:
                            unlist_region(tree, other)
                            tree.value[other, RADIUS] = distance if distance >= closed else 0.0
                            if distance >= closed:
                                list_region(tree, other)
                    other = following


@part
def select(tree: Tree, q: Floats) -> int:
    """Least visited node whose region contains `q`, ties at random; the nearest node if there is none, else -1.

    Nodes that can no longer lead to a better plan are removed from the index of regions.
    """
    chosen, ties, fewest_visits = int64(-1), 0, int64(2**62)
    for level in range(len(tree.level_cell)):
        if tree.level[level, LEVEL_COUNT] == 0:
            continue
        first_row, end_row, first_column, end_column = level_window(tree, level, q)
        for row in range(first_row, end_row):
            for column in range(first_column, end_column):
                cell = stored_cell(tree, level, row, column)
                node = int64(tree.region_cells[cell, HEAD]) - 1
                while node >= 0:
                    following = tree.link[node, REGION_NEXT]
                    if tree.value[node, F] >= tree.best[0]:
                        unlist_region(tree, node)
                    elif distance_squared(tree, node, q) <= tree.value[node, RADIUS] * tree.value[node, RADIUS]:
                        visits = tree.link[node, VISITS]
                        if visits < fewest_visits:
                            fewest_visits, ties = visits, 0
                        if visits == fewest_visits:
                            ties += 1
                            if uniform(tree.random) * ties < 1.0:  # reservoir sampling
                                chosen = node
                    node = following
    if chosen < 0:
        chosen, _ = nearest_better(tree, q, tree.best[0], math.inf, 0.0)
    return chosen


@inlined
def gap_squared(x: float, y: float, left: float, bottom: float, size: float) -> float:
    """Squared distance from a point to a square, 0 inside."""
    dx = max(left - x, x - left - size, 0.0)
    dy = max(bottom - y, y - bottom - size, 0.0)
    return dx * dx + dy * dy


@inlined
def nearest_better_in_cell(
    tree: Tree, cell: int, q: Floats, f: float, node: int, best2: float, closed: float
) -> tuple[int, float]:
    """Update (node, squared distance) with the nodes of a cell; remove nodes closed since they were listed."""
    before, other = int64(-1), int64(tree.cells[cell, HEAD]) - 1
    while other >= 0 and best2 >= closed * closed:
        following = tree.link[other, CELL_NEXT]
        if tree.value[other, RADIUS] < closed:
            if before >= 0:
                tree.link[before, CELL_NEXT] = following
            else:
                tree.cells[cell, HEAD] = following + 1
        else:
            before = other
            if tree.value[other, F] < f:
                d2 = distance_squared(tree, other, q)
                if d2 < best2:
                    best2, node = d2, other
        other = following
    return node, best2


@inlined
def position_cell(tree: Tree, row: int, column: int) -> int:
    """Index in cells of a cell of positions."""
    block = stored_block(tree, row // BLOCK, column // BLOCK)
    return (block * BLOCK + row % BLOCK) * BLOCK + column % BLOCK


@inlined
def position_block(tree: Tree, row: int, column: int) -> int:
    """Index in block_bound of the block of a cell of positions."""
    return (row // BLOCK) * tree.block_shape[BLOCK_COLUMNS] + column // BLOCK


@inlined
def nearest_better_around(
    tree: Tree, q: Floats, f: float, center_row: int, center_column: int, best2: float, closed: float
) -> tuple[int, float]:
    """Nearest better node in the 3 x 3 cells around a point, and its squared distance; the center cell first."""
    size, node, cell = tree.frame[CELL_SIZE], int64(-1), position_cell(tree, center_row, center_column)
    rows, columns = tree.block_shape[BLOCK_ROWS] * BLOCK, tree.block_shape[BLOCK_COLUMNS] * BLOCK
    below = MOST_TICKS - ticks(f)
    if tree.cells[cell, BOUND] > below:
        node, best2 = nearest_better_in_cell(tree, cell, q, f, node, best2, closed)
    for row in range(max(center_row - 1, 0), min(center_row + 2, rows)):
        for column in range(max(center_column - 1, 0), min(center_column + 2, columns)):
            cell = position_cell(tree, row, column)
            if tree.cells[cell, BOUND] > below and not (row == center_row and column == center_column):
                x, y = tree.frame[CELLS_X] + column * size, tree.frame[CELLS_Y] + row * size
                if gap_squared(q[0], q[1], x, y, size) < best2:
                    node, best2 = nearest_better_in_cell(tree, cell, q, f, node, best2, closed)
    return node, best2


@inlined
def nearest_better_in_block(
    tree: Tree, row: int, column: int, q: Floats, f: float, node: int, best2: float, closed: float
) -> tuple[int, float]:
    """Update (node, squared distance) with the nodes of a block of cells."""
    cell_size, first = tree.frame[CELL_SIZE], stored_block(tree, row, column) * BLOCK * BLOCK
    left, bottom = tree.frame[CELLS_X] + column * BLOCK * cell_size, tree.frame[CELLS_Y] + row * BLOCK * cell_size
    below = MOST_TICKS - ticks(f)
    for k in range(BLOCK * BLOCK):
        if tree.cells[first + k, BOUND] > below:
            x, y = left + (k % BLOCK) * cell_size, bottom + (k // BLOCK) * cell_size
            if gap_squared(q[0], q[1], x, y, cell_size) < best2:
                node, best2 = nearest_better_in_cell(tree, first + k, q, f, node, best2, closed)
    return node, best2


@inlined
def cell_of(tree: Tree, q: Floats) -> tuple[int, int]:
    """Row and column of the cell of positions that contains a configuration."""
    columns, rows = tree.block_shape[BLOCK_COLUMNS], tree.block_shape[BLOCK_ROWS]
    column = clamp(int((q[0] - tree.frame[CELLS_X]) / tree.frame[CELL_SIZE]), columns * BLOCK)
    row = clamp(int((q[1] - tree.frame[CELLS_Y]) / tree.frame[CELL_SIZE]), rows * BLOCK)
    return row, column


@inlined
def nearest_better(tree: Tree, q: Floats, f: float, limit: float, closed: float) -> tuple[int, float]:
    """Nearest listed node with f below `f` within `limit` m, and its distance; -1 and `limit` if there is none.

    A distance below `closed` need not be the smallest: any such distance closes the node.
    """
    columns, rows = tree.block_shape[BLOCK_COLUMNS], tree.block_shape[BLOCK_ROWS]
    size = BLOCK * tree.frame[CELL_SIZE]
    center_row, center_column = cell_of(tree, q)
    node, best2 = nearest_better_around(tree, q, f, center_row, center_column, limit * limit, closed)
    # all that is nearer is in those cells; in a large tree nearly always
    if best2 < tree.frame[CELL_SIZE] * tree.frame[CELL_SIZE]:
        return node, math.sqrt(best2)
    center_row, center_column, below = center_row // BLOCK, center_column // BLOCK, MOST_TICKS - ticks(f)
    for ring in range(max(columns, rows)):
        nearest = max((ring - 1) * size, 0.0)
        if nearest * nearest > best2 or best2 < closed * closed:
            break
        for row in range(max(center_row - ring, 0), min(center_row + ring, rows - 1) + 1):
            step = 1 if abs(row - center_row) == ring or ring == 0 else 2 * ring
            for column in range(center_column - ring, center_column + ring + 1, step):
                if column < 0 or column >= columns:
                    continue
                left, bottom = tree.frame[CELLS_X] + column * size, tree.frame[CELLS_Y] + row * size
                is_better = tree.block_bound[row * columns + column] > below
                if is_better and gap_squared(q[0], q[1], left, bottom, size) < best2:
                    node, best2 = nearest_better_in_block(tree, row, column, q, f, node, best2, closed)
    return node, math.sqrt(best2)


@inlined
def list_position(tree: Tree, node: int) -> None:
    """List a node in the cell of its position."""
    row, column = cell_of(tree, tree.value[node])
    cell = position_cell(tree, row, column)
    block = position_block(tree, row, column)
    bound = int(MOST_TICKS - ticks(tree.value[node, F])) + 1
    tree.link[node, CELL_NEXT] = tree.cells[cell, HEAD] - 1
    tree.cells[cell, HEAD] = node + 1
    tree.cells[cell, BOUND] = max(int64(tree.cells[cell, BOUND]), bound)
    tree.block_bound[block] = max(int64(tree.block_bound[block]), bound)


@compiled
def list_node(tree: Tree, node: int) -> None:
    """Add a node to both indices."""
    list_region(tree, node)
    list_position(tree, node)


@inlined
def add_to_indices(tree: Tree, node: int, limit: float, closed: float) -> None:
    """Set a node's region, up to `limit` or to the nearest better node, and shrink the regions of worse nodes to it."""
    _, tree.value[node, RADIUS] = nearest_better(tree, tree.value[node], tree.value[node, F], limit, closed)
    shrink_worse(tree, node, closed)
    if tree.value[node, RADIUS] >= closed:
        list_node(tree, node)
    else:
        tree.value[node, RADIUS] = 0.0


@inlined
def closed_radius(resolution: float, inserted: int) -> float:
    """Radius (m) below which a node is closed once the tree has had `inserted` nodes, pruned ones included."""
    return resolution * min(1.0, math.sqrt(NODES_AT_FULL_RESOLUTION / inserted))
