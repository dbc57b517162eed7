"""What arrives from a robot while it drives: poses and the dead man, taken by the controller without waiting."""

from __future__ import annotations

import queue
import time
from typing import Any

from kraft.robot.messages import BOOL
from kraft.robot.poses import Received, received
from kraft.robot.robot_file import Robot
from kraft.robot.timebase import clock_of
from kraft.robot.transport import Transport


class Inputs:
    """Subscriptions of a robot's topics; `clock` is the one by which their arrivals count."""

    def __init__(self, robot: Robot, transport: Transport) -> None:
        self._robot = robot
        self.clock = clock_of(robot, transport)
        self._poses: queue.SimpleQueue[Received] = queue.SimpleQueue()
        self._held: tuple[bool, int] | None = None  # and when it arrived, by the monotonic clock, ns
        self.latency = 0.0
        pose = robot.pose
        transport.subscribe(pose.topic, pose.type, self._take_pose, reliable=pose.reliable)
        if robot.dead_man is not None:
            transport.subscribe(robot.dead_man.topic, robot.dead_man.type, self._take_dead_man, reliable=False)

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

    def take_poses(self) -> list[Received]:
        """Poses that have arrived since the last call."""
        found = []
        while not self._poses.empty():
            found.append(self._poses.get())
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
