"""ROS 2 messages without ROS: their definitions, how they are built, and CDR and JSON forms of them.

Messages are the dataclasses of rosbags' type store.  Stamps are integer nanoseconds.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from kraft.logs.bag_tables import typestore
from ompl_ext.arrays import Floats, Matrix

ACKERMANN: Final = "ackermann_msgs/msg/AckermannDriveStamped"
BOOL: Final = "std_msgs/msg/Bool"
CLOCK: Final = "rosgraph_msgs/msg/Clock"
GRID: Final = "nav_msgs/msg/OccupancyGrid"
JOINTS: Final = "sensor_msgs/msg/JointState"
JOY: Final = "sensor_msgs/msg/Joy"
LOG: Final = "rcl_interfaces/msg/Log"
MARKERS: Final = "visualization_msgs/msg/MarkerArray"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
PATH: Final = "nav_msgs/msg/Path"
POLYGON: Final = "geometry_msgs/msg/PolygonStamped"
POSE: Final = "geometry_msgs/msg/PoseStamped"
TF: Final = "tf2_msgs/msg/TFMessage"
TRANSFORM: Final = "geometry_msgs/msg/TransformStamped"

EPOCH: Final = 10**18
"""Stamp of time 0 of a simulation, ns; a stamp of 0 means "unknown" in ROS."""

_BASE, _NAME, _ARRAY, _SEQUENCE = 1, 2, 3, 4
"""Kinds of fields in rosbags' definitions."""
_DTYPES: Final = {
    "bool": np.bool_, "byte": np.uint8, "char": np.uint8, "int8": np.int8, "uint8": np.uint8, "int16": np.int16,
    "uint16": np.uint16, "int32": np.int32, "uint32": np.uint32, "int64": np.int64, "uint64": np.uint64,
    "float32": np.float32, "float64": np.float64,
}  # fmt: skip


def is_known(kind: str) -> bool:
    """Whether a type such as ``nav_msgs/msg/Odometry`` is defined."""
    return kind in typestore().fielddefs


def make(kind: str, **values: Any) -> Any:
    """Message of a type; fields that are not given are zero or empty.

    A mapping is taken as the fields of a message, also inside lists.

    Raises:
        KeyError: if there is no such type or field.
    """
    fields = typestore().fielddefs[kind][1]
    unknown = set(values) - {name for name, _ in fields}
    if unknown:
        raise KeyError(f"{kind} has no field {', '.join(sorted(unknown))}")
    made = {name: _value(node, values.get(name)) for name, node in fields}
    return typestore().types[kind](**made)


def _value(node: Any, given: Any) -> Any:
    """Value of a field from what is given: None for zero, a mapping for a message, any sequence for a list."""
    kind, detail = int(node[0]), node[1]
    if kind == _NAME:
        return make(detail, **(given or {})) if given is None or isinstance(given, Mapping) else given
    if kind == _BASE:
        return _scalar(detail[0], given)
    (inner_kind, inner), size = detail
    items: Any = [None] * (size if kind == _ARRAY else 0) if given is None else given
    if int(inner_kind) == _BASE and inner[0] in _DTYPES:
        zeroed = [0 if item is None else item for item in items] if isinstance(items, list) else items
        return np.asarray(zeroed, dtype=_DTYPES[inner[0]])
    return [_value((inner_kind, inner), item) for item in items]


def _scalar(kind: str, given: Any) -> Any:
    if kind == "string" or kind == "wstring":
        return "" if given is None else str(given)
    if kind == "bool":
        if given is not None and given not in (0, 1):
            raise ValueError(f"is {given!r}, where true or false is expected")
        return bool(given)
    if kind.startswith("float"):
        return 0.0 if given is None else float(given)
    return 0 if given is None else int(given)


