"""DIRT, the tree planner of Algorithm 1, on the arrays of `ompl_ext.kernels.kernel_types`.

Littlefield and Bekris, Efficient and asymptotically optimal kinodynamic motion planning via dominance-informed
regions, IROS 2018.  The vehicle is represented by three functions (propagate, check, safe): those of a
compiled vehicle (`ompl_ext.kernels.lanes`) or callbacks into Python (`ompl_ext.kernels.callback_kernel`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

from ompl_ext.arrays import Floats, int64
from ompl_ext.jit import inlined, part, template
from ompl_ext.kernels.costtogo import UNREACHABLE
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    AT_GOAL,
    BEST,
    BLOSSOM,
    CHILD_EXTENSION,
    CLOSEST,
    CONTROL_BOUND_BIAS,
    COST,
    CUT_AT_GOAL,
    CYCLE,
    EDGES,
    EXPLORATION,
    FIRST_ITERATION,
    FULL,
    GOAL_BIAS,
    GOAL_COS,
    GOAL_HEADING,
    GOAL_SIN,
    GOAL_X,
    GOAL_Y,
    HEADING_WEIGHT,
    INSERTIONS,
    ITERATIONS,
    LANE_WIDTH,
    LONGEST,
    NEXT,
    PARENT,
    PRUNED,
    Q_DIM,
    QUANTUM,
    REQUIRE_SAFETY,
    RESOLUTION,
    RETAINED,
    SHORTEST,
    SHORTEST_NEAR_GOAL,
    SIZE,
    STEPS,
    TOGO,
    UNSAFE,
    VISITS,
    WAITING,
    X_HIGH,
    X_LOW,
    Y_HIGH,
    Y_LOW,
    F,
    Lanes,
    Problem,
    Retained,
    Tree,
)
from ompl_ext.kernels.rng import uniform
from ompl_ext.kernels.tree import add_to_indices, closed_radius, distance_squared, select
from ompl_ext.trigonometry import cos, sin

EXPLORATION_INSERTIONS = 4  # most candidates that an exploring visit adds
MAX_DEVIATION = 0.01  # deviation of a retained edge's end from its target beyond which it is corrected (m)
DEVIATION_LENGTH, DEVIATION_SPEED = 0.3, 0.2  # factors from errors of heading (m/rad) and duration (m/s) to a deviation
LARGEST_CORRECTION = 0.4  # largest change in the first correction, as a share of a control's range or of the duration
CORRECTION_ROUNDS = 4  # most corrections of a retained edge; changes are smaller after each one that is free and safe
CORRECTION_TRIES = 4  # variants of an edge that SAFETY may refuse before the next correction
NEAR_GOAL = 2.0  # cost-to-go below which edges may be shorter, in durations of the longest edge
Propagate = Callable[[Floats, int, Problem, Lanes], None]
Check = Callable[[int, float, Problem, Lanes], float]
Safe = Callable[[int, float, Problem, Lanes, Lanes], int]


@part
def sample_configuration(tree: Tree, problem: Problem, q: Floats) -> bool:
    """Sample the workspace uniformly, or the goal with the probability of the goal bias, and a heading.

    The heading is that of the goal if the goal is sampled and has one, else uniform.  Returns whether the visit
    explores: whether it adds any free candidates instead of the best one.
    """
    scalar, weight = problem.scalar, problem.scalar[HEADING_WEIGHT]
    at_goal = uniform(tree.random) < scalar[GOAL_BIAS]
    if at_goal:
        q[0], q[1] = scalar[GOAL_X], scalar[GOAL_Y]
    else:
        q[0] = scalar[X_LOW] + uniform(tree.random) * (scalar[X_HIGH] - scalar[X_LOW])
        q[1] = scalar[Y_LOW] + uniform(tree.random) * (scalar[Y_HIGH] - scalar[Y_LOW])
    heading = 2.0 * math.pi * uniform(tree.random)
    q[2], q[3] = weight * cos(heading), weight * sin(heading)
    if at_goal and problem.option[GOAL_HEADING] == 1:
        q[2], q[3] = weight * scalar[GOAL_COS], weight * scalar[GOAL_SIN]
    return uniform(tree.random) < scalar[EXPLORATION]


@inlined
def set_duration(problem: Problem, work: Lanes, lane: int, duration: float) -> None:
    """Set duration and integration steps of a lane; with a quantum the duration is rounded to a multiple of it."""
    quantum = problem.scalar[QUANTUM]
    work.duration[lane], work.steps[lane] = duration, problem.option[STEPS]
    if quantum > 0.0:
        work.steps[lane] = min(max(int(duration / quantum + 0.5), 1), problem.option[STEPS])
        work.duration[lane] = work.steps[lane] * quantum


@part
def sample_edges(tree: Tree, node: int, problem: Problem, work: Lanes, lanes: int) -> None:
    """Sample the controls and durations of a blossom; a share of the controls is on a bound, as time-optimal ones.

    Near a goal that an edge may pass edges may be shorter than elsewhere.
    """
    bias = problem.scalar[CONTROL_BOUND_BIAS]
    shortest, longest = problem.scalar[SHORTEST], problem.scalar[LONGEST]
    if problem.option[CUT_AT_GOAL] == 1 and tree.value[node, TOGO] < NEAR_GOAL * longest:
        shortest = problem.scalar[SHORTEST_NEAR_GOAL]
    for i in range(lanes):
        set_duration(problem, work, i, shortest + uniform(tree.random) * (longest - shortest))
        for k in range(len(problem.controls)):
            low, high = problem.controls[k, 0], problem.controls[k, 1]
            r = min(max(uniform(tree.random) * (1.0 + 2.0 * bias) - bias, 0.0), 1.0)
            work.control[k * LANE_WIDTH + i] = low + r * (high - low)


@part
def most_promising_lane(work: Lanes, lanes: int, start: float, bound: float) -> int:
    """Lane with the smallest f at its end among those not known to collide, if f is below `bound`; -1 without one.

    f uses the cost-to-go of the end point, so that it is a lower bound of the cost of plans through the edge.
    """
    best, lane = bound, -1
    for i in range(lanes):
        f = start + work.duration[i] + work.togo[i]
        if work.slack[i] >= 0.0 and f < best and work.togo[i] < UNREACHABLE:
            best, lane = f, i
    return lane


@template
def best_lane(work: Lanes, lanes: int, start: float, bound: float, problem: Problem, check: Check) -> int:
    """Free lane with the smallest f at its end, if that is below `bound`; -1 if there is none.

    Lanes are checked in the order of f, because a check costs more than the search for the next one.
    """
    lane = most_promising_lane(work, lanes, start, bound)
    while lane >= 0:
        work.slack[lane] = check(lane, start, problem, work)  # Alg. 1, l. 15, 18
        if work.slack[lane] >= 0.0:
            break
        lane = most_promising_lane(work, lanes, start, bound)
    return lane


@template
def check_lanes(work: Lanes, lanes: int, start: float, bound: float, problem: Problem, check: Check) -> None:
    """Check every lane with f below `bound`."""
    for lane in range(lanes):
        if start + work.duration[lane] + work.togo[lane] < bound and work.togo[lane] < UNREACHABLE:
            work.slack[lane] = check(lane, start, problem, work)


@part
def exploration_lane(tree: Tree, node: int, work: Lanes, lanes: int, start: float, added: int) -> int:
    """Free lane that ends farthest from the node, or, in turn, a uniformly random one; -1 if there is none."""
    chosen, candidates, farthest = -1, 0, -1.0
    for i in range(lanes):
        f = start + work.duration[i] + work.togo[i]
        if work.slack[i] < 0.0 or work.togo[i] >= UNREACHABLE or f >= tree.best[0]:
            continue
        d2 = 0.0
        for k in range(Q_DIM):
            difference = work.end[k * LANE_WIDTH + i] - tree.value[node, k]
            d2 += difference * difference
        candidates += 1
        if (added % 2 == 0 and d2 > farthest) or (added % 2 == 1 and uniform(tree.random) * candidates < 1.0):
            chosen, farthest = i, d2
    return chosen


@part
def is_visited_next(tree: Tree, node: int, child: int, exploring: bool) -> bool:
    """Whether a child is visited next: if it is nearer to the goal than its parent, or at random while exploring."""
    if tree.link[child, AT_GOAL] == 1:
        return False
    return tree.value[child, TOGO] < tree.value[node, TOGO] or (exploring and uniform(tree.random) < 0.5)


@part
def new_node(tree: Tree, problem: Problem, parent: int, lane: int, work: Lanes) -> int:
    """Add the end of an edge as a node that no index lists, and update the best solution; -1 if the tree is full."""
    node = tree.count[SIZE]
    if node == len(tree.state):
        tree.count[FULL] = 1
        return -1
    tree.count[SIZE] += 1
    nx, nu = tree.state.shape[1], tree.edge.shape[1] - 1
    last = problem.option[STEPS] * nx * LANE_WIDTH
    for k in range(nx):
        tree.state[node, k] = work.trajectory[last + k * LANE_WIDTH + lane]
    for k in range(nu):
        tree.edge[node, k] = work.control[k * LANE_WIDTH + lane]
    tree.edge[node, nu] = work.duration[lane]
    for k in range(Q_DIM):
        tree.value[node, k] = work.end[k * LANE_WIDTH + lane]
    tree.value[node, COST] = tree.value[parent, COST] + work.duration[lane]
    tree.value[node, TOGO] = work.togo[lane]
    tree.value[node, F] = tree.value[node, COST] + work.togo[lane]
    tree.link[node, PARENT] = parent
    tree.link[node, AT_GOAL] = work.at_goal[lane]
    tree.link[node, VISITS] = 0
    if tree.link[node, AT_GOAL] == 1 and tree.value[node, COST] < tree.best[0]:  # Alg. 1, l. 20-22
        if tree.count[BEST] < 0:
            tree.count[FIRST_ITERATION] = tree.count[ITERATIONS]
        tree.best[0] = tree.value[node, COST]
        tree.count[BEST] = node
    beyond_cycle = problem.option[REQUIRE_SAFETY] == 0 or tree.value[node, COST] >= problem.scalar[CYCLE]
    if beyond_cycle and tree.value[node, TOGO] < tree.best[1]:  # Alg. 1, l. 24, among the nodes checked by SAFETY
        tree.best[1] = tree.value[node, TOGO]
        tree.count[CLOSEST] = node
    return node


@part
def insert(tree: Tree, problem: Problem, parent: int, lane: int, work: Lanes) -> int:
    """Add the end of an edge as a node with its region, and update the best solution; -1 if the tree is full."""
    node = new_node(tree, problem, parent, lane, work)
    if node >= 0:
        closed = closed_radius(problem.scalar[RESOLUTION], tree.count[SIZE] + tree.count[PRUNED])
        add_to_indices(tree, node, math.sqrt(distance_squared(tree, parent, tree.value[node])), closed)
    return node


@part
def requires_safety(problem: Problem, start: float, lane: int, work: Lanes) -> bool:
    """Whether SAFETY is required: the edge crosses the cycle's end (Alg. 1, l. 7, 18) or ends a plan before it."""
    inside = start + work.duration[lane] < problem.scalar[CYCLE] and work.at_goal[lane] == 0
    return problem.option[REQUIRE_SAFETY] == 1 and start < problem.scalar[CYCLE] and not inside


