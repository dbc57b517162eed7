"""Read a ROS bag (ROS 1, ROS 2, MCAP; no ROS installation) into a table per topic."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from kraft.errors import Code, Diagnostic, InputError
from kraft.logs.table import LOG_TIME, STAMP, Table

_JOINTS: Final = "sensor_msgs/msg/JointState"
TYPES: Final = {
    *("ackermann_msgs/msg/AckermannDrive", "ackermann_msgs/msg/AckermannDriveStamped"),
    *("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"),
    *("geometry_msgs/msg/Pose", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"),
    *("geometry_msgs/msg/Pose2D", "geometry_msgs/msg/TransformStamped", "nav_msgs/msg/Odometry", "std_msgs/msg/Bool"),
    _JOINTS,
}
"""Types of messages that are read without a mapping file."""
TRUTH: Final = "/truth/"
"""Beginning of the topics of a simulated drive that are true; they are read only if a mapping file names them."""
_LIST_MAX: Final = 32
"""Longest list whose values become columns: longer ones are covariances and scans."""
_ACKERMANN: Final = """
float32 steering_angle
float32 steering_angle_velocity
float32 speed
float32 acceleration
float32 jerk
"""


@dataclass
class _Topic:
    """Messages of a topic that were read so far."""

    getters: dict[str, Any]
    times: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)


def read_bag(path: Path, topics: Iterable[str]) -> tuple[Table, ...]:
    """Read the topics that may hold commands and poses, and the topics `topics`.

    Raises:
        InputError: if the bag is truncated or damaged, has none of them, or mixes types of messages on one.
    """
    wanted = set(topics)
    try:
        with AnyReader([path], default_typestore=typestore()) as reader:
            known = {c.topic: c.msgtype for c in reader.connections}
            chosen = [c for c in reader.connections if c.topic in wanted or _is_read(c)]
            _check_types(path, chosen, reader.connections)
            read = _read(reader, chosen)
            _check_counts(chosen, read)
    except InputError:
        raise
    except Exception as error:  # a parser may raise anything on corrupt bytes
        raise InputError.of(
            str(path), f"is not a complete bag ({_reason(error)})", _repair(path), Code.UNREADABLE
        ) from error
    if not read:
        there = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(known.items())) or "none"
        expected = "expected AckermannDriveStamped or Twist, and Odometry, PoseStamped or the like; or a mapping file"
        raise InputError.of(
            str(path), f"has no messages of types that kraft reads; its topics are {there}", expected, Code.DATA
        )
    origin = min(topic.times[0] for topic in read.values())
    return tuple(_table(str(path), name, topic, origin) for name, topic in sorted(read.items()))


@cache
def typestore() -> Typestore:
    """Definitions of messages: those of ROS 2 Humble, which Iron and Jazzy share, and ackermann_msgs.

    Bags that hold no definitions are read with them: ROS 2 wrote none into SQLite before Iron.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    _register_ackermann(store)
    return store


def _register_ackermann(store: Typestore) -> None:
    """Add the types of ackermann_msgs that carry commands, which rosbags does not have."""
    store.register(get_types_from_msg(_ACKERMANN, "ackermann_msgs/msg/AckermannDrive"))
    stamped = "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n"
    store.register(get_types_from_msg(stamped, "ackermann_msgs/msg/AckermannDriveStamped"))


def _is_read(connection: Any) -> bool:
    """Whether a topic is read without a mapping file."""
    return connection.msgtype in TYPES and not connection.topic.startswith(TRUTH)


def _read(reader: AnyReader, chosen: Sequence[Any]) -> dict[str, _Topic]:
    read: dict[str, _Topic] = {}
    for connection, time, raw in reader.messages(connections=chosen) if chosen else ():
        message = reader.deserialize(raw, connection.msgtype)
        topic = read.get(connection.topic)
        if topic is None:
            topic = read[connection.topic] = _Topic(dict(_getters(message, "")))
        topic.times.append(time)
        header = getattr(message, "header", None)
        if header is not None:
            topic.stamps.append(header.stamp.sec * 1_000_000_000 + header.stamp.nanosec)
        if connection.msgtype == _JOINTS:
            topic.getters.update(_getters(message, ""))  # a message has some of the joints, in any order
        topic.rows.append(tuple(float(get(message)) for get in topic.getters.values()))
    return read


