"""Arrays of a query for the kernels, with the maps that are computed once per map and goal, and working memory."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ompl_ext.arrays import Floats, Ints, Matrix, Matrix32
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.clearance import (
    ClearanceField,
    cover,
    fields,
    grouped,
    least_spacing,
    memory_of_fields,
    tight_cover,
)
from ompl_ext.kernels.costtogo import cost_to_go
from ompl_ext.kernels.fine_field import FineField
from ompl_ext.kernels.functions import FUNCTIONS
from ompl_ext.kernels.kernel_types import (  # fmt: skip
    LANE_WIDTH,
    OPTIONS,
    Q_DIM,
    SCALARS,
    Lanes,
    Maps,
    Problem,
    block_length,
)
from ompl_ext.kernels.posepath import PoseCostToGo
from ompl_ext.kernels.posetogo import pose_cost_to_go
from ompl_ext.motion import motion_key, motion_of
from ompl_ext.obstacles import Workspace
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.vehicle import Footprint, Vehicle

CACHED_MAPS = 8  # maps of the latest queries that a process keeps: those of the methods of an evaluation in one scene
FINE_CELL = 0.01  # largest cell of the clearance field if the goal has a heading (m)
SHARE = 0.08  # the same if the goal has none, as a share of the footprint's width
SHORT = 0.1  # shortest edge near an exact goal over the shortest one elsewhere
COARSEST = 0.3  # largest cell of the cost-to-go of poses, as a share of the footprint's width
EXCESS = 0.01  # excess of the discs over the footprint if the goal has a heading, as a share of its width
LARGE_EXCESS = 0.03  # the same in the cost-to-go of poses away from the goal
HEADING_MAX = 1e6  # largest heading of a state (rad): sine and cosine of much larger ones are not bounded by 1
PRECISE = 0.018  # spacing of the fine field if the goal has a heading, as a share of the footprint's width


def make_problem(
    vehicle: Vehicle, workspace: Workspace, goal: Goal | None, safety: Safety, settings: Settings
) -> Problem:
    """Arrays of a query, with the clearance field and the cost-to-go, which are computed once per map and goal.

    Without a goal there is no cost-to-go: edges and SAFETY can be checked, a tree cannot grow.
    """
    spacing = _spacing(vehicle, goal)
    precise = spacing < math.inf
    settings = settings_for(settings, vehicle, workspace, goal)
    excess = EXCESS if precise else settings.excess
    few = cover(vehicle.footprint, settings.discs).discs
    discs = _tight_cover(vehicle.footprint, excess) if excess > 0.0 else np.column_stack([few, np.zeros(len(few))])
    delta = _largest_delta(vehicle, safety)
    smallest = float(discs[:, 2].min())
    field, fine = _fields(workspace, vehicle.footprint, smallest, settings.cell, delta, spacing)
    seconds = np.zeros((1, 1), np.float32)
    if goal is not None:
        goal.check(vehicle)
        seconds = _seconds(
            workspace, vehicle.footprint, smallest, settings.cell, delta, goal.center, goal.radius, vehicle.top_speed,
            spacing,
        )  # fmt: skip
    problem = Problem(
        parameters=vehicle.parameter_array,
        controls=vehicle.control_bounds,
        limits=_limits(vehicle, workspace),
        discs=discs,
        field=field.values,
        togo=seconds,
        tile=np.full((1, 1), -1, np.int32) if fine is None else fine.tile,
        squares=np.zeros((1, 1), np.uint16) if fine is None else fine.squares,
        pose_togo=np.zeros(0, np.float32),
        goal_limits=np.zeros((len(vehicle.state), 3)),
        scalar=_scalars(vehicle, workspace, safety, settings, field, fine),
        option=_options(vehicle, safety, settings),
        functions=np.zeros(FUNCTIONS, np.int64),  # `EdgeChecker` enters them, when they are compiled
    )
    if goal is None:
        return problem
    _set_goal(problem, goal, vehicle, settings)
    if settings.pose_cost_to_go if settings.pose_cost_to_go is not None else precise:
        problem = _with_pose_cost_to_go(problem, vehicle, workspace, goal, settings)
    return problem


def _limits(vehicle: Vehicle, workspace: Workspace) -> Floats:
    """Limits (nx, 2) of the state, within the bounds of the workspace and of headings whose sine is known."""
    limits = vehicle.state_limits.copy()
    for name, bounds in zip(("x", "y", "theta"), (*workspace.bounds, (-HEADING_MAX, HEADING_MAX)), strict=True):
        k = vehicle.index(name)
        if k >= 0:
            limits[k] = max(limits[k, 0], bounds[0]), min(limits[k, 1], bounds[1])
    return limits


def _scalars(
    vehicle: Vehicle, workspace: Workspace, safety: Safety, settings: Settings, field: ClearanceField,
    fine: FineField | None,
) -> Floats:  # fmt: skip
    """Numbers of a query without a goal, see `ompl_ext.kernels.kernel_types`."""
    scalar = np.zeros(SCALARS)
    scalar[[at.SHORTEST, at.LONGEST, at.QUANTUM]] = settings.shortest, settings.longest, settings.quantum
    scalar[[at.HEADING_WEIGHT, at.RESOLUTION]] = settings.heading_weight, settings.resolution
    scalar[[at.CYCLE, at.DELTA, at.DELTA_PER_SPEED]] = safety.cycle, safety.delta, safety.delta_per_speed
    scalar[[at.DELTA_PER_TIME, at.DELTA_HORIZON]] = safety.delta_per_time, safety.delta_horizon
    scalar[[at.NEAR, at.DELTA_FAR, at.DELTA_FAR_PER_SPEED]] = safety.near, safety.far_delta, safety.far_delta_per_speed
    scalar[at.REST_SPEED] = safety.rest_speeds(vehicle)[0] if vehicle.rest else 0.0
    scalar[[at.REST_RATE, at.BRAKE_STEP]] = safety.rest_speed, safety.step
    scalar[[at.LENGTH, at.TOP_SPEED]] = vehicle.footprint.length, vehicle.top_speed
    scalar[[at.GOAL_BIAS, at.EXPLORATION]] = settings.goal_bias, settings.exploration
    scalar[at.CONTROL_BOUND_BIAS] = settings.beyond
    _set_maps(scalar, workspace, vehicle.footprint, field, fine)
    return scalar


def _set_maps(
    scalar: Floats, workspace: Workspace, footprint: Footprint, field: ClearanceField, fine: FineField | None
) -> None:
    """Write what the check of a pose needs: the bounds, the footprint's reach, and the frames of the fields."""
    scalar[[at.X_LOW, at.X_HIGH, at.Y_LOW, at.Y_HIGH]] = *workspace.bounds[0], *workspace.bounds[1]
    scalar[[at.GRID_X, at.GRID_Y, at.GRID_INVERSE, at.REACH]] = *field.origin, 1 / field.cell, footprint.reach
    if fine is not None:
        x, y, c, s, spacing = fine.lattice
        scalar[[at.FINE_X, at.FINE_Y, at.FINE_COS, at.FINE_SIN, at.FINE_INVERSE]] = x, y, c, s, 1 / spacing


