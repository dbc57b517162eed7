"""The tree's two spatial indices: which dominance-informed regions hold a point, and which node near it is better.

*Regions.*  A node is listed on the level whose cell size is the smallest power of two above its region's radius, so
the regions that hold a point are found in 3 x 3 cells a level.  A better node inside a region shrinks it, hence no
two nodes of one level are much closer than its cell size and a cell lists a bounded number: a query costs the number
of levels, not of nodes.

*Cells.*  A uniform grid of all nodes in blocks of 8 x 8 cells; blocks and cells keep the smallest f = cost-to-come +
cost-to-go they hold.  A search for the nearest better node walks outward over rings of blocks and skips every block
and cell that holds none.
"""

from __future__ import annotations

import math

import numpy as np

from ompl_ext.arrays import Floats, Words
from ompl_ext.jit import inlined
from ompl_ext.kernel_types import BEST, CLOSEST, NEXT, Q_DIM, RADIUS, SIZE, F, Tree
from ompl_ext.rng import generator, uniform

REGION_CELL = 0.01
POSITION_CELL = 0.02
BLOCK = 8


def new_tree(capacity: int, nx: int, nu: int, bounds: tuple[tuple[float, float], tuple[float, float]]) -> Tree:
    """Empty tree for `capacity` nodes over a workspace with `bounds`; call `reset` before use."""
    (x_low, x_high), (y_low, y_high) = bounds
    width, height = x_high - x_low, y_high - y_low
    levels, cell_sizes, start = [], [], 0
    cell = max(REGION_CELL, math.sqrt(width * height / 250_000))
    while True:
        columns, rows = math.floor(width / cell) + 1, math.floor(height / cell) + 1
        levels.append((start, columns, rows))
        cell_sizes.append(cell)
        start += columns * rows
        if columns == rows == 1:
            break
        cell *= 2
    position_cell = max(POSITION_CELL, math.sqrt(width * height / 250_000))
    blocks = tuple(math.floor(extent / (BLOCK * position_cell)) + 1 for extent in (width, height))
    cells = blocks[0] * blocks[1] * BLOCK * BLOCK
    return Tree(
        state=np.zeros((capacity, nx)),
        control=np.zeros((capacity, nu)),
        duration=np.zeros(capacity),
        parent=np.full(capacity, -1, np.int32),
        at_goal=np.zeros(capacity, np.int32),
        hot=np.zeros((capacity, 8)),
        region_level=np.zeros(capacity, np.int32),
        region_next=np.zeros(capacity, np.int32),
        region_previous=np.zeros(capacity, np.int32),
        region_head=np.full(start, -1, np.int32),
        level_at=np.array(levels),
        level_cell=np.array(cell_sizes),
        level_count=np.zeros(len(levels), np.int64),
        cell_next=np.zeros(capacity, np.int32),
        cell_head=np.full(cells, -1, np.int32),
        cell_best=np.full(cells, math.inf),
        block_best=np.full(blocks[0] * blocks[1], math.inf),
        block_shape=np.array(blocks),
        frame=np.array([x_low, y_low, position_cell]),
        random=generator(0),
        count=np.zeros(9, np.int64),
        best=np.full(2, math.inf),
    )


def reset(tree: Tree, random: Words) -> None:
    """Empty the tree for a new query; its memory is reused."""
    tree.count[:] = 0
    tree.count[[BEST, CLOSEST, NEXT]] = -1
    tree.best[:] = math.inf
    tree.random[:] = random
    tree.region_head[:] = -1
    tree.level_count[:] = 0
    tree.cell_head[:] = -1
    tree.cell_best[:] = math.inf
    tree.block_best[:] = math.inf


@inlined
def clamp(value: int, count: int) -> int:
    return min(max(value, 0), count - 1)


