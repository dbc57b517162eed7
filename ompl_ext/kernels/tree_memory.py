"""The tree's memory: allocation, growth, reset for a new query, pruning, paths."""

from __future__ import annotations

import math
import mmap
import weakref
from collections import OrderedDict
from typing import Any

import numpy as np

from ompl_ext.arrays import Bools, Floats, IntMatrix32, Ints, Ints32, Matrix, Words, int64
from ompl_ext.jit import compiled, inlined
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    AT_GOAL,
    BEST,
    BOUND,
    CLOSEST,
    COST,
    COUNTS,
    FULL,
    HEAD,
    LANE_WIDTH,
    LEVEL_COLUMNS,
    LEVEL_COUNT,
    LEVEL_ROWS,
    NEXT,
    PARENT,
    PRUNED,
    Q_DIM,
    RADIUS,
    REGION_LEVEL,
    SIZE,
    TOGO,
    VISITS,
    F,
    Lanes,
    Tree,
)
from ompl_ext.kernels.tree import (  # fmt: skip
    BLOCK,
    add_to_indices,
    cell_of,
    closed_radius,
    distance_squared,
    list_node,
    position_block,
    position_cell,
    region_cell,
)

REGION_CELL = 0.01  # cell size of the finest level of regions (m)
POSITION_CELL = 0.02  # size of a cell of positions (m)
CAPACITY = 200_000  # nodes in the initial memory
MAX_NODES = 10_000_000  # limit of the growth: about 2 GB, minutes of a compiled search
MAX_CELLS = 250_000  # of each index with memory of their own; in larger workspaces cells share it
MAX_BLOCKS = 500_000  # of cells of positions; in workspaces above 12,800 m^2 these cells are larger
EVERY = 2**62 - 1  # mask of the number of a column or row that shares its memory with no other
HUGE_PAGE = 2**21  # bytes
CELLS_PER_NODE = 32  # cells are emptied one by one if there are this many times fewer nodes
LARGEST_REUSED = 2 * HUGE_PAGE  # bytes of an array whose memory is kept for the next tree
REUSED_SIZES, REUSED_PER_SIZE = 16, 4  # sizes of such arrays, and arrays of a size
_PER_NODE = ("state", "edge", "value", "link")
_unused: OrderedDict[int, list[mmap.mmap]] = OrderedDict()  # memory of arrays that exist no more, by its size


