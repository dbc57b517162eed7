"""Poses of a robot as observations: frames, units and clocks are checked, and poses that cannot be true are refused."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from kraft.driving.messages import Observation
from kraft.robot.messages import POSE, TRANSFORM, nanoseconds_of, yaw_of
from kraft.robot.robot_file import Robot

FAR: Final = 5.0
"""Distance from the expected position from which on the unit may be another one, m: near the origin all are alike."""
FROZEN_SPEED: Final = 0.05
"""Speed by the model from which on a pose that is exactly the last one tells nothing, m/s."""
Pose = tuple[float, float, float]


@dataclass(frozen=True)
class Received:
    """A pose message: stamp and arrival (ns since 1970, ns of the monotonic clock), frame, and pose of the body."""

    stamp: int
    arrival: int
    frame: str
    pose: Pose


def received(robot: Robot, message: Any, arrival: int) -> Received:
    """Content of a pose message of the type that the robot sends."""
    settings = robot.pose
    if settings.type == TRANSFORM:
        place, turn = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose if settings.type == POSE else message.pose.pose
        place, turn = pose.position, pose.orientation
    tracked = float(place.x), float(place.y), yaw_of(turn)
    body = settings.tracked_point.body_pose(*tracked) if all(map(math.isfinite, tracked)) else tracked
    return Received(nanoseconds_of(message.header.stamp), arrival, message.header.frame_id.lstrip("/"), body)


@dataclass(frozen=True)
class Clocks:
    """Time 0 of the drive by both clocks (ns), and the usual time between stamp and arrival of a pose, s."""

    wall: int
    monotonic: int
    latency: float = 0.0

    def of_arrival(self, arrival: int) -> float:
        """Time of the drive (s) of an arrival."""
        return 1e-9 * (arrival - self.monotonic)

    def of_stamp(self, stamp: int) -> float:
        """Time of the drive (s) of a stamp."""
        return 1e-9 * (stamp - self.wall)

    def stamp(self, time: float) -> int:
        """Stamp (ns since 1970) of a time of the drive (s)."""
        return self.wall + round(1e9 * time)


class PoseGuard:
    """Turns poses into observations while the vehicle drives, and refuses those that cannot be true.

    A refused pose is none: the newest observation grows older, until the watchdog stops the vehicle.
    """

    def __init__(self, robot: Robot, clocks: Clocks) -> None:
        self._robot, self._clocks = robot, clocks
        self._last: Pose | None = None
        self._frozen: Pose | None = None
        self.refused: dict[str, int] = {}
        self.reason = ""

    def observation(
        self, pose: Received, predicted: Pose, reckoned: Pose, speed: float, age: float
    ) -> Observation | None:
        """Observation of a pose; None if it is refused, and then `reason` says why.

        A pose is believed near either of two: what has been learned may be wrong, and then `predicted` leads away from
        a vehicle that stands unseen, where no true pose would be near it any more.

        Args:
            pose: the received pose.
            predicted: pose that the model with what has been learned predicts now.
            reckoned: pose to which the commands lead by the vehicle's model from the newest observation, without
                anything that has been learned.
            speed: speed that the commands lead to by the model, without any pose, m/s.
            age: age of the newest observation, s; the prediction is that much less certain.
        """
        arrival = self._clocks.of_arrival(pose.arrival)
        time = arrival if self._robot.pose.stamp == "arrival" else self._clocks.of_stamp(pose.stamp)
        reason = self._doubt(pose, time, arrival, speed) or self._displaced(
            pose.pose, (predicted, reckoned), speed, age
        )
        self._last = pose.pose
        if reason:
            self.refused[reason.split(":")[0]] = self.refused.get(reason.split(":")[0], 0) + 1
            self.reason = reason
            return None
        self.reason = ""
        return Observation(min(time, arrival), arrival, *pose.pose)

    def _doubt(self, pose: Received, time: float, arrival: float, speed: float) -> str:
        """Why a pose cannot be true wherever the vehicle is; empty if it can."""
        watchdog, (x, y, theta) = self._robot.watchdog, pose.pose
        if not all(map(math.isfinite, pose.pose)):
            return f"the poses are no numbers: ({x:g}, {y:g}, {theta:g})"
        if pose.frame != self._robot.pose.frame:
            return f"the poses are in another frame: {pose.frame!r} instead of {self._robot.pose.frame!r}"
        late = arrival - time - self._clocks.latency
        if abs(late) > watchdog.clock:
            return f"the clock of the poses jumped: by {-late:.2f} s"
        if pose.pose == self._last and abs(speed) > FROZEN_SPEED:
            self._frozen = pose.pose
        if pose.pose == self._frozen:  # also when the vehicle stands because of it
            return "the poses do not change: the vehicle should move"
        return ""

    def _displaced(self, pose: Pose, expected: tuple[Pose, ...], speed: float, age: float) -> str:
        """Why a pose is near none of the expected ones; empty if it is near one."""
        watchdog = self._robot.watchdog
        # a vehicle that was not seen may be farther off
        allowed = watchdog.jump + 0.5 * abs(speed) * min(max(age, 0.0), 2.0)
        reasons = []
        for x, y, theta in expected:
            off = math.hypot(pose[0] - x, pose[1] - y)
            turned = abs(math.remainder(pose[2] - theta, math.tau))
            if not off <= allowed:  # also where what is expected is no number
                reasons.append(f"the poses jumped: {off:.2f} m from the predicted position")
            elif not turned <= math.radians(watchdog.jump_deg):
                reasons.append(f"the poses turned: {math.degrees(turned):.0f} degrees from the predicted heading")
            else:
                return ""
        return reasons[0]


def units_hint(pose: Pose, expected: Pose, near: float) -> str:
    """What the units of a pose may be that is far from the expected one; empty if it is near in no other unit."""
    x, y, _ = expected
    if math.hypot(pose[0] - x, pose[1] - y) < FAR:
        return ""
    for factor, unit in ((1e-3, "millimetres"), (1e-2, "centimetres")):
        if math.hypot(factor * pose[0] - x, factor * pose[1] - y) <= near:
            return f"the position may be in {unit}"
    return ""