@inlined
def distance_squared(tree: Tree, node: int, q: Floats) -> float:
    """Squared distance between a node and a configuration, whose first Q_DIM entries are `q`."""
    total = 0.0
    for k in range(Q_DIM):
        difference = tree.hot[node, k] - q[k]
        total += difference * difference
    return total


@inlined
def region_cell(tree: Tree, level: int, node: int) -> int:
    column = clamp(int((tree.hot[node, 0] - tree.frame[0]) / tree.level_cell[level]), tree.level_at[level, 1])
    row = clamp(int((tree.hot[node, 1] - tree.frame[1]) / tree.level_cell[level]), tree.level_at[level, 2])
    return tree.level_at[level, 0] + row * tree.level_at[level, 1] + column


@inlined
def list_region(tree: Tree, node: int) -> None:
    """List a node on the level of its region's radius."""
    level = 0
    while level < len(tree.level_cell) - 1 and tree.level_cell[level] < tree.hot[node, RADIUS]:
        level += 1
    cell = region_cell(tree, level, node)
    head = tree.region_head[cell]
    tree.region_level[node] = level
    tree.region_next[node] = head
    tree.region_previous[node] = -1
    if head >= 0:
        tree.region_previous[head] = node
    tree.region_head[cell] = node
    tree.level_count[level] += 1


@inlined
def unlist_region(tree: Tree, node: int) -> None:
    level, before, after = tree.region_level[node], tree.region_previous[node], tree.region_next[node]
    if before >= 0:
        tree.region_next[before] = after
    else:
        tree.region_head[region_cell(tree, level, node)] = after
    if after >= 0:
        tree.region_previous[after] = before
    tree.level_count[level] -= 1


@inlined
def shrink_worse(tree: Tree, node: int, floor2: float) -> None:
    """Shrink the region of every node that the new `node` lies in and is better than."""
    f = tree.hot[node, F]
    q = tree.hot[node]
    for level in range(len(tree.level_cell)):
        if tree.level_count[level] == 0:
            continue
        size, columns, rows = tree.level_cell[level], tree.level_at[level, 1], tree.level_at[level, 2]
        column = clamp(int((q[0] - tree.frame[0]) / size), columns)
        row = clamp(int((q[1] - tree.frame[1]) / size), rows)
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                other = tree.region_head[tree.level_at[level, 0] + r * columns + c]
                while other >= 0:
                    following = tree.region_next[other]
                    if tree.hot[other, F] > f:
                        d2 = distance_squared(tree, other, q)
                        if d2 < tree.hot[other, RADIUS] * tree.hot[other, RADIUS]:
                            unlist_region(tree, other)
                            tree.hot[other, RADIUS] = math.sqrt(d2)
                            if d2 >= floor2:
                                list_region(tree, other)
                    other = following


@inlined
def select(tree: Tree, q: Floats) -> int:
    """A node whose region holds `q`, each of them equally likely; the nearest node if there is none."""
    chosen, seen = -1, 0
    bound = tree.best[0]
    for level in range(len(tree.level_cell)):
        if tree.level_count[level] == 0:
            continue
        size, columns, rows = tree.level_cell[level], tree.level_at[level, 1], tree.level_at[level, 2]
        column = clamp(int((q[0] - tree.frame[0]) / size), columns)
        row = clamp(int((q[1] - tree.frame[1]) / size), rows)
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                node = tree.region_head[tree.level_at[level, 0] + r * columns + c]
                while node >= 0:
                    following = tree.region_next[node]
                    if tree.hot[node, F] >= bound:
                        unlist_region(tree, node)  # cannot lead to a better plan any more
                    elif distance_squared(tree, node, q) <= tree.hot[node, RADIUS] * tree.hot[node, RADIUS]:
                        seen += 1
                        if uniform(tree.random) * seen < 1.0:  # reservoir sampling
                            chosen = node
                    node = following
    if chosen < 0:
        chosen = nearest_better(tree, q, bound, math.inf, 0.0)[0]
    return chosen


