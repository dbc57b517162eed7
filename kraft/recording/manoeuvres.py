"""Open-loop manoeuvres that make the parameters of a vehicle identifiable, and files of their commands.

Straight runs identify the drive and show a steering offset, arcs to both sides separate the wheelbase from the steering
offset, steps identify the lags, and the mix covers other combinations of commands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.files import write_csv
from kraft.logs.table import read_csv
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.times import SAME_TIME

DURATION: Final = 20.0
"""Duration of a manoeuvre, s."""
REST: Final = 0.5
"""Time at rest before it begins, s: the initial speed of a log that begins at rest is known."""
COASTING: Final = 2.5
"""Time without drive at its end, s, so that every log shows how the vehicle slows down."""

LONGEST: Final = 3600.0
"""Longest manoeuvre of a file, s."""

COMMAND_RATE: Final = 20.0
"""Rate of the commands, 1/s: not the camera's, so that the two are asynchronous, as on a real car."""

Piece = tuple[float, float, float]
"""Duration (s), and drive and turn to the left as shares of the largest ones: for a car throttle and steering."""
Draw = Callable[[np.random.Generator], list[Piece]]


ToControl = Callable[[float, float], Floats]
"""Control (nu,) of a vehicle from a drive and a turn, see `VehicleModel.drive_control`."""


@dataclass(frozen=True)
class Manoeuvre:
    """Controls (n, nu), held from each of `times` (n,) to the next and from the last to `end`, s."""

    name: str
    times: Floats
    controls: Matrix
    end: float

    def control_at(self, time: float) -> Floats:
        """Control (nu,) at a time, s."""
        k = int(np.searchsorted(self.times, time + SAME_TIME, side="right")) - 1
        held: Floats = self.controls[max(k, 0)]
        return held


def manoeuvre(name: str, to_control: ToControl, generator: np.random.Generator) -> Manoeuvre:
    """Draw a manoeuvre.

    Args:
        name: one of `NAMES`.
        to_control: makes the controls of the vehicle.
        generator: draws durations, drives and turns.
    """
    available = DURATION - REST - COASTING
    pieces: list[Piece] = [(REST, 0.0, 0.0)]
    used = 0.0
    for duration, u, phi in _pieces(KINDS[name], generator):
        pieces.append((min(duration, available - used), u, phi))
        used += duration
        if used >= available:
            break
    pieces.append((COASTING, 0.0, pieces[-1][2]))
    durations = np.array([piece[0] for piece in pieces])
    controls = np.array([to_control(u, phi) for _, u, phi in pieces])
    times = np.concatenate([[0.0], np.cumsum(durations)[:-1]])
    return Manoeuvre(name, times, controls, DURATION)


def _pieces(draw: Draw, generator: np.random.Generator) -> list[Piece]:
    """Draw pieces until they take at least as long as a manoeuvre."""
    pieces = draw(generator)
    while sum(piece[0] for piece in pieces) < DURATION:
        pieces += draw(generator)
    return pieces


def _straight(generator: np.random.Generator) -> list[Piece]:
    """Speed up on a straight line and coast."""
    throttle, driving, coasting = generator.uniform((0.25, 3.0, 1.0), (1.0, 5.0, 2.5))
    return [(driving, throttle, 0.0), (coasting, 0.0, 0.0)]


def _arc(generator: np.random.Generator) -> list[Piece]:
    """Drive circles one after another, each with its own radius and throttle."""
    throttle, steering, duration = generator.uniform((0.3, 0.35, 4.0), (1.0, 1.0, 7.0))
    return [(duration, throttle, steering)]


def _right(generator: np.random.Generator) -> list[Piece]:
    return [(duration, throttle, -steering) for duration, throttle, steering in _arc(generator)]


