"""Integrate a batch of candidate edges as vector lanes, and check them: the planner's innermost loop.

`ompl_ext.specialise` executes this module once per vehicle and supplies the vehicle as a global; it cannot be imported
by itself.  Lane i of component c stands at index c * WIDTH + i of a flat array: constant strides inside one array
are what lets LLVM prove the lanes independent and vectorise the loop over them.
"""

from __future__ import annotations

import math

from numba import types

from ompl_ext import dirt
from ompl_ext.clearance import pose_slack
from ompl_ext.costtogo import UNREACHABLE, seconds_to_goal
from ompl_ext.jit import compiled, inlined, part
from ompl_ext.kernel_types import LANE_WIDTH, LANES, PROBLEM, TREE, Lanes, Problem, Tree
from ompl_ext.specialise import take_target, vehicle_cache_folder
from ompl_ext.trigonometry import cos, sin
from ompl_ext.unroll import per_component, store_components, total_of_components

VEHICLE = take_target()
FOLDER = vehicle_cache_folder(VEHICLE)
NX = len(VEHICLE.state)
NU = len(VEHICLE.controls)
NI = len(VEHICLE.inputs) if VEHICLE.actuation is not None else NU
X, Y, THETA = (VEHICLE.index(name) for name in ("x", "y", "theta"))
SPEED = VEHICLE.rest_indices[0] if VEHICLE.rest else -1
REST = VEHICLE.rest_indices
MANOEUVRES = len(VEHICLE.manoeuvres)
WIDTH = LANE_WIDTH
AT_INPUT = NX * WIDTH  # the working block: state, input, step, cosine and sine of the heading, margin
AT_STEP = AT_INPUT + NI * WIDTH
AT_COS = AT_STEP + WIDTH
AT_SIN = AT_COS + WIDTH
AT_MARGIN = AT_SIN + WIDTH
AT_OUTSIDE = AT_MARGIN + WIDTH

derivative = VEHICLE.derivative
load_state = per_component("a, s, i", f"a[s + i + {{k}} * {WIDTH}]", NX)
load_input = per_component("a, s, i", f"a[s + i + {{k}} * {WIDTH}]", NI)
load_control = per_component("a, s, i", f"a[s + i + {{k}} * {WIDTH}]", NU)
load_parameters = per_component("p", "p[{k}]", len(VEHICLE.parameter_array))
axpy = per_component("a, k, x", "x[{k}] + a * k[{k}]", NX)
combine = per_component(
    "a, k1, k2, k3, k4, x", "x[{k}] + a * (k1[{k}] + 2.0 * (k2[{k}] + k3[{k}]) + k4[{k}])", NX
)
LIMITED = [k for k, name in enumerate(VEHICLE.state) if name in ("x", "y", *VEHICLE.limits)]
load_low = per_component("limits", "limits[{k}, 0]", NX)
load_high = per_component("limits", "limits[{k}, 1]", NX)
outside = total_of_components(
    "x, low, high", "(0.0 if low[{k}] <= x[{k}] else 1.0) + (0.0 if x[{k}] <= high[{k}] else 1.0)", LIMITED
)
store_state = store_components(NX, WIDTH)
store_input = store_components(NI, WIDTH)
actuation = VEHICLE.actuation or inlined(lambda u, p: u)
stop = VEHICLE.stop or per_component("x, p, k", "0.0", NU)


@inlined
def runge_kutta_4(x, u, p, h):  # type: ignore[no-untyped-def]
    """One classical RK4 step of h seconds."""
    k1 = derivative(x, u, p)
    k2 = derivative(axpy(0.5 * h, k1, x), u, p)
    k3 = derivative(axpy(0.5 * h, k2, x), u, p)
    k4 = derivative(axpy(h, k3, x), u, p)
    return combine(h / 6.0, k1, k2, k3, k4, x)


@inlined
def swept_margin(dx, dy, turn, c0, s0, c1, s1, reach, length):  # type: ignore[no-untyped-def]
    """Clearance (m) needed at both ends of a step so that no point of the body hits anything in between.

    The body moves `along` its axis, sideways and turns.  Moving along its axis by no more than its length it stays
    inside the union of its two end positions; `off`, what it moves otherwise, can carry its front or rear corners out
    of that union by at most off (along + off) / (along + 2 off).  See docs/planner.md for the derivation.
    """
    side0 = abs(dy * c0 - dx * s0)
    side1 = abs(dy * c1 - dx * s1)
    side = side0 if side0 > side1 else side1
    along = abs(dx * c0 + dy * s0)
    off = side + abs(turn) * reach
    margin = off * (along + off) / (along + 2.0 * off + 1e-12)
    return margin if along < length else 0.5 * (along + off)


