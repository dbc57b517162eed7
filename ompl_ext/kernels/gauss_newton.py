"""Local optimisation of a trajectory by Gauss-Newton with multiple shooting, compiled for one layout of the state.

`specialise` executes this module once for all vehicles whose states have the same layout, and supplies the layout as a
global; it cannot be imported directly.  `shooting` integrates the vehicle's motion.  `ompl_ext.polish` explains the
method.
"""

from __future__ import annotations

import math

from numba import types

from ompl_ext.arrays import Floats, Matrix, Matrix32, int64
from ompl_ext.jit import compiled, inlined, part
from ompl_ext.kernels import functions
from ompl_ext.kernels.clearance import delta_at
from ompl_ext.kernels.dirt import requires_safety, set_duration
from ompl_ext.kernels.fine_field import fine_distance_anywhere
from ompl_ext.kernels.functions import call_intervals
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    CYCLE,
    FINE_INVERSE,
    GOAL_X,
    GOAL_Y,
    GRID_INVERSE,
    GRID_X,
    GRID_Y,
    LANE_WIDTH,
    LANES,
    PROBLEM,
    REACH,
    Lanes,
    Problem,
)
from ompl_ext.kernels.search import search
from ompl_ext.kernels.specialise import layout_being_compiled, layout_cache_folder
from ompl_ext.kernels.trajectory_types import (  # fmt: skip
    BACKWARD,
    BEGIN,
    EVEN,
    EVENNESS,
    GOAL_DISTANCE,
    GOAL_HEADING,
    GOAL_SHARE,
    GOAL_TURN,
    LONGEST,
    PENALTY,
    SHOOTING,
    SHORTEST,
    SMALL_CHANGE,
    SMOOTHNESS,
    SMOOTHNESS_COST,
    STAGES,
    STIFFNESS,
    UNSAFE,
    URGENCY,
    Backward,
    Shooting,
    Stages,
)
from ompl_ext.trigonometry import cos, sin

LAYOUT = layout_being_compiled()
FOLDER = layout_cache_folder(LAYOUT)
NX, NU, X, Y, THETA = LAYOUT.components, LAYOUT.controls, LAYOUT.x, LAYOUT.y, LAYOUT.theta
M = NU + 1
SPEED = LAYOUT.rest[0] if LAYOUT.rest else -1
WIDTH = LANE_WIDTH
WITHIN_LIMITS = 1e-3  # share of a component's range, at most of 1, by which it is to stay within its limits
LEAST_MARGIN, MARGIN_SHARE = 0.1, 0.5  # what an edge gets more: cells of the field, and a share of what it lacks
CHANGE = 1e-6  # of numerical derivatives, in a control as a share of its range

edge, brake = search().edge, search().brake


@inlined
def integrate(
    first: int, lanes: int, column: int, change: float, problem: Problem, states: Matrix, inputs: Matrix, block: Floats
) -> None:
    """Integrate intervals `first` ... with one component of state, control and duration changed."""
    call_intervals(
        problem.functions[functions.INTERVALS], (first, lanes, column, change, problem, states, inputs, block)
    )


@inlined
def predict(n: int, problem: Problem, states: Matrix, inputs: Matrix, after: Matrix, block: Floats) -> None:
    """Set `after` to the states that the model predicts at the ends of the intervals."""
    for first in range(0, n, WIDTH):
        lanes = min(WIDTH, n - first)
        integrate(first, lanes, int64(-1), 0.0, problem, states, inputs, block)
        for i in range(lanes):
            for k in range(NX):
                after[first + i, k] = block[k * WIDTH + i]


@inlined
def linearise(n: int, problem: Problem, work: Shooting, stages: Stages) -> None:
    """Derivatives of the predicted states, which `after` has, by states, controls and durations."""
    block = work.block
    for first in range(0, n, WIDTH):
        lanes = min(WIDTH, n - first)
        for column in range(NX + M):
            change = CHANGE
            if NX <= column < NX + NU:
                change *= problem.controls[column - NX, 1] - problem.controls[column - NX, 0]
            integrate(first, lanes, column, change, problem, work.states, work.inputs, block)
            factor = 1.0 / change
            for i in range(lanes):
                for k in range(NX):
                    slope = factor * (block[k * WIDTH + i] - work.after[first + i, k])
                    if column < NX:
                        stages.a[first + i, k, column] = slope
                    else:
                        stages.b[first + i, k, column - NX] = slope