def _options(vehicle: Vehicle, safety: Safety, settings: Settings) -> Ints:
    """Whole numbers of a query without a goal, see `ompl_ext.kernels.kernel_types`."""
    option = np.zeros(OPTIONS, np.int64)
    option[at.STEPS] = settings.most_steps
    option[at.BRAKE_STEPS] = math.ceil(safety.horizon / safety.step)
    option[at.MANOEUVRES] = len(vehicle.manoeuvres)
    option[[at.BLOSSOM, at.INSERTIONS]] = settings.blossom, settings.insertions
    option[[at.CHILD_EXTENSION, at.REQUIRE_SAFETY]] = settings.child_extension, safety.enabled
    return option


def settings_for(settings: Settings, vehicle: Vehicle, workspace: Workspace, goal: Goal | None) -> Settings:
    """Settings with a finer clearance field if the goal has a heading: manoeuvring is done in narrow places.

    For other goals a small vehicle has smaller cells, as far as the workspace is not too large for them: cells of 2 cm
    lose 1.4 cm of clearance, which closes the gaps that a robot of 10 cm drives through.
    """
    if _spacing(vehicle, goal) < math.inf:
        return replace(settings, cell=min(settings.cell, FINE_CELL))
    suitable = max(SHARE * vehicle.footprint.width, least_spacing(workspace, vehicle.footprint))
    return replace(settings, cell=min(settings.cell, suitable))


