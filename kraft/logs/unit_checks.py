"""Detection of wrong units from the numbers: degrees for radians, millimetres for metres, milliseconds for seconds."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.logs.choice import Channel
from kraft.logs.log import Array, Findings
from kraft.logs.motion import Chords, agreement, chords
from kraft.logs.samples import Samples

SPEED_MAX: Final = 30.0
"""Speed above which positions are not in metres, m/s; logs are of small vehicles."""
POSE_INTERVAL_MAX: Final = 2.0
"""Time between poses above which stamps are not in seconds, s."""
STEERING_MAX: Final = 1.6
"""Steering command above which it is no angle in radians, a little more than a right angle."""
SWAPPED_OFFSET_MIN: Final = 1.2
"""Difference of the direction of motion from the negative yaw, rad, above which x and y are swapped: a right angle."""
_CHORDS_MIN: Final = 5


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


def check_units(commands: tuple[Samples, ...], poses: Samples, xyyaw: Array, findings: Findings) -> None:
    """Check clock, positions, yaw and commands; ``xyyaw`` are the poses in the assumed units, shape (n, 3).

    Raises:
        DegreesError: if yaw or steering are in degrees and neither name nor mapping file states it.
        SwappedError: if x and y are swapped.
        InputError: if another unit is wrong.
    """
    problems = _clock(poses)
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
    """How to state a unit in the mapping file, for a message."""
    return f"write {key}: {{column: {channel.column!r}, unit: {unit}}} into a mapping file, or name the column so"


def _clock(poses: Samples) -> list[Diagnostic]:
    time = poses.stream.time
    if len(poses) < 3:
        return []
    step = float(np.median(np.diff(poses.times)))
    if POSE_INTERVAL_MAX > step > 1e-5:
        return []
    problem = f"{time.column!r} in {time.unit} means a pose every {step:.4g} s"
    return [poses.diagnostic(problem, f"expected seconds; {in_mapping(time, 'poses.time', 'ms')} ({time.column}_ms)")]


def _pulses(samples: Samples, channel: Channel, values: Array) -> list[Diagnostic]:
    if channel.any_unit or channel.place is not None or not 500 <= values.min() <= values.max() <= 2500:
        return []
    problem = (
        f"{channel.column!r} goes from {values.min():g} to {values.max():g}: these look like pulse widths of a servo"
    )
    how = f"commands.controls.{channel.role}: {{column: {channel.column!r}, zero: 1500, scale: 0.002}}"
    return [samples.diagnostic(problem, f"expected a command; state their meaning in a mapping file, as in {how}")]


def _steering(samples: Samples) -> list[tuple[Diagnostic, Channel]]:
    found = []
    for channel, values in zip(samples.stream.channels, samples.values.T, strict=True):
        largest = int(np.argmax(np.abs(values)))
        if assumed_radians(channel) and abs(values[largest]) > STEERING_MAX:
            problem = f"{channel.column!r} reaches {values[largest]:g}: degrees, where radians are expected"
            expected = in_mapping(channel, f"commands.controls.{channel.role}", "deg") + f" ({channel.column}_deg)"
            found.append((samples.diagnostic(problem, expected, largest), channel))
    return found


def _lengths(poses: Samples, path: Chords) -> list[Diagnostic]:
    if len(path.speeds) < _CHORDS_MIN or np.median(path.speeds) < SPEED_MAX:
        return []
    x, y = poses.stream.channels[:2]
    problem = f"{x.column!r} and {y.column!r} in {x.unit} mean a speed of {np.median(path.speeds):.3g} m/s"
    return [poses.diagnostic(problem, f"expected metres; {in_mapping(x, 'poses.x', 'mm')} ({x.column}_mm), and y too")]


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
    expected = in_mapping(channel, "poses.yaw", "deg") + f" ({channel.column}_deg)"
    return [(poses.diagnostic(problem, expected, worst), channel)]


def _follows_as_degrees(path: Chords, yaw: Array) -> bool:
    """Whether yaw follows the motion in degrees and not in radians; values up to 7 may be noise on a straight drive."""
    if len(path.directions) < _CHORDS_MIN or float(np.abs(yaw).max()) < 7.0:
        return False
    as_radians, offset = agreement(path, yaw)
    as_degrees, offset_degrees = agreement(path, np.deg2rad(yaw))
    if as_degrees > 0.9 and as_radians < 0.7:
        return True
    straight = as_degrees > 0.95 and as_degrees >= as_radians - 0.01  # any constant follows a straight line
    return straight and abs(offset_degrees) < 0.2 < abs(offset)


def _heading(poses: Samples, path: Chords, yaw: Array, findings: Findings) -> None:
    if len(path.directions) < _CHORDS_MIN or agreement(path, yaw)[0] > 0.7:
        return
    follows, offset = agreement(path, -yaw)
    mirrored = follows > 0.9
    if mirrored and abs(offset) > SWAPPED_OFFSET_MIN:
        x, y = (channel.column for channel in poses.stream.channels[:2])
        problem = f"{x!r} and {y!r} are swapped: the vehicle moves as its yaw says if the first is y"
        expected = f"write poses: {{x: {y!r}, y: {x!r}}} into a mapping file"
        raise SwappedError([poses.diagnostic(problem, expected, code=Code.MISMATCH)], (x, y))
    why = "it follows when its sign is changed (scale: -1 in a mapping file)" if mirrored else "are x, y and yaw right?"
    findings.add("heading", 1, f"{poses.stream.table.name}: yaw does not follow the direction of motion; {why}")
