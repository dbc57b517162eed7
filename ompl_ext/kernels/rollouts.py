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
# The working block: that of `lanes`, the controls of all rollouts of a batch, those of the lanes; the rollout of a
# lane, its clearance and the one that is enough, a place in the clearance field and the value there; the clearance of
# the disc round the whole footprint
AT_CUT = AT_INPUT + _planner.NI * WIDTH
AT_CONTROL = AT_CUT + NU * WIDTH
AT_ROLLOUT = AT_CONTROL + NU * WIDTH
AT_CLEARANCE = AT_ROLLOUT + WIDTH
AT_ENOUGH = AT_CLEARANCE + WIDTH
AT_ROW, AT_COLUMN, AT_VALUE = AT_ENOUGH + WIDTH, AT_ENOUGH + 2 * WIDTH, AT_ENOUGH + 3 * WIDTH
AT_WHOLE = AT_VALUE + WIDTH
BLOCK = AT_WHOLE + WIDTH


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
def cut_controls(
    first: int,
    count: int,
    t: int,
    nominal: Matrix,
    drawn: Floats32Cube,
    hold: int,
    noise: Floats32Cube,
    precision: Floats,
    gamma: float,
    problem: Problem,
    block: Floats,
    costs: Floats,
) -> None:
    """Controls of a batch of rollouts in step t, within their bounds; `noise` becomes what remains of `drawn` there.

    Each loop reads and writes one array beside the block, so that LLVM can vectorise it.
    """
    for k in range(NU):
        low, high, planned = problem.controls[k, 0], problem.controls[k, 1], nominal[t, k]
        weight, at = gamma * precision[k] * planned, AT_CUT + k * WIDTH
        added, left, cost = drawn[t // hold, k, first:], noise[t, k, first:], costs[first:]
        for i in range(count):
            block[at + i] = min(max(planned + added[i], low), high)
        for i in range(count):
            left[i] = block[at + i] - planned
        for i in range(count):
            cost[i] += weight * (block[at + i] - planned)


@part
def look_up(lanes: int, ahead: float, aside: float, problem: Problem, block: Floats) -> None:
    """Read the clearance field for a point of the body (m), in the block's value, for every lane.

    The places are computed apart from the reading of the field, so that LLVM can vectorise that.
    """
    field, ox, oy = problem.field, problem.scalar[GRID_X], problem.scalar[GRID_Y]
    inverse, last_row, last_column = problem.scalar[GRID_INVERSE], field.shape[0] - 1.0, field.shape[1] - 1.0
    for i in range(lanes):
        c, s = block[AT_COS + i], block[AT_SIN + i]
        px = block[X * WIDTH + i] + ahead * c - aside * s
        py = block[Y * WIDTH + i] + ahead * s + aside * c
        block[AT_ROW + i] = min(max(0.0, (py - oy) * inverse), last_row)  # lanes outside count as collisions
        block[AT_COLUMN + i] = min(max(0.0, (px - ox) * inverse), last_column)
    for i in range(lanes):
        block[AT_VALUE + i] = field[int(block[AT_ROW + i]), int(block[AT_COLUMN + i])]


@part
def clearances(lanes: int, weight: Floats, problem: Problem, block: Floats) -> None:
    """Clearance of every lane (m), see `clearance`, and the one that is enough.

    Where the disc round the whole footprint has enough in all lanes, the other discs are left out.
    """
    discs, reach, origin = problem.discs, problem.scalar[REACH], 0.0
    margin, at_rest, per_speed = weight[ROLLOUT_MARGIN], problem.scalar[DELTA], problem.scalar[DELTA_PER_SPEED]
    for i in range(lanes):
        speed = abs(block[SPEED * WIDTH + i]) if SPEED >= 0 else 0.0
        block[AT_ENOUGH + i] = margin + (at_rest + per_speed * speed)
    if has_groups(problem):
        for i in range(lanes):
            x, y, c, s = block[X * WIDTH + i], block[Y * WIDTH + i], block[AT_COS + i], block[AT_SIN + i]
            if block[AT_OUTSIDE + i] == 0.0:
                block[AT_CLEARANCE + i] = clearance(problem, x, y, c, s, block[AT_ENOUGH + i])
        return
    look_up(lanes, origin, origin, problem, block)
    near = int64(0)
    for i in range(lanes):
        block[AT_WHOLE + i] = block[AT_VALUE + i] - reach
        near += 1 if block[AT_WHOLE + i] < block[AT_ENOUGH + i] else 0
    if near == 0:
        for i in range(lanes):
            block[AT_CLEARANCE + i] = block[AT_WHOLE + i]
        return
    for i in range(lanes):
        block[AT_CLEARANCE + i] = block[AT_ENOUGH + i]
    for k in range(len(discs)):
        radius = discs[k, 2]
        look_up(lanes, discs[k, 0], discs[k, 1], problem, block)
        for i in range(lanes):
            block[AT_CLEARANCE + i] = min(block[AT_CLEARANCE + i], block[AT_VALUE + i] - radius)
    for i in range(lanes):
        block[AT_CLEARANCE + i] = max(block[AT_CLEARANCE + i], block[AT_WHOLE + i])


@inlined
def has_groups(problem: Problem) -> bool:
    """Whether there is a fine field, or discs that contain others: then most poses take few discs, each its own."""
    grouped = problem.scalar[FINE_INVERSE] > 0.0
    for k in range(len(problem.discs)):
        grouped = grouped or problem.discs[k, 3] > 0.0
    return grouped


@part
def load_controls(lanes: int, batch: int, problem: Problem, block: Floats) -> None:
    """Give every lane the input that its rollout's controls cause; lane i has rollout i while all of them go on."""
    p = load_parameters(problem.parameters)
    for k in range(NU):
        if lanes == batch:
            for i in range(lanes):
                block[AT_CONTROL + k * WIDTH + i] = block[AT_CUT + k * WIDTH + i]
        else:
            for i in range(lanes):
                block[AT_CONTROL + k * WIDTH + i] = block[AT_CUT + k * WIDTH + int(block[AT_ROLLOUT + i])]
    for i in range(lanes):
        store_input(block, AT_INPUT, i, actuation(load_control(block, AT_CONTROL, i), p))


@inlined
def move_lane(block: Floats, before: int, after: int) -> None:
    """Move a rollout that goes on to another lane."""
    for k in range(NX):
        block[k * WIDTH + after] = block[k * WIDTH + before]
    block[AT_OUTSIDE + after] = 0.0
    block[AT_ROLLOUT + after] = block[AT_ROLLOUT + before]


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
) -> int:
    """Add the costs of every lane after step t; a rollout ends in a collision or in the goal.

    Rollouts that go on are moved to the first lanes; returns their number.
    """
    h, going = weight[ROLLOUT_STEP], int64(0)
    for i in range(lanes):
        rollout, start, ends = first + int(block[AT_ROLLOUT + i]), int64(0), False
        distance = block[AT_CLEARANCE + i]
        if block[AT_OUTSIDE + i] != 0.0 or distance < 0.0:
            costs[rollout] += weight[ROLLOUT_COLLISION] * (1.0 + (steps - t) / steps)
            continue
        lack = max(1.0 - distance / block[AT_ENOUGH + i], 0.0)
        cost = weight[ROLLOUT_NEAR] * h * lack * lack
        if weight[ROLLOUT_GOAL] > 0.0:
            cost += weight[ROLLOUT_GOAL] * h
            if in_goal(problem, block, start, i):
                ends = True
            elif t == steps - 1:
                togo = cost_to_go(problem, block, i)
                cost += weight[ROLLOUT_GOAL] * togo if togo < UNREACHABLE else weight[ROLLOUT_COLLISION]
        if len(reference) > 0:
            cost += h * tracking_cost(block, i, t, reference, weight)
        costs[rollout] += cost
        if not ends:
            if i != going:
                move_lane(block, i, going)
            going += 1
    return going


