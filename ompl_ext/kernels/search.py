"""The planner's search and single edges, compiled once for all vehicles; see `functions` for what depends on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from numba import types

from ompl_ext.arrays import Floats, IntMatrix32, Ints, Matrix, Matrix32, Words16Matrix, int64
from ompl_ext.jit import compiled, inlined, part
from ompl_ext.kernels import dirt
from ompl_ext.kernels import functions as at
from ompl_ext.kernels.clearance import clearances, least_slacks, pose_slack
from ompl_ext.kernels.functions import (  # fmt: skip
    call_brake,
    call_check,
    call_cut,
    call_cycle_end,
    call_finish,
    call_first_safe,
    call_propagate,
)
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    BEST,
    CUT_AT_GOAL,
    FULL,
    LANE_WIDTH,
    LANES,
    PROBLEM,
    RETAINED_EDGES,
    TREE,
    Lanes,
    Maps,
    Problem,
    Retained,
    Tree,
)
from ompl_ext.trigonometry import cos, sin


@part
def propagate(source: Floats, lanes: int, problem: Problem, work: Lanes) -> None:
    """Integrate `lanes` candidate edges from `source`, and compute configuration, cost-to-go and goal of their ends."""
    call_propagate(problem.functions[at.PROPAGATE], (source, lanes, problem, work))
    call_finish(problem.functions[at.FINISH], (lanes, problem, work))


@part
def propagate_to_goal(source: Floats, lanes: int, problem: Problem, work: Lanes) -> None:
    """Integrate candidate edges as `propagate`; where that may matter, edges that pass through the goal end in it."""
    propagate(source, lanes, problem, work)
    if problem.option[CUT_AT_GOAL] == 1 and call_cut(problem.functions[at.CUT], (lanes, problem, work)):
        propagate(source, lanes, problem, work)


@inlined
def check(lane: int, start_time: float, problem: Problem, work: Lanes) -> float:
    """Least slack (m) along an edge, negative if it may collide; within the cycle beyond delta(v)."""
    if work.slack[lane] < 0.0:
        return -1.0
    slack: float = call_check(problem.functions[at.CHECK], (lane, start_time, problem, work))
    return slack


@part
def brake_from(source: Floats, problem: Problem, brake: Lanes) -> int:
    """SAFETY (Alg. 2): number of the first contingency manoeuvre that is safe from `source`, -1 if there is none.

    Afterwards `brake` has the manoeuvres' trajectories and, in its lane, the slack of the safe one.
    """
    steps = call_brake(problem.functions[at.BRAKE], (source, problem, brake))
    number: int = call_first_safe(problem.functions[at.FIRST_SAFE], (steps, problem, brake))
    return number


@part
def safe(lane: int, start_time: float, problem: Problem, work: Lanes, brake: Lanes) -> int:
    """SAFETY where edge `lane` crosses the end of the cycle."""
    call_cycle_end(problem.functions[at.CYCLE_END], (lane, start_time, problem, work, brake.source))
    return brake_from(brake.source, problem, brake)


def _grow(
    tree: Tree,
    problem: Problem,
    work: Lanes,
    brake: Lanes,
    q: Floats,
    retained: Retained,
    iterations: int,
    until_plan: bool,
) -> None:
    dirt.retain(tree, problem, work, brake, retained, propagate, check, safe)
    waiting = until_plan and tree.count[BEST] < 0
    for _ in range(iterations):
        dirt.visit(tree, problem, work, brake, q, propagate_to_goal, check, safe)
        if tree.count[FULL] == 1 or (waiting and tree.count[BEST] >= 0):
            return


@part
def edge(problem: Problem, work: Lanes, start_time: float) -> None:
    """Integrate and check one edge, in lane 0, from the source on."""
    lane, lanes = int64(0), int64(1)
    propagate(work.source, lanes, problem, work)
    work.slack[lane] = check(lane, start_time, problem, work)


def _edge(problem: Problem, work: Lanes, start_time: float) -> None:
    edge(problem, work, start_time)


def _path(problem: Problem, work: Lanes, edges: Matrix, steps: Ints, times: Floats, states: Matrix) -> None:
    nx, nu, begin, clock = states.shape[1], edges.shape[1] - 1, int64(0), 0.0
    for k in range(len(edges)):
        for c in range(nx):
            work.source[c] = states[begin, c]
        for c in range(nu):
            work.control[c * LANE_WIDTH] = edges[k, c]
        duration = edges[k, nu]
        work.duration[0], work.steps[0] = duration, steps[k]
        call_propagate(problem.functions[at.PROPAGATE], (work.source, int64(1), problem, work))
        for step in range(1, steps[k] + 1):
            times[begin + step] = clock + duration * step / steps[k]
            for c in range(nx):
                states[begin + step, c] = work.trajectory[(step * nx + c) * LANE_WIDTH]
        begin, clock = begin + steps[k], clock + duration


def _brake(problem: Problem, work: Lanes, brake: Lanes, start_time: float) -> int:
    if start_time < math.inf:
        return safe(int64(0), start_time, problem, work, brake)
    return brake_from(brake.source, problem, brake)


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


def _clearances(problem: Problem, poses: Matrix, c: Floats, s: Floats, found: Floats) -> None:
    clearances(problem, poses, c, s, found)


def _least_slacks(
    problem: Problem, states: Matrix, c: Floats, s: Floats, where: Ints, since: Floats, ends: Ints, found: Floats
) -> None:
    least_slacks(problem, states, c, s, where, since, ends, found)


@dataclass(frozen=True)
class Search:
    """Compiled search: single edges, manoeuvres, poses, motions, and `grow`.

    `grow` adds edges of an earlier plan and visits nodes: so many or, if asked to, until the first plan to the goal.
    `path` integrates edges (n, nu + 1), controls and durations, one after the other from `states[0]` on: it writes the
    states and times (s) of all steps, `steps` (n,) an edge, and checks nothing.
    """

    grow: Callable[[Tree, Problem, Lanes, Lanes, Floats, Retained, int, bool], None]
    edge: Callable[[Problem, Lanes, float], None]
    path: Callable[[Problem, Lanes, Matrix, Ints, Floats, Matrix], None]
    brake: Callable[[Problem, Lanes, Lanes, float], int]
    pose: Callable[[Matrix32, IntMatrix32, Words16Matrix, Floats, Floats, float, float, float], float]
    clearances: Callable[[Problem, Matrix, Floats, Floats, Floats], None]
    least_slacks: Callable[[Problem, Matrix, Floats, Floats, Ints, Floats, Ints, Floats], None]


@cache
def search() -> Search:
    """Compiled search; compiled, or loaded from the cache, on the first call."""
    floats, matrix, number, ints = types.float64[::1], types.float64[:, ::1], types.float64, types.int64[::1]
    maps = types.float32[:, ::1], types.int32[:, ::1], types.uint16[:, ::1], matrix, floats
    return Search(
        compiled(
            _grow,
            signature=types.void(TREE, PROBLEM, LANES, LANES, floats, RETAINED_EDGES, types.int64, types.boolean),
        ),
        compiled(_edge, signature=types.void(PROBLEM, LANES, number)),
        compiled(_path, signature=types.void(PROBLEM, LANES, matrix, ints, floats, matrix)),
        compiled(_brake, signature=types.int64(PROBLEM, LANES, LANES, number)),
        compiled(_pose, signature=number(*maps, number, number, number)),
        compiled(_clearances, signature=types.void(PROBLEM, matrix, floats, floats, floats)),
        compiled(_least_slacks, signature=types.void(PROBLEM, matrix, floats, floats, ints, floats, ints, floats)),
    )
