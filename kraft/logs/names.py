"""Names of columns and topics: their words and units, and how well a name fits a role; units and their factors."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cache
from typing import Final, Literal, TypeAlias

Unit: TypeAlias = Literal["s", "ms", "us", "ns", "m", "cm", "mm", "rad", "deg", "m/s", "km/h", "1"]


Quantity: TypeAlias = Literal["time", "length", "angle", "control"]


FACTOR: Final[dict[Unit, float]] = {
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "ns": 1e-9,
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "rad": 1.0,
    "deg": math.pi / 180,
    "m/s": 1.0,
    "km/h": 1 / 3.6,
    "1": 1.0,
}
"""SI units per unit."""


ALLOWED: Final[dict[Quantity, tuple[Unit, ...]]] = {
    "time": ("s", "ms", "us", "ns"),
    "length": ("m", "cm", "mm"),
    "angle": ("rad", "deg"),
    "control": ("1", "m/s", "km/h", "rad", "deg"),
}
"""Units of each quantity, the SI unit first."""


SPELLINGS: Final[dict[str, Unit]] = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisec", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "usec", "usecs", "micros", "microsec", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanoseconds"), "ns"),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("cm",), "cm"),
    **dict.fromkeys(("mm", "millimeters", "millimetres"), "mm"),
    **dict.fromkeys(("rad", "rads", "radian", "radians"), "rad"),
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°"), "deg"),
    **dict.fromkeys(("m/s", "mps", "ms-1"), "m/s"),
    **dict.fromkeys(("km/h", "kmh", "kph"), "km/h"),
}
"""How units are written in the names of columns."""

_BRACKETS: Final = re.compile(r"[\[(]\s*([^\])]*?)\s*[\])]")
_WORD: Final = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+|°")
_GLUED: Final = {
    **{f"{word}{axis}": (word, axis) for word in ("pos", "pose", "position") for axis in "xyz"},
    **{f"{axis}pos": ("pos", axis) for axis in "xyz"},
    **{f"p{axis}": ("pos", axis) for axis in "xyz"},
    **{f"q{axis}": ("quaternion", axis) for axis in "xyzw"},
    **{f"v{axis}": ("velocity", axis) for axis in "xyz"},
    **{f"{word}{unit}": (word, unit) for word in ("yaw", "theta", "heading", "steering") for unit in ("deg", "rad")},
    "easting": ("pos", "x"),
    "northing": ("pos", "y"),
    "yawrate": ("yaw", "rate"),
    "deadman": ("dead", "man"),
    "tcmd": ("cmd", "t"),
    "tpose": ("pose", "t"),
}


@dataclass(frozen=True)
class Name:
    """A name as words and unit.

    Attributes:
        words: in lower case, without the unit.
        unit: unit that the name states, if it does.
    """

    words: tuple[str, ...]
    unit: Unit | None = None


@cache
def parse(name: str) -> Name:
    """Words and unit of a name: ``pose.heading_deg`` is ``pose heading`` in ``deg``."""
    bracketed = _BRACKETS.search(name)
    unit = SPELLINGS.get(bracketed.group(1).lower()) if bracketed else None
    found = _WORD.findall(_BRACKETS.sub(" ", name) if unit else name)
    words = tuple(part for word in found for part in _GLUED.get(word.lower(), (word.lower(),)))
    if unit is None and len(words) > 1 and words[-1] in SPELLINGS:
        return Name(words[:-1], SPELLINGS[words[-1]])
    return Name(words, unit)


TIME: Final = {"t", "time", "timestamp", "stamp", "ts", "clock", "seconds", "secs", "sec"}
YAW: Final = ("yaw", "heading", "theta", "psi", "th", "phi", "hdg")
COMMAND: Final = {
    *("cmd", "cmds", "command", "commands", "commanded", "control", "controls", "ctrl", "action", "input", "u", "act"),
    *("des", "desired", "target", "setpoint", "sp", "ref", "drive", "ackermann"),
}
POSE: Final = {
    *("pose", "poses", "pos", "position", "p", "transform", "translation", "car", "robot", "vehicle", "base", "obs"),
    *("odom", "odometry", "mocap", "vicon", "opti", "optitrack", "vrpn", "tracker", "marker", "aruco", "observed"),
    *("state", "meas", "measured", "world", "map", "field", "observation"),
}
ESTIMATE: Final = {"est", "estimate", "estimated", "filtered", "ekf", "pred", "predicted", "true", "truth", "gt"}
OTHER: Final = {
    *("vel", "velocity", "speed", "twist", "rate", "dot", "acc", "accel", "imu", "gyro", "linear", "angular", "cov"),
    *(
        "covariance",
        "goal",
        "error",
        "std",
        "sigma",
        "var",
        "arrival",
        "received",
        "seq",
        "size",
        "orientation",
        "quat",
    ),
    *("quaternion", "rotation"),
}
ROTATION: Final = {"orientation", "quaternion", "quat", "rotation", "rot", "q"}
SYNONYMS: Final[dict[str, tuple[str, ...]]] = {
    "throttle": (
        "throttle",
        "thr",
        "gas",
        "speed",
        "velocity",
        "vel",
        "v",
        "motor",
        "duty",
        "esc",
        "acceleration",
        "accel",
    ),
    "steering": ("steering", "steer", "delta", "servo", "str", "turn"),
}
"""Names of controls in logs, the best match first."""
TWIST: Final = {"throttle": ("linear", "x"), "steering": ("angular", "z")}
"""Fields of controls in a geometry_msgs/Twist; that of an Odometry, twist.twist, is measured and not a command."""
DEAD_MAN: Final = {"deadman", "enabled", "enable", "engaged", "autonomous", "armed"}
_MEASURED: Final = {
    "meas",
    "measured",
    "actual",
    "odom",
    "odometry",
    "pose",
    "imu",
    "est",
    "estimate",
    "estimated",
    "true",
    "acc",
}


def time_score(name: str, family: set[str]) -> int | None:
    """Score of a column as the clock of a family (commands or poses)."""
    found = parse(name)
    words = found.words
    named = bool(words) and bool(TIME & {words[-1], words[0]})
    by_unit = found.unit in ALLOWED["time"] and set(words) <= COMMAND | POSE  # pose_ns, cmd.secs
    if not (named or by_unit) or {"arrival", "received", "delay", "cov"} & set(words):
        return None
    rest = [word for word in words if word not in TIME]
    strange = sum(word in (COMMAND | POSE) - family for word in rest)
    return 100 - len(words) + 20 * any(word in family for word in rest) - 60 * strange - 10 * (not named)


def axis_score(name: str, axis: str) -> int | None:
    """Score of a column as ``x`` or ``y`` of a position."""
    words = parse(name).words
    return _pose_score(words, words[-1:] == (axis,) or words[:1] == (axis,), axis)


def yaw_score(name: str) -> int | None:
    """Score of a column as a yaw."""
    words = parse(name).words
    found = next((word for word in YAW if word in words), None)
    if found is None:
        return None
    score = _pose_score(words, True, found)
    return None if score is None else score - YAW.index(found)


def _pose_score(words: tuple[str, ...], fits: bool, key: str) -> int | None:
    rest = [word for word in words if word != key]
    if not fits or (OTHER | (COMMAND - POSE)) & set(rest):
        return None
    return 100 - sum(1 if word in POSE else 40 if word in ESTIMATE else 10 for word in rest)


def quaternion_score(name: str, axis: str) -> int | None:
    """Score of a column as a component of an orientation."""
    words = parse(name).words
    if words[-1:] != (axis,) or not ROTATION & set(words) or (COMMAND | {"imu", "goal", "covariance"}) & set(words):
        return None
    return 90 - sum(word not in POSE | ROTATION | {axis} for word in words)


def control_score(name: str, control: str) -> int | None:
    """Score of a column as the control of this name."""
    words = parse(name).words
    exact = parse(control).words
    commanded = bool(COMMAND & set(words))
    if (_MEASURED & set(words) and not commanded) or {"cov", "covariance", "rate", "dot", "error"} & set(words):
        return None
    if _contains(words, exact):
        return 120 + 15 * commanded - len(words)
    if words[-2:] == TWIST.get(control) and words.count("twist") <= 1 and set(words[:-2]) <= COMMAND | {"twist", "vel"}:
        return 30 + 15 * commanded
    for rank, synonym in enumerate(SYNONYMS.get(control, ())):
        if synonym in words and not ({"linear", "angular", "twist"} & set(words)):
            return (
                100
                - 3 * rank
                + 15 * commanded
                - len(words)
                - 40 * (not commanded and synonym in ("v", "vel", "velocity"))
            )
    return None


def dead_man_score(name: str) -> int | None:
    """Score of a column as a dead-man switch."""
    words = parse(name).words
    if _contains(words, ("dead", "man")) or DEAD_MAN & set(words):
        return 100 - len(words)
    return None


def _contains(words: tuple[str, ...], part: tuple[str, ...]) -> bool:
    return any(words[i : i + len(part)] == part for i in range(len(words) - len(part) + 1))