@part
def distance(problem: Problem, signed: Matrix32, x: float, y: float) -> float:
    """Distance of a point to the obstacles (m), negative inside them: interpolated, and the fine one where stored."""
    scalar = problem.scalar
    rows, columns = signed.shape
    # in this order a state that is not a number, as after a step that is too large, is not looked up outside the memory
    u = min(max(0.0, (x - scalar[GRID_X]) * scalar[GRID_INVERSE] - 0.5), columns - 1.001)
    v = min(max(0.0, (y - scalar[GRID_Y]) * scalar[GRID_INVERSE] - 0.5), rows - 1.001)
    column, row = int(u), int(v)
    u, v = u - column, v - row
    low = signed[row, column] * (1.0 - u) + signed[row, column + 1] * u
    high = signed[row + 1, column] * (1.0 - u) + signed[row + 1, column + 1] * u
    value = low * (1.0 - v) + high * v
    if scalar[FINE_INVERSE] > 0.0:
        fine = fine_distance_anywhere(problem, x, y)
        if fine * scalar[FINE_INVERSE] > 0.5:  # none inside an obstacle
            value = max(value, fine)
    return value


@inlined
def goal_miss(problem: Problem, setting: Floats, state: Floats, k: int) -> tuple[float, int, float, float]:
    """Residual k of a state outside the goal region, the component it depends on, and its slopes.

    Residual 0 depends on x and y, with both slopes.
    """
    if k == 0:
        dx, dy = state[X] - problem.scalar[GOAL_X], state[Y] - problem.scalar[GOAL_Y]
        away = math.sqrt(dx * dx + dy * dy)
        if away <= setting[GOAL_DISTANCE]:
            return 0.0, X, 0.0, 0.0
        return away - setting[GOAL_DISTANCE], X, dx / away, dy / away
    if k == 1:
        if THETA < 0 or setting[GOAL_TURN] >= math.pi:
            return 0.0, X, 0.0, 0.0
        off = state[THETA] - setting[GOAL_HEADING]
        off -= 2.0 * math.pi * math.floor(off / (2.0 * math.pi) + 0.5)
        return max(abs(off) - setting[GOAL_TURN], 0.0), THETA, 1.0 if off > 0.0 else -1.0, 0.0
    low, high, value = problem.goal_limits[k - 2, 0], problem.goal_limits[k - 2, 1], state[k - 2]
    inset = 0.5 * (1.0 - setting[GOAL_SHARE]) * (high - low) if high - low < math.inf else 0.0
    below, above = low + inset - value, value - high + inset
    return max(below, above, 0.0), k - 2, 1.0 if above > below else -1.0, 0.0


@inlined
def add_square(stages: Stages, k: int, penalty: float, residual: float, gradient: Floats) -> None:
    """Add 1/2 penalty residual^2 of the state k, to first order of the residual."""
    for i in range(NX):
        stages.q[k, i] += penalty * residual * gradient[i]
        for j in range(NX):
            stages.q_matrix[k, i, j] += penalty * gradient[i] * gradient[j]


@inlined
def clearance_penalty(
    problem: Problem,
    signed: Matrix32,
    work: Shooting,
    stages: Stages,
    state: Floats,
    k: int,
    time: float,
    penalty: float,
) -> float:
    """Sum of squared lacks of clearance at a state; with a positive `penalty` the stages get it, too."""
    scalar, required, growth = problem.scalar, work.margin[k], 0.0
    if time <= scalar[CYCLE]:
        at_rest, per_speed, later = delta_at(scalar, time)
        growth = per_speed if SPEED >= 0 else 0.0
        required += at_rest + later
        required += growth * abs(state[SPEED])
    x, y = state[X], state[Y]
    if distance(problem, signed, x, y) > scalar[REACH] + required:
        return 0.0
    c, s = (cos(state[THETA]), sin(state[THETA])) if THETA >= 0 else (1.0, 0.0)
    total, e = 0.0, 0.25 / scalar[GRID_INVERSE]
    d, count = 0, len(problem.discs)
    while d < count:
        ahead, aside, radius, members = (
            problem.discs[d, 0],
            problem.discs[d, 1],
            problem.discs[d, 2],
            problem.discs[d, 3],
        )
        px, py = x + ahead * c - aside * s, y + ahead * s + aside * c
        lack = required + radius - distance(problem, signed, px, py)
        d += 1
        if members > 0.0:
            d += int(members) if lack <= 0.0 else 0
            continue
        if lack <= 0.0:
            continue
        total += lack * lack
        if penalty > 0.0:
            gradient = work.gradient
            for i in range(NX):
                gradient[i] = 0.0
            sx = (distance(problem, signed, px + e, py) - distance(problem, signed, px - e, py)) * (0.5 / e)
            sy = (distance(problem, signed, px, py + e) - distance(problem, signed, px, py - e)) * (0.5 / e)
            gradient[X] -= sx
            gradient[Y] -= sy
            if THETA >= 0:
                gradient[THETA] += sx * (ahead * s + aside * c) - sy * (ahead * c - aside * s)
            if growth > 0.0:
                gradient[SPEED] += growth if state[SPEED] > 0.0 else -growth
            add_square(stages, k, penalty, lack, gradient)
    return total


