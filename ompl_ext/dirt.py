"""DIRT, the tree planner of Algorithm 1, over the arrays of `ompl_ext.kernel_types`.

Littlefield and Bekris, Efficient and asymptotically optimal kinodynamic motion planning via dominance-informed
regions, IROS 2018.  The vehicle comes in as three functions (propagate, check, safe); given compiled ones this runs
as a part of that vehicle's kernel, and `grow.py_func` is the same source given Python functions.
"""

from __future__ import annotations

import math

from ompl_ext.arrays import Floats
from ompl_ext.costtogo import UNREACHABLE
from ompl_ext.jit import inlined
from ompl_ext.kernel_types import (
    BEST, CLOSEST, COST, EDGES, FIRST_ITERATION, FULL, ITERATIONS, LANE_WIDTH, NEXT, Q_DIM, RADIUS, SIZE, TOGO, UNSAFE,
    F, Lanes, Problem, Tree,
)  # fmt: skip
from ompl_ext.rng import uniform
from ompl_ext.tree import (
    add_to_cells,
    distance_squared,
    is_full,
    list_region,
    nearest_better,
    select,
    shrink_worse,
)
from ompl_ext.trigonometry import cos, sin


@inlined
def sample_configuration(tree: Tree, problem: Problem, q: Floats) -> None:
    bounds, goal, weight = problem.bounds, problem.goal, problem.metric[0]
    if uniform(tree.random) < problem.chance[0]:
        q[0], q[1] = goal[0], goal[1]
    else:
        q[0] = bounds[0] + uniform(tree.random) * (bounds[1] - bounds[0])
        q[1] = bounds[2] + uniform(tree.random) * (bounds[3] - bounds[2])
    heading = 2.0 * math.pi * uniform(tree.random)
    q[2], q[3] = weight * cos(heading), weight * sin(heading)


@inlined
def sample_controls(tree: Tree, problem: Problem, work: Lanes, lanes: int) -> None:
    """Controls and durations of a blossom.  A share of the controls lies on their bounds, where optimal ones tend to be."""
    beyond = problem.chance[1]
    shortest, longest = problem.duration[0], problem.duration[1]
    for i in range(lanes):
        work.duration[i] = shortest + uniform(tree.random) * (longest - shortest)
        for k in range(len(problem.controls)):
            low, high = problem.controls[k, 0], problem.controls[k, 1]
            r = min(max(uniform(tree.random) * (1.0 + 2.0 * beyond) - beyond, 0.0), 1.0)
            work.control[k * LANE_WIDTH + i] = low + r * (high - low)


@inlined
def best_lane(work: Lanes, lanes: int, by_f: bool, bound: float) -> int:
    """The valid lane that has not been taken yet with the best heuristic and f below `bound`; -1 if none is left."""
    best, lane = math.inf, -1
    for i in range(lanes):
        key = work.togo[i] + (work.duration[i] if by_f else 0.0)
        if work.slack[i] >= 0.0 and key < best and work.duration[i] + work.togo[i] < bound:
            best, lane = key, i
    return lane


@inlined
def insert(tree: Tree, parent: int, lane: int, work: Lanes) -> int:
    """Add the end of an edge as a node and update regions, indices and the best solution."""
    node = tree.count[SIZE]
    tree.count[SIZE] += 1
    for k in range(tree.state.shape[1]):
        tree.state[node, k] = work.trajectory[work.last[0] + k * LANE_WIDTH + lane]
    for k in range(tree.control.shape[1]):
        tree.control[node, k] = work.control[k * LANE_WIDTH + lane]
    for k in range(Q_DIM):
        tree.hot[node, k] = work.end[k * LANE_WIDTH + lane]
    tree.duration[node] = work.duration[lane]
    tree.parent[node] = parent
    tree.hot[node, COST] = tree.hot[parent, COST] + work.duration[lane]
    tree.hot[node, TOGO] = work.togo[lane]
    tree.hot[node, F] = tree.hot[node, COST] + work.togo[lane]
    tree.at_goal[node] = work.at_goal[lane]
    return node


@inlined
def register(tree: Tree, problem: Problem, node: int, limit: float) -> None:
    """Region of a new node: up to its parent or the nearest better node; worse nodes' regions shrink to it."""
    floor2 = problem.metric[1] * problem.metric[1] * min(1.0, 20000.0 / tree.count[SIZE])
    _, tree.hot[node, RADIUS] = nearest_better(tree, tree.hot[node], tree.hot[node, F], limit, floor2)
    shrink_worse(tree, node, floor2)
    if tree.hot[node, RADIUS] * tree.hot[node, RADIUS] >= floor2:
        list_region(tree, node)
        add_to_cells(tree, node)
    if tree.at_goal[node] == 1 and tree.hot[node, COST] < tree.best[0]:  # Alg. 1, l. 20-22
        tree.best[0] = tree.hot[node, COST]
        if tree.count[BEST] < 0:
            tree.count[FIRST_ITERATION] = tree.count[ITERATIONS]
        tree.count[BEST] = node
    if tree.hot[node, TOGO] < tree.best[1]:  # Alg. 1, l. 24
        tree.best[1] = tree.hot[node, TOGO]
        tree.count[CLOSEST] = node


@inlined
def visit(tree: Tree, problem: Problem, work: Lanes, brake: Lanes, q: Floats, propagate, check, safe) -> None:  # type: ignore[no-untyped-def]
    """One iteration: select a node, propagate a blossom from it, add the best candidates that pass every check."""
    node = tree.count[NEXT]
    tree.count[NEXT] = -1
    if node < 0:
        sample_configuration(tree, problem, q)
        node = select(tree, q)  # Alg. 1, l. 10
        if node < 0:
            return
    lanes = problem.options[0]
    sample_controls(tree, problem, work, lanes)  # l. 11
    propagate(tree.state[node], lanes, problem, work)  # l. 12
    start = tree.hot[node, COST]
    for lane in range(lanes):
        work.slack[lane] = check(lane, start, problem, work)  # l. 14, 18
    tree.count[EDGES] += lanes
    added = 0
    while added < problem.options[1]:
        lane = best_lane(work, lanes, problem.options[3] == 1, min(tree.best[0], UNREACHABLE) - start)
        if lane < 0:
            return
        work.slack[lane] = -1.0  # taken
        crosses = start < problem.safety[0] <= start + work.duration[lane]
        if crosses and problem.options[4] == 1 and safe(lane, start, problem, work, brake) < 0:  # l. 18
            tree.count[UNSAFE] += 1
            continue
        if is_full(tree):
            tree.count[FULL] = 1
            return
        child = insert(tree, node, lane, work)
        register(tree, problem, child, math.sqrt(distance_squared(tree, node, tree.hot[child])))
        added += 1
        closer = tree.hot[child, TOGO] < tree.hot[node, TOGO]
        if added == 1 and problem.options[2] == 1 and closer and tree.at_goal[child] == 0:
            tree.count[NEXT] = child  # child extension


@inlined
def grow(tree: Tree, problem: Problem, work: Lanes, brake: Lanes, iterations: int, q: Floats, propagate, check, safe) -> None:  # type: ignore[no-untyped-def]
    """Grow the tree by `iterations` visits, or until it is full (Alg. 1, l. 9-22)."""
    for _ in range(iterations):
        visit(tree, problem, work, brake, q, propagate, check, safe)
        tree.count[ITERATIONS] += 1
        if tree.count[FULL] == 1:
            return
