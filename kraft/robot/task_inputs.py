"""What changes the task of a drive: goals and maps of a robot, taken by the controller without waiting."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from kraft.robot.messages import POSE
from kraft.robot.protocol import Check, Mailbox, MapLink, MapNews, StopOrder
from kraft.robot.robot_file import Robot
from kraft.robot.transport import Transport
from kraft.scenario import OccupancyMap


class TaskInputs:
    """Goals from the robot's topic, and maps from the process that receives them."""

    def __init__(self, robot: Robot, transport: Transport, maps: Mailbox | None) -> None:
        """Subscribe to goals; `maps` is the mailbox of the process that receives maps, None if the robot has none."""
        self._robot, self._maps = robot, maps
        self._goals: deque[tuple[float, float]] = deque(maxlen=1)  # a thread of the transport adds to it
        self._map: OccupancyMap | None = None
        self._goal_problem = ""
        self._size = self._map_problem = self._link_problem = ""
        if robot.goal is not None:
            transport.subscribe(robot.goal.topic, POSE, self._take_goal, refused=self._refuse_goal)

    def _take_goal(self, message: Any, _: int) -> None:
        place = message.pose.position
        frame = message.header.frame_id.lstrip("/")
        if frame == self._robot.pose.frame and math.isfinite(place.x) and math.isfinite(place.y):
            self._goals.append((float(place.x), float(place.y)))
        else:
            expected = f"expected numbers in the frame {self._robot.pose.frame!r}"
            self._goal_problem = (
                f"the goal ({place.x:g}, {place.y:g}) in the frame {frame!r} cannot be used: {expected}"
            )

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

    def take_goal(self) -> tuple[float, float] | None:
        """New goal since the last call, m."""
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
