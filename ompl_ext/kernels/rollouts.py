"""Costs of many rollouts of a vehicle's model as vector lanes, for sampling-based controllers.

`specialise` executes this module once per vehicle and supplies the vehicle as a global; it cannot be imported directly.
Steps, cost-to-go and goal are those of the planner, in `lanes` and `checks`.
"""

from __future__ import annotations

from numba import types

from ompl_ext.arrays import Floats, Floats32Cube, Matrix, int64
from ompl_ext.jit import compiled, inlined, part
from ompl_ext.kernels.costtogo import UNREACHABLE
from ompl_ext.kernels.fine_field import fine_distance
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    DELTA,
    DELTA_PER_SPEED,
    FINE_INVERSE,
    GRID_INVERSE,
    GRID_X,
    GRID_Y,
    LANE_WIDTH,
    PROBLEM,
    REACH,
    ROLLOUT_COLLISION,
    ROLLOUT_GAMMA,
    ROLLOUT_GOAL,
    ROLLOUT_HEADING,
    ROLLOUT_MARGIN,
    ROLLOUT_NEAR,
    ROLLOUT_POSITION,
    ROLLOUT_SPEED,
    ROLLOUT_STEP,
    Problem,
)
from ompl_ext.kernels.specialise import layout_module_of, module_of, vehicle_being_compiled, vehicle_cache_folder

VEHICLE = vehicle_being_compiled()
FOLDER = vehicle_cache_folder(VEHICLE)
NX, NU = len(VEHICLE.state), len(VEHICLE.controls)
X, Y = (VEHICLE.index(name) for name in ("x", "y"))
SPEED = VEHICLE.rest_indices[0] if VEHICLE.rest else -1
WIDTH = LANE_WIDTH

_planner, _checks = module_of(VEHICLE, "lanes"), layout_module_of(VEHICLE, "checks")
actuation, integrate_lanes, outside = _planner.actuation, _planner.integrate_lanes, _planner.outside
cost_to_go, in_goal, turn_lanes = _checks.cost_to_go, _checks.in_goal, _checks.turn_lanes
load_state, load_control, store_input = _planner.load_state, _planner.load_control, _planner.store_input
load_parameters, load_low, load_high = _planner.load_parameters, _planner.load_low, _planner.load_high
AT_INPUT, AT_STEP, AT_OUTSIDE = _planner.AT_INPUT, _planner.AT_STEP, _planner.AT_OUTSIDE
AT_COS, AT_SIN = _checks.AT_COS, _checks.AT_SIN
AT_CONTROL = AT_INPUT + _planner.NI * WIDTH  # the working block: that of `lanes`, controls, whether a rollout goes on
AT_GOING = AT_CONTROL + NU * WIDTH
BLOCK = AT_GOING + WIDTH


@inlined
def clearance(problem: Problem, x: float, y: float, c: float, s: float, enough: float) -> float:
    """Lower bound of the footprint's clearance at a pose (m), tight below `enough`."""
    field, scalar, discs = problem.field, problem.scalar, problem.discs
    ox, oy, inverse = scalar[GRID_X], scalar[GRID_Y], scalar[GRID_INVERSE]
    whole = field[int((y - oy) * inverse), int((x - ox) * inverse)] - scalar[REACH]  # of the disc around the body
    if whole >= enough:
        return whole
    smallest, k = enough, 0
    while k < len(discs):
        px, py = x + discs[k, 0] * c - discs[k, 1] * s, y + discs[k, 0] * s + discs[k, 1] * c
        spare = field[int((py - oy) * inverse), int((px - ox) * inverse)] - discs[k, 2]
        if spare < smallest and scalar[FINE_INVERSE] > 0.0:
            spare = max(spare, fine_distance(problem, px, py) - discs[k, 2])
        members = int(discs[k, 3])  # discs that follow and are within this one
        k += 1
        if members == 0:
            smallest = min(smallest, spare)
        elif spare >= smallest:
            k += members
    return max(smallest, whole)


@part
def control_lanes(
    first: int,
    lanes: int,
    t: int,
    nominal: Matrix,
    noise: Floats32Cube,
    precision: Floats,
    gamma: float,
    problem: Problem,
    block: Floats,
    costs: Floats,
) -> None:
    """Set the controls of every lane in step t, within their bounds; `noise` becomes what remains of it there."""
    for k in range(NU):
        low, high, planned = problem.controls[k, 0], problem.controls[k, 1], nominal[t, k]
        weight = gamma * precision[k] * planned
        for i in range(lanes):
            value = min(max(planned + noise[t, k, first + i], low), high)
            block[AT_CONTROL + k * WIDTH + i] = value
            noise[t, k, first + i] = value - planned
            costs[first + i] += weight * (value - planned)


