"""Wrong units and axes that the numbers of a log show, such as degrees for radians and millimetres for metres."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.logs.log import Array, Findings
from kraft.logs.motion import Chords, agreement, chords
from kraft.logs.names import ALLOWED, FACTOR
from kraft.logs.samples import Samples
from kraft.logs.streams import Channel

CHORD_TURN_MAX: Final = 0.6
"""Turn up to which the yaw follows the direction of a chord, rad."""
SPEED_MAX: Final = 30.0
"""Speed above which positions are not in metres, m/s; logs are of small vehicles."""
SLOW_MAX: Final = 0.1
"""Mean speed of a drive, m/s, below which its positions are rather in the next larger unit."""
POSE_INTERVAL_MIN, POSE_INTERVAL_MAX = 1e-5, 2.0
"""Usual time between poses beyond which stamps are in another unit, or show no motion, s."""
STEERING_MAX: Final = 1.6
"""Steering command above which it is no angle in radians, a little more than a right angle."""
FOLLOWS_MIN, FOLLOWS_NOT_MAX = 0.9, 0.7
"""Agreement of a yaw with the direction of motion above which it follows it, and below which it does not."""
FOLLOWS_DIFFERENCE: Final = 0.05
"""Difference of the agreements of two yaws above which they are told apart."""
CURVATURE_MIN, WHEELBASE_MIN = 0.2, 0.05
"""Least mean curvature of a path that tells the unit of the steering, 1/m, and least wheelbase of a car, m."""
SIDEWAYS_MIN: Final = 1.2
"""Difference of the direction of motion from a yaw, rad, above which it counts as a right angle."""
_CHORDS_MIN: Final = 5
"""Number of chords below which a log shows no direction of motion."""
_NEUTRAL_PULSE, _PULSE_REACH = 1500.0, 500.0
"""Usual neutral pulse width of a servo, and its usual largest deviation from there, us."""


class DegreesError(InputError):
    """Columns that are assumed to hold radians hold degrees; so do the same columns of other logs."""

    columns: frozenset[tuple[str, str]]
    """Role and name of each."""

    def __init__(self, diagnostics: Iterable[Diagnostic], columns: Iterable[tuple[str, str]]) -> None:
        super().__init__(diagnostics)
        self.columns = frozenset(columns)


class SwappedError(InputError):
    """The columns of x and y are swapped; so are the same columns of other logs."""

    def __init__(self, diagnostics: Iterable[Diagnostic], columns: tuple[str, str]) -> None:
        super().__init__(diagnostics)
        self.columns = columns


def assumed_radians(channel: Channel) -> bool:
    """Whether radians are only assumed for a column."""
    return channel.unit == "rad" and not (channel.place is not None and channel.stated)


def shows_radians(path: Chords, yaw: Array) -> bool:
    """Whether a yaw, shape (n,), follows the direction of motion in radians and less so in degrees."""
    return _follows_rather(path, yaw, np.deg2rad(yaw))


def shows_axes(path: Chords, yaw: Array) -> bool:
    """Whether a yaw, shape (n,), follows the direction of motion and less so with x and y swapped."""
    return _follows_rather(_ahead(path, yaw), yaw, -yaw)


def _follows_rather(path: Chords, yaw: Array, other: Array) -> bool:
    """Whether a yaw follows the direction of motion, and another one less; on a straight drive any constant does."""
    follows = agreement(path, yaw)[0]
    return follows > FOLLOWS_MIN and agreement(path, other)[0] < follows - FOLLOWS_DIFFERENCE


def shows_steering_radians(path: Chords, yaw: Array, steering: Array) -> bool:
    """Whether a yaw, shape (n,), turns more than the steering commands, shape (m,), would turn a car in degrees."""
    if len(path.directions) < _CHORDS_MIN:
        return False
    lengths = path.speeds * path.durations
    curvature = float(np.abs(np.diff(yaw[path.ends], axis=1)).sum() / lengths.sum())
    return curvature > max(CURVATURE_MIN, float(np.deg2rad(np.abs(steering).mean())) / WHEELBASE_MIN)


def check_units(commands: tuple[Samples, ...], poses: Samples, xyyaw: Array, findings: Findings) -> None:
    """Check clock, positions, yaw and commands; ``xyyaw`` are the poses in the assumed units, shape (n, 3).

    Raises:
        DegreesError: if yaw or steering are in degrees and neither name nor mapping file states it.
        SwappedError: if x and y are swapped.
        InputError: if another unit is wrong.
    """
    problems = _clock(poses, commands)
    for samples in commands:
        for channel, values in zip(samples.stream.channels, samples.values.T, strict=True):
            problems += _pulses(samples, channel, values)
    if problems:
        raise InputError(problems)
    path = chords(poses.times, xyyaw[:, :2])
    degrees = [found for samples in commands for found in _steering(samples)]
    degrees += _yaw(poses, path, xyyaw[:, 2])
    in_degrees = [problem for problem, _ in degrees]
    lengths = _lengths(poses, path)
    if lengths:
        raise InputError([*lengths, *in_degrees])
    if degrees:
        raise DegreesError(in_degrees, ((channel.role, channel.column) for _, channel in degrees))
    _heading(poses, path, xyyaw[:, 2], findings)


def in_mapping(channel: Channel, key: str, unit: str) -> str:
    """How to state a unit in the mapping file, or in the name of a column that states none, for a message."""
    written = f"write {key}: {{column: {channel.column!r}, unit: {unit}}} into a mapping file"
    return written if channel.stated else f"{written}, or name the column so ({channel.column}_{unit})"


def _clock(poses: Samples, commands: tuple[Samples, ...]) -> list[Diagnostic]:
    time = poses.stream.time
    if len(poses) < 3:
        return []
    step = float(np.median(np.diff(poses.times)))
    if POSE_INTERVAL_MAX > step > POSE_INTERVAL_MIN:
        return []
    problem = f"{time.column!r} in {time.unit} means a pose every {step:.4g} s"
    others = [unit for unit in ALLOWED["time"]
              if POSE_INTERVAL_MAX > step * FACTOR[unit] / FACTOR[time.unit] > POSE_INTERVAL_MIN]  # fmt: skip
    expected = f"expected one every {POSE_INTERVAL_MIN:g} to {POSE_INTERVAL_MAX:g} s"
    if others and not (time.place is not None and time.stated):
        shared = any(s.stream.table is poses.stream.table and s.stream.time.column == time.column for s in commands)
        both = ", and the same for commands.time" if shared else ""
        expected += f"; {in_mapping(time, 'poses.time', others[0])}{both}"
    return [poses.diagnostic(problem, expected)]


def _pulses(samples: Samples, channel: Channel, values: Array) -> list[Diagnostic]:
    if channel.any_unit or channel.place is not None or not 500 <= values.min() <= values.max() <= 2500:
        return []
    problem = (
        f"{channel.column!r} goes from {values.min():g} to {values.max():g}: these look like pulse widths of a servo"
    )
    reach = 1.0 if channel.reach is None else channel.reach
    how = f"commands.controls.{channel.role}: {{column: {channel.column!r}, zero: {_NEUTRAL_PULSE:g}"
    how += f", scale: {reach / _PULSE_REACH:.3g}}}"
    low, high = _NEUTRAL_PULSE - _PULSE_REACH, _NEUTRAL_PULSE + _PULSE_REACH
    unit = f" {channel.unit}" if channel.unit != "1" else ""
    guess = f"a guess that {low:g} to {high:g} is {-reach:.3g} to {reach:.3g}{unit}; its sign may be the opposite one"
    return [
        samples.diagnostic(problem, f"expected a command; state their meaning in a mapping file, as in {how}, {guess}")
    ]


def _steering(samples: Samples) -> list[tuple[Diagnostic, Channel]]:
    found = []
    for channel, values in zip(samples.stream.channels, samples.values.T, strict=True):
        largest = int(np.argmax(np.abs(values)))
        if assumed_radians(channel) and abs(values[largest]) > STEERING_MAX:
            problem = f"{channel.column!r} reaches {values[largest]:g}: degrees, where radians are expected"
            expected = in_mapping(channel, f"commands.controls.{channel.role}", "deg")
            found.append((samples.diagnostic(problem, expected, largest), channel))
    return found


def _lengths(poses: Samples, path: Chords) -> list[Diagnostic]:
    if len(path.speeds) < _CHORDS_MIN or np.median(path.speeds) < SPEED_MAX:
        return []
    x, y = poses.stream.channels[:2]
    speed = float(np.median(path.speeds))
    problem = f"{x.column!r} and {y.column!r} in {x.unit} mean a speed of {speed:.3g} m/s"
    speeds = {unit: speed * FACTOR[unit] / FACTOR[x.unit] for unit in ("mm", "cm")}
    possible = [unit for unit in speeds if SLOW_MAX < speeds[unit] < SPEED_MAX] or ["mm"]
    expected = f"expected metres; {in_mapping(x, 'poses.x', possible[0])}, and y too"
    if len(possible) > 1:
        each = " and ".join(f"{speeds[unit]:.2g} m/s in {unit}" for unit in possible)
        expected += f", or {possible[1]}: the speed would be {each}"
    return [poses.diagnostic(problem, expected)]


def _yaw(poses: Samples, path: Chords, yaw: Array) -> list[tuple[Diagnostic, Channel]]:
    """Degrees taken for radians do not follow the motion, or jump by 360."""
    channel = poses.stream.channels[2]
    if channel.role != "yaw" or not assumed_radians(channel):
        return []
    steps = np.abs(np.diff(yaw))
    if not ((steps > 300) & (steps < 400)).any() and not _follows_as_degrees(path, yaw):
        return []
    worst = int(np.argmax(np.abs(yaw)))
    problem = f"{channel.column!r} reaches {yaw[worst]:g}: degrees, where radians are expected"
    expected = in_mapping(channel, "poses.yaw", "deg")
    return [(poses.diagnostic(problem, expected, worst), channel)]


def _follows_as_degrees(path: Chords, yaw: Array) -> bool:
    """Whether yaw follows the motion in degrees and not in radians; values up to 7 may be noise on a straight drive."""
    if len(path.directions) < _CHORDS_MIN or float(np.abs(yaw).max()) < 7.0:
        return False
    as_radians, offset = agreement(path, yaw)
    as_degrees, offset_degrees = agreement(path, np.deg2rad(yaw))
    if as_degrees > FOLLOWS_MIN and as_radians < FOLLOWS_NOT_MAX:
        return True
    straight = as_degrees > 0.95 and as_degrees >= as_radians - 0.01  # any constant follows a straight line
    return straight and abs(offset_degrees) < 0.2 < abs(offset)


def _ahead(path: Chords, yaw: Array) -> Chords:
    """The chords on which a vehicle turns little: turns on the spot say nothing of the direction of motion."""
    turned = np.abs(np.diff(np.unwrap(yaw)[path.ends], axis=1)[:, 0])
    ahead = turned <= CHORD_TURN_MAX
    return Chords(path.directions[ahead], path.speeds[ahead], path.durations[ahead], path.ends[ahead])


def _heading(poses: Samples, path: Chords, yaw: Array, findings: Findings) -> None:
    path = _ahead(path, yaw)
    if len(path.directions) < _CHORDS_MIN:
        return
    follows, offset = agreement(path, yaw)
    aside = follows > FOLLOWS_MIN and abs(offset) > SIDEWAYS_MIN
    if follows > FOLLOWS_NOT_MAX and not aside:
        return
    reverse, offset = agreement(path, -yaw)
    mirrored = not aside and reverse > FOLLOWS_MIN
    if mirrored and abs(offset) > SIDEWAYS_MIN:
        x, y, *turn = poses.stream.channels
        problem = f"{x.column!r} and {y.column!r} are swapped: the vehicle moves as its yaw says if the first is y"
        expected = f"write poses: {{x: {y.column!r}, y: {x.column!r}}} into a mapping file"
        if len(turn) == 1:
            problem += "; or the yaw is a compass heading, clockwise from y"
            expected += f", or for a compass heading {_turned(turn[0], -1.0, math.pi / 2)}"
        raise SwappedError([poses.diagnostic(problem, expected, code=Code.MISMATCH)], (x.column, y.column))
    why = "are x, y and yaw right?"
    if aside:
        why = f"they are a right angle apart{_right_angle(poses, path, yaw)}"
    elif mirrored:
        why = f"it follows when its sign is changed{_other_sign(poses)}"
    findings.add("heading", 1, f"{poses.stream.table.name}: yaw does not follow the direction of motion; {why}")


def _right_angle(poses: Samples, path: Chords, yaw: Array) -> str:
    """How to turn a yaw that is a right angle away from a motion that is mostly forward; empty for a quaternion."""
    _x, _y, *turn = poses.stream.channels
    if len(turn) > 1:
        return ""
    left = float(np.mean(np.sin(path.directions - yaw[path.ends.sum(axis=1) // 2])))
    return f" (if the vehicle drives mostly forward, {_turned(turn[0], 1.0, math.copysign(math.pi / 2, left))})"


def _other_sign(poses: Samples) -> str:
    """How to change the sign of a yaw; empty for a quaternion."""
    _x, _y, *turn = poses.stream.channels
    return f" ({_turned(turn[0], -1.0, 0.0)})" if len(turn) == 1 else ""


def _turned(channel: Channel, sign: float, offset: float) -> str:
    """The line of a mapping file for the yaw `sign` times that of a channel plus `offset` (rad)."""
    zero = channel.zero - sign * offset / (channel.scale * FACTOR[channel.unit])
    scale = sign * channel.scale
    factor = "" if scale == 1.0 else f", scale: {scale:g}"
    shift = "" if zero == 0.0 else f", zero: {zero:.6g}"
    return f"poses.yaw: {{column: {channel.column!r}, unit: {channel.unit}{shift}{factor}}}"