def new_tree(capacity: int, nx: int, nu: int, bounds: tuple[tuple[float, float], tuple[float, float]]) -> Tree:
    """Empty tree for `capacity` nodes of `nx` states and `nu` controls over a workspace with `bounds`.

    Call `reset` before use.
    """
    (x_low, x_high), (y_low, y_high) = bounds
    width, height = x_high - x_low, y_high - y_low
    start, size = 0, REGION_CELL
    levels: list[list[int]] = []
    sizes: list[float] = []
    while not levels or levels[-1][LEVEL_COLUMNS] * levels[-1][LEVEL_ROWS] > 1:
        columns, rows = math.floor(width / size) + 1, math.floor(height / size) + 1
        column_mask, row_mask, stride, stored = _storage(columns, rows, MAX_CELLS)
        levels.append([start, columns, rows, 0, column_mask, row_mask, stride])
        sizes.append(size)
        start, size = start + stored, size * 2
    cell = max(POSITION_CELL, math.sqrt(width * height / MAX_BLOCKS) / BLOCK)
    blocks = [math.floor(extent / (BLOCK * cell)) + 1 for extent in (width, height)]
    *how, stored = _storage(blocks[0], blocks[1], MAX_CELLS // (BLOCK * BLOCK))
    cells = stored * BLOCK * BLOCK
    return Tree(
        state=_in_huge_pages(capacity, nx, np.float64),
        edge=_in_huge_pages(capacity, nu + 1, np.float64),
        value=_in_huge_pages(capacity, 8, np.float64),
        link=_in_huge_pages(capacity, 8, np.int32),
        region_cells=_in_huge_pages(start, 2, np.int32),
        level=np.array(levels),
        level_cell=np.array(sizes),
        cells=_in_huge_pages(cells, 2, np.int32),
        block_bound=np.zeros(blocks[0] * blocks[1], np.int32),
        block_shape=np.array([*blocks, *how]),
        frame=np.array([x_low, y_low, cell]),
        count=_counts_of_no_nodes(),
        best=np.full(2, math.inf),
        random=np.zeros(1, np.uint64),
    )


def _counts_of_no_nodes() -> Ints:
    counts = np.zeros(COUNTS, np.int64)
    counts[[BEST, CLOSEST, NEXT]] = -1
    return counts


def _storage(columns: int, rows: int, most: int) -> tuple[int, int, int, int]:
    """Masks of column and row numbers, stride and number of the stored cells, about `most` of them.

    If there are more cells, those a power of two of columns or rows apart share their memory.
    """
    if columns * rows <= most:
        return EVERY, EVERY, columns, columns * rows
    side = 1 << math.isqrt(most).bit_length()
    stored_columns = min(columns, side)
    stored_rows = min(rows, 1 << (2 * most // stored_columns).bit_length() - 1)
    masks = [
        stored - 1 if stored < count else EVERY for stored, count in ((stored_columns, columns), (stored_rows, rows))
    ]
    return masks[0], masks[1], stored_columns, stored_columns * stored_rows


def _in_huge_pages(rows: int, columns: int, dtype: type) -> Any:
    """Zeros (rows, columns) that begin a cache line, in huge pages if the system has them; the first is touched.

    Nodes are visited in no order: with small pages most visits would miss the processor's cache of addresses too.
    """
    size = max(rows, 1) * columns * np.dtype(dtype).itemsize
    try:
        memory, touched = _unused[size].pop(), size
    except (KeyError, IndexError):
        memory, touched = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS), HUGE_PAGE
        if size >= HUGE_PAGE and hasattr(mmap, "MADV_HUGEPAGE"):
            memory.madvise(mmap.MADV_HUGEPAGE)
    array: Any = np.frombuffer(memory, dtype, rows * columns)
    if size <= LARGEST_REUSED:
        weakref.finalize(array, _reuse, memory).atexit = False
    array = array.reshape(rows, columns)
    array[: touched // (columns * array.itemsize)] = 0
    return array


def _reuse(memory: mmap.mmap) -> None:
    """Keep the memory of an array that exists no more: to get new memory takes longer than to empty it."""
    same = _unused.pop(len(memory), [])
    _unused[len(memory)] = [*same, memory][-REUSED_PER_SIZE:]
    if len(_unused) > REUSED_SIZES:
        _unused.popitem(last=False)  # of the size that no tree has had for the longest time


def with_room(tree: Tree, nodes: int, max_nodes: int) -> Tree:
    """Tree with memory for `nodes` more nodes, doubled as often as needed, for at most `max_nodes` in total.

    It is `tree` itself if there is room; otherwise the nodes are copied, and the other arrays are shared.
    """
    size, capacity = int(tree.count[SIZE]), len(tree.state)
    while capacity - size < nodes and capacity < max_nodes:
        capacity = min(2 * capacity, max_nodes)
    if capacity == len(tree.state):
        return tree
    larger = {}
    for name in _PER_NODE:
        array = getattr(tree, name)
        larger[name] = _in_huge_pages(capacity, array.shape[1], array.dtype.type)
        larger[name][:size] = array[:size]
    return tree._replace(**larger)


def first_nodes(tree: Tree, capacity: int) -> Tree:
    """Tree restricted to the first `capacity` nodes of its memory."""
    return tree._replace(**{name: getattr(tree, name)[:capacity] for name in _PER_NODE})


def reset(tree: Tree, random: Words) -> None:
    """Empty the tree for a new query and reuse its memory."""
    reset_indices(tree)
    tree.count[:] = _counts_of_no_nodes()
    tree.best[:] = math.inf
    tree.random[:] = random


def reset_indices(tree: Tree) -> None:
    """Empty both indices; the nodes that they list must not have moved."""
    if tree.count[SIZE] < len(tree.region_cells) // CELLS_PER_NODE:
        _empty_cells_of_nodes(tree)
    else:
        tree.region_cells[:] = 0
        tree.cells[:] = 0
        tree.block_bound[:] = 0
    tree.level[:, LEVEL_COUNT] = 0


@compiled
def _empty_cells_of_nodes(tree: Tree) -> None:
    """Empty the cells of every node."""
    for node in range(tree.count[SIZE]):
        region = region_cell(tree, max(int64(tree.link[node, REGION_LEVEL]), 0), node)
        tree.region_cells[region, HEAD], tree.region_cells[region, BOUND] = 0, 0
        row, column = cell_of(tree, tree.value[node])
        cell = position_cell(tree, row, column)
        tree.cells[cell, HEAD], tree.cells[cell, BOUND] = 0, 0
        tree.block_bound[position_block(tree, row, column)] = 0


@compiled
def relist(tree: Tree) -> None:
    """List every open node again, after nodes have moved in memory; regions keep their radii."""
    for node in range(tree.count[SIZE]):
        if tree.value[node, RADIUS] > 0.0:
            list_node(tree, node)


@compiled
def _reindex(tree: Tree, closed: float) -> None:
    """Compute every region again, as if the nodes were inserted in their order; roots come first."""
    for node in range(tree.count[SIZE]):
        if tree.link[node, PARENT] < 0:
            tree.value[node, RADIUS] = math.inf
            list_node(tree, node)
        else:
            limit = math.sqrt(distance_squared(tree, tree.link[node, PARENT], tree.value[node]))
            add_to_indices(tree, node, limit, closed)


def set_costs_to_go(tree: Tree, togo: Floats, resolution: float, cycle: float) -> None:
    """Set the cost-to-go of every node, `togo` (nodes,) in s, and update f, regions, indices and the closest node.

    The closest node, where a plan ends that does not reach the goal, is at least `cycle` s after the start.
    """
    size = int(tree.count[SIZE])
    cost, parent = tree.value[:size, COST], tree.link[:size, PARENT]
    tree.value[:size, TOGO] = togo
    tree.value[:size, F] = cost + togo
    candidates = np.flatnonzero((parent >= 0) & (cost >= cycle))
    if len(candidates) > 0:
        tree.count[CLOSEST] = candidates[np.argmin(togo[candidates])]
        tree.best[1] = togo[tree.count[CLOSEST]]
    reset_indices(tree)
    _reindex(tree, closed_radius(resolution, max(1, size + int(tree.count[PRUNED]))))


def add_root(tree: Tree, work: Lanes) -> None:
    """Add the end of lane 0, which starts and ends in `work.source`, as a root; its region is the whole workspace.

    Raises:
        MemoryError: if the tree is full.
    """
    node = int(tree.count[SIZE])
    if node >= len(tree.state):
        raise MemoryError(f"no room for another start in a tree of {node:,} nodes")
    _write_root(tree, work)


@compiled
def _write_root(tree: Tree, work: Lanes) -> None:
    node = tree.count[SIZE]
    tree.count[SIZE] += 1
    for k in range(len(work.source)):
        tree.state[node, k] = work.source[k]
    tree.edge[node] = 0.0
    for k in range(Q_DIM):
        tree.value[node, k] = work.end[k * LANE_WIDTH]
    tree.value[node, COST], tree.value[node, RADIUS] = 0.0, math.inf
    tree.value[node, TOGO] = tree.value[node, F] = work.togo[0]
    tree.link[node] = -1
    tree.link[node, AT_GOAL] = work.at_goal[0]
    tree.link[node, VISITS] = 0
    if work.at_goal[0] != 0:
        tree.best[0], tree.count[BEST] = 0.0, node
    list_node(tree, node)


def prune(tree: Tree, bound: int = F) -> int:
    """Remove the nodes that can neither be selected again nor lead to a better plan, and return how many.

    These are closed nodes, and nodes whose lower bound of the cost of plans through them is at or above the best cost,
    unless they are ancestors of a node that is kept.  `bound` is the column of the lower bound: f, or `COST` if the
    cost-to-go may still fall.
    """
    size = int(tree.count[SIZE])
    lowest, radius, parent = tree.value[:size, bound], tree.value[:size, RADIUS], tree.link[:size, PARENT]
    keep = (lowest < tree.best[0]) & (radius > 0.0)
    keep[parent < 0] = True
    for named in (BEST, CLOSEST, NEXT):
        if tree.count[named] >= 0:
            keep[tree.count[named]] = True
    _keep_ancestors(keep, parent)
    reset_indices(tree)
    new_index = np.cumsum(keep) - 1
    kept = int(new_index[-1]) + 1
    for array in (tree.state, tree.edge, tree.value, tree.link):
        array[:kept] = array[:size][keep]
    parents = tree.link[:kept, PARENT]
    tree.link[:kept, PARENT] = np.where(parents >= 0, new_index[parents], -1)
    for named in (BEST, CLOSEST, NEXT):
        if tree.count[named] >= 0:
            tree.count[named] = new_index[tree.count[named]]
    tree.count[SIZE] = kept
    tree.count[PRUNED] += size - kept
    tree.count[FULL] = 0
    relist(tree)
    return size - kept


@compiled
def _keep_ancestors(keep: Bools, parent: Ints32) -> None:
    for node in range(len(keep) - 1, 0, -1):  # children come after their parents
        if keep[node] and parent[node] >= 0:
            keep[parent[node]] = True


@compiled
def add_descendants(chosen: Bools, parent: Ints32) -> None:
    """Choose the descendants of chosen nodes (n,) too; `parent` (n,) of a root is itself."""
    for node in range(len(chosen)):  # children come after their parents
        chosen[node] = chosen[node] or chosen[parent[node]]


@compiled
def keep_with_ancestors(keep: Bools, parent: Ints32, nodes: Ints, limit: int) -> None:
    """Keep `nodes` (m,) of a tree of n with their ancestors up to kept ones, in turn, until there are `limit` more."""
    kept = 0
    for node in nodes:
        ancestor, missing = node, 0
        while not keep[ancestor]:
            ancestor, missing = int64(parent[ancestor]), missing + 1
        kept += missing
        if kept > limit:
            return
        ancestor = node
        while not keep[ancestor]:
            keep[ancestor] = True
            ancestor = int64(parent[ancestor])


def best_node(tree: Tree) -> tuple[int, bool]:
    """Last node of the best plan, -1 without a plan, and whether it is in the goal."""
    reaches_goal = bool(tree.count[BEST] >= 0)
    return int(tree.count[BEST if reaches_goal else CLOSEST]), reaches_goal


def path_to(tree: Tree, node: int) -> list[int]:
    """Nodes from the root to `node`."""
    path = []
    while node >= 0:
        path.append(node)
        node = int(tree.link[node, PARENT])
    return path[::-1]


def path_along(tree: Tree, edges: Matrix) -> list[int]:
    """Nodes of a path from the first root on, as far as the tree has its edges (n, nu + 1), controls and durations."""
    size, nodes = int(tree.count[SIZE]), np.empty(len(edges) + 1, np.int64)
    count = _follow(tree.link[:size], tree.edge[:size], np.ascontiguousarray(edges), nodes)
    return [int(node) for node in nodes[:count]]


@inlined
def are_equal(one: Floats, other: Floats) -> bool:
    """Whether two rows are the same."""
    equal = True
    for k in range(len(one)):
        equal = equal and one[k] == other[k]
    return equal


@compiled
def _follow(link: IntMatrix32, edge: Matrix, edges: Matrix, nodes: Ints) -> int:
    nodes[0] = 0  # the first root is the first node
    for k in range(len(edges)):
        nodes[k + 1] = -1
        for child in range(nodes[k] + 1, len(link)):  # children come after their parents
            if link[child, PARENT] == nodes[k] and are_equal(edge[child], edges[k]):
                nodes[k + 1] = child
                break
        if nodes[k + 1] < 0:
            return k + 1
    return len(edges) + 1
