"""Units of the commands in the logs of a car, or of a robot with two driven sides: neutral value, sign and scale.

Pulse widths, duty, degrees and [-1, 1] are all converted to shares of the full throttle, forward positive, and to a
wheel angle, left positive.  Commands that already are such are left as they are.  The scale of the steering is that of
a car of a given wheelbase: poses show the ratio of the two alone.  Commands of sides that may be speeds are left as
they are too, because their models have a gain; others are converted to shares of the largest one of either side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.sysid.log_motion import SPAN, STEP, LogMotion, motions, sums_of
from ompl_ext.arrays import Floats, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Log


ASSUMED_WHEELBASE: Final = 0.33
"""Wheelbase that the scale of the steering is found with where nobody states it, m: that of a 1:10 car."""
STEERING_RATIO_MAX: Final = 2.2
"""Factor between the commanded and the found wheel angle up to which commands count as radians."""
THROTTLE_MAX: Final = 1.6
"""Largest throttle that counts as a share of the full one, or as a speed of a slow car in m/s."""
SIDES: Final = ("left", "right")
"""Commands of a robot with two driven sides."""
SIDE_MAX: Final = 40.0
"""Largest command of a side that counts as a speed, of the wheels in rad/s."""
OFFSET_MAX: Final = 0.6
"""Offset of the steering over its largest deviation from there, up to which the wheels are merely off centre."""
LARGEST: Final = "above it is the largest one in the logs"
FULL: Final = {"throttle": LARGEST, "steering": "above it is a radian", "left": LARGEST, "right": LARGEST}
OPPOSITE: Final = {"throttle": "backwards", "steering": "to the right", "left": "backwards", "right": "backwards"}
REST_SPEED: Final = 0.05
"""Share of the high speeds below which the car is at rest."""
REST_SAMPLES_MIN: Final = 10
REST_SHARE_MIN: Final = 0.3
"""Least number of samples at rest, as the share of fewer is chance; least share that has the neutral throttle, ..."""
REST_FACTOR: Final = 3.0
"""... or least ratio of their number to that of the next one: dead zone and friction hold a car at many commands."""
DELAY: Final = 0.15
"""Delay of the response to a command, s, as far as neutral value and sign need it."""


@dataclass(frozen=True)
class CommandUnit:
    """Meaning of the numbers of one command: (number - neutral) * scale is what models take."""

    neutral: float = 0.0
    scale: float = 1.0

    @property
    def as_is(self) -> bool:
        """Whether the numbers are what models take."""
        return self == CommandUnit()


def command_units(logs: Sequence[Log], wheelbase: float = ASSUMED_WHEELBASE) -> dict[str, CommandUnit]:
    """Meaning of the commands in the logs of one vehicle; as they are where the logs do not show another one.

    The scale of the steering is that of a car with this wheelbase, m.
    """
    if logs and set(SIDES) <= set(logs[0].controls):
        return dict(zip(SIDES, _sides(motions(logs, SIDES)), strict=True))
    found = motions(logs)
    if not found:
        return {"throttle": CommandUnit(), "steering": CommandUnit()}
    return {"throttle": _throttle(found), "steering": _steering(found, wheelbase)}


def with_units(logs: Sequence[Log], units: Mapping[str, CommandUnit]) -> tuple[Log, ...]:
    """The logs with their commands converted."""
    if all(unit.as_is for unit in units.values()):
        return tuple(logs)
    converted = []
    for log in logs:
        neutral = np.array([units[name].neutral for name in log.controls])
        scale = np.array([units[name].scale for name in log.controls])
        parts = tuple(replace(part, commands=(part.commands - neutral) * scale) for part in log.parts)
        converted.append(replace(log, parts=parts))
    return tuple(converted)


def unit_notes(units: Mapping[str, CommandUnit]) -> tuple[str, ...]:
    """What was found of commands that were converted, and how a mapping file states it."""
    return tuple(
        f"{name}: {unit.neutral:g} is neutral, {abs(1.0 / unit.scale):.4g} {FULL[name]}; in a mapping file: "
        f"commands.controls.{name}: {{column: ..., zero: {unit.neutral:g}, scale: {unit.scale:g}}}"
        for name, unit in units.items()
        if not unit.as_is
    )


def sign_warnings(units: Mapping[str, CommandUnit]) -> tuple[str, ...]:
    """Warnings of commands whose sign is flipped."""
    return tuple(
        f"{name} has the opposite sign: larger numbers are {OPPOSITE[name]}; the commands were negated"
        for name, unit in units.items()
        if unit.scale < 0.0
    )


def _throttle(found: Sequence[LogMotion]) -> CommandUnit:
    values = np.concatenate([m.commands(DELAY)[:, 0] for m in found])
    speed = np.concatenate([m.speed for m in found])
    if np.ptp(values) <= 0.0:
        return CommandUnit()
    neutral = _at_rest(values, speed, THROTTLE_MAX)
    if neutral is None:
        neutral = 0.0 if values.min() <= 0.0 <= values.max() or np.abs(values).max() <= THROTTLE_MAX else None
    if neutral is None:  # the car never rests: where its speed would be 0
        neutral = _rounded(_throttle_of_no_speed(found), values)
    away = values - neutral
    forward = float(np.sign(np.sum(away * speed))) or 1.0
    largest = float(np.abs(away).max())
    if neutral == 0.0 and forward > 0.0 and largest <= THROTTLE_MAX:
        return CommandUnit()
    return CommandUnit(neutral, float(f"{forward / largest:.4g}") if largest > THROTTLE_MAX or neutral else forward)


def _throttle_of_no_speed(found: Sequence[LogMotion]) -> float:
    """Throttle that would bring the car to rest, from the change of its speed with throttle and speed."""
    count, terms, changes = round(SPAN / STEP), [], []
    for m in found:
        given = sums_of(m.commands()[:, 0], count)
        terms.append(np.column_stack([np.ones(len(given)), given, m.speed[:-count]]))
        changes.append(m.speed[count:] - m.speed[:-count])
    table = np.concatenate(terms) / [1.0, count, 1.0]
    level, slope, _ = np.linalg.lstsq(table, np.concatenate(changes), rcond=None)[0]
    return float(-level / slope) if slope else float(np.mean(table[:, 1]))


def _at_rest(values: Floats, speed: Floats, largest: float) -> float | None:
    """The usual command of a vehicle at rest, None if it is hardly ever at rest; 0 if it may be, up to `largest`."""
    resting = np.abs(speed) < REST_SPEED * np.quantile(np.abs(speed), 0.95)
    kinds, counts = np.unique(values[resting], return_counts=True)
    if resting.sum() < REST_SAMPLES_MIN:
        return None
    most = np.sort(counts)[::-1]
    if most[0] < REST_SHARE_MIN * counts.sum() and most[0] < REST_FACTOR * most[1]:  # a share below 1 has a next one
        return None
    if 0.0 in kinds and values.min() >= -largest and values.max() <= largest:
        return 0.0
    return float(kinds[np.argmax(counts)])


def _steering(found: Sequence[LogMotion], wheelbase: float) -> CommandUnit:
    values = np.concatenate([m.commands(DELAY)[:, 1] for m in found])
    speed = np.concatenate([m.speed for m in found])
    rate = np.concatenate([m.rate for m in found])
    if np.ptp(values) <= 0.0:
        return CommandUnit()
    middle, half = float(np.mean(values)), float(np.std(values))
    level, slope = np.linalg.lstsq(np.column_stack([speed, speed * (values - middle) / half]), rate, rcond=None)[0]
    if slope == 0.0:
        return CommandUnit()
    straight, per_unit = middle - half * level / slope, wheelbase * slope / half
    away = float(np.abs(values - straight).max())
    neutral = _rounded(straight, values) if abs(straight) > OFFSET_MAX * away else 0.0
    radians = 1.0 / STEERING_RATIO_MAX <= per_unit <= STEERING_RATIO_MAX
    if neutral == 0.0 and radians:
        return CommandUnit()
    flipped = -STEERING_RATIO_MAX <= per_unit <= -1.0 / STEERING_RATIO_MAX
    return CommandUnit(neutral, -1.0 if neutral == 0.0 and flipped else float(f"{per_unit:.3g}"))


def _sides(found: Sequence[LogMotion]) -> tuple[CommandUnit, CommandUnit]:
    """Meaning of the commands of both sides, with one scale: that the sides differ is a parameter of the models."""
    if not found:
        return CommandUnit(), CommandUnit()
    given = np.concatenate([m.commands(DELAY) for m in found])
    motion = np.concatenate([np.column_stack([m.speed, m.rate]) for m in found])
    middle, half = given.mean(axis=0), given.std(axis=0) + 1e-12
    table = np.column_stack([np.ones(len(given)), (given - middle) / half])
    level, *slopes = np.linalg.lstsq(table, motion, rcond=None)[0]
    moving = np.abs(motion / (np.quantile(np.abs(motion), 0.95, axis=0) + 1e-12)).max(axis=1)
    still = _without_motion(np.array(slopes).T, level, half) + middle
    neutral = [_side_neutral(given[:, k], moving, float(still[k])) for k in range(2)]
    forward = [-1.0 if slope[0] < 0.0 else 1.0 for slope in slopes]
    largest = float(np.abs(given - neutral).max())
    if largest <= 0.0 or (largest <= SIDE_MAX and not any(neutral)):
        return CommandUnit(0.0, forward[0]), CommandUnit(0.0, forward[1])
    one, other = (CommandUnit(n, float(f"{sign / largest:.4g}")) for n, sign in zip(neutral, forward, strict=True))
    return one, other


def _side_neutral(values: Floats, moving: Floats, still: float) -> float:
    """Neutral command of a side: the usual one at rest, else 0 where it may be, else that without motion, `still`."""
    found = _at_rest(values, moving, SIDE_MAX)
    if found is not None:
        return found
    if values.min() <= 0.0 <= values.max() or np.abs(values).max() <= SIDE_MAX or not np.ptp(values):
        return 0.0
    return _rounded(still, values)


def _without_motion(slopes: Matrix, level: Floats, half: Floats) -> Floats:
    """Commands (2,) at which neither speed nor yaw rate remain, less their means."""
    found: Floats = -half * np.linalg.lstsq(slopes, level, rcond=None)[0]
    return found


def _rounded(neutral: float, values: Floats) -> float:
    """The nearest round number, in steps of a tenth to a twentieth of the range of the values."""
    step = 0.5 * 10.0 ** math.floor(math.log10(float(np.ptp(values)) / 2.0))
    return step * round(neutral / step)