@inlined
def limit_penalty(problem: Problem, stages: Stages, state: Floats, k: int, penalty: float) -> float:
    """Sum of squared violations of the limits of a state; with a positive `penalty` the stages get it, too."""
    total = 0.0
    for i in range(NX):
        low, high = problem.limits[i, 0], problem.limits[i, 1]
        slack = WITHIN_LIMITS * min(high - low, 1.0)
        excess = max(low + slack - state[i], state[i] - high + slack)
        if excess > 0.0:
            total += excess * excess
            if penalty > 0.0:
                stages.q[k, i] += penalty * (excess if state[i] > low + slack else -excess)
                stages.q_matrix[k, i, i] += penalty
    return total


@inlined
def goal_penalty(
    problem: Problem, setting: Floats, work: Shooting, stages: Stages, state: Floats, k: int, penalty: float
) -> float:
    """Sum of squared distances of the last state from the goal; with a positive `penalty` the stages get it, too."""
    total = 0.0
    for residual in range(NX + 2):
        miss, component, first, second = goal_miss(problem, setting, state, residual)
        if miss > 0.0:
            total += miss * miss
            if penalty > 0.0:
                for i in range(NX):
                    work.gradient[i] = 0.0
                work.gradient[component] = first
                if residual == 0:
                    work.gradient[Y] = second
                add_square(stages, k, penalty, miss, work.gradient)
    return total


@part
def state_penalties(
    n: int,
    problem: Problem,
    signed: Matrix32,
    setting: Floats,
    work: Shooting,
    stages: Stages,
    states: Matrix,
    inputs: Matrix,
    penalty: float,
) -> float:
    """Sum of squared violations of clearance, limits and goal; with a positive `penalty` the stages get it, too."""
    total, time = 0.0, setting[BEGIN]
    for k in range(n + 1):
        total += clearance_penalty(problem, signed, work, stages, states[k], k, time, penalty)
        total += limit_penalty(problem, stages, states[k], k, penalty)
        if k < n:
            time += inputs[k, NU]
    return total + goal_penalty(problem, setting, work, stages, states[n], n, penalty)


@inlined
def merit(
    n: int, setting: Floats, stages: Stages, states: Matrix, inputs: Matrix, after: Matrix, violation: float
) -> float:
    """Cost of a trajectory with its penalties (s), from what the model predicts and what is violated."""
    defect, rough, time = 0.0, 0.0, 0.0
    for k in range(n):
        for i in range(NX):
            d = after[k, i] - states[k + 1, i]
            defect += d * d
        time += inputs[k, NU]
        uneven = inputs[k, NU] - setting[EVEN]
        rough += setting[EVENNESS] * uneven * uneven
        if k > 0:
            for i in range(NU):
                jump = inputs[k, i] - inputs[k - 1, i]
                rough += stages.jump_weight[k, i] * jump * jump
    return setting[URGENCY] * time + 0.5 * (setting[PENALTY] * violation + setting[STIFFNESS] * defect + rough)


@inlined
def expand(n: int, problem: Problem, signed: Matrix32, setting: Floats, work: Shooting, stages: Stages) -> float:
    """Fill the linear-quadratic problem around the current trajectory, whose prediction is in `after`; its merit."""
    linearise(n, problem, work, stages)
    for k in range(n + 1):
        for i in range(NX):
            stages.q[k, i] = 0.0
            for j in range(NX):
                stages.q_matrix[k, i, j] = 0.0
    states, inputs = work.states, work.inputs
    violation = state_penalties(n, problem, signed, setting, work, stages, states, inputs, setting[PENALTY])
    for k in range(n):
        for i in range(NX):
            stages.c[k, i] = work.after[k, i] - states[k + 1, i]
        for i in range(NU):
            stages.r[k, i], stages.r_diagonal[k, i] = 0.0, 0.0
            stages.jump[k, i] = inputs[k, i] - inputs[k - 1, i] if k > 0 else 0.0
            stages.low[k, i] = problem.controls[i, 0] - inputs[k, i]
            stages.high[k, i] = problem.controls[i, 1] - inputs[k, i]
        stages.r[k, NU] = setting[URGENCY] + setting[EVENNESS] * (inputs[k, NU] - setting[EVEN])
        stages.r_diagonal[k, NU] = setting[EVENNESS]
        fixed = setting[SHORTEST] >= setting[LONGEST]
        stages.low[k, NU] = 0.0 if fixed else setting[SHORTEST] - inputs[k, NU]
        stages.high[k, NU] = 0.0 if fixed else setting[LONGEST] - inputs[k, NU]
    return merit(n, setting, stages, states, inputs, work.after, violation)


