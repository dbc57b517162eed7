"""Solvers of a task as a method uses them: the one that plans with a margin, and the one that checks plans again."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from kraft.driving.bound import DeviationBound
from kraft.driving.planner_settings import PlannerSettings
from kraft.planning.workspace import goal_of, settings_of, workspace_of
from kraft.scenario import Task
from ompl_ext.arrays import Floats
from ompl_ext.obstacles import Obstacle
from ompl_ext.poses import poses_of
from ompl_ext.query import Goal, Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

COVER_EXCESS: Final = 0.05
"""Excess of the discs that cover the footprint where the bound is measured, as a share of its width."""
WAY_MARGIN: Final = 0.05
"""Distance that the ways of the cost-to-go of poses keep from obstacles where they can, m."""
LEAST_GOAL: Final = 0.5
"""Share of a small goal's radius that is aimed for, however large the margin; of tolerances of the heading and rest."""
MIN_GOAL_RADIUS: Final = 0.01
"""Smallest radius of the region that the planner aims for, m."""
MIN_GOAL_TOLERANCE: Final = math.radians(1.0)
"""Smallest tolerance of the heading that it aims for, rad."""


@dataclass(frozen=True)
class Solvers:
    """Two solvers of one task: `planning` requires the method's margin and foresight, `checking` only its clearance.

    The margin is not required when a plan is checked again, so that small errors do not reject the plan.
    """

    planning: DirtSolver
    checking: DirtSolver
    origin: tuple[Task, Vehicle] | None = None
    """task and vehicle that they were made for"""
    goal: Goal = field(init=False)
    """the whole region that a method aims for; queries aim for parts of it"""

    def __post_init__(self) -> None:
        assert self.checking.goal is not None, "a task has a goal"
        object.__setattr__(self, "goal", self.checking.goal)

    @classmethod
    def of(cls, task: Task, vehicle: Vehicle, settings: PlannerSettings, more: tuple[Obstacle, ...] = ()) -> Solvers:
        """Make the solvers for a method's settings; without a clearance in the settings, SAFETY is disabled.

        `more` are obstacles that the task does not have.
        """
        goal = aimed_for(goal_of(task), settings.goal_margin)
        workspace, safety, shape = workspace_of(task, vehicle), method_safety(settings), vehicle.footprint
        workspace = replace(workspace, obstacles=workspace.obstacles + more)
        planner = "sst" if settings.type == "sst" else "dirt"
        search = replace(settings_of(task, vehicle), polish=settings.polish, planner=planner)
        if settings.cost_to_go == "pose" and vehicle.index("theta") >= 0:
            search = replace(search, pose_cost_to_go=True, way_margin=WAY_MARGIN)
        if settings.bound is not None:
            search = replace(search, excess=COVER_EXCESS)
        checking = DirtSolver(vehicle, workspace, goal, safety, search, settings.capacity)
        clearance = settings.bound or settings.safety
        foresight = clearance.foresight if clearance else 0.0
        if settings.margin == 0.0 and foresight <= settings.cycle:
            return cls(checking, checking, (task, vehicle))
        safety = replace(safety, cycle=max(foresight, settings.cycle))
        margin = settings.margin if settings.bound is None else 0.0  # which is added to the bound
        larger_vehicle = replace(vehicle, footprint=shape.with_margin(margin))
        return cls(
            DirtSolver(larger_vehicle, workspace, goal, safety, search, settings.capacity), checking, (task, vehicle)
        )

    def with_obstacles(self, more: tuple[Obstacle, ...], settings: PlannerSettings) -> Solvers:
        """Solvers of the same task with `more` obstacles than it has, and with the present parameters."""
        assert self.origin is not None, "the solvers were made for a task"
        solvers = Solvers.of(*self.origin, settings, more)
        solvers.set_parameters(np.array(list(self.checking.vehicle.parameters.values())))
        return solvers

    def load(self, state: Floats) -> None:
        """Compute what queries of this map share, which the first one from a state (nx,) would do otherwise."""
        for dirt in (self.checking, self.planning):
            dirt.start(state, 0)
            dirt.least_distance(poses_of(state[None, :], dirt.vehicle))

    def set_bound(self, bound: DeviationBound) -> None:
        """Set the clearance that SAFETY asks for in both."""
        asked = bound.clearance
        for dirt in (self.checking, self.planning):
            dirt.set_bound(asked.delta, asked.delta_per_speed, asked.delta_per_time, asked.delta_horizon)

    def set_parameters(self, values: Floats) -> None:
        """Set the parameters of the vehicle (np,) in both; in most cycles they are those that these have."""
        if np.array_equal(self.checking.problem.parameters[: len(values)], values):
            return
        self.checking.set_parameters(values)
        if self.planning is not self.checking:
            self.planning.set_parameters(values)


def aimed_for(goal: Goal, margin: float) -> Goal:
    """Region within a goal that a method with a margin (m) aims for.

    The cheapest plan ends at the border of its region.  Where the goal has a heading and limits, as in parking, a
    vehicle that ends there beside its plan needs another manoeuvre: it aims for half of the tolerance too, and of
    limits that include zero.  Into a goal without limits it drives on.
    """
    radius = max(goal.radius - margin, LEAST_GOAL * goal.radius)
    if margin == 0.0 or not (goal.has_heading and goal.limits):
        return replace(goal, radius=radius)
    tolerance = max(LEAST_GOAL * goal.tolerance, min(goal.tolerance, MIN_GOAL_TOLERANCE))
    limits = {
        name: (LEAST_GOAL * low, LEAST_GOAL * high) if low <= 0.0 <= high else (low, high)
        for name, (low, high) in goal.limits.items()
    }
    return replace(goal, radius=radius, tolerance=tolerance, limits=limits)


def goal_region(goal: Goal, vehicle: Vehicle, root: Floats) -> tuple[float, float]:
    """Radius (m) and tolerance of the heading (rad) to aim for from `root` (nx,): smaller ones within the goal.

    A vehicle that is in the goal by its estimate, but not in truth, would wait there.  It aims for half of its
    distance to the centre, or of its deviation from the heading if that is the one closer to its limit.
    """
    if (goal.has_heading or goal.limits) and not goal.contains(vehicle, root):
        return goal.radius, goal.tolerance  # it has to turn or to stop on the way to the centre
    away = math.dist(goal.center, (root[vehicle.index("x")], root[vehicle.index("y")]))
    radius = max(MIN_GOAL_RADIUS, min(goal.radius, 0.5 * away))
    if not goal.has_heading:
        return radius, goal.tolerance
    off = abs(math.remainder(root[vehicle.index("theta")] - goal.heading, math.tau))
    if off / goal.tolerance <= away / goal.radius:
        return radius, goal.tolerance
    return goal.radius, max(MIN_GOAL_TOLERANCE, 0.5 * off)


def method_safety(settings: PlannerSettings) -> Safety:
    """SAFETY with the clearance of a method, disabled if the method has none."""
    clearance = settings.safety
    if settings.bound is not None:  # the clearance is set in every cycle
        return Safety(cycle=settings.cycle)
    if clearance is None:
        return Safety(enabled=False, cycle=settings.cycle)
    return Safety(cycle=settings.cycle, delta=clearance.delta, delta_per_speed=clearance.delta_per_speed)
