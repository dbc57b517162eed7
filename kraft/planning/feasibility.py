"""Exact checks of start and goal before planning; problems are reported at their line of the scenario."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from kraft.errors import Code, Diagnostic, InputError, Unreachable
from kraft.planning.free_place import Pose, beyond_bounds, fits, free_place, overlap
from kraft.planning.workspace import (
    goal_of,
    planar_obstacle,
    pose_text,
    safety_of_task,
    settings_of,
    workspace_of,
)
from kraft.scenario import OccupancyMap, Task
from kraft.scenario.planning import INTEGRATION_STEP
from kraft.text import suggestion
from ompl_ext.arrays import Floats
from ompl_ext.exact import ExactClearance
from ompl_ext.kernels import costtogo
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.kernel_types import Problem
from ompl_ext.memory import MapTooLargeError, check_memory, in_words
from ompl_ext.motion import motion_of
from ompl_ext.obstacles import Workspace
from ompl_ext.poses import heading_of
from ompl_ext.problem import make_problem, memory_of_maps
from ompl_ext.query import Settings
from ompl_ext.vehicle import Footprint, Vehicle

POINT = Footprint(1e-6, 1e-6)
REACH_ALLOWANCE: Final = 0.02
"""Allowance for the range of a component, as a share of the range that simulated motions show."""
OUTSIDE: Final = -1
"""In place of the number of an obstacle: beyond the bounds."""
TOUCHING: Final = 1e-3
"""Depth of an overlap below which the vehicle touches the obstacle, m."""
EXPECTED_START: Final = "expected a start that is free and inside the bounds"
UNREACHABLE: Final = "the goal is unreachable: no path from the start is wide enough for the footprint"


def memory_needed(task: Task, vehicle: Vehicle) -> int:
    """Memory (bytes) that the distance fields of a task need at most."""
    settings = Settings()  # those of the search do not matter
    return memory_of_maps(vehicle, workspace_of(task, vehicle), safety_of_task(task), settings, goal_of(task))


def check_memory_of_maps(task: Task, vehicle: Vehicle) -> None:
    """Check that the maps of a task fit into memory, before any of it is taken.

    Raises:
        InputError: at the first map, or at the bounds, if they do not.
    """
    try:
        check_memory(memory_needed(task, vehicle))
    except MapTooLargeError as error:
        maps = [i for i, obstacle in enumerate(task.obstacles) if isinstance(obstacle, OccupancyMap)]
        place: str | tuple[str | int, ...] = ("obstacles", maps[0], "map") if maps else "bounds"
        problem = f"needs {in_words(error.needed)} of memory for its distance fields"
        expected = f"expected at most {in_words(error.available)}, which are available"
        raise InputError([task.source.diagnostic(place, problem, expected, code=Code.VALUE)]) from None


def check_placement(task: Task, vehicle: Vehicle, state: Floats, origin: str | None = None) -> None:
    """Check with FCL that the start state and the centre of the goal are free and within the bounds.

    Args:
        task: the scene and the goal.
        vehicle: vehicle whose footprint is checked.
        state: state in which planning starts, shape (nx,).
        origin: plan file that the state is from, if it is not the start of the task.

    Raises:
        InputError: if the footprint at the start, or the goal's centre, is inside an obstacle or out of bounds, if the
            goal bounds what the vehicle does not have or cannot reach, if the integration step is too short, or if the
            maps do not fit into memory.
    """
    check_memory_of_maps(task, vehicle)
    x, y = float(state[vehicle.index("x")]), float(state[vehicle.index("y")])
    heading = heading_of(state, vehicle)
    problems = []
    if (hit := _first_hit(task, vehicle, vehicle.footprint, (x, y, heading))) is not None:
        problems.append(_start_problem(task, vehicle, (x, y, heading), hit, origin))
    problems += _speed_problems(task, vehicle) if origin is None else []
    if (hit := _first_hit(task, vehicle, POINT, (*task.goal.center, 0.0))) is not None:
        problem = f"the goal's centre {_phrase(task, hit)}"
        expected = "expected a free place"
        problems.append(task.source.diagnostic("goal.center", problem, expected, code=Code.GEOMETRY))
    if task.goal.heading is not None and vehicle.index("theta") < 0:
        problem = f"{vehicle.name} has no heading: its state has no component theta"
        expected = "expected a goal without a heading, or a vehicle that turns"
        problems.append(task.source.diagnostic("goal.heading_deg", problem, expected, code=Code.MISMATCH))
    problems += _goal_limit_problems(task, vehicle) + _step_problems(task, vehicle)
    if problems:
        raise InputError(problems)


def _start_problem(task: Task, vehicle: Vehicle, pose: Pose, hit: int, origin: str | None) -> Diagnostic:
    """What is wrong with a start: in what the vehicle is, how deep, and where near it there is room."""
    shape = vehicle.footprint
    if not fits(task, shape):  # then what it collides with at this start says nothing
        problem = (
            f"the footprint of {vehicle.name}, {shape.length:g} m x {shape.width:g} m, does not fit into the bounds"
        )
        expected = "expected a smaller vehicle or wider bounds"
    else:
        problem = f"{vehicle.name} at {pose_text(*pose)} {_phrase(task, hit)}{_how_deep(task, vehicle, pose, hit)}"
        place = free_place(task, vehicle, pose) if origin is None else None
        near = "" if place is None else f", such as ({place[0]:.2f}, {place[1]:.2f}) with this heading"
        expected = EXPECTED_START + near
    if origin is None:
        return task.source.diagnostic("start", problem, expected, code=Code.GEOMETRY)
    return Diagnostic(origin, problem, expected, code=Code.GEOMETRY)


def _how_deep(task: Task, vehicle: Vehicle, pose: Pose, hit: int) -> str:
    """How far the vehicle is in what it hits, as the end of a sentence; empty if that is not known."""
    if hit == OUTSIDE:
        return f": it reaches {beyond_bounds(task, vehicle.footprint, pose)}"
    depth = overlap(task, vehicle, pose, hit)
    if depth is None:
        return ""
    return f", which it overlaps by {depth:.2g} m" if depth >= TOUCHING else ", which it touches"


def needs_motions(task: Task) -> bool:
    """Whether `check_placement` simulates motions of the vehicle, for which its model is compiled.

    All other tasks need those of maps alone.
    """
    return bool(task.goal.limits) or (_has_short_step(task) and task.planning.edge_duration is None)


def _has_short_step(task: Task) -> bool:
    return task.planning.integration_step < INTEGRATION_STEP


def _speed_problems(task: Task, vehicle: Vehicle) -> list[Diagnostic]:
    """A speed at the start that the vehicle does not have."""
    speed = task.start.speed
    if abs(speed) > vehicle.top_speed:
        problem, expected = f"is {speed:g} m/s, faster than {vehicle.name} can be", f"at most {vehicle.top_speed:g} m/s"
        return [task.source.diagnostic("start.speed", problem, f"expected {expected}")]
    if speed != 0.0 and not vehicle.rest:
        problem = f"is {speed:g} m/s, and {vehicle.name} names no speed in its rest components"
        expected = "expected no speed, or another vehicle"
        return [task.source.diagnostic("start.speed", problem, expected, code=Code.MISMATCH)]
    return []


def _step_problems(task: Task, vehicle: Vehicle) -> list[Diagnostic]:
    """A step that is too short for the edges of the vehicle.  Their durations are computed only for a shorter step."""
    if not _has_short_step(task):
        return []
    try:
        settings_of(task, vehicle)
    except InputError as error:
        return list(error.diagnostics)
    return []


def _goal_limit_problems(task: Task, vehicle: Vehicle) -> list[Diagnostic]:
    """Limits of the goal on components that the vehicle does not have, or that exclude what it can reach."""
    problems = []
    others = [name for name in vehicle.state if name not in ("x", "y", "theta")]
    for name, (low, high) in task.goal.limits.items():
        key = ("goal", "limits", name)
        if name not in others:
            has = suggestion(name, others, none=f"expected no limits: {vehicle.name} has no component besides its pose")
            problem = f"{vehicle.name} has no component {name!r} besides its pose"
            problems.append(task.source.diagnostic(key, problem, has, code=Code.UNKNOWN))
            continue
        motion, k = motion_of(vehicle), vehicle.index(name)
        least, most = float(motion.low[k]), float(motion.high[k])
        allowance = REACH_ALLOWANCE * (most - least)
        if high < least - allowance or low > most + allowance:
            problem = f"{low:g} to {high:g} excludes what {vehicle.name} can reach, {least:.3g} to {most:.3g}"
            expected = "expected limits that overlap with it"
            problems.append(task.source.diagnostic(key, problem, expected))
    return problems


def _first_hit(task: Task, vehicle: Vehicle, footprint: Footprint, pose: Pose) -> int | None:
    """Number of the first obstacle that the footprint at a pose collides with, or `OUTSIDE`; None if it is free."""
    workspace = workspace_of(task, vehicle)
    outside = task.bounds.outside(*pose[:2])
    if not outside and not ExactClearance(workspace, footprint).collides(*pose):
        return None
    for i, obstacle in enumerate(task.obstacles):
        alone = Workspace(workspace.bounds, (planar_obstacle(obstacle),))
        if ExactClearance(alone, footprint).collides(*pose):
            return i
    return OUTSIDE


def _phrase(task: Task, hit: int) -> str:
    """What something is in, as the end of a sentence."""
    return "is out of bounds" if hit == OUTSIDE else f"is in collision with {obstacle_text(task, hit)}"


def obstacle_text(task: Task, number: int) -> str:
    """Obstacle in a message: its name, or its place in the file."""
    name = task.obstacles[number].name
    return repr(name) if name else f"obstacles[{number}]"


def nearest_obstacle(task: Task, vehicle: Vehicle, pose: Pose) -> str:
    """Obstacle that is nearest to the vehicle at a pose, in a message; `the bounds` if these are nearer."""
    bounds = task.bounds.x, task.bounds.y
    alone = [Workspace(bounds, (planar_obstacle(obstacle),)) for obstacle in task.obstacles]
    away = [ExactClearance(each, vehicle.footprint).distance(*pose) for each in alone]
    fence_away = ExactClearance(workspace_of(replace(task, obstacles=()), vehicle), vehicle.footprint).distance(*pose)
    nearest = min(range(len(away)), key=away.__getitem__, default=None)
    return "the bounds" if nearest is None or fence_away < away[nearest] else obstacle_text(task, nearest)


def footprint_hit(task: Task, vehicle: Vehicle, pose: Pose) -> str | None:
    """Phrase with the first collision of the vehicle at a pose (m, m, rad), or that it is outside; None if free."""
    hit = _first_hit(task, vehicle, vehicle.footprint, pose)
    return None if hit is None else _phrase(task, hit)


def goal_hit(task: Task, vehicle: Vehicle) -> str | None:
    """Phrase with what the goal's centre is in, or that it is out of bounds; None if it is free."""
    hit = _first_hit(task, vehicle, POINT, (*task.goal.center, 0.0))
    return None if hit is None else _phrase(task, hit)


