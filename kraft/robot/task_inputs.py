"""What changes the task of a drive: goals and maps of a robot, taken by the controller without waiting."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from kraft.robot.messages import POSE, yaw_of
from kraft.robot.protocol import Check, Mailbox, MapLink, MapNews, NewGoal, StopOrder
from kraft.robot.robot_file import Robot
from kraft.robot.transport import Transport
from kraft.scenario import OccupancyMap


class TaskInputs:
    """Goals from the robot's topic, and maps from the process that receives them."""

    def __init__(self, robot: Robot, transport: Transport, maps: Mailbox | None) -> None:
        """Subscribe to goals; `maps` is the mailbox of the process that receives maps, None if the robot has none."""
        self._robot, self._maps = robot, maps
        self._goals: deque[NewGoal] = deque(maxlen=1)  # a thread of the transport adds to it
        self._map: OccupancyMap | None = None
        self._goal_problem = ""
        self._size = self._map_problem = self._link_problem = ""
        if robot.goal is not None:
            transport.subscribe(robot.goal.topic, POSE, self._take_goal, refused=self._refuse_goal)

    def _take_goal(self, message: Any, _: int) -> None:
        place, frame = message.pose.position, message.header.frame_id.lstrip("/")
        goal, expected = self._goal(message.pose), f"numbers in the frame {self._robot.pose.frame!r}"
        numbers = [*goal.center, 0.0 if goal.heading is None else goal.heading]
        if frame == self._robot.pose.frame and all(map(math.isfinite, numbers)):
            self._goals.append(goal)
            return
        expected += "" if goal.heading is None else ", and a rotation as the orientation"
        where = f"({place.x:g}, {place.y:g}) in the frame {frame!r}"
        self._goal_problem = f"the goal {where} cannot be used: expected {expected}"

    def _goal(self, pose: Any) -> NewGoal:
        """Goal of a pose, with its heading if the robot file states a tolerance."""
        assert self._robot.goal is not None, "it is subscribed because of it"
        center, tolerance = (float(pose.position.x), float(pose.position.y)), self._robot.goal.heading_tolerance
        if tolerance is None:
            return NewGoal(center)
        return NewGoal(center, yaw_of(pose.orientation), tolerance)

    def _refuse_goal(self, why: str) -> None:
        self._goal_problem = f"a message cannot be used as a goal: it {why}"

    def _take_news(self) -> None:
        """Take what has arrived of the process that receives maps."""
        for news in self._maps.take() if self._maps is not None else []:
            if isinstance(news, MapNews):
                self._map = self._map if news.map is None else news.map
                self._size, self._map_problem = news.size, news.problem
            elif isinstance(news, MapLink):
                self._link_problem = news.problem
            elif isinstance(news, StopOrder):
                self._link_problem = "the process that receives maps has ended"

    def take_goal(self) -> NewGoal | None:
        """New goal since the last call."""
        return self._goals.pop() if self._goals else None

    def take_goal_problem(self) -> str:
        """Why a goal could not be used since the last call; empty if all could."""
        problem, self._goal_problem = self._goal_problem, ""
        return problem

    def take_map(self) -> OccupancyMap | None:
        """New map since the last call."""
        self._take_news()
        found, self._map = self._map, None
        return found

    @property
    def awaits_map(self) -> bool:
        """Whether the robot has a topic of maps, and nothing has arrived on it yet."""
        self._take_news()
        return self._maps is not None and not (self._size or self.trouble)

    @property
    def trouble(self) -> str:
        """Why the vehicle must not drive: its newest map cannot be used, or none would arrive; empty if it may."""
        self._take_news()
        return self._map_problem or self._link_problem

    def map_check(self, topic: str) -> Check:
        """Whether there is a map, for the check list."""
        if self.trouble:
            return Check("map", "problem", self.trouble)
        if self._size:
            return Check("map", "ok", self._size)
        return Check("map", "warning", f"no map on {topic}: the obstacles are those of the scenario")
