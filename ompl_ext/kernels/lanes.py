"""Integration and checks of a batch of candidate edges as vector lanes: the planner's innermost loop.

`specialise` executes this module once per vehicle and supplies the vehicle as a global; it cannot be imported directly.
Lane i of component c has index c * WIDTH + i of a flat array: with constant strides in one array LLVM can prove the
lanes independent and vectorise the loop over them.
"""

from __future__ import annotations

import math

from numba import types

from ompl_ext.arrays import Floats, IntMatrix32, Matrix, Matrix32, Words16Matrix, int64
from ompl_ext.jit import compiled, inlined, part, template
from ompl_ext.kernels import dirt
from ompl_ext.kernels.clearance import pose_slack, swept_margin
from ompl_ext.kernels.costtogo import UNREACHABLE, seconds_to_goal, with_braking
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    BRAKE_STEP,
    BRAKE_STEPS,
    BRAKING,
    CUT_AT_GOAL,
    CYCLE,
    DELTA,
    DELTA_HORIZON,
    DELTA_PER_SPEED,
    DELTA_PER_TIME,
    FULL,
    GOAL_COS,
    GOAL_LIMITS,
    GOAL_NEAR,
    GOAL_RADIUS,
    GOAL_SIN,
    GOAL_TOLERANCE,
    GOAL_X,
    GOAL_Y,
    HEADING_WEIGHT,
    LANE_WIDTH,
    LANES,
    LENGTH,
    POSE_HEADINGS,
    PROBLEM,
    REACH,
    REST_SPEED,
    RETAINED_EDGES,
    STEPS,
    TREE,
    Lanes,
    Maps,
    Problem,
    Retained,
    Tree,
)
from ompl_ext.kernels.posetogo import seconds_to_goal_pose
from ompl_ext.kernels.runge_kutta import runge_kutta_4
from ompl_ext.kernels.specialise import vehicle_being_compiled, vehicle_cache_folder
from ompl_ext.kernels.unroll import per_component, store_components, total_of_components
from ompl_ext.trigonometry import cos, sin

Values = tuple[float, ...]

VEHICLE = vehicle_being_compiled()
FOLDER = vehicle_cache_folder(VEHICLE)
NX = len(VEHICLE.state)
NU = len(VEHICLE.controls)
NI = len(VEHICLE.inputs) or NU
X, Y, THETA = (VEHICLE.index(name) for name in ("x", "y", "theta"))
REST = VEHICLE.rest_indices
SPEED = REST[0] if REST else -1
RESTING = REST or (-1,)  # numba cannot iterate over an empty tuple
MANOEUVRES = len(VEHICLE.manoeuvres)
WIDTH = LANE_WIDTH
AT_INPUT = NX * WIDTH  # the working block: state, input, step, deviation, outside, cosine and sine of the heading
AT_STEP = AT_INPUT + NI * WIDTH
AT_DEVIATION = AT_STEP + WIDTH
AT_OUTSIDE = AT_DEVIATION + WIDTH
AT_COS = AT_OUTSIDE + WIDTH
AT_SIN = AT_COS + WIDTH

derivative = VEHICLE.derivative
actuation = VEHICLE.actuation or per_component("u, p", "u[{k}]", NU)
stop = VEHICLE.stop or per_component("x, p, k", "0.0", NU)
load_state = per_component("a, s, i", f"a[s + i + {{k}} * {WIDTH}]", NX)
load_input = per_component("a, s, i", f"a[s + i + {{k}} * {WIDTH}]", NI)
load_control = per_component("a, s, i", f"a[s + i + {{k}} * {WIDTH}]", NU)
first_state = per_component("a", "a[{k}]", NX)
first_control = per_component("a", "a[{k}]", NU)
load_parameters = per_component("p", "p[{k}]", len(VEHICLE.parameter_array))
load_low = per_component("limits", "limits[{k}, 0]", NX)
load_high = per_component("limits", "limits[{k}, 1]", NX)
rk4_step = runge_kutta_4(derivative, NX)
outside = total_of_components(
    "x, low, high",
    "(0.0 if low[{k}] <= x[{k}] else 1.0) + (0.0 if x[{k}] <= high[{k}] else 1.0)",
    [k for k, name in enumerate(VEHICLE.state) if name in ("x", "y", *VEHICLE.limits)],
)
store_state = store_components(NX, WIDTH)
store_input = store_components(NI, WIDTH)