def _steps(generator: np.random.Generator) -> list[Piece]:
    """Steering from one side to the other at one throttle, then a step of the throttle."""
    throttle, first, second = generator.uniform((0.3, 0.3, 0.3), (1.0, 1.0, 1.0))
    side = 1.0 if generator.random() < 0.5 else -1.0
    durations = generator.uniform(1.0, 2.5, 3)
    turns = (side * first, -side * second, 0.0)
    return [(float(duration), throttle, turn) for duration, turn in zip(durations, turns, strict=True)]


def _mix(generator: np.random.Generator) -> list[Piece]:
    """Any throttle and steering for 0.5 to 2 s, sometimes coasting."""
    duration, throttle, steering = generator.uniform((0.5, 0.0, -1.0), (2.0, 1.0, 1.0))
    return [(duration, throttle if throttle > 0.15 else 0.0, steering)]


KINDS: Final[Mapping[str, Draw]] = MappingProxyType({
    "straight": _straight,
    "left": _arc,
    "right": _right,
    "steps": _steps,
    "mix": _mix,
})  # fmt: skip
NAMES: Final = tuple(KINDS)


def write_commands(path: Path, names: Sequence[str], drive: Manoeuvre) -> None:
    """Write the commands of a manoeuvre as a CSV file: its time and the controls, `COMMAND_RATE` times a second.

    Raises:
        InputError: if it cannot be written.
    """
    times = np.arange(round(drive.end * COMMAND_RATE) + 1) / COMMAND_RATE
    write_csv(path, ("t", *names), [(float(t), *drive.control_at(float(t)).tolist()) for t in times])


def read_commands(path: Path, limits: Mapping[str, tuple[float, float]]) -> Manoeuvre:
    """Read a manoeuvre from a CSV file with the columns t (s) and the controls; its last row is its end.

    Args:
        path: the file; the manoeuvre has the name of its folder, or of the file.
        limits: lowest and highest command by the name of a control.

    Raises:
        InputError: if it cannot be read, lacks a column, or has times or commands that no drive can have.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        expected = "expected a file of commands, as kraft sysid --commands writes it"
        raise InputError.of(str(path), "does not exist", expected, Code.NOT_FOUND) from None
    except OSError as error:
        problem = f"cannot be read: {error.strerror}"
        raise InputError.of(str(path), problem, "expected a readable file", Code.UNREADABLE) from error
    table = read_csv(path, content)
    missing = [
        Diagnostic(
            str(path), f"has no column {name!r}", f"expected the columns t, {', '.join(limits)}", 1, code=Code.MISSING
        )
        for name in ("t", *limits)
        if name not in table.columns
    ]
    if missing:
        raise InputError(missing)
    if table.broken:
        problem, expected = "has another number of fields than the heading", "expected a number in every column"
        raise InputError([Diagnostic(str(path), problem, expected, table.broken[0], code=Code.SYNTAX)])
    times, controls = table.columns["t"], np.column_stack([table.columns[name] for name in limits])
    checks = [
        (~np.isfinite(times), "t is not a number", "expected a time in s"),
        (np.diff(times, prepend=-np.inf) <= 0.0, "t does not ascend", "expected a later time than in the line before"),
        (times > times[:1] + LONGEST, "t is too late", f"expected at most {LONGEST:g} s after the first row"),
    ]
    for name, column in zip(limits, controls.T, strict=True):
        low, high = limits[name]
        slack = 1e-5 * (high - low)  # files round their numbers
        beyond = ~((column >= low - slack) & (column <= high + slack))
        checks.append((beyond, f"{name} is out of its range or no number", f"expected {low:g} to {high:g}"))
    problems = [
        table.diagnostic(problem, expected, int(np.argmax(wrong))) for wrong, problem, expected in checks if wrong.any()
    ]
    if not problems and len(times) < 2:
        problems = [table.diagnostic("has a single row", "expected a row at the beginning and one at the end")]
    if problems:
        raise InputError(problems)
    name = path.parent.name if path.name == "commands.csv" and path.parent.name else path.stem
    since = np.ascontiguousarray(times - times[0])
    return Manoeuvre(name, since, np.ascontiguousarray(controls), float(since[-1]))
