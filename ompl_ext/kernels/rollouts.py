"""Costs of many rollouts of a vehicle's model as vector lanes, for sampling-based controllers.

`specialise` executes this module once per vehicle and supplies the vehicle as a global; it cannot be imported directly.
Cost-to-go and goal are those of the planner, in `checks`.

Clearances take most of the time and only add costs.  So a batch of rollouts is first driven to its end, with all other
costs.  Clearances are found for the rollouts that are not known to be worse by then than the best ones of the batches
before, and only where the disc round the whole footprint comes near to obstacles.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types

from ompl_ext.arrays import Floats, Floats32Cube, Matrix, int64
from ompl_ext.jit import compiled, inlined, part
from ompl_ext.kernels.costtogo import UNREACHABLE
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    DELTA,
    DELTA_PER_SPEED,
    GOAL_RADIUS,
    LANE_WIDTH,
    PROBLEM,
    REACH,
    ROLLOUT_COLLISION,
    ROLLOUT_CUTOFF,
    ROLLOUT_GAMMA,
    ROLLOUT_GOAL,
    ROLLOUT_HEADING,
    ROLLOUT_MARGIN,
    ROLLOUT_MEMORY,
    ROLLOUT_NEAR,
    ROLLOUT_POSITION,
    ROLLOUT_SPEED,
    ROLLOUT_STEP,
    Problem,
    RolloutMemory,
)
from ompl_ext.kernels.pose_clearances import (  # fmt: skip
    AT_CLEARANCE,
    AT_ENOUGH,
    AT_POINT_X,
    AT_POINT_Y,
    AT_VALUE,
    AT_WHO,
    POSES,
    ROW,
    find_clearances,
    read_field,
)
from ompl_ext.kernels.specialise import layout_module_of, module_of, vehicle_being_compiled, vehicle_cache_folder
from ompl_ext.kernels.unroll import per_component

VEHICLE = vehicle_being_compiled()
FOLDER = vehicle_cache_folder(VEHICLE)
NX, NU = len(VEHICLE.state), len(VEHICLE.controls)
X, Y, THETA = (VEHICLE.index(name) for name in ("x", "y", "theta"))
SPEED = VEHICLE.rest_indices[0] if VEHICLE.rest else -1
WIDTH = LANE_WIDTH

_planner, _checks = module_of(VEHICLE, "lanes"), layout_module_of(VEHICLE, "checks")
derivative, actuation, outside, shifted = _planner.derivative, _planner.actuation, _planner.outside, _planner.shifted
cost_to_go, in_goal, turn_lanes = _checks.cost_to_go, _checks.in_goal, _checks.turn_lanes
is_near_goal = _checks.is_near_goal
load_state, load_input = _planner.load_state, _planner.load_input
store_state, store_input = _planner.store_state, _planner.store_input
disturbed = per_component("planned, noise, i", "planned[{k}] + noise[{k}, i]", NU)
load_parameters, load_low, load_high = _planner.load_parameters, _planner.load_low, _planner.load_high
AT_INPUT, AT_STEP, AT_OUTSIDE, AT_STAGES = _planner.AT_INPUT, _planner.AT_STEP, _planner.AT_OUTSIDE, _planner.AT_STAGES
AT_COS, AT_SIN = _checks.AT_COS, _checks.AT_SIN
# The working block: that of `lanes`; the costs of a rollout apart from those of controls and clearances, so far and of
# all steps (negative while it goes on), the number of its steps, its costs of controls and clearances so far; the
# rollouts of which clearances are found
AT_KNOWN, AT_TOTAL, AT_END, AT_COST, AT_ROLLOUT = (AT_INPUT + (_planner.NI + k) * WIDTH for k in range(5))
BLOCK = AT_ROLLOUT + WIDTH
# The path, after each step: first rows of poses as in `pose_clearances`, and the known costs before the step
PATH_X, PATH_Y, PATH_HEADING, PATH_ENOUGH, PATH_WHOLE, PATH_KNOWN = (k * WIDTH for k in range(6))
POSE_ROWS = 5
PATH = 6 * WIDTH


def memory(steps: int) -> RolloutMemory:
    """Working memory for rollouts of so many steps."""
    return RolloutMemory(np.zeros(BLOCK), np.zeros((steps, PATH)), np.zeros((2, ROW)))


@part
def cut_noise(
    nominal: Matrix,
    drawn: Floats32Cube,
    hold: int,
    precision: Floats,
    gamma: float,
    problem: Problem,
    noise: Floats32Cube,
    costs: Floats,
) -> None:
    """Find what remains of `drawn` in every step when the controls are kept within their bounds, and its costs (n,).

    Each of the inner loops writes one array, so that LLVM can vectorise it.
    """
    costs[:] = 0.0
    for t in range(len(nominal)):
        for k in range(NU):
            planned, added, left = nominal[t, k], drawn[t // hold, k], noise[t, k]
            low, high = problem.controls[k, 0] - planned, problem.controls[k, 1] - planned
            weight = gamma * precision[k] * planned
            for i in range(len(costs)):
                left[i] = min(max(added[i], low), high)
            for i in range(len(costs)):
                costs[i] += weight * left[i]


@part
def advance(first: int, lanes: int, planned: Floats, noise: Matrix, problem: Problem, block: Floats) -> None:
    """Advance a batch of rollouts by a step under what is planned and its noise, by the midpoint rule.

    These loops vectorise.

    The rule is of second order: in steps of 0.05 s a car of 0.7 m/s stays within a millimetre of the exact motion.
    """
    p, low, high = load_parameters(problem.parameters), load_low(problem.limits), load_high(problem.limits)
    for i in range(lanes):
        store_input(block, AT_INPUT, i, actuation(disturbed(planned, noise, first + i), p))
    for i in range(lanes):
        x, h = load_state(block, 0, i), block[AT_STEP + i]
        store_state(block, AT_STAGES, i, shifted(0.5 * h, derivative(x, load_input(block, AT_INPUT, i), p), x))
    for i in range(lanes):
        middle = derivative(load_state(block, AT_STAGES, i), load_input(block, AT_INPUT, i), p)
        y = shifted(block[AT_STEP + i], middle, load_state(block, 0, i))
        store_state(block, 0, i, y)
        block[AT_OUTSIDE + i] += outside(y, low, high)


@part
def keep_path(lanes: int, weight: Floats, problem: Problem, block: Floats, poses: Floats, path: Floats) -> None:
    """Keep the poses of all lanes, which clearance is enough for them and that of the disc round the footprint."""
    margin, at_rest, per_speed = weight[ROLLOUT_MARGIN], problem.scalar[DELTA], problem.scalar[DELTA_PER_SPEED]
    reach = problem.scalar[REACH]
    for i in range(lanes):
        path[PATH_X + i], path[PATH_Y + i] = block[X * WIDTH + i], block[Y * WIDTH + i]
        path[PATH_HEADING + i] = block[THETA * WIDTH + i] if THETA >= 0 else 0.0
        speed = abs(block[SPEED * WIDTH + i]) if SPEED >= 0 else 0.0
        path[PATH_ENOUGH + i] = margin + (at_rest + per_speed * speed)
        path[PATH_KNOWN + i] = block[AT_KNOWN + i]
    for i in range(lanes):
        poses[AT_POINT_X + i], poses[AT_POINT_Y + i] = block[X * WIDTH + i], block[Y * WIDTH + i]
    read_field(lanes, problem, poses)
    for i in range(lanes):
        path[PATH_WHOLE + i] = poses[AT_VALUE + i] - reach


@inlined
def tracking_cost(block: Floats, lane: int, t: int, reference: Matrix, weight: Floats) -> float:
    """Weighted squared deviation from the reference after step t: position, heading, speed."""
    dx, dy = block[X * WIDTH + lane] - reference[t, 0], block[Y * WIDTH + lane] - reference[t, 1]
    turned = 2.0 - 2.0 * (block[AT_COS + lane] * reference[t, 2] + block[AT_SIN + lane] * reference[t, 3])
    faster = block[SPEED * WIDTH + lane] - reference[t, 4] if SPEED >= 0 else 0.0
    total = weight[ROLLOUT_POSITION] * (dx * dx + dy * dy) + weight[ROLLOUT_HEADING] * turned
    return total + weight[ROLLOUT_SPEED] * faster * faster


@inlined
def collision_cost(weight: Floats, t: int, steps: int) -> float:
    """Cost of a collision in step t."""
    return float(weight[ROLLOUT_COLLISION] * (1.0 + (steps - t) / steps))


@inlined
def end_outside(lanes: int, t: int, steps: int, weight: Floats, block: Floats) -> None:
    """End the rollouts that have left the limits in step t."""
    for i in range(lanes):
        if block[AT_OUTSIDE + i] != 0.0 and block[AT_TOTAL + i] < 0.0:
            block[AT_TOTAL + i], block[AT_END + i] = block[AT_KNOWN + i] + collision_cost(weight, t, steps), t


@inlined
def add_goal_costs(lanes: int, t: int, cost: float, problem: Problem, block: Floats) -> None:
    """Add the cost of the time of a step; end the rollouts that are in the goal after step t.

    Counting the lanes that are near the goal vectorises, and in most steps there are none.
    """
    scalar, start, near = problem.scalar, int64(0), int64(0)
    for i in range(lanes):
        block[AT_KNOWN + i] += cost
    for i in range(lanes):
        near += int64(is_near_goal(scalar, block[X * WIDTH + i], block[Y * WIDTH + i], scalar[GOAL_RADIUS]))
    if near > 0:
        for i in range(lanes):
            if in_goal(problem, block, start, i) and block[AT_TOTAL + i] < 0.0:
                block[AT_TOTAL + i], block[AT_END + i] = block[AT_KNOWN + i], t + 1


@part
def add_known_costs(
    lanes: int, t: int, steps: int, reference: Matrix, weight: Floats, problem: Problem, block: Floats
) -> None:
    """Add the costs of step t that do not depend on clearances; a rollout ends outside the limits or in the goal."""
    h, left = weight[ROLLOUT_STEP], int64(0)
    for i in range(lanes):
        left += int64(block[AT_OUTSIDE + i] != 0.0)
    if left > 0:
        end_outside(lanes, t, steps, weight, block)
    if len(reference) > 0:
        turn_lanes(block, lanes)
        for i in range(lanes):
            block[AT_KNOWN + i] += h * tracking_cost(block, i, t, reference, weight)
    if weight[ROLLOUT_GOAL] > 0.0:
        add_goal_costs(lanes, t, h * weight[ROLLOUT_GOAL], problem, block)


@part
def choose(lanes: int, limit: float, weight: Floats, problem: Problem, block: Floats, costs: Floats) -> int:
    """Choose the rollouts whose costs may be below the limit, whatever their clearances; returns their number."""
    chosen = int64(0)
    for i in range(lanes):
        if block[AT_TOTAL + i] < 0.0:
            block[AT_TOTAL + i] = block[AT_KNOWN + i]
            if weight[ROLLOUT_GOAL] > 0.0:
                togo = cost_to_go(problem, block, i)
                more = weight[ROLLOUT_GOAL] * togo if togo < UNREACHABLE else weight[ROLLOUT_COLLISION]
                block[AT_TOTAL + i] += more
        costs[i] = math.inf
        if least_cost(weight, block, i) <= limit:
            block[AT_ROLLOUT + chosen] = i
            chosen += 1
    return chosen


@inlined
def least_cost(weight: Floats, block: Floats, lane: int) -> float:
    """Least cost that a rollout can have, if clearances are enough from here on or it collides."""
    return float(block[AT_COST + lane] + min(block[AT_TOTAL + lane], weight[ROLLOUT_COLLISION]))


@part
def add_near_costs(
    count: int, limit: float, weight: Floats, problem: Problem, memory: RolloutMemory, costs: Floats
) -> None:
    """Add the costs of poses that are near to obstacles; a rollout ends in a collision or beyond the limit."""
    find_clearances(count, problem, memory.poses)
    block, poses, steps = memory.block, memory.poses[0], len(memory.path)
    near = weight[ROLLOUT_NEAR] * weight[ROLLOUT_STEP]
    for j in range(count):
        who = int(poses[AT_WHO + j])
        t, i = who // WIDTH, who % WIDTH
        if t >= block[AT_END + i]:
            continue
        distance = poses[AT_CLEARANCE + j]
        if distance < 0.0:
            costs[i] = block[AT_COST + i] + memory.path[t, PATH_KNOWN + i] + collision_cost(weight, t, steps)
            block[AT_END + i] = -1.0
            continue
        lack = max(1.0 - distance / poses[AT_ENOUGH + j], 0.0)
        block[AT_COST + i] += near * lack * lack
        if least_cost(weight, block, i) > limit:
            block[AT_END + i] = -1.0


@part
def add_clearances(
    chosen: int, limit: float, weight: Floats, problem: Problem, memory: RolloutMemory, costs: Floats
) -> None:
    """Find the costs of the chosen rollouts, or that they are beyond the limit."""
    block, poses, count = memory.block, memory.poses[0], int64(0)
    for t in range(len(memory.path)):
        path = memory.path[t]
        for j in range(chosen):
            i = int(block[AT_ROLLOUT + j])
            if t < block[AT_END + i] and path[PATH_WHOLE + i] < path[PATH_ENOUGH + i]:
                for k in range(POSE_ROWS):
                    poses[k * POSES + count] = path[k * WIDTH + i]
                poses[AT_WHO + count] = t * WIDTH + i
                count += 1
        if count > POSES - WIDTH:
            add_near_costs(count, limit, weight, problem, memory, costs)
            count = int64(0)
    add_near_costs(count, limit, weight, problem, memory, costs)
    for j in range(chosen):
        i = int(block[AT_ROLLOUT + j])
        if block[AT_END + i] >= 0.0:
            costs[i] = block[AT_COST + i] + block[AT_TOTAL + i]


def _roll_out_costs(
    start: Floats,
    nominal: Matrix,
    drawn: Floats32Cube,
    hold: int,
    reference: Matrix,
    weight: Floats,
    precision: Floats,
    problem: Problem,
    memory: RolloutMemory,
    noise: Floats32Cube,
    costs: Floats,
) -> None:
    """Costs (n,) of rollouts from `start` (nx,) with the controls `nominal` (steps, nu) and what is `drawn` added.

    Each of `drawn` (holds, nu, n) is held for `hold` steps.  The controls are kept within their bounds; `noise` (steps,
    nu, n) receives the difference that is left.  `reference` (steps, 5) has x, y, cosine and sine of the heading and
    speed after each step; it is empty if none is tracked.  `precision` (nu,) is one over the variance of the noise.

    The cost is infinite of rollouts that cost more than the least one and the weight ROLLOUT_CUTOFF.
    """
    steps, count, least, block = int64(len(nominal)), int64(len(costs)), math.inf, memory.block
    low, high = load_low(problem.limits), load_high(problem.limits)
    cut_noise(nominal, drawn, hold, precision, weight[ROLLOUT_GAMMA], problem, noise, costs)
    for first in range(0, count, WIDTH):
        lanes, found = min(int64(WIDTH), count - first), costs[first:]
        for i in range(lanes):
            for k in range(NX):
                block[k * WIDTH + i] = start[k]
            block[AT_STEP + i], block[AT_END + i] = weight[ROLLOUT_STEP], steps
            block[AT_KNOWN + i], block[AT_TOTAL + i], block[AT_COST + i] = 0.0, -1.0, found[i]
            block[AT_OUTSIDE + i] = outside(load_state(block, 0, i), low, high)
        for t in range(steps):
            advance(first, lanes, nominal[t], noise[t], problem, block)
            keep_path(lanes, weight, problem, block, memory.poses[0], memory.path[t])
            add_known_costs(lanes, t, steps, reference, weight, problem, block)
        limit = least + weight[ROLLOUT_CUTOFF]
        chosen = choose(lanes, limit, weight, problem, block, found)
        add_clearances(chosen, limit, weight, problem, memory, found)
        for i in range(lanes):
            least = min(least, found[i])


_VECTOR, _MATRIX, _CUBE = types.float64[::1], types.float64[:, ::1], types.float32[:, :, ::1]
roll_out_costs = compiled(
    _roll_out_costs,
    folder=FOLDER,
    signature=types.void(
        _VECTOR, _MATRIX, _CUBE, types.int64, _MATRIX, _VECTOR, _VECTOR, PROBLEM, ROLLOUT_MEMORY, _CUBE, _VECTOR
    ),
)
