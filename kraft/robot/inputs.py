"""What arrives from a robot: poses, the dead man, goals and maps, taken by the controller without waiting."""

from __future__ import annotations

import queue
import time
from typing import Any, Final

import numpy as np

from kraft.robot.messages import BOOL, GRID, POSE, yaw_of
from kraft.robot.poses import Received, received
from kraft.robot.protocol import Check
from kraft.robot.robot_file import Robot
from kraft.robot.timebase import clock_of
from kraft.robot.transport import Transport
from kraft.scenario import OccupancyMap

OCCUPIED = 50
"""Occupancy in percent from which on a cell of a map is occupied; unknown cells are occupied too."""


RESOLUTION_MIN: Final = 0.005
"""Least side of a cell of a map, m."""


class Inputs:
    """Subscriptions of a robot's topics; `clock` is the one by which their arrivals count."""

    def __init__(self, robot: Robot, transport: Transport) -> None:
        self._robot = robot
        self.clock = clock_of(robot, transport)
        self._poses: queue.SimpleQueue[Received] = queue.SimpleQueue()
        self._held: tuple[bool, int] | None = None  # and when it arrived, by the monotonic clock, ns
        self._goal: tuple[float, float] | None = None
        self._map: OccupancyMap | None = None
        self._newest_map: OccupancyMap | None = None
        self._map_problem = ""
        self.latency = 0.0
        pose = robot.pose
        transport.subscribe(pose.topic, pose.type, self._take_pose, reliable=pose.reliable)
        if robot.dead_man is not None:
            transport.subscribe(robot.dead_man.topic, robot.dead_man.type, self._take_dead_man, reliable=False)
        if robot.goal is not None:
            transport.subscribe(robot.goal.topic, POSE, self._take_goal)
        if robot.map is not None:
            transport.subscribe(robot.map.topic, GRID, self._take_map, latched=True)

    def _take_pose(self, message: Any, arrival: int) -> None:
        if self.clock.is_running:
            self._poses.put(received(self._robot, message, self.clock.at(arrival)))

    def _take_dead_man(self, message: Any, arrival: int) -> None:
        switch = self._robot.dead_man
        assert switch is not None, "it is subscribed because of it"
        if switch.type == BOOL:
            held = bool(message.data)
        else:
            button = switch.button or 0
            held = button < len(message.buttons) and bool(message.buttons[button])
        self._held = held, arrival

    def _take_goal(self, message: Any, arrival: int) -> None:
        place = message.pose.position
        if message.header.frame_id.lstrip("/") == self._robot.pose.frame and np.isfinite([place.x, place.y]).all():
            self._goal = float(place.x), float(place.y)

    def _take_map(self, message: Any, arrival: int) -> None:
        frame = message.header.frame_id.lstrip("/")
        found = occupancy_map(message) if frame == self._robot.pose.frame else None
        if found is None:
            info = message.info
            size = f"{info.width} x {info.height} cells of {info.resolution:g} m"
            expected = f"expected cells of at least {RESOLUTION_MIN:g} m in the frame {self._robot.pose.frame!r}"
            self._map_problem = f"the map of {size} in the frame {frame!r} cannot be used; {expected}"
        elif found != self._newest_map:
            self._map = self._newest_map = found

    def map_check(self, topic: str) -> Check:
        """Whether there is a map, for the check list."""
        if self._newest_map is not None:
            rows, columns = self._newest_map.occupied.shape
            return Check("map", "ok", f"{columns} x {rows} cells of {self._newest_map.resolution:g} m")
        if self._map_problem:
            return Check("map", "problem", self._map_problem)
        return Check("map", "warning", f"no map on {topic}: the obstacles are those of the scenario")

    def take_poses(self) -> list[Received]:
        """Poses that have arrived since the last call."""
        found = []
        while not self._poses.empty():
            found.append(self._poses.get())
        return found

    def take_goal(self) -> tuple[float, float] | None:
        """New goal since the last call, m."""
        goal, self._goal = self._goal, None
        return goal

    def take_map(self) -> OccupancyMap | None:
        """New map since the last call."""
        found, self._map = self._map, None
        return found

    @property
    def trouble(self) -> str:
        """Why the vehicle must not drive by its dead man; empty if it may."""
        switch = self._robot.dead_man
        if switch is None:
            return ""
        if self._held is None:
            return f"no message of the dead man on {switch.topic}"
        held, arrival = self._held
        silence = self.clock.at(time.monotonic_ns()) - self.clock.at(arrival)
        if 1e-9 * silence > switch.timeout:
            return f"the dead man on {switch.topic} is silent"
        return "" if held else "the dead man is released"


def occupancy_map(message: Any) -> OccupancyMap | None:
    """Obstacle from an OccupancyGrid, unknown cells occupied; None if its size or resolution cannot be used."""
    info = message.info
    origin = info.origin.position.x, info.origin.position.y, yaw_of(info.origin.orientation)
    cells = np.asarray(message.data, dtype=np.int8)
    if cells.size == 0 or cells.size != info.width * info.height:
        return None
    if not np.isfinite([*origin, info.resolution]).all() or info.resolution < RESOLUTION_MIN:
        return None
    occupied = (cells >= OCCUPIED) | (cells < 0)
    grid = occupied.reshape(int(info.height), int(info.width))
    grid.setflags(write=False)
    return OccupancyMap(grid, float(info.resolution), origin, name="map")
