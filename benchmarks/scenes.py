"""The scenes and the vehicle of all planning figures, without a safety margin."""

from __future__ import annotations

from dataclasses import dataclass

from kraft.planning.workspace import goal_of, start_state, workspace_of
from kraft.scenario import load_scenario
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats
from ompl_ext.obstacles import Workspace
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.system import SimpleSetup, simple_setup
from ompl_ext.vehicle import Vehicle

SCENES = ("turns", "boxes")
NO_MARGIN = Safety(enabled=False, cycle=0.0)
RK4_STEPS = Settings().steps  # of an edge
OMPL_STEP = 0.05  # propagation and validity checking of planners that work over callbacks (s)


@dataclass(frozen=True)
class Scene:
    """A query: vehicle, workspace, start state (nx,) and goal."""

    name: str
    vehicle: Vehicle
    workspace: Workspace
    start: Floats
    goal: Goal

    def dirt(self, capacity: int = 200_000) -> DirtSolver:
        """The compiled planner for the query, with its maps and memory."""
        return DirtSolver(self.vehicle, self.workspace, self.goal, NO_MARGIN, Settings(), capacity)

    def setup(self) -> SimpleSetup:
        """The query as OMPL planners take it."""
        settings = Settings()
        duration = (settings.shortest, settings.longest)
        return simple_setup(self.vehicle, self.workspace, self.start, self.goal, NO_MARGIN, OMPL_STEP, duration)


def scene(name: str) -> Scene:
    """A bundled scene with the benchmark vehicle."""
    task, vehicle = load_scenario(name).task(), load_vehicle("benchmark")
    return Scene(name, vehicle, workspace_of(task, vehicle), start_state(task, vehicle), goal_of(task))


def endless(given: Scene) -> Scene:
    """The same query with a heading asked for so exactly that no tree ever meets it: the search never ends."""
    goal = Goal(given.goal.center, given.goal.radius, heading=0.0, tolerance=1e-9)
    return Scene(given.name, given.vehicle, given.workspace, given.start, goal)
