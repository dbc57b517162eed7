"""When the planner of a drive gets new goals and maps: one change at most for each decision."""

from __future__ import annotations

from collections import deque
from typing import TypeAlias

from kraft.robot.newest_map import NewestMap
from kraft.robot.protocol import TaskChange, TaskTaken
from kraft.scenario import Goal

Place: TypeAlias = tuple[float, float]


class ChangeRequests:
    """The newest goal of a robot, and the changes that the planner is asked for.

    The planner gets the newest goal and the newest map in one change, and the next change after it has decided: to get
    ready for one takes a part of a cycle, and a robot may send goals and maps many times in a second.

    Args:
        goal: goal of the task.  One that arrives has no heading, and is another one even at the place of one that has.
    """

    def __init__(self, goal: Goal) -> None:
        self._goal = goal.center if goal.heading is None else None  # that holds
        self._new: Place | None = None  # the newest one, if the planner has not got it yet
        self._unanswered = deque[Place | None]()  # goals of the changes that the planner has not answered
        self._has_decided = True  # since the last change

    def take(self, goal: Place) -> None:
        """Take a goal (m) that has arrived, unless it is the newest one already."""
        if goal != [self._goal, *self.open_goals][-1]:
            self._new = goal

    def next(self, newest_map: NewestMap, cycle: int) -> TaskChange | None:
        """Change that the planner gets before it decides `cycle` or a later one; None if there is none, or not yet."""
        if not self._has_decided:
            return None
        goal, grid = self._new, newest_map.hand_over(cycle)
        if goal is None and grid is None:
            return None
        self._new, self._has_decided = None, False
        self._unanswered.append(goal)
        return TaskChange(goal, grid)

    def decided(self) -> None:
        """Note that the planner has decided."""
        self._has_decided = True

    def answered(self, answer: TaskTaken) -> None:
        """Note the answer to the oldest change that has none."""
        self._unanswered.popleft()
        self._goal = self._goal if answer.goal is None else answer.goal

    @property
    def open_goals(self) -> list[Place]:
        """Goals (m), the newest one last, of which the planner has not told yet whether they hold."""
        return [goal for goal in (*self._unanswered, self._new) if goal is not None]