@template
def visit(
    tree: Tree, problem: Problem, work: Lanes, brake: Lanes, q: Floats, propagate: Propagate, check: Check, safe: Safe
) -> None:
    """One iteration: select a node, propagate a blossom from it, add the best candidate that passes all checks.

    A visit *explores* if no candidate comes nearer to the goal, and with a small probability if its node was visited
    before: it adds a few candidates that are not the best, and with probability 1/2 the first of them is visited next.
    The best candidate alone makes no progress wherever every path first leads away from the goal.
    """
    tree.count[ITERATIONS] += 1
    node, exploring = tree.count[NEXT], False
    tree.count[NEXT] = -1
    if node < 0:
        exploring = sample_configuration(tree, problem, q)
        node = select(tree, q)  # Alg. 1, l. 11
        if node < 0:
            return
    exploring = exploring and tree.link[node, VISITS] > 0
    tree.link[node, VISITS] += 1
    lanes, start = problem.option[BLOSSOM], tree.value[node, COST]
    sample_edges(tree, node, problem, work, lanes)  # l. 12
    propagate(tree.state[node], lanes, problem, work)  # l. 13
    tree.count[EDGES] += lanes
    lane, added, wanted = int64(-1), int64(0), problem.option[INSERTIONS]
    decided, checked = exploring, False
    while added < wanted:
        if not exploring:
            lane = best_lane(work, lanes, start, tree.best[0], problem, check)
            exploring = not decided and lane >= 0 and work.togo[lane] >= tree.value[node, TOGO]
            decided = True
        if exploring:
            if not checked:
                check_lanes(work, lanes, start, tree.best[0], problem, check)
                checked, wanted = True, EXPLORATION_INSERTIONS
            lane = exploration_lane(tree, node, work, lanes, start, added)
        if lane < 0:
            return
        if requires_safety(problem, start, lane, work) and safe(lane, start, problem, work, brake) < 0:
            tree.count[UNSAFE] += 1
        else:
            child = insert(tree, problem, node, lane, work)  # l. 16, 19
            if child < 0:
                return
            if added == 0 and problem.option[CHILD_EXTENSION] == 1 and is_visited_next(tree, node, child, exploring):
                tree.count[NEXT] = child
            added += 1
        work.slack[lane] = -1.0  # inserted, or not safe