@inlined
def integrate_lanes(block, lanes, p, low, high, reach, length):  # type: ignore[no-untyped-def]
    """Advance every lane of the working block by its own step; this loop vectorises."""
    for i in range(lanes):
        x = load_state(block, 0, i)
        y = runge_kutta_4(x, load_input(block, AT_INPUT, i), p, block[AT_STEP + i])
        store_state(block, 0, i, y)
        block[AT_OUTSIDE + i] += outside(y, low, high)
        if THETA >= 0:
            c, s = cos(y[THETA]), sin(y[THETA])
            turn = y[THETA] - x[THETA]
        else:
            c, s, turn = 1.0, 0.0, 0.0
        block[AT_MARGIN + i] = swept_margin(
            y[X] - x[X], y[Y] - x[Y], turn, block[AT_COS + i], block[AT_SIN + i], c, s, reach, length
        )
        block[AT_COS + i] = c
        block[AT_SIN + i] = s


@inlined
def record_lanes(work: Lanes, step, lanes):  # type: ignore[no-untyped-def]
    """Copy state, heading and margin of every lane from the working block into the trajectory."""
    block, start = work.block, step * NX * WIDTH
    for k in range(NX):
        for i in range(lanes):
            work.trajectory[start + k * WIDTH + i] = block[k * WIDTH + i]
    start = step * WIDTH
    for i in range(lanes):
        work.cosine[start + i] = block[AT_COS + i]
        work.sine[start + i] = block[AT_SIN + i]
        work.margin[start + i] = block[AT_MARGIN + i]


@inlined
def load_source(source, work: Lanes, lanes):  # type: ignore[no-untyped-def]
    """Start every lane from one state."""
    c, s = 1.0, 0.0
    if THETA >= 0:
        c, s = cos(source[THETA]), sin(source[THETA])
    for i in range(lanes):
        for k in range(NX):
            work.block[k * WIDTH + i] = source[k]
        work.block[AT_COS + i] = c
        work.block[AT_SIN + i] = s
        work.block[AT_MARGIN + i] = 0.0
        work.block[AT_OUTSIDE + i] = 0.0
    record_lanes(work, 0, lanes)


@part
def propagate(source, lanes, problem: Problem, work: Lanes):  # type: ignore[no-untyped-def]
    """Integrate `lanes` candidate edges from `source` and describe their ends: configuration, cost-to-go, goal."""
    p = load_parameters(problem.parameters)
    low, high = load_low(problem.limits), load_high(problem.limits)
    steps = problem.steps[0]
    reach, length = problem.body[0], problem.body[2]
    load_source(source, work, lanes)
    for i in range(lanes):
        store_input(work.block, AT_INPUT, i, actuation(load_control(work.control, 0, i), p))
        work.block[AT_STEP + i] = work.duration[i] / steps
    for step in range(1, steps + 1):
        integrate_lanes(work.block, lanes, p, low, high, reach, length)
        record_lanes(work, step, lanes)
    heading_weight = problem.metric[0]
    for i in range(lanes):
        x, y = work.block[X * WIDTH + i], work.block[Y * WIDTH + i]
        c, s = work.block[AT_COS + i], work.block[AT_SIN + i]
        work.end[i] = x
        work.end[WIDTH + i] = y
        work.end[2 * WIDTH + i] = heading_weight * c  # a heading as a point on a circle needs no wrapping
        work.end[3 * WIDTH + i] = heading_weight * s
        inside = work.block[AT_OUTSIDE + i] == 0.0  # only there is (x, y) surely on the grids
        work.slack[i] = 0.0 if inside else -1.0
        work.togo[i] = seconds_to_goal(problem, x, y) if inside else UNREACHABLE
        work.at_goal[i] = 1 if inside and in_goal(problem.goal, x, y, c, s) else 0


@inlined
def in_goal(goal, x, y, c, s):  # type: ignore[no-untyped-def]
    """Whether a pose is inside the goal region: position within the radius and heading within the tolerance."""
    dx, dy = x - goal[0], y - goal[1]
    heading = c * goal[3] + s * goal[4] >= goal[5]
    return dx * dx + dy * dy < goal[2] * goal[2] and heading


@inlined
def sample_slack(work: Lanes, step, lane, required, problem: Problem):  # type: ignore[no-untyped-def]
    at = step * NX * WIDTH + lane
    return pose_slack(
        problem, work.trajectory[at + X * WIDTH], work.trajectory[at + Y * WIDTH],
        work.cosine[step * WIDTH + lane], work.sine[step * WIDTH + lane], required,
    )  # fmt: skip


@inlined
def delta(work: Lanes, step, lane, problem: Problem):  # type: ignore[no-untyped-def]
    """Clearance delta(v) = delta_0 + delta_1 |v| that the model gap asks for at a sample (m)."""
    speed = 0.0
    if SPEED >= 0:
        speed = abs(work.trajectory[step * NX * WIDTH + SPEED * WIDTH + lane])
    return problem.safety[1] + problem.safety[2] * speed