@inlined
def rate_change(first: Values, last: Values) -> tuple[float, float]:
    """Change of the rates of position (m/s, as the sum over both axes) and heading (rad/s) between two derivatives."""
    turning = abs(last[THETA] - first[THETA]) if THETA >= 0 else 0.0
    return abs(last[X] - first[X]) + abs(last[Y] - first[Y]), turning


@inlined
def integrate_lanes(block: Floats, lanes: int, p: Values, low: Values, high: Values, reach: float) -> None:
    """Advance every lane of the working block by its step; this loop vectorises.

    If a rate changes by d within a step of h s, the motion deviates from one at a constant rate by up to h d / 8.  The
    rest of the margin is left to `step_margin`, because most edges are never checked.
    """
    for i in range(lanes):
        x, h = load_state(block, 0, i), block[AT_STEP + i]
        y, first, last = rk4_step(x, load_input(block, AT_INPUT, i), p, h)
        shift, spin = rate_change(first, last)
        store_state(block, 0, i, y)
        block[AT_OUTSIDE + i] += outside(y, low, high)
        block[AT_DEVIATION + i] = 0.125 * h * (shift + reach * spin)


@inlined
def record_lanes(work: Lanes, step: int, lanes: int) -> None:
    """Copy state and deviation of every lane from the working block into the trajectory."""
    for k in range(NX):
        for i in range(lanes):
            work.trajectory[(step * NX + k) * WIDTH + i] = work.block[k * WIDTH + i]
    for i in range(lanes):
        work.deviation[step * WIDTH + i] = work.block[AT_DEVIATION + i]


@inlined
def load_source(source: Floats, work: Lanes, lanes: int, low: Values, high: Values) -> None:
    """Set every lane to one start state."""
    block = work.block
    for i in range(lanes):
        for k in range(NX):
            block[k * WIDTH + i] = source[k]
        block[AT_DEVIATION + i] = 0.0
        block[AT_OUTSIDE + i] = outside(load_state(block, 0, i), low, high)
    record_lanes(work, int64(0), lanes)


@inlined
def turn_lanes(block: Floats, lanes: int) -> None:
    """Compute cosine and sine of every lane's heading; this loop vectorises."""
    for i in range(lanes):
        block[AT_COS + i] = cos(block[THETA * WIDTH + i]) if THETA >= 0 else 1.0
        block[AT_SIN + i] = sin(block[THETA * WIDTH + i]) if THETA >= 0 else 0.0


@inlined
def is_near_goal(scalar: Floats, x: float, y: float, distance: float) -> bool:
    """Whether a position is less than `distance` m from the goal's centre."""
    dx, dy = x - scalar[GOAL_X], y - scalar[GOAL_Y]
    return dx * dx + dy * dy < distance * distance


@inlined
def in_goal(problem: Problem, states: Floats, at: int, lane: int) -> bool:
    """Whether a lane's state, at an index of `states`, is in the goal region: position, heading and bounds."""
    scalar, limits = problem.scalar, problem.goal_limits
    if not is_near_goal(scalar, states[at + X * WIDTH + lane], states[at + Y * WIDTH + lane], scalar[GOAL_RADIUS]):
        return False
    if THETA >= 0:
        theta = states[at + THETA * WIDTH + lane]
        if cos(theta) * scalar[GOAL_COS] + sin(theta) * scalar[GOAL_SIN] < scalar[GOAL_TOLERANCE]:
            return False
    if problem.option[GOAL_LIMITS] == 1:
        for k in range(NX):
            value = states[at + k * WIDTH + lane]
            if not limits[k, 0] <= value <= limits[k, 1]:
                return False
    return True


@inlined
def cost_to_go(problem: Problem, block: Floats, lane: int) -> float:
    """Cost-to-go of a lane's state (s): the largest of the bounds that the goal asks for."""
    scalar, limits = problem.scalar, problem.goal_limits
    x, y = block[X * WIDTH + lane], block[Y * WIDTH + lane]
    seconds = seconds_to_goal(problem, x, y)
    if seconds >= UNREACHABLE:
        return seconds
    if THETA >= 0 and problem.option[POSE_HEADINGS] > 0:
        seconds = max(seconds, seconds_to_goal_pose(problem, x, y, block[THETA * WIDTH + lane], seconds))
    if problem.option[GOAL_LIMITS] == 1:
        if SPEED >= 0 and scalar[BRAKING] > 0.0:
            seconds = with_braking(scalar, seconds, abs(block[SPEED * WIDTH + lane]))
        for k in range(NX):
            value = block[k * WIDTH + lane]
            seconds = max(seconds, limits[k, 2] * max(limits[k, 0] - value, value - limits[k, 1], 0.0))
    return seconds


