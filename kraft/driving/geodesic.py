"""Path of least cost-to-go as a plan, for controllers that make their own way: no vehicle model, nothing is checked."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.costtogo import descend, smooth
from ompl_ext.plan import Plan
from ompl_ext.poses import pose_of
from ompl_ext.solver import DirtSolver

STRIDE: Final = 3.0
"""Length of a step of the descent, cells."""
DIRECTIONS: Final = 48
"""Directions that a step of the descent tries."""
SMOOTHED: Final = 9
"""Samples of the path that its smoothed positions are the means of."""


def geodesic_plan(dirt: DirtSolver, root: Floats) -> Plan | None:
    """Path from `root` (nx,) down the cost-to-go to the goal at top speed; None if no path leads there.

    Its controls are those at rest: a path has none.
    """
    points = descended(dirt, *pose_of(root, dirt.vehicle)[:2])
    if points is None:
        return None
    vehicle = dirt.vehicle
    steps = np.diff(points, axis=0)
    lengths = np.hypot(*steps.T)
    durations = lengths / vehicle.top_speed
    times: Floats = np.concatenate([[0.0], durations.cumsum()])
    states = np.zeros((len(points), len(vehicle.state)))
    states[:, [vehicle.index("x"), vehicle.index("y")]] = points
    if vehicle.index("theta") >= 0 and len(steps):
        heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        states[:, vehicle.index("theta")] = np.append(heading, heading[-1])
    if vehicle.rest_indices:
        states[:, vehicle.rest_indices[0]] = vehicle.top_speed
    states[0] = root
    controls = np.zeros((len(durations), len(vehicle.controls)))
    return Plan(
        states=states, controls=controls, durations=durations, times=times, trajectory=states,
        cost=float(times[-1]), cost_to_go=0.0, reaches_goal=True, contingency=None,
    )  # fmt: skip


def descended(dirt: DirtSolver, x: float, y: float) -> Matrix | None:
    """Points (n, 2) from (x, y) to the goal region down the cost-to-go; None if it is infinite there."""
    scalar = dirt.problem.scalar
    stride, angles = STRIDE / float(scalar[at.GRID_INVERSE]), np.arange(DIRECTIONS) * math.tau / DIRECTIONS
    around = stride * np.column_stack([np.cos(angles), np.sin(angles)])
    points = np.empty((dirt.problem.togo.size, 2))  # more than any path has
    points[0] = x, y
    count = descend(dirt.problem, around, float(scalar[at.GOAL_RADIUS]) + stride, points)
    if count == 0:
        return None
    path = np.vstack([points[:count], scalar[[at.GOAL_X, at.GOAL_Y]]])
    result = np.empty_like(path)
    smooth(path, SMOOTHED // 2, result)
    return result