@part
def deviation_squared(problem: Problem, retained: Retained, k: int, work: Lanes, lane: int) -> float:
    """Squared deviation (m^2) of a lane's end from the target of a retained edge; 0 without a target.

    Errors of the heading and of the duration count with a length and a speed.
    """
    if k >= len(retained.target):
        return 0.0
    weight = problem.scalar[HEADING_WEIGHT]
    late = DEVIATION_SPEED * (work.duration[lane] - retained.edge[k, retained.edge.shape[1] - 1])
    total = late * late
    for c in range(Q_DIM):
        difference = work.end[c * LANE_WIDTH + lane] - retained.target[k, c]
        if c >= 2:
            difference *= DEVIATION_LENGTH / weight if weight > 0.0 else 0.0
        total += difference * difference
    return total


@part
def requires_correction(problem: Problem, retained: Retained, k: int, work: Lanes, found: int) -> bool:
    """Whether edge k, in lane 0, has a target and fails (`found` < 0) or ends too far from it."""
    if k >= len(retained.target):
        return False
    return found < 0 or deviation_squared(problem, retained, k, work, int64(0)) > MAX_DEVIATION * MAX_DEVIATION


@part
def vary_edge(tree: Tree, problem: Problem, work: Lanes, lanes: int, spread: float) -> None:
    """Set the lanes after lane 0 to its control and duration with random changes, most of them small."""
    shortest, longest = min(problem.scalar[SHORTEST], work.duration[0]), problem.scalar[LONGEST]
    for i in range(1, lanes):
        r = 2.0 * uniform(tree.random) - 1.0
        set_duration(problem, work, i, min(max(work.duration[0] * (1.0 + spread * r * r * r), shortest), longest))
        for c in range(len(problem.controls)):
            low, high = problem.controls[c, 0], problem.controls[c, 1]
            r = 2.0 * uniform(tree.random) - 1.0
            varied = work.control[c * LANE_WIDTH] + spread * (high - low) * r * r * r
            work.control[c * LANE_WIDTH + i] = min(max(varied, low), high)


