"""The tree's two spatial indices: which dominance-informed regions hold a point, and which node near it is better.

*Regions.*  A node is listed on the level whose cell size is the smallest power of two above its region's radius, so
the regions that hold a point are found in 3 x 3 cells a level.  A better node inside a region shrinks it, hence no
two nodes of one level are much closer than its cell size and a cell lists a bounded number: a query costs the number
of levels, not of nodes.

*Cells.*  A uniform grid in blocks of 8 x 8 cells; blocks and cells keep the smallest f = cost-to-come + cost-to-go
they hold.  A search for the nearest better node walks outward over rings of blocks and skips every block and cell
that holds none.

*Closed nodes.*  A node whose region has shrunk below the tree's resolution has a better node right beside it.  It stays
in the tree but leaves both indices, which keeps their lists short.  The resolution falls with the square root of the
number of nodes, so no region of positive size stays closed off as the tree grows.
"""

from __future__ import annotations

import math

import numpy as np

from ompl_ext.arrays import Bools, Floats, Ints, Words, int64
from ompl_ext.jit import helper, inlined
from ompl_ext.kernel_types import (
    AT_GOAL,
    BEST,
    CELL_NEXT,
    CLOSEST,
    COST,
    COUNTS,
    FULL,
    LANE_WIDTH,
    LEVEL_COLUMNS,
    LEVEL_COUNT,
    LEVEL_ROWS,
    LEVEL_START,
    NEXT,
    PARENT,
    Q_DIM,
    RADIUS,
    REGION_LEVEL,
    REGION_NEXT,
    REGION_PREVIOUS,
    SIZE,
    TOGO,
    VISITS,
    F,
    Lanes,
    Tree,
)  # fmt: skip
from ompl_ext.rng import uniform

REGION_CELL = 0.01  # cell size of the finest level (m)
POSITION_CELL = 0.02  # size of a cell (m)
BLOCK = 8  # cells along a block's side
NODES_AT_FULL_RESOLUTION = 20_000.0
MOST_CELLS = 250_000  # in either index: larger workspaces get larger cells


def new_tree(capacity: int, nx: int, nu: int, bounds: tuple[tuple[float, float], tuple[float, float]]) -> Tree:
    """Empty tree for `capacity` nodes of `nx` states and `nu` controls over a workspace with `bounds`.

    Call `reset` before use.
    """
    (x_low, x_high), (y_low, y_high) = bounds
    width, height = x_high - x_low, y_high - y_low
    smallest = math.sqrt(width * height / MOST_CELLS)
    start, size = 0, max(REGION_CELL, smallest)
    levels: list[list[int]] = []
    sizes: list[float] = []
    while not levels or levels[-1][LEVEL_COLUMNS] * levels[-1][LEVEL_ROWS] > 1:
        columns, rows = math.floor(width / size) + 1, math.floor(height / size) + 1
        levels.append([start, columns, rows, 0])
        sizes.append(size)
        start, size = start + columns * rows, size * 2
    cell = max(POSITION_CELL, smallest)
    blocks = [math.floor(extent / (BLOCK * cell)) + 1 for extent in (width, height)]
    cells = blocks[0] * blocks[1] * BLOCK * BLOCK
    return Tree(
        state=np.zeros((capacity, nx)),
        edge=np.zeros((capacity, nu + 1)),
        hot=np.zeros((capacity, 8)),
        link=np.zeros((capacity, 7), np.int64),
        region_head=np.full(start, -1, np.int32),
        level=np.array(levels),
        level_cell=np.array(sizes),
        cell_head=np.full(cells, -1, np.int32),
        cell_best=np.full(cells, math.inf),
        block_best=np.full(blocks[0] * blocks[1], math.inf),
        block_shape=np.array(blocks),
        frame=np.array([x_low, y_low, cell]),
        count=np.zeros(COUNTS, np.int64),
        best=np.full(2, math.inf),
        random=np.zeros(1, np.uint64),
    )


