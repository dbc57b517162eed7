"""What the planner is asked, and the arrays that the kernels read it from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ompl_ext import kernel_types as at
from ompl_ext.arrays import Floats
from ompl_ext.clearance import clearance_field, cover
from ompl_ext.costtogo import cost_to_go
from ompl_ext.kernel_types import LANE_WIDTH, OPTIONS, Q_DIM, SCALARS, Lanes, Problem, Retained
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
    """Clearance delta(v) = `delta` + `delta_per_speed` |v| (m) inside the first cycle and of contingencies.

    With `enabled`, SAFETY (Alg. 2) is asked of every edge that crosses the end of the cycle.  A vehicle stands when
    every component it names as resting is below `rest_speed`; a manoeuvre that has not stopped it within `horizon` s
    is not safe.
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
    """Settings of DIRT.  Lengths in m, times in s."""

    blossom: int = 32
    insertions: int = 1
    child_extension: bool = True
    pruning: bool = False
    goal_bias: float = 0.05
    beyond: float = 1.0
    shortest: float = 0.5
    longest: float = 1.0
    steps: int = 10
    quantum: float = 0.0
    heading_weight: float = 0.05
    resolution: float = 0.01
    discs: int = 4
    cell: float = 0.02


def make_problem(
    vehicle: Vehicle, workspace: Workspace, goal: Goal | None, safety: Safety, settings: Settings
) -> Problem:
    """Arrays of a query: the clearance field and the cost-to-go are computed here, once per goal and map.

    Without a goal there is no cost-to-go: enough to check edges and to ask for SAFETY, not to grow a tree.
    """
    discs = cover(vehicle.footprint, settings.discs)
    reach = vehicle.footprint.reach
    field = clearance_field(workspace, reach + 2 * settings.cell, settings.cell)
    seconds = np.zeros((1, 1), np.float32)
    if goal is not None:
        inscribed = vehicle.footprint.inscribed
        seconds = cost_to_go(field, inscribed, goal.center, goal.radius, vehicle.top_speed, workspace.bounds).seconds
    limits = vehicle.state_limits.copy()
    for name, bounds in zip(("x", "y"), workspace.bounds, strict=True):
        k = vehicle.index(name)
        limits[k] = max(limits[k, 0], bounds[0]), min(limits[k, 1], bounds[1])
    scalar = np.zeros(SCALARS)
    scalar[[at.SHORTEST, at.LONGEST, at.QUANTUM]] = settings.shortest, settings.longest, settings.quantum
    scalar[[at.HEADING_WEIGHT, at.RESOLUTION]] = settings.heading_weight, settings.resolution
    scalar[[at.CYCLE, at.DELTA, at.DELTA_PER_SPEED]] = safety.cycle, safety.delta, safety.delta_per_speed
    scalar[[at.REST_SPEED, at.BRAKE_STEP]] = safety.rest_speed, safety.step
    scalar[[at.REACH, at.DISC_RADIUS, at.LENGTH]] = reach, discs.radius, vehicle.footprint.length
    scalar[[at.GRID_X, at.GRID_Y, at.GRID_INVERSE]] = *field.origin, 1 / field.cell
    scalar[[at.X_LOW, at.X_HIGH, at.Y_LOW, at.Y_HIGH]] = *workspace.bounds[0], *workspace.bounds[1]
    scalar[[at.GOAL_BIAS, at.BEYOND]] = settings.goal_bias, settings.beyond
    if goal is not None:
        scalar[[at.GOAL_X, at.GOAL_Y, at.GOAL_RADIUS]] = *goal.center, goal.radius
        scalar[[at.GOAL_COS, at.GOAL_SIN]] = math.cos(goal.heading), math.sin(goal.heading)
        scalar[at.GOAL_TOLERANCE] = math.cos(goal.tolerance) if goal.tolerance < math.pi else -2.0
    option = np.zeros(OPTIONS, np.int64)
    option[at.STEPS] = round(settings.longest / settings.quantum) if settings.quantum > 0 else settings.steps
    option[at.BRAKE_STEPS] = math.ceil(safety.horizon / safety.step)
    option[[at.BLOSSOM, at.INSERTIONS]] = settings.blossom, settings.insertions
    option[[at.CHILD_EXTENSION, at.ASK_SAFETY]] = settings.child_extension, safety.enabled
    return Problem(
        parameters=vehicle.parameter_array,
        controls=vehicle.control_bounds,
        limits=limits,
        discs=discs.centres,
        field=field.values,
        togo=seconds,
        scalar=scalar,
        option=option,
    )


def make_lanes(nx: int, nu: int, inputs: int, steps: int) -> Lanes:
    """Working memory for edges of up to `steps` integration steps."""
    width = LANE_WIDTH
    return Lanes(
        control=np.zeros(nu * width),
        duration=np.ones(width),
        steps=np.full(width, steps),
        block=np.zeros((nx + inputs + 5) * width),
        trajectory=np.zeros((steps + 1) * nx * width),
        pose=np.zeros((steps + 1) * 3 * width),
        end=np.zeros(Q_DIM * width),
        togo=np.zeros(width),
        at_goal=np.zeros(width, np.int64),
        slack=np.zeros(width),
        source=np.zeros(nx),
    )


def edges_to_retain(parent: list[int], controls: Floats, durations: Floats) -> Retained:
    """Edges for `grow` to begin with; `controls` has shape (edges, nu), `durations` (edges,)."""
    edge = np.ascontiguousarray(np.column_stack([controls, durations]), dtype=float)
    return Retained(np.array(parent, np.int64), edge, np.full(len(parent), -1))