@inlined
def tracking_cost(block: Floats, lane: int, t: int, reference: Matrix, weight: Floats) -> float:
    """Weighted squared deviation from the reference after step t: position, heading, speed."""
    dx, dy = block[X * WIDTH + lane] - reference[t, 0], block[Y * WIDTH + lane] - reference[t, 1]
    turned = 2.0 - 2.0 * (block[AT_COS + lane] * reference[t, 2] + block[AT_SIN + lane] * reference[t, 3])
    faster = block[SPEED * WIDTH + lane] - reference[t, 4] if SPEED >= 0 else 0.0
    total = weight[ROLLOUT_POSITION] * (dx * dx + dy * dy) + weight[ROLLOUT_HEADING] * turned
    return total + weight[ROLLOUT_SPEED] * faster * faster


@part
def add_costs(
    first: int,
    lanes: int,
    t: int,
    steps: int,
    reference: Matrix,
    weight: Floats,
    problem: Problem,
    block: Floats,
    costs: Floats,
) -> None:
    """Add the costs of every lane after step t; a rollout ends in a collision or in the goal."""
    scalar, h = problem.scalar, weight[ROLLOUT_STEP]
    for i in range(lanes):
        if block[AT_GOING + i] == 0.0:
            continue
        cost, distance, enough, start = 0.0, -1.0, weight[ROLLOUT_MARGIN], int64(0)
        if block[AT_OUTSIDE + i] == 0.0:
            speed = abs(block[SPEED * WIDTH + i]) if SPEED >= 0 else 0.0
            enough += scalar[DELTA] + scalar[DELTA_PER_SPEED] * speed
            x, y, c, s = block[X * WIDTH + i], block[Y * WIDTH + i], block[AT_COS + i], block[AT_SIN + i]
            distance = clearance(problem, x, y, c, s, enough)
        if distance < 0.0:
            block[AT_GOING + i] = 0.0
            costs[first + i] += weight[ROLLOUT_COLLISION] * (1.0 + (steps - t) / steps)
            continue
        if distance < enough:
            lack = 1.0 - distance / enough
            cost += weight[ROLLOUT_NEAR] * h * lack * lack
        if weight[ROLLOUT_GOAL] > 0.0:
            cost += weight[ROLLOUT_GOAL] * h
            if in_goal(problem, block, start, i):
                block[AT_GOING + i] = 0.0
            elif t == steps - 1:
                togo = cost_to_go(problem, block, i)
                cost += weight[ROLLOUT_GOAL] * togo if togo < UNREACHABLE else weight[ROLLOUT_COLLISION]
        if len(reference) > 0:
            cost += h * tracking_cost(block, i, t, reference, weight)
        costs[first + i] += cost


def _roll_out_costs(
    start: Floats,
    nominal: Matrix,
    noise: Floats32Cube,
    reference: Matrix,
    weight: Floats,
    precision: Floats,
    problem: Problem,
    block: Floats,
    costs: Floats,
) -> None:
    """Costs (n,) of rollouts from `start` (nx,) with the controls `nominal` (steps, nu) + `noise` (steps, nu, n).

    The controls are kept within their bounds, and `noise` is changed to the difference that is left.  `reference`
    (steps, 5) has x, y, cosine and sine of the heading and speed after each step; it is empty if none is tracked.
    `precision` (nu,) is one over the variance of the noise.
    """
    steps, count = int64(len(nominal)), int64(len(costs))
    p, low, high = load_parameters(problem.parameters), load_low(problem.limits), load_high(problem.limits)
    for first in range(0, count, WIDTH):
        lanes = min(int64(WIDTH), count - first)
        for i in range(lanes):
            for k in range(NX):
                block[k * WIDTH + i] = start[k]
            block[AT_STEP + i] = weight[ROLLOUT_STEP]
            block[AT_GOING + i], costs[first + i] = 1.0, 0.0
            block[AT_OUTSIDE + i] = outside(load_state(block, 0, i), low, high)
        for t in range(steps):
            control_lanes(first, lanes, t, nominal, noise, precision, weight[ROLLOUT_GAMMA], problem, block, costs)
            for i in range(lanes):
                store_input(block, AT_INPUT, i, actuation(load_control(block, AT_CONTROL, i), p))
            integrate_lanes(block, lanes, p, low, high, problem.scalar[REACH])
            turn_lanes(block, lanes)
            add_costs(first, lanes, t, steps, reference, weight, problem, block, costs)


_VECTOR, _MATRIX = types.float64[::1], types.float64[:, ::1]
roll_out_costs = compiled(
    _roll_out_costs,
    folder=FOLDER,
    signature=types.void(
        _VECTOR, _MATRIX, types.float32[:, :, ::1], _MATRIX, _VECTOR, _VECTOR, PROBLEM, _VECTOR, _VECTOR
    ),
)