def reset(tree: Tree, random: Words) -> None:
    """Empty the tree for a new query; its memory is reused."""
    tree.count[:] = 0
    tree.count[[BEST, CLOSEST, NEXT]] = -1
    tree.best[:] = math.inf
    tree.random[:] = random
    reset_indices(tree)


def reset_indices(tree: Tree) -> None:
    """Empty both indices."""
    tree.region_head[:] = -1
    tree.level[:, LEVEL_COUNT] = 0
    tree.cell_head[:] = -1
    tree.cell_best[:] = math.inf
    tree.block_best[:] = math.inf


@inlined
def clamp(value: int, count: int) -> int:
    """The nearest of 0 .. count - 1."""
    return min(max(value, 0), count - 1)


@helper
def distance_squared(tree: Tree, node: int, q: Floats) -> float:
    """Squared distance between a node and a configuration, the first Q_DIM entries of `q`."""
    total = 0.0
    for k in range(Q_DIM):
        difference = tree.hot[node, k] - q[k]
        total += difference * difference
    return total


@inlined
def region_cell(tree: Tree, level: int, node: int) -> int:
    """Place in region_head of the cell that a node's position lies in."""
    size, columns, rows = (
        tree.level_cell[level],
        tree.level[level, LEVEL_COLUMNS],
        tree.level[level, LEVEL_ROWS],
    )
    column = clamp(int((tree.hot[node, 0] - tree.frame[0]) / size), columns)
    row = clamp(int((tree.hot[node, 1] - tree.frame[1]) / size), rows)
    return tree.level[level, LEVEL_START] + row * columns + column


@inlined
def list_region(tree: Tree, node: int) -> None:
    """List a node on the level of its region's radius."""
    level = int64(0)
    while level < len(tree.level_cell) - 1 and tree.level_cell[level] < tree.hot[node, RADIUS]:
        level += 1
    cell = region_cell(tree, level, node)
    head = int64(tree.region_head[cell])
    tree.link[node, REGION_LEVEL] = level
    tree.link[node, REGION_NEXT] = head
    tree.link[node, REGION_PREVIOUS] = -1
    if head >= 0:
        tree.link[head, REGION_PREVIOUS] = node
    tree.region_head[cell] = node
    tree.level[level, LEVEL_COUNT] += 1


@inlined
def unlist_region(tree: Tree, node: int) -> None:
    """Take a node off its level's list."""
    level, before, after = (
        tree.link[node, REGION_LEVEL], tree.link[node, REGION_PREVIOUS], tree.link[node, REGION_NEXT],
    )  # fmt: skip
    if before >= 0:
        tree.link[before, REGION_NEXT] = after
    else:
        tree.region_head[region_cell(tree, level, node)] = after
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
    column = clamp(int((q[0] - tree.frame[0]) / size), columns)
    row = clamp(int((q[1] - tree.frame[1]) / size), rows)
    return max(row - 1, 0), min(row + 2, rows), max(column - 1, 0), min(column + 2, columns)


@inlined
def shrink_worse(tree: Tree, node: int, closed: float) -> None:
    """Shrink the region of every worse node that `node` lies in; below radius `closed` the region is given up."""
    for level in range(len(tree.level_cell)):
        if tree.level[level, LEVEL_COUNT] == 0:
            continue
        first_row, end_row, first_column, end_column = level_window(tree, level, tree.hot[node])
        for row in range(first_row, end_row):
            for column in range(first_column, end_column):
                cell = tree.level[level, LEVEL_START] + row * tree.level[level, LEVEL_COLUMNS] + column
                other = int64(tree.region_head[cell])
                while other >= 0:
                    following = tree.link[other, REGION_NEXT]
                    if tree.hot[other, F] > tree.hot[node, F]:
                        distance = math.sqrt(distance_squared(tree, other, tree.hot[node]))
                        if distance < tree.hot[other, RADIUS]:
                            unlist_region(tree, other)
                            tree.hot[other, RADIUS] = distance
                            if distance >= closed:
                                list_region(tree, other)
                    other = following