def _roll_out_costs(
    start: Floats,
    nominal: Matrix,
    drawn: Floats32Cube,
    hold: int,
    reference: Matrix,
    weight: Floats,
    precision: Floats,
    problem: Problem,
    block: Floats,
    noise: Floats32Cube,
    costs: Floats,
) -> None:
    """Costs (n,) of rollouts from `start` (nx,) with the controls `nominal` (steps, nu) and what is `drawn` added.

    Each of `drawn` (holds, nu, n) is held for `hold` steps.  The controls are kept within their bounds; `noise` (steps,
    nu, n) receives the difference that is left.  `reference` (steps, 5) has x, y, cosine and sine of the heading and
    speed after each step; it is empty if none is tracked.  `precision` (nu,) is one over the variance of the noise.
    """
    steps, count = int64(len(nominal)), int64(len(costs))
    p, low, high = load_parameters(problem.parameters), load_low(problem.limits), load_high(problem.limits)
    for first in range(0, count, WIDTH):
        batch = min(int64(WIDTH), count - first)
        lanes = batch
        for i in range(batch):
            for k in range(NX):
                block[k * WIDTH + i] = start[k]
            block[AT_STEP + i], block[AT_ROLLOUT + i], costs[first + i] = weight[ROLLOUT_STEP], i, 0.0
            block[AT_OUTSIDE + i] = outside(load_state(block, 0, i), low, high)
        for t in range(steps):
            cut_controls(
                first, batch, t, nominal, drawn, hold, noise, precision, weight[ROLLOUT_GAMMA], problem, block, costs
            )
            if lanes > 0:
                load_controls(lanes, batch, problem, block)
                integrate_lanes(block, lanes, p, low, high, problem.scalar[REACH])
                turn_lanes(block, lanes)
                clearances(lanes, weight, problem, block)
                lanes = add_costs(first, lanes, t, steps, reference, weight, problem, block, costs)


_VECTOR, _MATRIX, _CUBE = types.float64[::1], types.float64[:, ::1], types.float32[:, :, ::1]
roll_out_costs = compiled(
    _roll_out_costs,
    folder=FOLDER,
    signature=types.void(
        _VECTOR, _MATRIX, _CUBE, types.int64, _MATRIX, _VECTOR, _VECTOR, PROBLEM, _VECTOR, _CUBE, _VECTOR
    ),
)