@inlined
def gap_squared(value_x: float, value_y: float, left: float, bottom: float, size: float) -> float:
    """Squared distance from a point to a square cell, 0 inside."""
    dx = max(max(left - value_x, value_x - left - size), 0.0)
    dy = max(max(bottom - value_y, value_y - bottom - size), 0.0)
    return dx * dx + dy * dy


@inlined
def nearest_better_in_block(tree: Tree, block: int, q: Floats, f: float, node: int, best2: float, floor2: float) -> tuple[int, float]:
    """Improve (node, best2) by the nodes of one block with f below `f`."""
    size = tree.frame[2]
    left = tree.frame[0] + (block % tree.block_shape[0]) * BLOCK * size
    bottom = tree.frame[1] + (block // tree.block_shape[0]) * BLOCK * size
    for inner in range(BLOCK * BLOCK):
        cell = block * BLOCK * BLOCK + inner
        if tree.cell_best[cell] < f:
            if gap_squared(q[0], q[1], left + (inner % BLOCK) * size, bottom + (inner // BLOCK) * size, size) < best2:
                before, other = -1, tree.cell_head[cell]
                while other >= 0:
                    following = tree.cell_next[other]
                    if tree.hot[other, RADIUS] * tree.hot[other, RADIUS] < floor2:  # closed since it was listed
                        if before >= 0:
                            tree.cell_next[before] = following
                        else:
                            tree.cell_head[cell] = following
                    else:
                        before = other
                        if tree.hot[other, F] < f:
                            d2 = distance_squared(tree, other, q)
                            if d2 < best2:
                                best2, node = d2, other
                                if best2 < floor2:
                                    return node, best2
                    other = following
    return node, best2


@inlined
def nearest_better(tree: Tree, q: Floats, f: float, limit: float, floor2: float) -> tuple[int, float]:
    """The nearest node with f below `f` within `limit` m, and its distance; -1 and `limit` if there is none."""
    columns, rows = tree.block_shape[0], tree.block_shape[1]
    size = BLOCK * tree.frame[2]
    column = clamp(int((q[0] - tree.frame[0]) / size), columns)
    row = clamp(int((q[1] - tree.frame[1]) / size), rows)
    best2, node = limit * limit, -1
    for ring in range(max(columns, rows)):
        nearest = max((ring - 1) * size, 0.0)
        if nearest * nearest > best2 or best2 < floor2:
            break
        for r in range(max(row - ring, 0), min(row + ring, rows - 1) + 1):
            step = 1 if abs(r - row) == ring or ring == 0 else 2 * ring
            for c in range(column - ring, column + ring + 1, step):
                if 0 <= c < columns and tree.block_best[r * columns + c] < f:
                    if gap_squared(q[0], q[1], tree.frame[0] + c * size, tree.frame[1] + r * size, size) < best2:
                        node, best2 = nearest_better_in_block(tree, r * columns + c, q, f, node, best2, floor2)
    return node, math.sqrt(best2)


@inlined
def add_to_cells(tree: Tree, node: int) -> None:
    columns, rows = tree.block_shape[0], tree.block_shape[1]
    column = clamp(int((tree.hot[node, 0] - tree.frame[0]) / tree.frame[2]), columns * BLOCK)
    row = clamp(int((tree.hot[node, 1] - tree.frame[1]) / tree.frame[2]), rows * BLOCK)
    block = (row // BLOCK) * columns + column // BLOCK
    cell = block * BLOCK * BLOCK + (row % BLOCK) * BLOCK + column % BLOCK
    tree.cell_next[node] = tree.cell_head[cell]
    tree.cell_head[cell] = node
    tree.cell_best[cell] = min(tree.cell_best[cell], tree.hot[node, F])
    tree.block_best[block] = min(tree.block_best[block], tree.hot[node, F])


@inlined
def is_full(tree: Tree) -> bool:
    return tree.count[SIZE] >= len(tree.parent)