def check_reachable(task: Task, vehicle: Vehicle) -> float:
    """Check that a path leads from the task's start to its goal; 15 ms for a map of 4 m by 10 m.

    Returns:
        Lower bound of the time to the goal: the shortest path of the disc inscribed in the footprint, at top speed (s).

    Raises:
        Unreachable: at the goal, if there is none.
    """
    seconds = geodesic_time(task, vehicle)
    if not math.isfinite(seconds):
        expected = "expected a goal that the vehicle can get to"
        raise Unreachable([task.source.diagnostic("goal", UNREACHABLE, expected, code=Code.GEOMETRY)])
    return seconds


def geodesic_time(task: Task, vehicle: Vehicle) -> float:
    """Time of the shortest path at top speed for the disc inscribed in the footprint, s; infinite if there is none."""
    goal = replace(goal_of(task), limits={})
    settings = Settings(pose_cost_to_go=False)  # neither limits nor settings matter; the vehicle's need its kernels
    problem = make_problem(vehicle, workspace_of(task, vehicle), goal, safety_of_task(task), settings)
    least = least_time(problem, task.start.x, task.start.y)
    return least if least < costtogo.UNREACHABLE else math.inf


def reachable(problem: Problem, x: float, y: float) -> bool:
    """Whether the disc inscribed in the footprint can move from a point (m) to the goal: necessary, not sufficient."""
    return least_time(problem, x, y) < costtogo.UNREACHABLE


def least_time(problem: Problem, x: float, y: float) -> float:
    """Least time in which that disc gets from a point (m) to the goal at top speed, s, at the best cell around it.

    It is `UNREACHABLE` without a way, and of a point that has no cell, as that of a vehicle far out of the bounds.
    """
    scalar, togo = problem.scalar, problem.togo
    column = math.floor((x - scalar[at.GRID_X]) * scalar[at.GRID_INVERSE] - 0.5)
    row = math.floor((y - scalar[at.GRID_Y]) * scalar[at.GRID_INVERSE] - 0.5)
    around = togo[max(row, 0) : max(row + 2, 0), max(column, 0) : max(column + 2, 0)]
    return float(around.min(initial=costtogo.UNREACHABLE))
