"""Check list before a drive: poses, clocks, the dead man, the receiver of commands, the map, the model."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from kraft.planning.feasibility import footprint_hit, goal_hit
from kraft.robot.announcement import Announced
from kraft.robot.command import unit_problem, unit_warnings
from kraft.robot.connect import open_transport
from kraft.robot.inputs import Inputs
from kraft.robot.maps import with_map
from kraft.robot.poses import Pose, Received, units_hint
from kraft.robot.priority import is_preferred
from kraft.robot.protocol import Check, Checked, DriveSpec
from kraft.robot.robot_file import Robot
from kraft.robot.task_inputs import TaskInputs
from kraft.robot.transport import Peers, Transport
from kraft.scenario import Task
from kraft.scenario.unmapped import unstated_outside
from kraft.vehicles.config import load_vehicle_config
from kraft.vehicles.identification_record import IdentificationRecord
from ompl_ext.vehicle import Vehicle

LISTENING: Final = 1.5
"""Time for which poses are collected, s."""
WAITING: Final = 15.0
"""Longest time to wait for poses and peers, s."""
SLOW: Final = 0.7
"""Share of the expected rate of poses below which there is a warning."""
LATENCY: Final = 0.15
"""Age of an arriving pose beyond which there is a warning, s."""
FUTURE: Final = -0.02
"""Age of an arriving pose below which there is a warning, s: its stamp is later than its arrival."""
TURNED: Final = (
    "if it stands as the scenario says, the marker is turned on the car (pose.tracked_point.heading_deg), or the frame "
    "of the poses against that of the scenario"
)
"""What else a wrong heading at the right place may mean."""
MOVED: Final = 0.01
"""Distance from the tracked point to the model's beyond which they are two points, m."""
MOVING: Final = 0.15
"""Distance between the poses of a vehicle that should stand beyond which it moves, m."""


def examine_topics(robot: Robot) -> tuple[Check, ...]:
    """Checks of a robot without a drive: everything but the start, the map and the model.

    Raises:
        InputError: if no connection is possible.
        MissingDependency: if a package of the transport is missing.
    """
    transport = open_transport(robot)
    try:
        return Checklist(robot, transport, Inputs(robot, transport)).examine()
    finally:
        transport.close()