@part
def check(lane, start_time, problem: Problem, work: Lanes):  # type: ignore[no-untyped-def]
    """Smallest spare clearance (m) along an edge, negative if it may collide; delta(v) is asked for inside the cycle."""
    if work.slack[lane] < 0.0:
        return -1.0
    steps, cycle = problem.steps[0], problem.safety[0]
    h = work.duration[lane] / steps
    smallest = math.inf
    for step in range(steps, -1, -1):  # the far end first: it collides most often
        before = work.margin[step * WIDTH + lane]
        after = work.margin[(step + 1) * WIDTH + lane] if step < steps else 0.0
        required = before if before > after else after
        if start_time + (step - 1) * h < cycle:
            required += delta(work, step, lane, problem)
        slack = sample_slack(work, step, lane, required, problem)
        if slack < 0.0:
            return slack
        smallest = min(smallest, slack)
    return smallest


@inlined
def at_rest(work: Lanes, step, lane, problem: Problem):  # type: ignore[no-untyped-def]
    resting = True
    for k in REST:
        resting = resting and abs(work.trajectory[step * NX * WIDTH + k * WIDTH + lane]) <= problem.safety[3]
    return resting


@inlined
def manoeuvre_slack(work: Lanes, lane, steps, problem: Problem):  # type: ignore[no-untyped-def]
    """Smallest spare delta-clearance of one braking manoeuvre until standstill; negative if unsafe (Alg. 2, l. 4-6)."""
    smallest = math.inf
    for step in range(steps + 1):
        before = work.margin[step * WIDTH + lane]
        after = work.margin[(step + 1) * WIDTH + lane] if step < steps else 0.0
        required = (before if before > after else after) + delta(work, step, lane, problem)
        slack = sample_slack(work, step, lane, required, problem)
        if slack < 0.0:
            return slack
        smallest = min(smallest, slack)
        if at_rest(work, step, lane, problem):
            return smallest
    return -1.0  # did not stop within the horizon


@inlined
def state_at_cycle_end(lane, start_time, problem: Problem, work: Lanes, source):  # type: ignore[no-untyped-def]
    """Write the state where an edge crosses the end of the cycle into `source`."""
    p = load_parameters(problem.parameters)
    h = work.duration[lane] / problem.steps[0]
    into = (problem.safety[0] - start_time) / h
    step = min(max(int(math.floor(into)), 0), problem.steps[0])
    x = load_state(work.trajectory, step * NX * WIDTH, lane)
    rest = (into - step) * h
    if rest > 0.0:
        x = runge_kutta_4(x, actuation(load_control(work.control, 0, lane), p), p, rest)
    for k in range(NX):
        source[k] = x[k]


@part
def safe(lane, start_time, problem: Problem, work: Lanes, brake: Lanes):  # type: ignore[no-untyped-def]
    """SAFETY (Alg. 2): number of the first contingency manoeuvre that is safe where edge `lane` leaves the cycle.

    -1 if there is none.  A negative `lane` asks the question of the state in `brake.source`.
    """
    if lane >= 0:
        state_at_cycle_end(lane, start_time, problem, work, brake.source)
    p = load_parameters(problem.parameters)
    low, high = load_low(problem.limits), load_high(problem.limits)
    reach, length = problem.body[0], problem.body[2]
    load_source(brake.source, brake, MANOEUVRES)
    for i in range(MANOEUVRES):
        brake.block[AT_STEP + i] = problem.safety[4]
    taken = 0
    for step in range(1, problem.steps[1] + 1):
        for i in range(MANOEUVRES):  # a manoeuvre is a control law, held over one step
            u = stop(load_state(brake.block, 0, i), p, i)
            store_input(brake.block, AT_INPUT, i, actuation(u, p))
        integrate_lanes(brake.block, MANOEUVRES, p, low, high, reach, length)
        record_lanes(brake, step, MANOEUVRES)
        taken = step
        everyone = True
        for i in range(MANOEUVRES):
            everyone = everyone and at_rest(brake, step, i, problem)
        if everyone:
            break
    for i in range(MANOEUVRES):
        if brake.block[AT_OUTSIDE + i] == 0.0:
            slack = manoeuvre_slack(brake, i, taken, problem)
            if slack >= 0.0:
                brake.slack[0] = slack
                return i
    return -1


def _grow(tree: Tree, problem: Problem, work: Lanes, brake: Lanes, iterations, q):  # type: ignore[no-untyped-def]
    dirt.grow(tree, problem, work, brake, iterations, q, propagate, check, safe)


grow = compiled(_grow, folder=FOLDER, signature=types.void(TREE, PROBLEM, LANES, LANES, types.int64, types.float64[::1]))