def to_cdr(message: Any) -> bytes:
    """CDR bytes (little-endian, with header) of a message."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def from_cdr(content: bytes, kind: str) -> Any:
    """Message of a type from its CDR bytes.

    Raises:
        Exception: of any type, if the bytes are not such a message.
    """
    return typestore().deserialize_cdr(content, kind)


def to_json(message: Any, ros: int = 2) -> dict[str, Any]:
    """Message as rosbridge writes it: numbers that are not finite are null; `ros` is the version of the names."""
    fields = typestore().fielddefs[message.__msgtype__][1]
    content = {name: _plain(getattr(message, name), ros) for name, _ in fields}
    if ros == 1:
        return _ros1(content)
    return content


_ROS1_NAMES: Final = {"sec": "secs", "nanosec": "nsecs"}
_ONLY_ROS2: Final = ("texture_resource", "texture", "uv_coordinates", "mesh_file")


def _ros1(content: dict[str, Any]) -> dict[str, Any]:
    """Fields with the names of ROS 1, without those that only ROS 2 has."""
    if set(content) == {"sec", "nanosec"}:
        return {_ROS1_NAMES[name]: value for name, value in content.items()}
    return {name: value for name, value in content.items() if name not in _ONLY_ROS2}


def _plain(value: Any, ros: int) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype == np.uint8:
            return base64.b64encode(value.tobytes()).decode("ascii")
        return [_plain(item, ros) for item in value.tolist()] if value.dtype.kind == "f" else value.tolist()
    if isinstance(value, list):
        return [_plain(item, ros) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, bool | int | str):
        return value
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return to_json(value, ros)


def from_json(content: Mapping[str, Any], kind: str) -> Any:
    """Message from what rosbridge sent, of ROS 1 or 2; null is NaN, and fields that are missing are zero.

    Raises:
        ValueError: if the content is not such a message.
    """
    try:
        values = {
            name: _from_plain(node, content[key])
            for name, node in typestore().fielddefs[kind][1]
            if (key := name if name in content else _ROS1_NAMES.get(name, name)) in content
        }
        return make(kind, **values)
    except (TypeError, KeyError, AttributeError, OverflowError) as error:
        raise ValueError(f"is not a {kind}: {error}") from error


def _from_plain(node: Any, value: Any) -> Any:
    kind, detail = int(node[0]), node[1]
    if kind == _NAME:
        return from_json(value, detail)
    if kind == _BASE:
        return math.nan if value is None and detail[0].startswith("float") else value
    (inner_kind, inner), _size = detail
    if int(inner_kind) == _BASE and isinstance(value, str):
        return np.frombuffer(base64.b64decode(value), dtype=_DTYPES[inner[0]])
    if not isinstance(value, list):
        raise ValueError(f"expected a list, not {value!r}")
    if int(inner_kind) == _BASE and inner[0] in _DTYPES:
        return np.array(value, dtype=_DTYPES[inner[0]])  # at once: a map has millions of numbers; null is NaN
    return [_from_plain((inner_kind, inner), item) for item in value]


def stamp(nanoseconds: int) -> dict[str, int]:
    """Fields of a time."""
    return {"sec": nanoseconds // 1_000_000_000, "nanosec": nanoseconds % 1_000_000_000}


def nanoseconds_of(time: Any) -> int:
    """Nanoseconds of a time of a message."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def header(nanoseconds: int, frame: str) -> dict[str, Any]:
    """Fields of a header."""
    return {"stamp": stamp(nanoseconds), "frame_id": frame}


def pose_fields(x: float, y: float, theta: float) -> dict[str, Any]:
    """Fields of a pose in the plane (m, rad)."""
    turn = {"z": math.sin(0.5 * theta), "w": math.cos(0.5 * theta)}
    return {"position": {"x": x, "y": y}, "orientation": turn}


def yaw_of(quaternion: Any) -> float:
    """Yaw of an orientation, rad; NaN if it is no rotation."""
    x, y, z, w = (float(getattr(quaternion, name)) for name in "xyzw")
    norm = x * x + y * y + z * z + w * w
    if not math.isfinite(norm) or abs(norm - 1.0) > 0.1:
        return math.nan
    return math.atan2(2.0 * (w * z + x * y) / norm, 1.0 - 2.0 * (y * y + z * z) / norm)


def stamped_pose(time: int, frame: str, pose: Sequence[float]) -> Any:
    """A PoseStamped of (x, y, theta)."""
    return make(POSE, header=header(time, frame), pose=pose_fields(*pose))


def odometry(time: int, frame: str, child: str, pose: Sequence[float], speed: float) -> Any:
    """An Odometry of (x, y, theta) and speed (m/s)."""
    twist = {"twist": {"linear": {"x": speed}}}
    return make(
        ODOMETRY, header=header(time, frame), child_frame_id=child, pose={"pose": pose_fields(*pose)}, twist=twist
    )


def transform(time: int, frame: str, child: str, pose: Sequence[float]) -> dict[str, Any]:
    """Fields of the transform from a frame to a child frame at (x, y, theta) in it."""
    x, y, theta = pose
    fields = pose_fields(x, y, theta)
    moved = {"translation": {"x": x, "y": y}, "rotation": fields["orientation"]}
    return {"header": header(time, frame), "child_frame_id": child, "transform": moved}


def path(time: int, frame: str, times: Iterable[int], poses: Matrix) -> Any:
    """A Path through poses (n, 3), each with the time (ns) at which it is reached."""
    stamped = [
        {"header": header(at, frame), "pose": pose_fields(*pose)}
        for at, pose in zip(times, poses.tolist(), strict=True)
    ]
    return make(PATH, header=header(time, frame), poses=stamped)


def polygon(time: int, frame: str, corners: Matrix) -> Any:
    """A PolygonStamped with corners (n, 2)."""
    points = [{"x": x, "y": y} for x, y in corners.tolist()]
    return make(POLYGON, header=header(time, frame), polygon={"points": points})


def joints(time: int, names: Sequence[str], control: Floats) -> Any:
    """A JointState with the controls of a vehicle by name, each as a position."""
    return make(JOINTS, header=header(time, ""), name=list(names), position=control)


def log_line(time: int, text: str, level: int = 20) -> Any:
    """A line for the log of a viewer; 20 is information, 30 a warning, 40 an error."""
    return make(LOG, stamp=stamp(time), level=level, name="kraft", msg=text)