def _spacing(vehicle: Vehicle, goal: Goal | None) -> float:
    """Spacing of the fine field (m) if the goal has a heading, else infinite."""
    has_heading = goal is not None and vehicle.index("theta") >= 0 and goal.has_heading
    return PRECISE * vehicle.footprint.width if has_heading else math.inf


def _set_goal(problem: Problem, goal: Goal, vehicle: Vehicle, settings: Settings) -> None:
    """Write the goal region, and how edges near it are treated, into a problem's arrays."""
    scalar, option, limits = problem.scalar, problem.option, problem.goal_limits
    scalar[[at.GOAL_X, at.GOAL_Y, at.GOAL_RADIUS]] = *goal.center, goal.radius
    scalar[[at.GOAL_COS, at.GOAL_SIN]] = math.cos(goal.heading), math.sin(goal.heading)
    scalar[at.GOAL_TOLERANCE] = math.cos(goal.tolerance) if goal.has_heading else -2.0
    scalar[at.GOAL_NEAR] = goal.radius + settings.longest * vehicle.top_speed
    exact = goal.is_exact  # a disc alone needs no short edges: those that pass it end in it
    scalar[at.SHORTEST_NEAR_GOAL] = (SHORT if exact else 1.0) * settings.shortest
    passes = settings.shortest * vehicle.top_speed > 4 * goal.radius  # over twice the diameter
    option[at.GOAL_HEADING], option[at.GOAL_LIMITS] = goal.has_heading, bool(goal.limits)
    option[at.CUT_AT_GOAL] = exact or passes
    limits[:, 0], limits[:, 1] = -math.inf, math.inf
    for name, (low, high) in goal.limits.items():
        k, rate = vehicle.index(name), motion_of(vehicle).rate[vehicle.index(name)]
        limits[k] = low, high, 1.0 / rate if rate > 0.0 else 0.0
        if vehicle.rest_indices[:1] == (k,):
            scalar[[at.BRAKING, at.GOAL_SPEED]] = rate, max(abs(low), abs(high))


def pose_cost_to_go_of(
    vehicle: Vehicle, workspace: Workspace, goal: Goal, settings: Settings, *, clear: bool = False
) -> PoseCostToGo:
    """Cost-to-go of poses, computed once for a vehicle, a map and a goal; kernels only read it.

    Its paths avoid poses that hardly keep their clearance if they shall be `clear`.
    """
    wide = vehicle.footprint.with_margin(settings.way_margin)
    cell = settings_for(settings, vehicle, workspace, goal).cell
    key, near = _Vehicle(replace(vehicle, footprint=wide)), vehicle.footprint if goal.has_heading else wide
    return _pose_seconds(key, near, workspace, cell, goal.center, goal.radius, goal.heading, goal.tolerance, clear)


def _with_pose_cost_to_go(
    problem: Problem, vehicle: Vehicle, workspace: Workspace, goal: Goal, settings: Settings
) -> Problem:
    """Problem with the cost-to-go of poses."""
    found = pose_cost_to_go_of(vehicle, workspace, goal, settings)
    problem.option[[at.POSE_HEADINGS, at.POSE_ROWS, at.POSE_COLUMNS]] = found.shape
    problem.scalar[[at.POSE_X, at.POSE_Y, at.POSE_INVERSE]] = *found.origin, 1 / found.cell
    problem.scalar[[at.POSE_BEYOND, at.POSE_HEADING]] = found.beyond, goal.heading
    return problem._replace(pose_togo=found.seconds)