class Checklist:
    """Looks at a robot that stands, and tells what prevents a drive."""

    def __init__(self, robot: Robot, transport: Transport, inputs: Inputs, tasks: TaskInputs | None = None) -> None:
        """Look at what arrives in `inputs`; `tasks` are the goals and maps of a drive."""
        self._robot, self._transport, self._inputs, self._tasks = robot, transport, inputs, tasks

    def examine(self) -> tuple[Check, ...]:
        """Checks that need no drive."""
        poses, peers = self._listen(lambda: False)
        return (
            *self._check_poses(poses),
            *self._check_clock(poses),
            self._check_dead_man(),
            self._check_commands(peers),
        )

    def run(self, spec: DriveSpec, is_cancelled: Callable[[], bool], on_wait: Callable[[Check], object]) -> Checked:
        """Collect poses for a while and check; every check is reported.

        The commands are announced only if nobody else does.  An earlier drive that has ended may be listed for a
        while (rosbridge keeps its registration for 10 s); `on_wait` is told what is waited for then.
        """
        topic, kind = self._robot.command.topic, self._robot.command.type
        announced = Announced(self._transport)
        poses, peers = self._listen(is_cancelled)
        if peers.publishers:
            on_wait(Check("commands", "waiting", f"{WAITING:g} s at most for {_others(peers)} to leave {topic}"))
            if self._wait_for_others(is_cancelled):
                poses, peers = self._listen(is_cancelled)
        checks = [*self._check_poses(poses), *self._check_start(poses, spec.task), *self._check_clock(poses)]
        checks += [self._check_dead_man(), self._check_commands(peers), *self._check_map()]
        grid = None if self._tasks is None else self._tasks.take_map()
        checks += self._check_scenario(announced, spec, has_map=grid is not None) if poses else []
        mapped = with_map(spec.task, grid)
        checks += [*_check_bounds(spec.task), *_check_place(_mean_pose(poses), mapped, spec.vehicle)]
        checks += _check_goal(mapped, spec.vehicle)
        checks += [_check_model(spec.vehicle, is_simulated=self._robot.simulated), _check_priority()]
        checks += [*_check_point(spec.vehicle, self._robot), *_check_units(spec.vehicle, self._robot)]
        if not peers.publishers:
            self._transport.advertise(topic, kind)
            self._wait_for_subscriber(is_cancelled)
        return Checked(tuple(checks), _mean_pose(poses), _rate(poses), grid)

    def _listen(self, is_cancelled: Callable[[], bool]) -> tuple[list[Received], Peers]:
        """Poses of a while after the first one, and the peers of the commands."""
        topic = self._robot.command.topic
        until, poses, peers = clock.monotonic() + WAITING, list[Received](), Peers(None, None)
        first: float | None = None
        while clock.monotonic() < until and not is_cancelled():
            poses += self._inputs.take_poses()
            now = clock.monotonic()
            if poses and first is None:
                first = now
            peers = self._transport.peers(topic)
            complete = peers.subscribers is None or peers.subscribers
            ready = complete and not self._inputs.trouble and not (self._tasks is not None and self._tasks.awaits_map)
            if first is not None and now - first > LISTENING and (ready or now - first > 0.5 * WAITING):
                break
            clock.sleep(0.05)
        return poses, peers

    def _wait_for_others(self, is_cancelled: Callable[[], bool]) -> bool:
        """Wait until nobody else publishes commands; whether that is so in the end."""
        until = clock.monotonic() + WAITING
        while clock.monotonic() < until and not is_cancelled():
            if not self._transport.peers(self._robot.command.topic).publishers:
                return True
            clock.sleep(0.05)
        return False

    def _wait_for_subscriber(self, is_cancelled: Callable[[], bool]) -> None:
        """Wait until the announced commands can reach somebody: discovery takes a moment."""
        until = clock.monotonic() + 2.0
        while clock.monotonic() < until and not is_cancelled():
            subscribers = self._transport.peers(self._robot.command.topic).subscribers
            if subscribers is None or subscribers:
                return
            clock.sleep(0.05)

    def _check_scenario(self, announced: Announced, spec: DriveSpec, *, has_map: bool) -> list[Check]:
        is_simulated = self._robot.simulated
        return announced.checks(spec.task, spec.vehicle, is_simulated=is_simulated, has_map=has_map)

    def _check_poses(self, poses: list[Received]) -> list[Check]:
        robot = self._robot
        topic = robot.pose.topic
        if not poses:
            publishers = self._transport.peers(topic).publishers
            why = "nobody publishes there" if publishers is not None and not publishers else "it is silent"
            return [Check("poses", "problem", f"no pose of type {robot.pose.type} on {topic}: {why}")]
        frames = {pose.frame for pose in poses}
        if frames != {robot.pose.frame}:
            there = ", ".join(repr(frame) for frame in sorted(frames))
            return [Check("poses", "problem", f"their frame is {there}, expected {robot.pose.frame!r} (pose.frame)")]
        if _mean_pose(poses) is None:
            return [Check("poses", "problem", "they are no numbers, or their orientation is no unit quaternion")]
        checks = [self._check_rate(poses)]
        moved = _way(poses)
        if moved > MOVING:
            checks.append(Check("standstill", "problem", f"the vehicle moves by {moved:.2f} m while it should stand"))
        return checks

    def _check_start(self, poses: list[Received], task: Task) -> list[Check]:
        watchdog, mean = self._robot.watchdog, _mean_pose(poses)
        if mean is None:
            return []
        start = task.start.x, task.start.y, task.start.heading
        off = math.hypot(mean[0] - start[0], mean[1] - start[1])
        turned = math.degrees(abs(math.remainder(mean[2] - start[2], math.tau)))
        where = f"({mean[0]:.2f}, {mean[1]:.2f}) heading {math.degrees(mean[2]):.0f} deg"
        if off <= watchdog.start and turned <= watchdog.start_deg:
            return [Check("start", "ok", f"{where}, {off:.2f} m and {turned:.0f} deg from the scenario's start")]
        hint = units_hint(mean, start, watchdog.start) if off > watchdog.start else TURNED
        problem = f"the vehicle is at {where}, {off:.2f} m and {turned:.0f} deg from the start of {task.name}"
        return [Check("start", "problem", problem + (f"; {hint}" if hint else ""))]

    def _check_rate(self, poses: list[Received]) -> Check:
        rate = _rate(poses)
        expected = self._robot.pose.rate_hz
        state = "ok" if rate >= SLOW * expected else "warning"
        return Check("poses", state, f"{rate:.1f} Hz on {self._robot.pose.topic}, expected {expected:g} Hz")

    def _check_clock(self, poses: list[Received]) -> list[Check]:
        """Whether stamps fit to this machine's clock; the usual latency is kept for the drive."""
        robot, timebase = self._robot, self._inputs.clock
        if robot.clock is not None and not timebase.is_running:
            return [Check("clock", "problem", f"no time on {robot.clock.topic}: is the simulation running?")]
        if not poses or robot.pose.stamp == "arrival":
            return []
        offset = timebase.stamp() - timebase.now()
        latency = float(np.median([1e-9 * (pose.arrival + offset - pose.stamp) for pose in poses]))
        self._inputs.latency = latency
        if abs(latency) > robot.watchdog.clock:
            whose = "this machine's clock" if robot.clock is None else f"the clock on {robot.clock.topic}"
            problem = f"the stamps are {latency:.2f} s from {whose}"
            return [Check("clock", "problem", f"{problem}: set the clocks, or pose.stamp: arrival")]
        state = "ok" if FUTURE < latency < LATENCY else "warning"
        return [Check("clock", state, f"poses arrive {1000 * latency:.0f} ms after their stamps")]

    def _check_dead_man(self) -> Check:
        switch = self._robot.dead_man
        if switch is None and self._robot.simulated:
            return Check("dead man", "ok", "none: the robot is simulated")
        if switch is None:
            return Check("dead man", "warning", "the robot file names no switch that a person holds")
        trouble = self._inputs.trouble
        return Check("dead man", "problem" if trouble else "ok", trouble or f"held on {switch.topic}")

    def _check_commands(self, peers: Peers) -> Check:
        topic = self._robot.command.topic
        if peers.publishers:
            return Check("commands", "problem", f"somebody else publishes on {topic} already ({_others(peers)})")
        if peers.subscribers is None:
            return Check("commands", "warning", f"the transport cannot tell whether anybody listens on {topic}")
        if not peers.subscribers:
            return Check("commands", "problem", f"nobody listens on {topic}")
        return Check("commands", "ok", f"{topic} has a listener")

    def _check_map(self) -> list[Check]:
        settings = self._robot.map
        if settings is None or self._tasks is None:
            return []
        return [self._tasks.map_check(settings.topic)]