@part
def propagate(source: Floats, lanes: int, problem: Problem, work: Lanes) -> None:
    """Integrate `lanes` candidate edges from `source`, and compute configuration, cost-to-go and goal of their ends."""
    scalar, steps = problem.scalar, problem.option[STEPS]
    p, low, high = load_parameters(problem.parameters), load_low(problem.limits), load_high(problem.limits)
    load_source(source, work, lanes, low, high)
    for i in range(lanes):
        store_input(work.block, AT_INPUT, i, actuation(load_control(work.control, 0, i), p))
        work.block[AT_STEP + i] = work.duration[i] / work.steps[i]
    for step in range(1, steps + 1):
        for i in range(lanes):  # a lane with fewer steps than the others stays at its end
            if step > work.steps[i]:
                work.block[AT_STEP + i] = 0.0
        integrate_lanes(work.block, lanes, p, low, high, scalar[REACH])
        record_lanes(work, step, lanes)
    turn_lanes(work.block, lanes)
    for i in range(lanes):
        x, y = work.block[X * WIDTH + i], work.block[Y * WIDTH + i]
        c, s = work.block[AT_COS + i], work.block[AT_SIN + i]
        work.end[i] = x
        work.end[WIDTH + i] = y
        work.end[2 * WIDTH + i] = scalar[HEADING_WEIGHT] * c  # a heading as a point on a circle does not wrap
        work.end[3 * WIDTH + i] = scalar[HEADING_WEIGHT] * s
        inside = work.block[AT_OUTSIDE + i] == 0.0  # guarantees that (x, y) is on the grids
        work.slack[i] = 0.0 if inside else -1.0
        work.togo[i] = cost_to_go(problem, work.block, i) if inside else UNREACHABLE
        work.at_goal[i] = 1 if inside and in_goal(problem, work.block, int64(0), i) else 0


@part
def cut_at_goal(lanes: int, problem: Problem, work: Lanes) -> bool:
    """Shorten the edges that pass through the goal to their first sample in it; whether there are any."""
    found = False
    for i in range(lanes):
        steps = work.steps[i]
        for step in range(1, steps):
            if in_goal(problem, work.trajectory, step * NX * WIDTH, i):
                dirt.set_duration(problem, work, i, work.duration[i] * step / steps)
                found = True
                break
    return found


@template
def propagate_to_goal(source: Floats, lanes: int, problem: Problem, work: Lanes) -> None:
    """Integrate candidate edges as `propagate`; where that may matter, edges that pass through the goal end in it."""
    scalar, uncut = problem.scalar, problem.option[CUT_AT_GOAL] == 1
    uncut = uncut and is_near_goal(scalar, source[X], source[Y], scalar[GOAL_NEAR])
    again = True
    while again:
        propagate(source, lanes, problem, work)
        again = uncut and cut_at_goal(lanes, problem, work)
        uncut = False


@inlined
def heading_at(work: Lanes, step: int, lane: int) -> tuple[float, float]:
    """Cosine and sine of the heading at a sample of a trajectory."""
    if THETA < 0:
        return 1.0, 0.0
    theta = work.trajectory[(step * NX + THETA) * WIDTH + lane]
    return cos(theta), sin(theta)


@inlined
def step_margin(
    work: Lanes, step: int, lane: int, c0: float, s0: float, c1: float, s1: float, problem: Problem
) -> float:
    """Clearance (m) that the motion from sample `step` - 1 to sample `step` requires at both."""
    before, after = (step - 1) * NX * WIDTH + lane, step * NX * WIDTH + lane
    dx = work.trajectory[after + X * WIDTH] - work.trajectory[before + X * WIDTH]
    dy = work.trajectory[after + Y * WIDTH] - work.trajectory[before + Y * WIDTH]
    turn = 0.0
    if THETA >= 0:
        turn = work.trajectory[after + THETA * WIDTH] - work.trajectory[before + THETA * WIDTH]
    straight = swept_margin(dx, dy, turn, c0, s0, c1, s1, problem.scalar[REACH], problem.scalar[LENGTH])
    return straight + work.deviation[step * WIDTH + lane]


@inlined
def sample_slack(work: Lanes, step: int, lane: int, c: float, s: float, required: float, problem: Problem) -> float:
    """Clearance at a sample of a trajectory beyond `required` (m)."""
    at = step * NX * WIDTH + lane
    return pose_slack(problem, work.trajectory[at + X * WIDTH], work.trajectory[at + Y * WIDTH], c, s, required)


