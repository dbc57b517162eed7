"""Can the goal be reached at all?  Asked of the map, before anything is searched or driven."""

from __future__ import annotations

import math
from typing import Final

from kraft.errors import Unreachable
from kraft.scenario import Task
from kraft.workspace import goal_of, safety_of, settings_of, workspace_of
from ompl_ext import costtogo
from ompl_ext import kernel_types as at
from ompl_ext.kernel_types import Problem
from ompl_ext.query import make_problem
from ompl_ext.vehicle import Vehicle

UNREACHABLE: Final = "the goal is unreachable: no path from the start is wide enough for the footprint"


def check_reachable(task: Task, vehicle: Vehicle) -> None:
    """Check that a path leads from the task's start to its goal; 15 ms for a map of 4 m by 10 m.

    Raises:
        Unreachable: at the goal, if there is none.
    """
    problem = make_problem(vehicle, workspace_of(task, vehicle), goal_of(task), safety_of(task), settings_of(task))
    if not reachable(problem, task.start.x, task.start.y):
        expected = "expected a goal that the vehicle can get to"
        raise Unreachable([task.source.diagnostic("goal", UNREACHABLE, expected)])


def reachable(problem: Problem, x: float, y: float) -> bool:
    """Whether a point (m) is connected to the goal for the disc inscribed in the footprint: needed, not enough."""
    scalar, togo = problem.scalar, problem.togo
    column = math.floor((x - scalar[at.GRID_X]) * scalar[at.GRID_INVERSE] - 0.5)
    row = math.floor((y - scalar[at.GRID_Y]) * scalar[at.GRID_INVERSE] - 0.5)
    return bool(togo[row : row + 2, column : column + 2].min() < costtogo.UNREACHABLE)
