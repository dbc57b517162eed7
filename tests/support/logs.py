"""A drive that is known exactly, and how to write it as CSV files and bags."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from kraft.errors import Diagnostic, InputError
from kraft.logs.log import Log
from kraft.logs.reader import read_logs

ACKERMANN = (
    "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n"
)
STAMPED = "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n"
EPOCH = 1_700_000_000_000_000_000  # ns
_FOLDER = os.environ.get("KRAFT_REAL_LOGS")
REAL_LOGS = Path(_FOLDER or "", "f1tenth_koopman_cc0")
"""Logs of a real F1TENTH car, which are not part of the repository."""
RAMPS = Path(_FOLDER or "", "dart_ramps_mit")
"""Logs of a real 1:10 car that drives circles with slow ramps of the throttle, each with one steering."""
needs_real_logs = pytest.mark.skipif(not _FOLDER, reason="KRAFT_REAL_LOGS does not name the folder of the real logs")


def located(diagnostics: Iterable[Diagnostic], folder: Path) -> list[str]:
    """Place, key and code of each diagnostic, as in ``m.yaml:1:14 poses.yaw unknown``."""
    return [" ".join(filter(None, (d.place.replace(f"{folder}/", ""), d.path, d.code))) for d in diagnostics]


@dataclass(frozen=True)
class Drive:
    """A car that weaves: commands at 20 Hz from 0 s, poses at 30 Hz from 0.01 s."""

    command_times: np.ndarray
    commands: np.ndarray
    pose_times: np.ndarray
    poses: np.ndarray


def drive(duration: float = 6.0, turn: float = 1.0) -> Drive:
    """Drive at 0.8 m/s; the yaw, which is not wrapped, swings and grows by ``turn`` rad/s."""
    commands = np.arange(0, duration, 0.05)
    poses = np.arange(0.01, duration, 1 / 30)
    fine = np.linspace(0, duration, 20001)
    yaw = turn * fine + 0.6 * np.sin(1.5 * fine)
    x = np.concatenate([[0], np.cumsum(0.8 * np.cos(yaw[:-1]) * np.diff(fine))])
    y = np.concatenate([[0], np.cumsum(0.8 * np.sin(yaw[:-1]) * np.diff(fine))])
    xyyaw = np.column_stack([np.interp(poses, fine, values) for values in (x, y, yaw)])
    steering = 0.1 * turn + 0.2 * np.cos(1.5 * commands)
    return Drive(commands, np.column_stack([np.full(len(commands), 0.5), steering]), poses, xyyaw)


def wrapped(yaw: np.ndarray) -> np.ndarray:
    return (yaw + np.pi) % (2 * np.pi) - np.pi


def write_table(path: Path, heading: Sequence[str], columns: Sequence[np.ndarray], separator: str = ",") -> Path:
    """Write a CSV file; NaN is written as nothing."""
    lines = [separator.join(heading)]
    lines += [separator.join("" if np.isnan(v) else repr(float(v)) for v in row) for row in np.column_stack(columns)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def wide_columns(times: np.ndarray, made: Drive) -> dict[str, np.ndarray]:
    """The drive sampled at common times, as columns of a wide table."""
    held = np.searchsorted(made.command_times, times, side="right") - 1
    poses = [np.interp(times, made.pose_times, made.poses[:, k]) for k in range(3)]
    return {
        "t": times, "throttle": made.commands[held, 0], "steering": made.commands[held, 1],
        "x": poses[0], "y": poses[1], "yaw": wrapped(poses[2]),
    }  # fmt: skip


def write_wide(path: Path, changed: Mapping[str, np.ndarray] | None = None, made: Drive | None = None) -> Path:
    """Write a good wide log at 40 Hz with some columns changed."""
    columns = {**wide_columns(np.arange(0.025, 5.9, 0.025), made or drive()), **(changed or {})}
    return write_table(path, list(columns), list(columns.values()))


def write_pair(folder: Path, made: Drive, commands: str = "commands.csv", poses: str = "poses.csv") -> Path:
    """Write a pair of CSV files."""
    write_table(folder / commands, ["t", "throttle", "steering"], [made.command_times, *made.commands.T])
    columns = [made.pose_times, made.poses[:, 0], made.poses[:, 1], wrapped(made.poses[:, 2])]
    write_table(folder / poses, ["t", "x", "y", "yaw"], columns)
    return folder


def store(ros1: bool) -> Typestore:
    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(ACKERMANN, "ackermann_msgs/msg/AckermannDrive"))
    types.register(get_types_from_msg(STAMPED, "ackermann_msgs/msg/AckermannDriveStamped"))
    return types


class Bag:
    """Writes a bag of any kind: ``bag.send(topic, type, time, ...)`` in any order."""

    def __init__(self, path: Path, kind: str) -> None:
        self.ros1 = kind == "bag"
        self.types = store(self.ros1)
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer = Writer1(path) if self.ros1 else Writer2(path, version=9, storage_plugin=plugin)
        self.connections: dict[tuple[str, str], object] = {}
        self.sequence = 0

    def __enter__(self) -> Bag:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def make(self, name: str, *values: object, **named: object) -> object:
        return self.types.types[name](*values, **named)

    def header(self, stamp: int) -> object:
        time = self.make("builtin_interfaces/msg/Time", stamp // 10**9, stamp % 10**9)
        if self.ros1:
            return self.make("std_msgs/msg/Header", self.sequence, time, "map")
        return self.make("std_msgs/msg/Header", time, "map")

    def send(self, topic: str, kind: str, time: int, message: object) -> None:
        if (topic, kind) not in self.connections:
            self.connections[topic, kind] = self.writer.add_connection(topic, kind, typestore=self.types)
        encode = self.types.serialize_ros1 if self.ros1 else self.types.serialize_cdr
        self.writer.write(self.connections[topic, kind], time, encode(message, kind))

    def ackermann(self, topic: str, stamp: int, speed: float, steering: float, lag: int = 0) -> None:
        inner = self.make("ackermann_msgs/msg/AckermannDrive", steering, 0.0, speed, 0.0, 0.0)
        kind = "ackermann_msgs/msg/AckermannDriveStamped"
        self.send(topic, kind, stamp + lag, self.make(kind, self.header(stamp), inner))

    def twist(self, topic: str, stamp: int, speed: float, turn: float) -> None:
        vectors = [
            self.make("geometry_msgs/msg/Vector3", speed, 0.0, 0.0),
            self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, turn),
        ]
        self.send(topic, "geometry_msgs/msg/Twist", stamp, self.make("geometry_msgs/msg/Twist", *vectors))

    def joints(self, topic: str, stamp: int, positions: Mapping[str, float]) -> None:
        names, values, none = list(positions), np.array(list(positions.values())), np.zeros(0)
        kind = "sensor_msgs/msg/JointState"
        self.send(topic, kind, stamp, self.make(kind, self.header(stamp), names, values, none, none))

    def boolean(self, topic: str, stamp: int, value: bool) -> None:
        self.send(topic, "std_msgs/msg/Bool", stamp, self.make("std_msgs/msg/Bool", value))

    def pose(self, x: float, y: float, yaw: float) -> object:
        point = self.make("geometry_msgs/msg/Point", x, y, 0.0)
        return self.make(
            "geometry_msgs/msg/Pose",
            point,
            self.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)),
        )

    def stamped_pose(self, topic: str, stamp: int, x: float, y: float, yaw: float, lag: int = 0) -> None:
        kind = "geometry_msgs/msg/PoseStamped"
        self.send(topic, kind, stamp + lag, self.make(kind, self.header(stamp), self.pose(x, y, yaw)))

    def odometry(self, topic: str, stamp: int, x: float, y: float, yaw: float, lag: int = 0) -> None:
        zero = np.zeros(36)
        pose = self.make("geometry_msgs/msg/PoseWithCovariance", self.pose(x, y, yaw), zero)
        vector = self.make("geometry_msgs/msg/Vector3", 0.8, 0.0, 0.0)
        twist = self.make(
            "geometry_msgs/msg/TwistWithCovariance", self.make("geometry_msgs/msg/Twist", vector, vector), zero
        )
        kind = "nav_msgs/msg/Odometry"
        self.send(topic, kind, stamp + lag, self.make(kind, self.header(stamp), "base", pose, twist))


def nanoseconds(time: float) -> int:
    return EPOCH + round(float(time) * 1e9)


def write_bag(
    path: Path, kind: str, made: Drive, poses: str = "odometry", commands: str = "ackermann", lag: float = 0.0
) -> Path:
    """Write a drive as a bag: ``bag`` (ROS 1), ``sqlite`` or ``mcap`` (folders of ROS 2). Headers arrive ``lag`` s late."""
    late = round(lag * 1e9)
    with Bag(path, kind) as bag:
        for time, (speed, steering) in zip(made.command_times, made.commands, strict=True):
            if commands == "ackermann":
                bag.ackermann("/drive", nanoseconds(time), speed, steering, late)
            else:
                bag.twist("/cmd_vel", nanoseconds(time), speed, steering)
        for time, (x, y, yaw) in zip(made.pose_times, made.poses, strict=True):
            send = bag.odometry if poses == "odometry" else bag.stamped_pose
            send("/odom" if poses == "odometry" else "/car/car_pose", nanoseconds(time), x, y, yaw, late)
    return path


def read_one(path: Path, **options: object) -> Log:
    """The only log at a path, which is read without problems."""
    found = read_logs(path, **options)  # type: ignore[arg-type]
    assert not found.problems
    assert len(found.logs) == 1
    return found.logs[0]


def problems_of(path: Path) -> list[str]:
    """What prevents reading the logs at a path, see `located`."""
    with pytest.raises(InputError) as error:
        read_logs(path)
    return located(error.value.diagnostics, path.parent)


def same_drive(log: Log, made: Drive) -> None:
    """Check that a log is of a drive, to the digits that a CSV file has."""
    (part,) = log.parts
    np.testing.assert_allclose(part.poses, made.poses, atol=1e-9)
    np.testing.assert_allclose(part.pose_times, made.pose_times, atol=1e-9)
    np.testing.assert_allclose(part.commands, made.commands, atol=1e-6)
    np.testing.assert_allclose(part.command_times, made.command_times, atol=1e-9)
