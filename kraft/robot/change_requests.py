"""When the planner of a drive gets new goals and maps: so seldom that its decisions come in time."""

from __future__ import annotations

from typing import Final

from kraft.robot.health import DECISIONS
from kraft.robot.newest_map import NewestMap
from kraft.robot.protocol import NewGoal, TaskChange, TaskTaken
from kraft.scenario import Goal

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
        goal: goal of the task.
    """

    def __init__(self, cycle: float, goal: Goal) -> None:
        self._cycle = cycle
        self._goal = NewGoal(goal.center, goal.heading, goal.heading_tolerance)  # that holds
        self._new: NewGoal | None = None  # the newest one, if the planner has not got it yet
        self._unanswered: TaskChange | None = None  # the change that the planner has not answered
        self._decisions = 0  # number of decisions until the next change
        self._problem = ""  # why the goal cannot be reached, as far as the planner knows

    def take(self, goal: NewGoal) -> None:
        """Take a goal that has arrived, unless it is the newest one already."""
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
        self._unanswered = TaskChange(goal, grid)
        return self._unanswered

    def decided(self) -> None:
        """Note that the planner has decided."""
        if not self._unanswered:  # else it was asked for before the change
            self._decisions = max(0, self._decisions - 1)

    def answered(self, answer: TaskTaken) -> list[str]:
        """Note the answer to the change; returns what is new in it, of the problem of a goal once for all maps."""
        self._unanswered = None
        if answer.seconds > LONG * self._cycle:
            self._decisions = DECISIONS
        self._goal = self._goal if answer.goal is None else answer.goal
        news = [answer.refused] if answer.refused else []
        if answer.problem != self._problem:
            self._problem = answer.problem
            news.append(answer.problem or "the goal can be reached, as far as is known")
        return news

    @property
    def open_goals(self) -> list[NewGoal]:
        """Goals, the newest one last, of which the planner has not told yet whether they hold."""
        asked = None if self._unanswered is None else self._unanswered.goal
        return [goal for goal in (asked, self._new) if goal is not None]
