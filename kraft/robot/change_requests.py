"""When the planner of a drive gets new goals and maps: so seldom that its decisions come in time."""

from __future__ import annotations

from collections import deque
from typing import Final, TypeAlias

from kraft.robot.health import DECISIONS
from kraft.robot.newest_map import NewestMap
from kraft.robot.protocol import TaskChange, TaskTaken
from kraft.scenario import Goal

Place: TypeAlias = tuple[float, float]
LONG: Final = 0.5
"""Share of a cycle beyond which a change makes the next decision late."""


class ChangeRequests:
    """The newest goal of a robot, and the changes that the planner is asked for.

    The planner gets the newest goal and the newest map in one change, and the next change after it has decided: to get
    ready for one takes a part of a cycle, and a robot may send goals and maps many times in a second.  For a large task
    it takes more than a cycle, and one decision is late: the next change waits until no other of those is late by which
    `Health` judges.

    Args:
        cycle: duration of a cycle, s.
        goal: goal of the task.  One that arrives has no heading, and is another one even at the place of one that has.
    """

    def __init__(self, cycle: float, goal: Goal) -> None:
        self._cycle = cycle
        self._goal = goal.center if goal.heading is None else None  # that holds
        self._new: Place | None = None  # the newest one, if the planner has not got it yet
        self._unanswered = deque[Place | None]()  # goals of the changes that the planner has not answered
        self._decisions = 0  # number of decisions until the next change

    def take(self, goal: Place) -> None:
        """Take a goal (m) that has arrived, unless it is the newest one already."""
        if goal != [self._goal, *self.open_goals][-1]:
            self._new = goal

    def next(self, newest_map: NewestMap, cycle: int) -> TaskChange | None:
        """Change that the planner gets before it decides `cycle` or a later one; None if there is none, or not yet."""
        if self._unanswered or self._decisions > 0:
            return None
        goal, grid = self._new, newest_map.hand_over(cycle)
        if goal is None and grid is None:
            return None
        self._new, self._decisions = None, 1
        self._unanswered.append(goal)
        return TaskChange(goal, grid)

    def decided(self) -> None:
        """Note that the planner has decided."""
        if not self._unanswered:  # else it was asked for before the change
            self._decisions = max(0, self._decisions - 1)

    def answered(self, answer: TaskTaken) -> None:
        """Note the answer to the oldest change that has none."""
        self._unanswered.popleft()
        if answer.seconds > LONG * self._cycle:
            self._decisions = DECISIONS
        self._goal = self._goal if answer.goal is None else answer.goal

    @property
    def open_goals(self) -> list[Place]:
        """Goals (m), the newest one last, of which the planner has not told yet whether they hold."""
        return [goal for goal in (*self._unanswered, self._new) if goal is not None]
