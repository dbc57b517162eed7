"""Solvers of a method's settings, and the clearance that they ask for."""

from __future__ import annotations

from dataclasses import dataclass, replace

from kraft.driving.bound import DeviationBound
from kraft.driving.method import PlannerSettings
from kraft.planning.workspace import goal_of, poses_of, settings_of, workspace_of
from kraft.scenario import Task
from ompl_ext.arrays import Floats
from ompl_ext.query import Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

MIN_GOAL_RADIUS = 0.01  # of the region that the planner aims for (m)


@dataclass(frozen=True)
class Solvers:
    """Two solvers of one task: `planning` requires the method's margin and foresight, `checking` only its clearance.

    The margin is not required when a plan is checked again, so that small errors do not reject the plan.
    """

    planning: DirtSolver
    checking: DirtSolver

    @classmethod
    def of(cls, task: Task, vehicle: Vehicle, settings: PlannerSettings) -> Solvers:
        """Make the solvers for a method's settings; without a clearance in the settings, SAFETY is disabled."""
        goal = goal_of(task)
        goal = replace(goal, radius=max(goal.radius - settings.goal_margin, MIN_GOAL_RADIUS))
        workspace, safety, shape = workspace_of(task, vehicle), method_safety(settings), vehicle.footprint
        planner = "sst" if settings.type == "sst" else "dirt"
        search = replace(settings_of(task, vehicle), polish=settings.polish, planner=planner)
        checking = DirtSolver(vehicle, workspace, goal, safety, search, settings.capacity)
        clearance = settings.bound or settings.safety
        foresight = clearance.foresight if clearance else 0.0
        if settings.margin == 0.0 and foresight <= settings.cycle:
            return cls(checking, checking)
        safety = replace(safety, cycle=max(foresight, settings.cycle))
        margin = settings.margin if settings.bound is None else 0.0  # which is added to the bound
        larger = replace(shape, length=shape.length + 2 * margin, width=shape.width + 2 * margin)
        larger_vehicle = replace(vehicle, footprint=larger)
        return cls(DirtSolver(larger_vehicle, workspace, goal, safety, search, settings.capacity), checking)

    def load(self, state: Floats) -> None:
        """Compute what queries of this map share, which the first one from a state (nx,) would do otherwise."""
        for dirt in (self.checking, self.planning):
            dirt.start(state, 0)
            dirt.least_distance(poses_of(state[None, :], dirt.vehicle))

    def set_bound(self, bound: DeviationBound) -> None:
        """Set the clearance that SAFETY asks for in both."""
        for dirt in (self.checking, self.planning):
            dirt.set_bound(bound.delta, bound.per_speed, bound.per_time, bound.horizon)

    def set_parameters(self, values: Floats) -> None:
        """Set the parameters of the vehicle (np,) in both."""
        self.checking.set_parameters(values)
        if self.planning is not self.checking:
            self.planning.set_parameters(values)


def method_safety(settings: PlannerSettings) -> Safety:
    """SAFETY with the clearance of a method, disabled if the method has none."""
    margin = settings.safety
    if settings.bound is not None:  # the clearance is set in every cycle
        return Safety(cycle=settings.cycle)
    if margin is None:
        return Safety(enabled=False, cycle=settings.cycle)
    return Safety(cycle=settings.cycle, delta=margin.delta, delta_per_speed=margin.delta_per_speed)
