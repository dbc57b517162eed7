"""Units of logged quantities: conversion to SI, and how units are spelled in column names."""

from __future__ import annotations

import math
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
