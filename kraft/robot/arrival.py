"""When the goal of a drive counts as reached, by the estimate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from kraft.robot.protocol import NewGoal
from kraft.scenario import Goal
from ompl_ext.arrays import Floats
from ompl_ext.poses import pose_of
from ompl_ext.vehicle import Vehicle

TICKS: Final = 3
"""Number of ticks in a row for which the estimate is in the goal region before the goal counts as reached."""
MARGIN: Final = 0.05
"""Distance by which the estimate is inside the goal region then, m."""


class Arrival:
    """Counts the ticks in a row for which the estimated state of a vehicle is in the goal region."""

    def __init__(self, goal: Goal, vehicle: Vehicle) -> None:
        self._goal, self._vehicle, self._ticks = goal, vehicle, 0

    def move(self, goal: NewGoal) -> None:
        """Take another goal."""
        self._goal = goal.moved(self._goal)

    def look(self, state: Floats, open_goals: Sequence[NewGoal], *, may_count: bool) -> bool:
        """Whether the goal is reached in this tick, with an estimated state (nx,); only ticks that `may_count` do.

        Whichever of `open_goals` the planner takes, the state has to be in it too.
        """
        goals = [self._goal, *(each.moved(self._goal) for each in open_goals)]
        is_inside = may_count and all(self._is_inside(goal, state) for goal in goals)
        self._ticks = self._ticks + 1 if is_inside else 0
        return self._ticks >= TICKS

    def _is_inside(self, goal: Goal, state: Floats) -> bool:
        """Whether a state is inside a goal region by a margin."""
        components = {name: float(state[k]) for k, name in enumerate(self._vehicle.state)}
        margin = min(MARGIN, 0.25 * goal.radius)
        return goal.contains(*pose_of(state, self._vehicle), components, margin)