class _Vehicle:
    """Vehicle as the key of a cache: its motion, footprint and top speed."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self._key = vehicle.footprint, vehicle.top_speed, *motion_key(vehicle)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Vehicle) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@lru_cache(CACHED_MAPS)
def _tight_cover(footprint: Footprint, excess: float) -> Matrix:
    return grouped(tight_cover(footprint, excess * footprint.width))


@lru_cache(CACHED_MAPS)
def _pose_seconds(
    key: _Vehicle,
    near: Footprint,
    workspace: Workspace,
    cell: float,
    center: tuple[float, float],
    radius: float,
    heading: float,
    tolerance: float,
    clear: bool,
) -> PoseCostToGo:
    """Cost-to-go of poses; the search around a goal with a heading has the footprint `near`."""
    vehicle = key.vehicle
    footprint, motion = vehicle.footprint, motion_of(vehicle)
    discs = _tight_cover(near, EXCESS)
    smallest = float(discs[:, 2].min())
    spacing = PRECISE * footprint.width
    field, fine = _fields(workspace, footprint, smallest, cell, 0.0, spacing)
    assert fine is not None
    scalar = np.zeros(SCALARS)
    _set_maps(scalar, workspace, footprint, field, fine)
    maps = Maps(_tight_cover(footprint, LARGE_EXCESS), field.values, fine.tile, fine.squares, scalar)
    speed = vehicle.rest_indices[0] if vehicle.rest_indices else -1
    reversal = vehicle.top_speed / motion.rate[speed] if speed >= 0 and motion.rate[speed] > 0 else 0.0
    geodesic = _seconds(workspace, footprint, smallest, cell, 0.0, center, radius, vehicle.top_speed, spacing)
    return pose_cost_to_go(
        maps,
        workspace.bounds,
        (*center, heading),
        radius,
        tolerance,
        motion.extreme_twists(near.reach)[0],  # which those who follow the ways number alike
        reversal,
        (cell if tolerance < math.pi else COARSEST * footprint.width, COARSEST * footprint.width),
        geodesic,
        footprint.width,
        discs,
        clear,
    )


def memory_of_maps(
    vehicle: Vehicle, workspace: Workspace, safety: Safety, settings: Settings, goal: Goal | None
) -> int:
    """Memory (bytes) that the maps of a query need at most."""
    settings, delta = settings_for(settings, vehicle, workspace, goal), _largest_delta(vehicle, safety)
    return memory_of_fields(workspace, vehicle.footprint, settings.cell, delta, _spacing(vehicle, goal))


def _largest_delta(vehicle: Vehicle, safety: Safety) -> float:
    """Largest clearance delta(t, v) that a query requires (m), until `safety.near` or after it."""
    times = np.array([min(safety.near, safety.delta_horizon), math.inf])
    return float(safety.clearance(np.array(vehicle.top_speed), times).max())


@lru_cache(CACHED_MAPS)
def _fields(
    workspace: Workspace, footprint: Footprint, disc_radius: float, cell: float, delta: float, spacing: float
) -> tuple[ClearanceField, FineField | None]:
    """Clearance field and fine field for a footprint; kernels only read them."""
    return fields(workspace, footprint, disc_radius, cell, delta, spacing)


@lru_cache(CACHED_MAPS)
def _seconds(
    workspace: Workspace,
    footprint: Footprint,
    disc_radius: float,
    cell: float,
    delta: float,
    goal: tuple[float, float],
    goal_radius: float,
    top_speed: float,
    spacing: float,
) -> Matrix32:
    """Cost-to-go on the cells of the clearance field; kernels only read it."""
    field, _ = _fields(workspace, footprint, disc_radius, cell, delta, spacing)
    return cost_to_go(field, footprint.inscribed, goal, goal_radius, top_speed, workspace.bounds).seconds


def make_lanes(nx: int, nu: int, inputs: int, steps: int) -> Lanes:
    """Working memory for edges of up to `steps` integration steps."""
    width = LANE_WIDTH
    return Lanes(
        control=np.zeros(nu * width),
        duration=np.ones(width),
        steps=np.full(width, steps),
        block=np.zeros(block_length(nx, inputs)),
        trajectory=np.zeros((steps + 1) * nx * width),
        deviation=np.zeros((steps + 1) * width),
        end=np.zeros(Q_DIM * width),
        togo=np.zeros(width),
        at_goal=np.zeros(width, np.int64),
        slack=np.zeros(width),
        source=np.zeros(nx),
    )


def lanes_of(vehicle: Vehicle, steps: int) -> Lanes:
    """Working memory for edges or manoeuvres of a vehicle of up to `steps` integration steps."""
    nx, nu = len(vehicle.state), len(vehicle.controls)
    return make_lanes(nx, nu, len(vehicle.inputs) or nu, steps)