def _check_place(pose: Pose | None, task: Task, vehicle: Vehicle) -> list[Check]:
    """A warning if the vehicle stands in an obstacle of the scenario or of its map, or outside of the bounds."""
    hit = None if pose is None else footprint_hit(task, vehicle, pose)
    return [Check("place", "warning", f"where it stands, the vehicle {hit}")] if hit else []


def _check_goal(task: Task, vehicle: Vehicle) -> list[Check]:
    """A warning if the goal is in an obstacle of the robot's map: no plan reaches it until one of them changes."""
    (x, y), hit = task.goal.center, goal_hit(task, vehicle)
    return [Check("goal", "warning", f"the goal ({x:g}, {y:g}) {hit}")] if hit else []


def _check_bounds(task: Task) -> list[Check]:
    """A warning if the bounds of the scenario reach beyond its maps, and it does not state what is there."""
    unstated = unstated_outside(task)
    return [Check("bounds", "warning", unstated)] if unstated else []


def _check_model(vehicle: Vehicle, *, is_simulated: bool) -> Check:
    shape = vehicle.footprint
    model = f"{vehicle.name}, {shape.length:.2f} m long and {shape.width:.2f} m wide,"
    if is_simulated:
        return Check("model", "ok", f"{model} for a simulated robot")
    if _record(vehicle) is not None:
        return Check("model", "ok", f"{model} is identified")
    return Check("model", "warning", f"{model} states no identification: was it made for this car?")


def _check_point(vehicle: Vehicle, robot: Robot) -> list[Check]:
    """A warning if the poses are moved to another point than that of a model which already has theirs."""
    moved = math.hypot(robot.pose.tracked_point.x, robot.pose.tracked_point.y)
    if robot.simulated or "lever" not in vehicle.parameters or moved < MOVED:
        return []
    detail = (
        f"poses are moved by {moved:.2f} m, and {vehicle.name} has those of the point that its logs have: leave out "
        "pose.tracked_point, unless the robot's poses are of another point than the logs'"
    )
    return [Check("tracked point", "warning", detail)]


def _check_units(vehicle: Vehicle, robot: Robot) -> list[Check]:
    """A problem or warnings if the robot may take other numbers than it is sent."""
    if (problem := unit_problem(vehicle, robot)) is not None:
        return [Check("units", "problem", problem)]
    record = None if robot.simulated else _record(vehicle)
    converted = {} if record is None or record.commands is None else record.commands
    return [Check("units", "warning", text) for text in unit_warnings(vehicle, robot, converted)]


def _record(vehicle: Vehicle) -> IdentificationRecord | None:
    """Record of the identification in the file of a vehicle, if there is one."""
    return load_vehicle_config(Path(vehicle.file)).identification if vehicle.file else None


def _check_priority() -> Check:
    """Whether the controller runs before other programs."""
    if is_preferred():
        return Check("priority", "ok", "the controller runs before all ordinary programs")
    detail = "the controller waits for other programs: rtprio in /etc/security/limits.conf permits more"
    return Check("priority", "warning", detail)


def _others(peers: Peers) -> str:
    """Names of the publishers, for people."""
    return ", ".join(sorted(peers.publishers or ()))


def _rate(poses: list[Received]) -> float:
    """Poses per second, Hz; 0 of fewer than two."""
    duration = 1e-9 * (poses[-1].arrival - poses[0].arrival) if poses else 0.0
    return (len(poses) - 1) / duration if duration > 0.0 else 0.0


def _way(poses: list[Received]) -> float:
    """Distance between the medians of the first and of the last third of the poses, which noise hardly moves, m."""
    places, third = np.array([pose.pose[:2] for pose in poses]), max(1, len(poses) // 3)
    return float(np.hypot(*(np.median(places[-third:], axis=0) - np.median(places[:third], axis=0))))


def _mean_pose(poses: list[Received]) -> Pose | None:
    """Mean pose, with the mean direction as heading; None without poses, or if a number is not finite."""
    if not poses:
        return None
    table = np.array([pose.pose for pose in poses])
    x, y = table[:, :2].mean(axis=0).tolist()
    heading = math.atan2(float(np.sin(table[:, 2]).mean()), float(np.cos(table[:, 2]).mean()))
    return (x, y, heading) if all(map(math.isfinite, (x, y, heading))) else None