@part
def nearest_lane(problem: Problem, retained: Retained, k: int, work: Lanes, lanes: int) -> int:
    """Lane not known to collide that ends nearest to the target of a retained edge; -1 if there is none."""
    chosen, nearest = -1, math.inf
    for i in range(lanes):
        if work.slack[i] >= 0.0 and work.togo[i] < UNREACHABLE:
            d2 = deviation_squared(problem, retained, k, work, i)
            if d2 < nearest:
                chosen, nearest = i, d2
    return chosen


@template
def propagate_retained(
    tree: Tree,
    problem: Problem,
    work: Lanes,
    brake: Lanes,
    retained: Retained,
    k: int,
    parent: int,
    lanes: int,
    propagate: Propagate,
    check: Check,
    safe: Safe,
) -> int:
    """Propagate lanes from a node; the free and safe lane that ends nearest to the target of edge k, -1 if none."""
    start, tries = tree.value[parent, COST], 0
    propagate(tree.state[parent], lanes, problem, work)
    tree.count[EDGES] += lanes
    while tries < CORRECTION_TRIES:
        lane = nearest_lane(problem, retained, k, work, lanes)  # checked one by one, which costs less than all of them
        if lane < 0:
            return -1
        work.slack[lane] = check(lane, start, problem, work)
        if work.slack[lane] < 0.0:
            continue
        if not requires_safety(problem, start, lane, work) or safe(lane, start, problem, work, brake) >= 0:
            return lane
        tree.count[UNSAFE] += 1
        tries += 1
        work.slack[lane] = -1.0
    return -1


