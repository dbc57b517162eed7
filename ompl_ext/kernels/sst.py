"""SST, the sparse tree planner of Li, Littlefield and Bekris, beside DIRT; its import compiles it.

Asymptotically optimal sampling-based kinodynamic planning, IJRR 2016.  Sampling, propagation, checks, SAFETY and
the tree's arrays are those of DIRT.  A blossom of controls is propagated at once as vector lanes, and each is what the
paper calls a Monte Carlo propagation.

Witnesses are a second tree without edges: the configuration of node w is that of witness w, its parent the node that
represents it, its cost that of this node.  A node that represents no witness is inactive: its f is infinite, its radius
negative, so that the index of positions drops it.
"""

from __future__ import annotations

import math

from numba import types

from ompl_ext.arrays import Floats, int64
from ompl_ext.jit import compiled, part
from ompl_ext.kernels.costtogo import UNREACHABLE
from ompl_ext.kernels.dirt import new_node, requires_safety, sample_configuration, sample_edges
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    BLOSSOM,
    CELL_NEXT,
    CELL_SIZE,
    CELLS_X,
    CELLS_Y,
    COST,
    EDGES,
    HEAD,
    ITERATIONS,
    LANE_WIDTH,
    LANES,
    PARENT,
    PROBLEM,
    Q_DIM,
    RADIUS,
    SIZE,
    SST_PRUNING,
    SST_SELECTION,
    TREE,
    UNSAFE,
    F,
    Lanes,
    Problem,
    Tree,
)
from ompl_ext.kernels.search import check, propagate_to_goal, safe
from ompl_ext.kernels.tree import BLOCK, clamp, distance_squared, list_position, nearest_better, stored_block


@part
def cheapest_within(tree: Tree, q: Floats, radius: float) -> int:
    """Active node with the lowest cost within `radius` m of `q` (Best_First_Selection_SST); -1 if there is none."""
    size = BLOCK * tree.frame[CELL_SIZE]
    columns, rows = tree.block_shape[BLOCK_COLUMNS], tree.block_shape[BLOCK_ROWS]
    first_row = clamp(int((q[1] - radius - tree.frame[CELLS_Y]) / size), rows)
    last_row = clamp(int((q[1] + radius - tree.frame[CELLS_Y]) / size), rows)
    first_column = clamp(int((q[0] - radius - tree.frame[CELLS_X]) / size), columns)
    last_column = clamp(int((q[0] + radius - tree.frame[CELLS_X]) / size), columns)
    chosen, lowest = int64(-1), math.inf
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            if tree.block_bound[row * columns + column] == 0:
                continue
            first = stored_block(tree, row, column) * BLOCK * BLOCK
            for cell in range(first, first + BLOCK * BLOCK):
                node = int64(tree.cells[cell, HEAD]) - 1
                while node >= 0:
                    cheaper = tree.value[node, RADIUS] >= 0.0 and tree.value[node, COST] < lowest
                    if cheaper and distance_squared(tree, node, q) <= radius * radius:
                        chosen, lowest = node, tree.value[node, COST]
                    node = int64(tree.link[node, CELL_NEXT])
    return chosen


@part
def nearest(tree: Tree, q: Floats) -> tuple[int, float]:
    """Nearest active node and its distance (m); -1 if there is none."""
    return nearest_better(tree, q, math.inf, math.inf, 0.0)


@part
def witness_of(witnesses: Tree, q: Floats, radius: float) -> int:
    """Witness within `radius` m of `q`, -1 if there is none."""
    found, distance = nearest(witnesses, q)
    return found if distance <= radius else int64(-1)


@part
def represent(tree: Tree, witnesses: Tree, node: int, radius: float) -> None:
    """Make a node the representative of its witness (Prune_Dominated_Nodes_SST); without one it is its own witness."""
    witness = witness_of(witnesses, tree.value[node], radius)
    if witness < 0:
        witness = int64(witnesses.count[SIZE])
        witnesses.count[SIZE] += 1
        for k in range(Q_DIM):
            witnesses.value[witness, k] = tree.value[node, k]
        witnesses.value[witness, F] = 0.0
        witnesses.value[witness, RADIUS] = 1.0
        list_position(witnesses, witness)
    else:
        dominated = witnesses.link[witness, PARENT]
        tree.value[dominated, F] = math.inf
        tree.value[dominated, RADIUS] = -1.0
    witnesses.link[witness, PARENT] = node
    witnesses.value[witness, COST] = tree.value[node, COST]
    tree.value[node, RADIUS] = 1.0
    list_position(tree, node)


@part
def represent_all(tree: Tree, witnesses: Tree, radius: float) -> None:
    """Find witnesses for the nodes of a tree that has none; indices are empty."""
    for node in range(tree.count[SIZE]):
        witness = witness_of(witnesses, tree.value[node], radius)
        if tree.value[node, F] < math.inf and (witness < 0 or tree.value[node, COST] < witnesses.value[witness, COST]):
            represent(tree, witnesses, node, radius)
        else:
            tree.value[node, F] = math.inf
            tree.value[node, RADIUS] = -1.0


@part
def is_locally_best(witnesses: Tree, work: Lanes, lane: int, cost: float, radius: float, q: Floats) -> bool:
    """Whether no node near the end of a lane costs less (Is_Node_Locally_the_Best_SST)."""
    for k in range(Q_DIM):
        q[k] = work.end[k * LANE_WIDTH + lane]
    witness = witness_of(witnesses, q, radius)
    return witness < 0 or cost < witnesses.value[witness, COST]


def _grow(
    tree: Tree, witnesses: Tree, problem: Problem, work: Lanes, brake: Lanes, q: Floats, radii: Floats, iterations: int
) -> None:
    if witnesses.count[SIZE] == 0:
        represent_all(tree, witnesses, radii[SST_PRUNING])
    lanes = problem.option[BLOSSOM]
    for _ in range(iterations):
        tree.count[ITERATIONS] += 1
        sample_configuration(tree, problem, q)
        node = cheapest_within(tree, q, radii[SST_SELECTION])
        if node < 0:
            node, _ = nearest(tree, q)
        if node < 0:
            return
        start = tree.value[node, COST]
        sample_edges(tree, node, problem, work, lanes)
        propagate_to_goal(tree.state[node], lanes, problem, work)
        tree.count[EDGES] += lanes
        for lane in range(lanes):
            cost = start + work.duration[lane]
            if work.slack[lane] < 0.0 or work.togo[lane] >= UNREACHABLE or cost + work.togo[lane] >= tree.best[0]:
                continue
            if not is_locally_best(witnesses, work, lane, cost, radii[SST_PRUNING], q):
                continue
            if check(lane, start, problem, work) < 0.0:
                continue
            if requires_safety(problem, start, lane, work) and safe(lane, start, problem, work, brake) < 0:
                tree.count[UNSAFE] += 1
                continue
            child = new_node(tree, problem, node, lane, work)
            if child < 0:
                return
            represent(tree, witnesses, child, radii[SST_PRUNING])


grow = compiled(
    _grow,
    signature=types.void(TREE, TREE, PROBLEM, LANES, LANES, types.float64[::1], types.float64[::1], types.int64),
)