@inlined
def weigh(n: int, problem: Problem, setting: Floats, work: Shooting, stages: Stages) -> None:
    """Weights of the changes of controls, which in the last rounds cost a share of the time at most; even duration.

    Beyond a share of a control's range a change counts in proportion, not with its square: weights are those of the
    changes of the current trajectory (iteratively reweighted least squares).
    """
    time, rough = 0.0, 0.0
    for k in range(n):
        time += work.inputs[k, NU]
        for i in range(NU):
            jump = work.inputs[k, i] - work.inputs[k - 1, i] if k > 0 else 0.0
            span = problem.controls[i, 1] - problem.controls[i, 0]
            relative = jump / (span * setting[SMALL_CHANGE])
            stages.jump_weight[k, i] = 1.0 / math.sqrt(1.0 + relative * relative) if k > 0 else 0.0
            rough += stages.jump_weight[k, i] * (jump * jump / (span * span))
    setting[EVEN] = time / n
    weight = setting[SMOOTHNESS]
    if 0.5 * weight * rough > setting[SMOOTHNESS_COST] * time:
        weight = setting[SMOOTHNESS_COST] * time / (0.5 * rough)
    for k in range(1, n):
        for i in range(NU):
            span = problem.controls[i, 1] - problem.controls[i, 0]
            stages.jump_weight[k, i] *= weight / (span * span)


def _replay(n: int, problem: Problem, setting: Floats, work: Shooting, lanes: Lanes, braking: Lanes) -> int:
    """Edges that fail when the tree's own propagation and checks follow the controls, and 1 more outside the goal.

    Where one fails, the states at its ends get more margin, at most a cell.  That is less than what the edge lacks: a
    step over the border of a cell of the field gains a whole cell, and margin that is not needed makes turns tighter.
    """
    cell = 1.0 / problem.scalar[GRID_INVERSE]
    failed, time, first, before = int64(0), setting[BEGIN], int64(0), 0.0
    for i in range(NX):
        lanes.source[i] = work.states[0, i]
    for k in range(n):
        for i in range(NU):
            lanes.control[i * WIDTH] = work.inputs[k, i]
        set_duration(problem, lanes, first, work.inputs[k, NU])
        edge(problem, lanes, time)
        more = 0.0
        if lanes.slack[0] < 0.0:
            failed += 1
            more = min(LEAST_MARGIN * cell - MARGIN_SHARE * lanes.slack[0], cell)
        work.margin[k] += max(more - before, 0.0)
        work.margin[k + 1] += more
        before = more
        if requires_safety(problem, time, first, lanes) and brake(problem, lanes, braking, time) < 0:
            failed += UNSAFE
        time += work.inputs[k, NU]
        for i in range(NX):
            lanes.source[i] = lanes.block[i * WIDTH]
    return failed + (0 if lanes.at_goal[0] == 1 else 1)


def _approximate(n: int, problem: Problem, signed: Matrix32, setting: Floats, work: Shooting, stages: Stages) -> float:
    """Weights, and the linear-quadratic problem around the current trajectory, whose prediction is in `after`.

    Returns its merit with these weights.
    """
    weigh(n, problem, setting, work, stages)
    return expand(n, problem, signed, setting, work, stages)


def _evaluate(
    n: int,
    problem: Problem,
    signed: Matrix32,
    setting: Floats,
    work: Shooting,
    stages: Stages,
    backward: Backward,
    stepping: bool,
) -> float:
    """Merit of the current trajectory, or after a step, which becomes `tried`; `after` receives its prediction."""
    for k in range(n + 1):
        for i in range(NX):
            work.tried_states[k, i] = work.states[k, i] + (backward.dx[k, i] if stepping else 0.0)
    for k in range(n):
        for i in range(M):
            work.tried_inputs[k, i] = work.inputs[k, i] + (backward.du[k, i] if stepping else 0.0)
    states, inputs = work.tried_states, work.tried_inputs
    predict(n, problem, states, inputs, work.after, work.block)
    violation = state_penalties(n, problem, signed, setting, work, stages, states, inputs, 0.0)
    return merit(n, setting, stages, states, inputs, work.after, violation)


_ARGUMENTS = types.int64, PROBLEM, types.float32[:, ::1], types.float64[::1], SHOOTING, STAGES
approximate = compiled(_approximate, folder=FOLDER, signature=types.float64(*_ARGUMENTS))
evaluate = compiled(_evaluate, folder=FOLDER, signature=types.float64(*_ARGUMENTS, BACKWARD, types.boolean))
replay = compiled(
    _replay, folder=FOLDER, signature=types.int64(types.int64, PROBLEM, types.float64[::1], SHOOTING, LANES, LANES)
)
