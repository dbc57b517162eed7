"""From a vehicle, a workspace and a goal to the arrays that the kernels read."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ompl_ext.clearance import ClearanceField, clearance_field, cover
from ompl_ext.costtogo import cost_to_go
from ompl_ext.kernel_types import LANE_WIDTH, Q_DIM, Lanes, Problem
from ompl_ext.obstacles import Workspace
from ompl_ext.vehicle import Vehicle


@dataclass(frozen=True)
class Goal:
    """Goal region: a position, a radius (m) and, optionally, a heading with a tolerance (rad)."""

    center: tuple[float, float]
    radius: float
    heading: float = 0.0
    tolerance: float = math.pi


@dataclass(frozen=True)
class Safety:
    """Clearance delta(v) = `delta` + `delta_per_speed` |v| kept within the first cycle and until standstill.

    `enabled` asks SAFETY (Alg. 2) of every edge that crosses the end of the cycle.
    """

    enabled: bool = True
    cycle: float = 1.0
    delta: float = 0.0
    delta_per_speed: float = 0.0
    rest_speed: float = 0.01
    step: float = 0.1
    horizon: float = 10.0


@dataclass(frozen=True)
class Settings:
    """Settings of DIRT."""

    blossom: int = 16
    insertions: int = 1
    child_extension: bool = True
    sort_by_f: bool = False
    goal_bias: float = 0.05
    beyond: float = 0.25
    shortest: float = 0.5
    longest: float = 1.0
    steps: int = 10
    heading_weight: float = 0.0
    floor: float = 0.005
    discs: int = 4
    cell: float = 0.02


def make_problem(vehicle: Vehicle, workspace: Workspace, goal: Goal, safety: Safety, settings: Settings) -> Problem:
    discs = cover(vehicle.footprint, settings.discs)
    reach = vehicle.footprint.reach
    field = clearance_field(workspace, reach + 2 * settings.cell, settings.cell)
    togo = cost_to_go(field, vehicle.footprint.inscribed, goal.center, goal.radius, vehicle.top_speed)
    limits = vehicle.state_limits.copy()
    for name, bounds in zip(("x", "y"), workspace.bounds, strict=True):
        k = vehicle.index(name)
        limits[k] = max(limits[k, 0], bounds[0]), min(limits[k, 1], bounds[1])
    has_tolerance = goal.tolerance < math.pi
    return Problem(
        parameters=vehicle.parameter_array,
        controls=vehicle.control_bounds,
        limits=limits,
        steps=np.array([settings.steps, math.ceil(safety.horizon / safety.step)]),
        duration=np.array([settings.shortest, settings.longest]),
        metric=np.array([settings.heading_weight, settings.floor]),
        safety=np.array([safety.cycle, safety.delta, safety.delta_per_speed, safety.rest_speed, safety.step]),
        body=np.array([reach, discs.radius, vehicle.footprint.length]),
        discs=discs.centres,
        field=field.values,
        grid=np.array([*field.origin, 1 / field.cell]),
        togo=togo.seconds,
        togo_grid=np.array([*togo.origin, 1 / togo.cell]),
        bounds=np.array([*workspace.bounds[0], *workspace.bounds[1]]),
        chance=np.array([settings.goal_bias, settings.beyond]),
        options=np.array([settings.blossom, settings.insertions, settings.child_extension, settings.sort_by_f, safety.enabled]),
        goal=np.array([*goal.center, goal.radius, math.cos(goal.heading), math.sin(goal.heading),
                       math.cos(goal.tolerance) if has_tolerance else -2.0]),
    )  # fmt: skip


def make_lanes(vehicle: Vehicle, steps: int) -> Lanes:
    nx, nu = len(vehicle.state), len(vehicle.controls)
    inputs = len(vehicle.inputs) or nu
    width = LANE_WIDTH
    return Lanes(
        control=np.zeros(nu * width),
        duration=np.ones(width),
        block=np.zeros((nx + inputs + 5) * width),
        trajectory=np.zeros((steps + 1) * nx * width),
        cosine=np.zeros((steps + 1) * width),
        sine=np.zeros((steps + 1) * width),
        margin=np.zeros((steps + 1) * width),
        end=np.zeros(Q_DIM * width),
        togo=np.zeros(width),
        at_goal=np.zeros(width, np.int64),
        slack=np.zeros(width),
        source=np.zeros(nx),
        last=np.array([steps * nx * width]),
    )