@helper
def select(tree: Tree, q: Floats) -> int:
    """The least visited node whose region holds `q`, ties by lot; the nearest node if there is none.

    Nodes that cannot lead to a better plan any more are taken off the index on the way; -1 if no others are left.
    """
    chosen, seen, fewest = int64(-1), 0, int64(2**62)
    for level in range(len(tree.level_cell)):
        if tree.level[level, LEVEL_COUNT] == 0:
            continue
        first_row, end_row, first_column, end_column = level_window(tree, level, q)
        for row in range(first_row, end_row):
            for column in range(first_column, end_column):
                cell = tree.level[level, LEVEL_START] + row * tree.level[level, LEVEL_COLUMNS] + column
                node = int64(tree.region_head[cell])
                while node >= 0:
                    following = tree.link[node, REGION_NEXT]
                    if tree.hot[node, F] >= tree.best[0]:
                        unlist_region(tree, node)
                    elif distance_squared(tree, node, q) <= tree.hot[node, RADIUS] * tree.hot[node, RADIUS]:
                        visits = tree.link[node, VISITS]
                        if visits < fewest:
                            fewest, seen = visits, 0
                        if visits == fewest:
                            seen += 1
                            if uniform(tree.random) * seen < 1.0:  # reservoir sampling
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
    """Improve (node, squared distance) by the nodes of one cell; nodes closed since they were listed are taken off."""
    before, other = int64(-1), int64(tree.cell_head[cell])
    while other >= 0 and best2 >= closed * closed:
        following = tree.link[other, CELL_NEXT]
        if tree.hot[other, RADIUS] < closed:
            if before >= 0:
                tree.link[before, CELL_NEXT] = following
            else:
                tree.cell_head[cell] = following
        else:
            before = other
            if tree.hot[other, F] < f:
                d2 = distance_squared(tree, other, q)
                if d2 < best2:
                    best2, node = d2, other
        other = following
    return node, best2