def _check_types(path: Path, chosen: Iterable[Any], connections: Sequence[Any]) -> None:
    """Refuse topics with messages of several types: the name of the topic does not determine which are meant."""
    problems = []
    for topic in sorted({connection.topic for connection in chosen}):
        types = sorted({connection.msgtype for connection in connections if connection.topic == topic})
        if len(types) > 1:
            problem = f"has messages of {len(types)} types: {', '.join(types)}"
            problems.append(
                Diagnostic(str(path), problem, "expected one type on a topic", path=topic, code=Code.CONFLICT)
            )
    if problems:
        raise InputError(problems)


def _check_counts(chosen: Sequence[Any], read: Mapping[str, _Topic]) -> None:
    """Refuse a bag with fewer messages than its index counts; not all formats have checksums."""
    for topic in {connection.topic for connection in chosen}:
        counted = sum(connection.msgcount for connection in chosen if connection.topic == topic)
        there = len(read[topic].rows) if topic in read else 0
        if there < counted:
            raise AnyReaderError(f"{there} of {counted} messages on {topic}")


def _getters(value: Any, name: str) -> Iterable[tuple[str, Any]]:
    """Name and getter of each number in a message: ``pose.position.x``, ``buttons[4]``; of joints by their names."""
    if getattr(value, "__msgtype__", "") == _JOINTS:
        yield from ((joint, _position_of(joint)) for joint in value.name)
        return
    for part in fields(value):
        inner, path = getattr(value, part.name), f"{name}{part.name}"
        if part.name in ("header", "covariance") or part.name.startswith("__"):
            continue
        if is_dataclass(inner):
            yield from _getters(inner, f"{path}.")
        elif isinstance(inner, bool | int | float | np.number):
            yield path, attrgetter(path)
        elif (
            isinstance(inner, np.ndarray | list) and len(inner) <= _LIST_MAX and np.asarray(inner).dtype.kind in "biuf"
        ):
            yield from ((f"{path}[{i}]", _item(path, i)) for i in range(len(inner)))


def _position_of(joint: str) -> Callable[[Any], float]:
    """Getter of the position of a joint, NaN in a message without it: publishers of one topic list other joints."""

    def position(message: Any) -> float:
        k = message.name.index(joint) if joint in message.name else -1
        return float(message.position[k]) if 0 <= k < len(message.position) else math.nan

    return position


def _item(path: str, i: int) -> Any:
    get = attrgetter(path)
    return lambda message: get(message)[i] if i < len(get(message)) else float("nan")


def _table(file: str, name: str, topic: _Topic, origin: int) -> Table:
    """Table of a topic; times are subtracted as integer nanoseconds, since floats would lose hundreds of them."""
    columns = {LOG_TIME: np.array([1e-9 * (time - origin) for time in topic.times])}
    if topic.stamps and any(topic.stamps):
        columns[STAMP] = np.array([1e-9 * (stamp - origin) for stamp in topic.stamps])
    by_column = itertools.zip_longest(*topic.rows, fillvalue=math.nan)  # before a joint appears it has no numbers
    columns.update((name, np.array(values, float)) for name, values in zip(topic.getters, by_column, strict=True))
    return Table(file, name, columns, np.arange(1, len(topic.rows) + 1))


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else text[:117] + "..."


def _repair(path: Path) -> str:
    tool = {".bag": "rosbag reindex", ".mcap": "mcap recover"}.get(path.suffix, "ros2 bag reindex")
    return f"expected a bag that was closed properly; `{tool}` may recover its content"