@template
def retain(
    tree: Tree,
    problem: Problem,
    work: Lanes,
    brake: Lanes,
    retained: Retained,
    propagate: Propagate,
    check: Check,
    safe: Safe,
) -> None:
    """Add the free and safe part of an earlier plan or tree, propagated from the root (Alg. 1, l. 2-8).

    An edge with a target that fails, or ends too far from it, is corrected: it is varied at random around the best
    variant so far, with smaller and smaller changes.
    """
    nu = tree.edge.shape[1] - 1
    single, first = int64(1), int64(0)  # not literals: numba compiles the callees once more for each
    for k in range(len(retained.parent)):
        if retained.node[k] != WAITING:
            continue
        parent = 0 if retained.parent[k] < 0 else retained.node[retained.parent[k]]
        retained.node[k] = -1
        if parent < 0:
            continue
        for c in range(nu):
            work.control[c * LANE_WIDTH] = retained.edge[k, c]
        set_duration(problem, work, first, retained.edge[k, nu])
        found, spread, lanes = int64(-1), LARGEST_CORRECTION, single
        for variation in range(CORRECTION_ROUNDS + 1):
            if variation > 0:
                lanes = problem.option[BLOSSOM]
                vary_edge(tree, problem, work, lanes, spread)
            lane = propagate_retained(tree, problem, work, brake, retained, k, parent, lanes, propagate, check, safe)
            if lane >= 0:
                found, spread = first, spread / 3.0 if variation > 0 else spread
                work.duration[0], work.steps[0] = work.duration[lane], work.steps[lane]
                for c in range(nu):
                    work.control[c * LANE_WIDTH] = work.control[c * LANE_WIDTH + lane]
            if variation == 0 and not requires_correction(problem, retained, k, work, found):
                break
        if variation > 0 and found >= 0:
            propagate(tree.state[parent], single, problem, work)
        if found >= 0:
            retained.node[k] = insert(tree, problem, parent, first, work)
            tree.count[RETAINED] += 1 if retained.node[k] >= 0 else 0