@inlined
def delta(work: Lanes, step: int, lane: int, time: float, problem: Problem) -> float:
    """Clearance that the model gap requires at a sample (m), `time` s after the begin of the query."""
    speed = 0.0
    if SPEED >= 0:
        speed = abs(work.trajectory[(step * NX + SPEED) * WIDTH + lane])
    growth = problem.scalar[DELTA_PER_TIME] * min(time, problem.scalar[DELTA_HORIZON])
    return problem.scalar[DELTA] + problem.scalar[DELTA_PER_SPEED] * speed + growth


@part
def check(lane: int, start_time: float, problem: Problem, work: Lanes) -> float:
    """Smallest spare clearance (m) along an edge, negative if it may collide; within the cycle beyond delta(v)."""
    if work.slack[lane] < 0.0:
        return -1.0
    steps = work.steps[lane]
    h = work.duration[lane] / steps
    smallest, after = math.inf, 0.0  # `after` and `before` are the margins of the motions after and before a sample
    c, s = heading_at(work, steps, lane)
    for step in range(steps, -1, -1):  # from the end, which collides most often
        before, c0, s0 = 0.0, c, s
        if step > 0:
            c0, s0 = heading_at(work, step - 1, lane)
            before = step_margin(work, step, lane, c0, s0, c, s, problem)
        required = before if before > after else after
        if start_time + (step - 1) * h < problem.scalar[CYCLE]:
            required += delta(work, step, lane, start_time + step * h, problem)
        slack = sample_slack(work, step, lane, c, s, required, problem)
        if slack < 0.0:
            return slack
        smallest, after, c, s = min(smallest, slack), before, c0, s0
    return smallest


@inlined
def at_rest(work: Lanes, step: int, lane: int, problem: Problem) -> bool:
    """Whether the vehicle is at standstill at a sample."""
    resting = True
    for k in RESTING:
        resting = resting and (
            k < 0 or abs(work.trajectory[(step * NX + k) * WIDTH + lane]) <= problem.scalar[REST_SPEED]
        )
    return resting


@inlined
def manoeuvre_slack(brake: Lanes, lane: int, steps: int, problem: Problem) -> float:
    """Smallest spare delta-clearance of a manoeuvre until standstill, negative if it is not safe (Alg. 2, l. 4-6)."""
    smallest, before = math.inf, 0.0  # `before` and `after` are the margins of the motions before and after a sample
    c, s = heading_at(brake, int64(0), lane)
    for step in range(steps + 1):
        after, c1, s1 = 0.0, c, s
        if step < steps:
            c1, s1 = heading_at(brake, step + 1, lane)
            after = step_margin(brake, step + 1, lane, c, s, c1, s1, problem)
        time = problem.scalar[CYCLE] + step * problem.scalar[BRAKE_STEP]  # at the latest
        required = (before if before > after else after) + delta(brake, step, lane, time, problem)
        slack = sample_slack(brake, step, lane, c, s, required, problem)
        if slack < 0.0:
            return slack
        smallest = min(smallest, slack)
        if at_rest(brake, step, lane, problem):
            brake.steps[lane] = step
            return smallest
        before, c, s = after, c1, s1
    return -1.0  # did not stop within the horizon


@inlined
def state_at_cycle_end(lane: int, start_time: float, problem: Problem, work: Lanes, source: Floats) -> None:
    """Write the state where an edge crosses the end of the cycle, or ends before it, into `source`."""
    p = load_parameters(problem.parameters)
    h = work.duration[lane] / work.steps[lane]
    into = min((problem.scalar[CYCLE] - start_time) / h, float(work.steps[lane]))
    step = min(max(int(into), 0), work.steps[lane])
    x = load_state(work.trajectory, step * NX * WIDTH, lane)
    u = actuation(load_control(work.control, 0, lane), p)
    x, _, _ = rk4_step(x, u, p, max(into - step, 0.0) * h)
    for k in range(NX):
        source[k] = x[k]