@inlined
def nearest_better(tree: Tree, q: Floats, f: float, limit: float, closed: float) -> tuple[int, float]:
    """The nearest listed node with f below `f` within `limit` m, and its distance; -1 and `limit` if there is none.

    A distance below `closed` need not be the smallest: it decides that the node is closed, whatever it is.
    """
    columns, rows = tree.block_shape[0], tree.block_shape[1]
    cell_size, size = tree.frame[2], BLOCK * tree.frame[2]
    center_column = clamp(int((q[0] - tree.frame[0]) / size), columns)
    center_row = clamp(int((q[1] - tree.frame[1]) / size), rows)
    best2, node = limit * limit, int64(-1)
    for ring in range(max(columns, rows)):
        nearest = max((ring - 1) * size, 0.0)
        if nearest * nearest > best2 or best2 < closed * closed:
            break
        for row in range(max(center_row - ring, 0), min(center_row + ring, rows - 1) + 1):
            step = 1 if abs(row - center_row) == ring or ring == 0 else 2 * ring
            for column in range(center_column - ring, center_column + ring + 1, step):
                if column < 0 or column >= columns:
                    continue
                block = row * columns + column
                left, bottom = tree.frame[0] + column * size, tree.frame[1] + row * size
                if tree.block_best[block] >= f or gap_squared(q[0], q[1], left, bottom, size) >= best2:
                    continue
                for k in range(BLOCK * BLOCK):
                    cell = block * BLOCK * BLOCK + k
                    if tree.cell_best[cell] < f:
                        x, y = left + (k % BLOCK) * cell_size, bottom + (k // BLOCK) * cell_size
                        if gap_squared(q[0], q[1], x, y, cell_size) < best2:
                            node, best2 = nearest_better_in_cell(tree, cell, q, f, node, best2, closed)
    return node, math.sqrt(best2)


@inlined
def list_position(tree: Tree, node: int) -> None:
    """List a node in the cell of its position."""
    columns, rows = tree.block_shape[0], tree.block_shape[1]
    column = clamp(int((tree.hot[node, 0] - tree.frame[0]) / tree.frame[2]), columns * BLOCK)
    row = clamp(int((tree.hot[node, 1] - tree.frame[1]) / tree.frame[2]), rows * BLOCK)
    block = (row // BLOCK) * columns + column // BLOCK
    cell = block * BLOCK * BLOCK + (row % BLOCK) * BLOCK + column % BLOCK
    tree.link[node, CELL_NEXT] = tree.cell_head[cell]
    tree.cell_head[cell] = node
    tree.cell_best[cell] = min(tree.cell_best[cell], tree.hot[node, F])
    tree.block_best[block] = min(tree.block_best[block], tree.hot[node, F])


@helper
def list_node(tree: Tree, node: int) -> None:
    """Put a node into both indices."""
    list_region(tree, node)
    list_position(tree, node)


@inlined
def add_to_indices(tree: Tree, node: int, limit: float, closed: float) -> None:
    """Give a node its region: up to `limit` or the nearest better node; worse nodes' regions shrink to it."""
    _, tree.hot[node, RADIUS] = nearest_better(tree, tree.hot[node], tree.hot[node, F], limit, closed)
    shrink_worse(tree, node, closed)
    if tree.hot[node, RADIUS] >= closed:
        list_node(tree, node)


@inlined
def closed_radius(resolution: float, size: int) -> float:
    """Radius (m) below which a node is closed in a tree of `size` nodes."""
    return resolution * min(1.0, math.sqrt(NODES_AT_FULL_RESOLUTION / size))


@helper
def relist(tree: Tree, closed: float) -> None:
    """List every node anew, after nodes have moved in memory; regions keep their radii."""
    for node in range(tree.count[SIZE]):
        if tree.hot[node, RADIUS] >= closed:
            list_node(tree, node)


def add_root(tree: Tree, work: Lanes) -> None:
    """Make the end of lane 0, which starts and ends in `work.source`, a root; its region is the whole workspace."""
    node = int(tree.count[SIZE])
    tree.state[node] = work.source
    tree.edge[node] = 0.0
    tree.hot[node, :Q_DIM] = work.end[: Q_DIM * LANE_WIDTH : LANE_WIDTH]
    tree.hot[node, [COST, TOGO, F, RADIUS]] = 0.0, work.togo[0], work.togo[0], math.inf
    tree.link[node] = -1
    tree.link[node, AT_GOAL] = work.at_goal[0]
    tree.link[node, VISITS] = 0
    if work.at_goal[0]:
        tree.best[0], tree.count[BEST] = 0.0, node
    tree.count[SIZE] += 1
    list_node(tree, node)


def prune(tree: Tree, closed: float) -> int:
    """Forget the nodes that can neither be selected again nor lead to a better plan, and return how many.

    These are the closed ones and those with f at or above the best cost, unless they lead to a node that is kept.
    """
    size = int(tree.count[SIZE])
    f, radius, parent = tree.hot[:size, F], tree.hot[:size, RADIUS], tree.link[:size, PARENT]
    keep = (f < tree.best[0]) & (radius >= closed)
    keep[parent < 0] = True
    for special in (BEST, CLOSEST, NEXT):
        if tree.count[special] >= 0:
            keep[tree.count[special]] = True
    _keep_ancestors(keep, parent)
    place = np.cumsum(keep) - 1
    kept = int(place[-1]) + 1
    for array in (tree.state, tree.edge, tree.hot, tree.link):
        array[:kept] = array[:size][keep]
    parents = tree.link[:kept, PARENT]
    tree.link[:kept, PARENT] = np.where(parents >= 0, place[parents], -1)
    for special in (BEST, CLOSEST, NEXT):
        if tree.count[special] >= 0:
            tree.count[special] = place[tree.count[special]]
    tree.count[SIZE] = kept
    tree.count[FULL] = 0
    reset_indices(tree)
    relist(tree, closed)
    return size - kept


@helper
def _keep_ancestors(keep: Bools, parent: Ints) -> None:
    for node in range(len(keep) - 1, 0, -1):  # children stand behind their parents
        if keep[node] and parent[node] >= 0:
            keep[parent[node]] = True


def path_to(tree: Tree, node: int) -> list[int]:
    """Nodes from the root to `node`."""
    path = []
    while node >= 0:
        path.append(node)
        node = int(tree.link[node, PARENT])
    return path[::-1]
