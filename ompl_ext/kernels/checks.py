"""Checks of candidate edges and contingency manoeuvres, and the values of edges' ends, for one layout of the state.

`specialise` executes this module once for all vehicles whose states have the same layout, and supplies the layout as a
global; it cannot be imported directly.  `lanes` integrates the motion that is checked here.
"""

from __future__ import annotations

import math

from ompl_ext.arrays import Floats, int64
from ompl_ext.jit import callee, inlined
from ompl_ext.kernels import dirt, functions
from ompl_ext.kernels.clearance import delta_at, pose_slack, swept_margin
from ompl_ext.kernels.costtogo import UNREACHABLE, seconds_to_goal, with_braking
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    BRAKE_STEP,
    BRAKING,
    CYCLE,
    GOAL_COS,
    GOAL_HEADING,
    GOAL_LIMITS,
    GOAL_NEAR,
    GOAL_RADIUS,
    GOAL_SIN,
    GOAL_TOLERANCE,
    GOAL_X,
    GOAL_Y,
    HEADING_WEIGHT,
    LANE_WIDTH,
    LENGTH,
    MANOEUVRES,
    POSE_HEADINGS,
    REACH,
    REST_RATE,
    REST_SPEED,
    Lanes,
    Problem,
    block_layout,
)
from ompl_ext.kernels.posetogo import seconds_to_goal_pose
from ompl_ext.kernels.specialise import layout_being_compiled, layout_cache_folder
from ompl_ext.trigonometry import cos, sin

LAYOUT = layout_being_compiled()
FOLDER = layout_cache_folder(LAYOUT)
NX, X, Y, THETA = LAYOUT.components, LAYOUT.x, LAYOUT.y, LAYOUT.theta
SPEED = LAYOUT.rest[0] if LAYOUT.rest else -1
RESTING = LAYOUT.rest or (-1,)  # numba cannot iterate over an empty tuple
WIDTH = LANE_WIDTH
_, _, AT_OUTSIDE, AT_COS, AT_SIN, _, _ = block_layout(NX)


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


def finish(lanes: int, problem: Problem, work: Lanes) -> None:
    """Compute configuration, cost-to-go and goal of the ends of `lanes` edges, which the working block has."""
    scalar = problem.scalar
    is_exact = problem.option[GOAL_HEADING] == 1 or problem.option[GOAL_LIMITS] == 1
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
        if work.at_goal[i] == 1 and is_exact:  # the search for poses aims for a smaller region within the goal
            work.togo[i] = 0.0


def cut_at_goal(lanes: int, problem: Problem, work: Lanes) -> bool:
    """Shorten the edges that pass through the goal to their first sample in it; whether there are any."""
    x, y = work.trajectory[X * WIDTH], work.trajectory[Y * WIDTH]
    if not is_near_goal(problem.scalar, x, y, problem.scalar[GOAL_NEAR]):
        return False
    found = False
    for i in range(lanes):
        steps = work.steps[i]
        for step in range(1, steps):
            if in_goal(problem, work.trajectory, step * NX * WIDTH, i):
                dirt.set_duration(problem, work, i, work.duration[i] * step / steps)
                found = True
                break
    return found


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
    """Clearance that the model gap requires at a sample (m), `time` s after the start of the query."""
    speed = 0.0
    if SPEED >= 0:
        speed = abs(work.trajectory[(step * NX + SPEED) * WIDTH + lane])
    at_rest, per_speed, growth = delta_at(problem.scalar, time)
    return at_rest + per_speed * speed + growth


def check(lane: int, start_time: float, problem: Problem, work: Lanes) -> float:
    """Least slack (m) along an edge, negative if it may collide; within the cycle beyond delta(v)."""
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
def is_resting(work: Lanes, step: int, lane: int, problem: Problem) -> bool:
    """Whether the vehicle is at standstill at a sample, as `Safety.is_resting`."""
    resting = True
    for k in RESTING:
        largest = problem.scalar[REST_SPEED if k == RESTING[0] else REST_RATE]
        resting = resting and (k < 0 or abs(work.trajectory[(step * NX + k) * WIDTH + lane]) <= largest)
    return resting


@inlined
def manoeuvre_slack(brake: Lanes, lane: int, steps: int, problem: Problem) -> float:
    """Least slack (m) of a manoeuvre until standstill beyond delta, negative if it is not safe (Alg. 2, l. 4-6)."""
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
        if is_resting(brake, step, lane, problem):
            brake.steps[lane] = step
            return smallest
        before, c, s = after, c1, s1
    return -1.0  # did not stop within the horizon


def first_safe(steps: int, problem: Problem, brake: Lanes) -> int:
    """Number of the first contingency manoeuvre that is safe, -1 if there is none; `brake` has their trajectories.

    Its lane has the slack.
    """
    for i in range(problem.option[MANOEUVRES]):
        brake.slack[i] = -1.0
        if brake.block[AT_OUTSIDE + i] == 0.0:
            brake.slack[i] = manoeuvre_slack(brake, i, steps, problem)
        if brake.slack[i] >= 0.0:
            return i
    return -1


FUNCTIONS = {
    functions.FINISH: finish,
    functions.CUT: cut_at_goal,
    functions.CHECK: check,
    functions.FIRST_SAFE: first_safe,
}
ADDRESSES = {number: callee(each, FOLDER, functions.SIGNATURES[number]) for number, each in FUNCTIONS.items()}