@part
def brake_from(source: Floats, problem: Problem, brake: Lanes) -> int:
    """SAFETY (Alg. 2): number of the first contingency manoeuvre that is safe from `source`, -1 if there is none.

    Afterwards `brake` has the manoeuvres' trajectories and, in its lane's slack, the spare clearance of the safe one.
    """
    manoeuvres = int64(MANOEUVRES)  # not a literal: numba compiles the callees once more for each
    p, low, high = load_parameters(problem.parameters), load_low(problem.limits), load_high(problem.limits)
    load_source(source, brake, manoeuvres, low, high)
    for i in range(manoeuvres):
        brake.block[AT_STEP + i] = problem.scalar[BRAKE_STEP]
    step, moving = int64(0), True
    while moving and step < problem.option[BRAKE_STEPS]:
        step += 1
        for i in range(manoeuvres):  # a manoeuvre is a control law, held over one step
            u = stop(load_state(brake.block, 0, i), p, i)
            store_input(brake.block, AT_INPUT, i, actuation(u, p))
        integrate_lanes(brake.block, manoeuvres, p, low, high, problem.scalar[REACH])
        record_lanes(brake, step, manoeuvres)
        moving = False
        for i in range(manoeuvres):
            moving = moving or not at_rest(brake, step, i, problem)
    for i in range(manoeuvres):
        brake.slack[i] = -1.0
        if brake.block[AT_OUTSIDE + i] == 0.0:
            brake.slack[i] = manoeuvre_slack(brake, i, step, problem)
        if brake.slack[i] >= 0.0:
            return i
    return -1


@template
def safe(lane: int, start_time: float, problem: Problem, work: Lanes, brake: Lanes) -> int:
    """SAFETY where edge `lane` crosses the end of the cycle."""
    state_at_cycle_end(lane, start_time, problem, work, brake.source)
    return brake_from(brake.source, problem, brake)


def _grow(
    tree: Tree, problem: Problem, work: Lanes, brake: Lanes, q: Floats, retained: Retained, iterations: int
) -> None:
    dirt.retain(tree, problem, work, brake, retained, propagate, check, safe)
    for _ in range(iterations):
        dirt.visit(tree, problem, work, brake, q, propagate_to_goal, check, safe)
        if tree.count[FULL] == 1:
            return


def _edge(problem: Problem, work: Lanes, start_time: float) -> None:
    lane, lanes = int64(0), int64(1)
    propagate(work.source, lanes, problem, work)
    work.slack[lane] = check(lane, start_time, problem, work)


def _brake(problem: Problem, work: Lanes, brake: Lanes, start_time: float) -> int:
    if start_time < math.inf:
        return safe(int64(0), start_time, problem, work, brake)
    return brake_from(brake.source, problem, brake)


def _advance(state: Floats, control: Floats, parameters: Floats, h: float, result: Floats) -> None:
    p = load_parameters(parameters)
    y, _, _ = rk4_step(first_state(state), actuation(first_control(control), p), p, h)
    for k in range(NX):
        result[k] = y[k]


def _roll_out(states: Floats, controls: Matrix, parameters: Floats, h: Floats) -> None:
    p = load_parameters(parameters)
    for motion in range(states.shape[0]):
        x, u = first_state(states[motion, 0]), actuation(first_control(controls[motion]), p)
        for step in range(1, states.shape[1]):
            x, _, _ = rk4_step(x, u, p, h[motion])
            for k in range(NX):
                states[motion, step, k] = x[k]


def _pose(
    field: Matrix32,
    tile: IntMatrix32,
    squares: Words16Matrix,
    discs: Matrix,
    scalar: Floats,
    x: float,
    y: float,
    theta: float,
) -> float:
    maps = Maps(discs, field, tile, squares, scalar)  # passing few arrays from Python takes half the time of a Problem
    return pose_slack(maps, x, y, cos(theta), sin(theta), 0.0)


_FLOATS = types.float64[::1]
grow = compiled(
    _grow,
    folder=FOLDER,
    signature=types.void(TREE, PROBLEM, LANES, LANES, _FLOATS, RETAINED_EDGES, types.int64),
)
edge = compiled(_edge, folder=FOLDER, signature=types.void(PROBLEM, LANES, types.float64))
brake = compiled(_brake, folder=FOLDER, signature=types.int64(PROBLEM, LANES, LANES, types.float64))
advance = compiled(_advance, folder=FOLDER, signature=types.void(_FLOATS, _FLOATS, _FLOATS, types.float64, _FLOATS))
roll_out = compiled(
    _roll_out,
    folder=FOLDER,
    signature=types.void(types.float64[:, :, ::1], types.float64[:, ::1], _FLOATS, _FLOATS),
)
pose = compiled(
    _pose,
    folder=FOLDER,
    signature=types.float64(
        types.float32[:, ::1],
        types.int32[:, ::1],
        types.uint16[:, ::1],
        types.float64[:, ::1],
        _FLOATS,
        types.float64,
        types.float64,
        types.float64,
    ),
)
