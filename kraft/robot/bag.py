"""Bags: drives as ROS 2 messages in an MCAP file, for viewers, `ros2 bag play` and `kraft sysid`.

The bag of a simulated drive depends on the drive alone: the same seed gives the same bytes.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer

from kraft.driving.messages import Cycle
from kraft.errors import Code, InputError
from kraft.files import check_writable, file_mode, unwritable
from kraft.logs.bag_tables import typestore
from kraft.recording.recorder import Recording
from kraft.robot.display import Frames, cycle_messages, occupancy_grid, scene_markers
from kraft.robot.messages import (
    ACKERMANN,
    EPOCH,
    TF,
    header,
    joints,
    log_line,
    make,
    odometry,
    stamped_pose,
    to_cdr,
    transform,
)
from kraft.scenario import Task
from kraft.trial.result import TrialResult, TrialSpec, outcome_text
from kraft.vehicles import CAR_CONTROLS, is_car
from ompl_ext.arrays import Floats
from ompl_ext.poses import pose_of
from ompl_ext.vehicle import Vehicle

LATCHED: Final = ("/map", "/markers/scene")
"""Topics whose last message late subscribers get too."""
FRAMES: Final = Frames()
TRUTH_FRAME: Final = "truth/base_link"
_NO_TIME: Final = QosTime(0, 0)
_NAME: Final = "drive"
"""Name of the file while it is written; the bag contains it."""


def check_bag(path: Path, *, new: bool = False) -> None:
    """Check before the drive that a bag can be written; a `new` one replaces no file, since no drive can be repeated.

    Raises:
        InputError: if the name has another ending than .mcap, it cannot be written, or a new one is there already.
    """
    if path.suffix != ".mcap":
        raise InputError.of_argument("bag", f"is {str(path)!r}", "expected the name of an .mcap file")
    if new and os.path.lexists(path):
        raise InputError.of(str(path), "is there already", "expected a new file for the bag", Code.EXISTS)
    check_writable(path)


class BagWriter:
    """Writes messages into an MCAP file, which is complete and in its place at the exit of the context."""

    def __init__(self, path: Path, *, keeps: bool = False) -> None:
        """Write to `path`; what is written before an error stays there if it `keeps` it, otherwise it is removed."""
        self._path, self._keeps = path, keeps
        self._folder: Path | None = None
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> Self:
        """Open the file.

        Raises:
            InputError: if it cannot be written.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=f".{self._path.name}.", suffix=".part", dir=self._path.parent))
        except OSError as error:
            raise unwritable(self._path, error) from error
        self._writer = Writer(self._folder / _NAME, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        assert self._folder is not None, "it was entered"
        try:
            written = self._folder / _NAME / f"{_NAME}.mcap"
            if kind is None:
                self._writer.close()
            elif self._keeps:
                with suppress(OSError):
                    self._writer.close()
                if written.stat().st_size == 0:
                    return
            else:
                self._writer.abort()
                return
            written.chmod(file_mode())
            written.replace(self._path)
        except OSError as failure:
            raise unwritable(self._path, failure) from failure
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def write(self, topic: str, time: int, message: Any) -> None:
        """Write a message at `time` (ns) of the recorder."""
        self.write_cdr(topic, message.__msgtype__, time, to_cdr(message))

    def write_cdr(self, topic: str, kind: str, time: int, content: bytes) -> None:
        """Write a message of type `kind` that is already serialised."""
        connection = self._connections.get(topic)
        if connection is None:
            quality = [_latched_quality()] if topic in LATCHED else []
            connection = self._writer.add_connection(topic, kind, typestore=typestore(), offered_qos_profiles=quality)
            self._connections[topic] = connection
        self._writer.write(connection, time, content)


def _latched_quality() -> Qos:
    return Qos(
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL,
        _NO_TIME, _NO_TIME, QosLiveliness.AUTOMATIC, _NO_TIME, False,
    )  # fmt: skip


Timed = tuple[int, str, Any]
"""Time of recording (ns), topic, message."""


def write_trial(path: Path, spec: TrialSpec, result: TrialResult) -> None:
    """Write a trial as a bag.

    Raises:
        InputError: if the file cannot be written.
    """
    _write(path, _trial(spec, result))


def _trial(spec: TrialSpec, result: TrialResult) -> Iterator[Timed]:
    vehicle = spec.vehicle
    yield from scene(spec.scenario.task())
    for observation in result.observations:
        pose = observation.x, observation.y, observation.theta
        yield at(observation.arrival), "/pose", stamped_pose(at(observation.time), FRAMES.map, pose)
    for step in result.steps:
        time = at(step.time)
        yield time, command_topic(vehicle), command(time, vehicle, step.command)
        pose, speed = pose_of(step.estimate, vehicle), float(step.estimate[vehicle.rest_indices[0]])
        yield time, "/odometry/filtered", odometry(time, FRAMES.map, FRAMES.body, pose, speed)
        yield time, "/truth/odom", odometry(time, FRAMES.map, TRUTH_FRAME, step.pose, step.speed)
        moved = [
            transform(time, FRAMES.map, FRAMES.body, pose),
            transform(time, FRAMES.map, TRUTH_FRAME, step.pose),
        ]
        yield time, "/tf", make(TF, transforms=moved)
    for cycle in result.cycles:
        yield from _cycle(cycle, vehicle)
    end = outcome_text(result.outcome, result.obstacle, result.time)
    yield at(result.time), "/rosout", log_line(at(result.time), end)


def _cycle(cycle: Cycle, vehicle: Vehicle) -> Iterator[Timed]:
    time = at(cycle.time)
    for name, message in cycle_messages(cycle, vehicle, time, EPOCH, FRAMES):
        yield time, f"/{name}", message
    if cycle.reason:
        yield time, "/rosout", log_line(time, f"{cycle.kind}: {cycle.reason}", level=30)


def write_recording_bag(path: Path, task: Task, vehicle: Vehicle, recording: Recording) -> None:
    """Write a recorded run as a bag.

    Raises:
        InputError: if the file cannot be written.
    """
    _write(path, _recording(task, vehicle, recording))


def _recording(task: Task, vehicle: Vehicle, recording: Recording) -> Iterator[Timed]:
    yield from scene(task)
    for t, *control in recording.commands.tolist():
        yield at(t), command_topic(vehicle), command(at(t), vehicle, np.array(control))
    for t, x, y, theta in recording.poses.tolist():
        yield at(t), "/pose", stamped_pose(at(t), FRAMES.map, (x, y, theta))
        yield at(t), "/tf", make(TF, transforms=[transform(at(t), FRAMES.map, FRAMES.body, (x, y, theta))])
    for t, x, y, theta, speed in recording.truth.tolist():
        yield at(t), "/truth/odom", odometry(at(t), FRAMES.map, TRUTH_FRAME, (x, y, theta), speed)
        yield at(t), "/tf", make(TF, transforms=[transform(at(t), FRAMES.map, TRUTH_FRAME, (x, y, theta))])


def _write(path: Path, messages: Iterable[Timed]) -> None:
    """Write messages as a bag, in the order of their times; those of the same time stay in their order."""
    try:
        with BagWriter(path) as bag:
            for time, topic, message in sorted(messages, key=lambda timed: timed[0]):
                bag.write(topic, time, message)
    except OSError as error:
        raise unwritable(path, error) from error


def scene(task: Task, time: int = EPOCH, frame: str = FRAMES.map) -> Iterator[Timed]:
    """The map and the markers of obstacles and goal."""
    yield time, "/map", occupancy_grid(task, time, frame)
    yield time, "/markers/scene", scene_markers(task, time, frame)


def at(time: float) -> int:
    """Time of a simulated drive (s) as a stamp (ns)."""
    return EPOCH + round(1e9 * time)


def command_topic(vehicle: Vehicle) -> str:
    """Topic of the commands in a bag."""
    return "/drive" if is_car(vehicle) else "/controls"


def command(time: int, vehicle: Vehicle, control: Floats) -> Any:
    """A control (nu,): of a car an AckermannDriveStamped with the throttle as speed, else a JointState with names.

    The throttle is written as it is, so that an identification from the bag gives the gain of the throttle.
    """
    names = list(vehicle.controls)
    if not is_car(vehicle):
        return joints(time, names, control)
    throttle, steering = (float(control[names.index(name)]) for name in CAR_CONTROLS)
    drive = {"speed": throttle, "steering_angle": steering}
    return make(ACKERMANN, header=header(time, FRAMES.body), drive=drive)


def bag_of_run(path: Path, number: int, runs: int) -> Path:
    """File of one of several recorded runs: FILE_01.mcap; of the only one FILE.mcap."""
    return path if runs == 1 else path.with_name(f"{path.stem}_{number:02d}{path.suffix}")
