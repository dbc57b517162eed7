"""Conversion of a task to the input of the planner: workspace, goal, safety and settings."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from kraft.errors import Code, InputError
from kraft.scenario import Bounds, Box, Circle, Obstacle, OccupancyMap, Polygon, Task
from kraft.scenario.planning import STEPS_MAX
from kraft.vehicles.load import load_vehicle
from ompl_ext import obstacles as planar
from ompl_ext.arrays import Floats
from ompl_ext.motion import edge_durations
from ompl_ext.obstacles import Workspace, box
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.vehicle import Vehicle


def workspace_of(task: Task, vehicle: Vehicle) -> Workspace:
    """Obstacles of the task, and walls around its bounds, because the footprint has to stay inside them."""
    solid = tuple(planar_obstacle(obstacle) for obstacle in task.obstacles)
    thickness = 2 * vehicle.footprint.reach
    return Workspace((task.bounds.x, task.bounds.y), solid + fence(task.bounds, thickness))


def planar_obstacle(obstacle: Obstacle) -> planar.Obstacle:
    """Obstacle for the planner."""
    match obstacle:
        case Box():
            return box(obstacle.center, obstacle.size, obstacle.yaw)
        case Circle():
            return planar.Circle(np.array(obstacle.center), obstacle.radius)
        case Polygon():
            return planar.Polygon(np.array(obstacle.vertices))
        case OccupancyMap():
            return obstacle.grid


def fence(bounds: Bounds, thickness: float) -> tuple[planar.Polygon, ...]:
    """Four walls around the bounds, `thickness` m wide."""
    (x0, x1), (y0, y1) = bounds.x, bounds.y
    cx, cy, width, height = (x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0
    t = thickness
    return (
        box((x0 - t / 2, cy), (t, height + 2 * t)),
        box((x1 + t / 2, cy), (t, height + 2 * t)),
        box((cx, y0 - t / 2), (width, t)),
        box((cx, y1 + t / 2), (width, t)),
    )


def goal_of(task: Task) -> Goal:
    """Goal region; without a heading every heading is accepted."""
    goal = task.goal
    if goal.heading is None or goal.heading_tolerance is None:
        return Goal(goal.center, goal.radius, limits=goal.limits)
    return Goal(goal.center, goal.radius, goal.heading, goal.heading_tolerance, goal.limits)


def safety_of_task(task: Task) -> Safety:
    """SAFETY at the end of the first cycle, with the clearance that the task requires."""
    stated = task.planning.safety
    return Safety(
        cycle=task.planning.cycle,
        delta=stated.delta,
        delta_per_speed=stated.delta_per_speed,
        horizon=stated.horizon,
    )


def settings_of(task: Task, vehicle: Vehicle) -> Settings:
    """Settings of the planner; those that a scenario does not have keep their defaults.

    Raises:
        InputError: if the integration step is too short for the edges of the vehicle.
    """
    planning = task.planning
    shortest, longest = planning.edge_duration or edge_durations(vehicle)
    if planning.steps_of(longest) > STEPS_MAX:  # the schema checks durations that the scenario states
        problem = f"is {planning.integration_step:g}, and the longest edge of {vehicle.name} takes {longest:.3g} s"
        expected = f"expected a step with which it takes at most {STEPS_MAX} steps"
        key = "planning.integration_step"
        raise InputError([task.source.diagnostic(key, problem, expected, code=Code.CONFLICT)])
    planner = "sst" if planning.planner == "sst" else "dirt"
    return Settings(
        planner=planner,
        blossom=planning.blossom,
        child_extension=planning.child_extension,
        pruning=planning.pruning,
        polish=planning.polish and planner == "dirt",
        goal_bias=planning.goal_bias,
        shortest=shortest,
        longest=longest,
        steps=planning.steps_of(longest),
    )


def start_state(task: Task, vehicle: Vehicle) -> Floats:
    """Start pose and speed as a state of the vehicle with all other components zero, shape (nx,).

    The speed is the first of the components that vanish at rest.
    """
    state = np.zeros(len(vehicle.state))
    values = {"x": task.start.x, "y": task.start.y, "theta": task.start.heading}
    if vehicle.rest:
        values[vehicle.rest[0]] = task.start.speed
    for name, value in values.items():
        if vehicle.index(name) >= 0:
            state[vehicle.index(name)] = value
    return state


def pose_text(x: float, y: float, heading: float) -> str:
    """Pose as a phrase."""
    return f"({x:.3g}, {y:.3g}) heading {math.degrees(heading):.4g} deg"


def vehicle_of_task(task: Task) -> Vehicle:
    """Vehicle that a scenario names.

    Raises:
        InputError: as `load_vehicle`; problems of the reference are reported at its line.
    """
    try:
        return load_vehicle(task.vehicle, Path(task.source.file).parent)
    except InputError as error:
        raise InputError(
            task.source.diagnostic("vehicle", d.problem, d.expected, code=d.code) if d.file == task.vehicle else d
            for d in error.diagnostics
        ) from error
