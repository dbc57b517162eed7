"""Screening of logs before an identification: what commands and motion of a car say of each other without a model.

The motion of all logs is put on equal time steps.  Regressions of the yaw rate on speed and steering, and of the change
of the speed on throttle and speed, are enough to see that commands and poses do not belong together (an offset of their
clocks, swapped columns, two cars), and in which units the commands are: their neutral value, sign and scale.

Pulse widths, duty, degrees and [-1, 1] are all converted to shares of the full throttle, forward positive, and to a
wheel angle, left positive.  Commands that already are such are left as they are.  The scale of the steering is that of
a car of a given wheelbase: poses show the ratio of the two alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.sysid.smoothing import smoothed, thinned
from ompl_ext.arrays import Bools, Floats, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


STEP: Final = 0.05
"""Time between two samples, s."""
POSE_INTERVAL: Final = 0.03
"""Least time between two poses of the parabolas that give speed and yaw rate, s."""
SPAN: Final = 0.3
"""Time over which the change of the speed is explained, s."""
FINE_DELAYS: Final = tuple(0.01 * k for k in range(-10, 11))
"""Delays at which the response to the steering is sought, s."""
EXPLAINED_MAX: Final = 0.5
"""Share of a motion that a command leaves unexplained, up to which it counts as its cause."""
NEAR_DELAYS: Final = np.round(np.arange(-0.1, 0.61, 0.05), 3)
"""Delays of a response that a car and a recorder may have, s."""
FAR_DELAYS: Final = np.round(np.concatenate([np.arange(-5.0, -0.25, 0.1), np.arange(0.8, 5.01, 0.1)]), 3)
"""Delays that show an offset of the clocks, s."""
USUAL_DELAY: Final = 0.1
"""Delay at which the response to a command shows, s."""
SWAPPED_LEAST, SWAPPED_RATIO = 0.3, 0.75
"""Share of both motions that swapped commands explain in addition, at least, and of what is left by them, at most."""
OFFSET_LEAST, OFFSET_RATIO = 0.2, 0.6
"""The same for commands at another time."""
OFFSET_WIDTH: Final = 1.0
"""Time from the found offset at which commands must explain less, s."""
AVERAGED: Final = 0.6
"""Time over which the yaw rate of different logs is compared, s."""
GROUP_LOGS_MIN: Final = 4
GROUP_TIME_MIN: Final = 20.0
"""Least duration of the logs of a group, s: a few seconds may differ by chance."""
GROUP_ROUNDS: Final = 20
GROUP_DELAYS: Final = (0.1, 0.3)
"""Delays of the response with which groups are sought, s: that of a mixture would say nothing about either."""
GROUP_TURN_LEAST, GROUP_TURN_RATIO = 0.008, 0.5
"""Share of the yaw rate that two groups explain in addition, at least, and of what is left by them, at most."""
GROUP_DRIVE_LEAST, GROUP_DRIVE_RATIO = 0.05, 0.6
"""The same for changes of the speed."""
OTHERS: Final = 1e-3
"""Weight of the logs of the other group, which decide where those of a group do not."""
RIDGE: Final = 1e-6
"""Share of the information that is added, so that a command that never changes has no effect."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion and commands of one part on equal time steps, n samples."""

    log: int
    times: Floats
    """(n,) s, as in the log"""
    speed: Floats
    """(n,) along the car, m/s"""
    side: Floats
    """(n,) to its left, m/s"""
    rate: Floats
    """(n,) of the yaw, rad/s"""
    part: Part

    def commands(self, delay: float = 0.0) -> Matrix:
        """Commands (n, 2), throttle and steering, from `delay` s before each sample."""
        at = np.searchsorted(self.part.command_times, self.times - delay, side="right") - 1
        found: Matrix = self.part.commands[np.maximum(at, 0)]
        return found


def motions(logs: Sequence[Log]) -> list[Motion]:
    """Motion of all parts that last for a second or longer, commands in the order throttle, steering."""
    found = []
    for i, log in enumerate(logs):
        columns = [log.controls.index(name) for name in ("throttle", "steering")]
        for part in log.parts:
            if part.duration >= 1.0 and len(part.pose_times) >= 10:
                found.append(motion(i, part, columns))
    return found


def motion(log: int, part: Part, columns: Sequence[int]) -> Motion:
    """Motion of one part; `columns` are those of throttle and steering."""
    less = thinned(part, POSE_INTERVAL)
    times = np.arange(part.pose_times[0], part.pose_times[-1], STEP)
    poses, rates = smoothed(less.pose_times, less.poses, times)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    ordered = replace(part, commands=part.commands[:, list(columns)])
    return Motion(
        log, times, rates[:, 0] * c + rates[:, 1] * s, rates[:, 1] * c - rates[:, 0] * s, rates[:, 2], ordered
    )


def yaw_error(found: Sequence[Motion], delay: float, *, swapped: bool = False) -> float:
    """Share of the yaw rate that speed and steering do not explain, with steering from `delay` s before."""
    control = 0 if swapped else 1
    terms = [np.column_stack([m.speed, m.speed * m.commands(delay)[:, control]]) for m in found]
    return _unexplained(np.concatenate(terms), np.concatenate([m.rate for m in found]))


def speed_error(found: Sequence[Motion], delay: float, *, swapped: bool = False) -> float:
    """Share of the change of the speed that throttle and speed do not explain, with throttle from `delay` s before."""
    control, count, terms, changes = 1 if swapped else 0, round(SPAN / STEP), [], []
    for m in found:
        mean = sums_of(m.commands(delay)[:, control], count) / count
        terms.append(np.column_stack([np.ones(len(mean)), mean, m.speed[:-count]]))
        changes.append(m.speed[count:] - m.speed[:-count])
    change = np.concatenate(changes)
    return _unexplained(np.concatenate(terms), change - np.mean(change))


def sums_of(values: Floats, count: int) -> Floats:
    """Sums (n - count,) of `count` successive values of n, beginning with each value in turn."""
    total = np.concatenate([[0.0], np.cumsum(values[:-1])])
    sums: Floats = total[count:] - total[:-count]
    return sums


def _unexplained(terms: Matrix, values: Floats) -> float:
    """Share of the sum of squares of `values` (n,) that is left by least squares on `terms` (n, k)."""
    whole = float(values @ values)
    if whole <= 0.0:
        return 1.0
    scaled = terms / (np.sqrt(np.mean(terms**2, axis=0)) + 1e-12)
    slope = scaled.T @ values
    fit = np.linalg.solve(scaled.T @ scaled + RIDGE * len(values) * np.eye(scaled.shape[1]), slope)
    return max(1.0 - float(fit @ (2.0 * slope - scaled.T @ (scaled @ fit))) / whole, 0.0)


def turns_before_steered(logs: Sequence[Log]) -> bool:
    """Whether the yaw rate precedes the steering: commands are recorded later than they act."""
    if not logs or not {"throttle", "steering"} <= set(logs[0].controls):
        return False
    found = motions(logs)
    if not found:
        return False
    errors = np.array([yaw_error(found, delay) for delay in FINE_DELAYS])
    best = int(np.argmin(errors))
    return bool(FINE_DELAYS[best] < 0.0 and errors[best] < EXPLAINED_MAX and errors.max() > 1.2 * errors[best])


def check_consistency(logs: Sequence[Log]) -> None:
    """Refuse logs of a car whose commands and poses do not belong together, or that are of two cars.

    Logs without throttle and steering are not checked.

    Raises:
        InputError: if the yaw does not follow the motion, if throttle and steering are swapped, if the clocks of
            commands and poses are apart, or if the logs fall into two groups; with what to do.
    """
    if not logs or any(not {"throttle", "steering"} <= set(log.controls) for log in logs):
        return
    found = motions(logs)
    if not found:
        return
    astray = [log for log in logs if any(finding.kind == "heading" for finding in log.findings)]
    if 2 * len(astray) > len(logs):
        what, expected = "the yaw does not follow the direction of motion", "expected x, y and yaw of one pose"
        raise InputError([Diagnostic(log.name, what, expected, code=Code.MISMATCH) for log in astray])
    for check in (_check_columns, _check_clock, _check_groups):
        problem = check(found, logs)
        if problem is not None:
            raise InputError([problem])


def _least(found: Sequence[Motion], delays: Iterable[float], *, swapped: bool = False) -> tuple[float, float]:
    """Least sum of both shares that commands leave unexplained, and its delay."""
    return min(
        (yaw_error(found, d, swapped=swapped) + speed_error(found, d, swapped=swapped), float(d)) for d in delays
    )


def _check_columns(found: Sequence[Motion], _: Sequence[Log]) -> Diagnostic | None:
    stated, _delay = _least(found, NEAR_DELAYS)
    swapped, _delay = _least(found, NEAR_DELAYS, swapped=True)
    if stated - swapped < SWAPPED_LEAST or swapped > SWAPPED_RATIO * stated:
        return None
    problem = "throttle and steering are swapped: the vehicle turns with the throttle"
    expected = "state the other column of each in a mapping file, commands.controls: {throttle: ..., steering: ...}"
    return Diagnostic("logs", problem, expected, code=Code.MISMATCH)


def _check_clock(found: Sequence[Motion], _: Sequence[Log]) -> Diagnostic | None:
    near, _delay = _least(found, NEAR_DELAYS)
    far, delay = _least(found, FAR_DELAYS)
    if near - far < OFFSET_LEAST or far > OFFSET_RATIO * near:
        return None
    beside, _delay = _least(found, (delay - OFFSET_WIDTH, delay + OFFSET_WIDTH))
    if beside - far < 0.5 * OFFSET_LEAST:  # slow ramps are explained by commands of any time
        return None
    _error, delay = _least(found, delay + STEP * np.arange(-4.0, 5.0, dtype=np.float64))
    offset = USUAL_DELAY - delay
    problem = (
        f"the commands are recorded {abs(offset):.1f} s {'later' if offset > 0.0 else 'earlier'} than they act: their "
        "clock is not that of the poses"
    )
    expected = f"state the offset in a mapping file, commands.time: {{column: ..., zero: {offset:.1f}}} for seconds"
    return Diagnostic("logs", problem, expected, code=Code.MISMATCH)


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations of one regression for each log."""

    information: Floats
    """(logs, k, k)"""
    gradient: Matrix
    """(logs, k)"""
    square: Floats
    """(logs,) of the values"""

    def cost(self, chosen: Bools) -> Floats:
        """(logs,) sum of squares that the regression over the chosen logs leaves of each log."""
        weight = np.where(chosen, 1.0, OTHERS)
        whole = np.tensordot(weight, self.information, 1)
        ridge = RIDGE * np.trace(self.information.sum(axis=0)) * np.eye(len(whole))
        b = np.linalg.solve(whole + ridge, weight @ self.gradient)
        cost: Floats = self.square - 2.0 * self.gradient @ b + np.einsum("i,nij,j->n", b, self.information, b)
        return cost


def _check_groups(found: Sequence[Motion], logs: Sequence[Log]) -> Diagnostic | None:
    if len(logs) < GROUP_LOGS_MIN:
        return None
    for what, terms, least, most in (
        ("turn", _turning_terms, GROUP_TURN_LEAST, GROUP_TURN_RATIO),
        ("accelerate", _driving_terms, GROUP_DRIVE_LEAST, GROUP_DRIVE_RATIO),
    ):
        tried = [_normal(found, len(logs), [terms(m, delay) for m in found]) for delay in GROUP_DELAYS]
        normal = min(tried, key=lambda each: _two_groups(each)[1])
        one = normal.cost(np.ones(len(logs), bool)).sum()
        first, two = _two_groups(normal)
        times = np.bincount([m.log for m in found], [len(m.times) * STEP for m in found], len(logs))
        long = min(times[first].sum(), times[~first].sum()) >= GROUP_TIME_MIN
        fair = long and 2 <= first.sum() <= len(logs) - 2
        if fair and one - two >= least * normal.square.sum() and two <= most * one:
            sides = [
                ", ".join(log.name for log, own in zip(logs, first == k, strict=True) if own) for k in (True, False)
            ]
            problem = f"the logs fall into two groups that {what} differently: one is {sides[0]}; the other {sides[1]}"
            expected = "expected logs of one car in one state; identify each group by itself"
            return Diagnostic("logs", problem, expected, code=Code.MISMATCH)
    return None


def _turning_terms(m: Motion, delay: float) -> tuple[Matrix, Floats]:
    """Terms of the yaw rate and the yaw rate, averaged over a time in which lags hardly count."""
    v, s = m.speed, m.commands(delay)[:, 1]
    table = np.column_stack([v, v * s, v * s * np.abs(s), v**3 * s, v**3, m.rate])
    count = min(round(AVERAGED / STEP), len(v) - 1)
    total = np.cumsum(np.vstack([np.zeros(table.shape[1]), table]), axis=0)
    mean = (total[count:] - total[:-count]) / count
    return mean[:, :-1], mean[:, -1]


def _driving_terms(m: Motion, delay: float) -> tuple[Matrix, Floats]:
    """Terms of the change of the speed and the change."""
    count, u, v = round(SPAN / STEP), m.commands(delay)[:, 0], m.speed
    mean, before = sums_of(u, count) / count, v[:-count]
    turned = np.abs(m.commands(delay)[:-count, 1])
    terms = [np.ones(len(mean)), mean, mean * np.abs(mean), before, before * np.abs(before), np.tanh(10.0 * before)]
    return np.column_stack([*terms, before * turned]), v[count:] - before


def _normal(found: Sequence[Motion], logs: int, samples: Sequence[tuple[Matrix, Floats]]) -> _Normal:
    scale = np.sqrt(np.mean(np.concatenate([x for x, _ in samples]) ** 2, axis=0)) + 1e-12
    k = len(scale)
    normal = _Normal(np.zeros((logs, k, k)), np.zeros((logs, k)), np.zeros(logs))
    for m, (x, y) in zip(found, samples, strict=True):
        normal.information[m.log] += (x / scale).T @ (x / scale)
        normal.gradient[m.log] += (x / scale).T @ y
        normal.square[m.log] += y @ y
    return normal


def _two_groups(normal: _Normal) -> tuple[Bools, float]:
    """Division of the logs into two groups with a regression each that leaves least, and what it leaves."""
    logs = len(normal.square)
    whole = np.maximum(normal.square, 1e-12)
    best: tuple[Bools, float] = (np.ones(logs, bool), np.inf)
    for k in range(logs):  # begin with the logs that are most like one of them
        share = normal.cost(np.arange(logs) == k) / whole
        first = share < np.median(share)
        for _ in range(GROUP_ROUNDS):
            if not 0 < first.sum() < logs:
                break
            own, other = normal.cost(first), normal.cost(~first)
            left = float(np.minimum(own, other).sum())
            if left < best[1]:
                best = (own < other, left)
            if np.array_equal(own < other, first):
                break
            first = own < other
    return best


WHEELBASE: Final = 0.33
"""Wheelbase that the scale of the steering is found with, m: that of a 1:10 car."""
STEERING_RATIO_MAX: Final = 2.2
"""Factor between the commanded and the found wheel angle up to which commands count as radians."""
THROTTLE_MAX: Final = 1.6
"""Largest throttle that counts as a share of the full one, or as a speed of a slow car in m/s."""
OFFSET_MAX: Final = 0.6
"""Offset of the steering over its largest deviation from there, up to which the wheels are merely off centre."""
FULL: Final = {"throttle": "above it is the largest one in the logs", "steering": "above it is a radian"}
OPPOSITE: Final = {"throttle": "backwards", "steering": "to the right"}
REST_SPEED: Final = 0.05
"""Share of the high speeds below which the car is at rest."""
REST_SAMPLES_MIN: Final = 10
REST_SHARE_MIN: Final = 0.3
"""Least number of samples at rest, and least share of them that have the neutral throttle."""
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


def command_units(logs: Sequence[Log]) -> dict[str, CommandUnit]:
    """Meaning of throttle and steering in the logs of one car; as they are where the logs do not show another one."""
    found = motions(logs)
    if not found:
        return {"throttle": CommandUnit(), "steering": CommandUnit()}
    return {"throttle": _throttle(found), "steering": _steering(found)}


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
    notes = tuple(
        f"{name}: {unit.neutral:g} is neutral, {abs(1.0 / unit.scale):.4g} {FULL[name]}; in a mapping file: "
        f"commands.controls.{name}: {{column: ..., zero: {unit.neutral:g}, scale: {unit.scale:g}}}"
        for name, unit in units.items()
        if not unit.as_is
    )
    if units.get("steering", CommandUnit()).as_is:
        return notes
    ratio = "poses show only the ratio of the scale of the steering to the wheelbase L"
    return (*notes, f"{ratio}: both are those of a car with about {WHEELBASE:g} m; state the scale if you know it")


def sign_warnings(units: Mapping[str, CommandUnit]) -> tuple[str, ...]:
    """Warnings of commands whose sign is flipped."""
    return tuple(
        f"{name} has the opposite sign: larger numbers are {OPPOSITE[name]}; the commands were negated"
        for name, unit in units.items()
        if unit.scale < 0.0
    )


def _throttle(found: Sequence[Motion]) -> CommandUnit:
    values = np.concatenate([m.commands(DELAY)[:, 0] for m in found])
    speed = np.concatenate([m.speed for m in found])
    if np.ptp(values) <= 0.0:
        return CommandUnit()
    neutral = _throttle_at_rest(values, speed)
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


def _throttle_of_no_speed(found: Sequence[Motion]) -> float:
    """Throttle that would bring the car to rest, from the change of its speed with throttle and speed."""
    count, terms, changes = round(SPAN / STEP), [], []
    for m in found:
        given = sums_of(m.commands()[:, 0], count)
        terms.append(np.column_stack([np.ones(len(given)), given, m.speed[:-count]]))
        changes.append(m.speed[count:] - m.speed[:-count])
    table = np.concatenate(terms) / [1.0, count, 1.0]
    level, slope, _ = np.linalg.lstsq(table, np.concatenate(changes), rcond=None)[0]
    return float(-level / slope) if slope else float(np.mean(table[:, 1]))


def _throttle_at_rest(values: Floats, speed: Floats) -> float | None:
    """The usual throttle of a car at rest, None if it is hardly ever at rest."""
    resting = np.abs(speed) < REST_SPEED * np.quantile(np.abs(speed), 0.95)
    kinds, counts = np.unique(values[resting], return_counts=True)
    if resting.sum() < REST_SAMPLES_MIN or counts.max() < REST_SHARE_MIN * counts.sum():
        return None
    if 0.0 in kinds and values.min() >= -THROTTLE_MAX and values.max() <= THROTTLE_MAX:
        return 0.0
    return float(kinds[np.argmax(counts)])


def _steering(found: Sequence[Motion]) -> CommandUnit:
    values = np.concatenate([m.commands(DELAY)[:, 1] for m in found])
    speed = np.concatenate([m.speed for m in found])
    rate = np.concatenate([m.rate for m in found])
    if np.ptp(values) <= 0.0:
        return CommandUnit()
    middle, half = float(np.mean(values)), float(np.std(values))
    level, slope = np.linalg.lstsq(np.column_stack([speed, speed * (values - middle) / half]), rate, rcond=None)[0]
    if slope == 0.0:
        return CommandUnit()
    straight, per_unit = middle - half * level / slope, WHEELBASE * slope / half
    away = float(np.abs(values - straight).max())
    neutral = _rounded(straight, values) if abs(straight) > OFFSET_MAX * away else 0.0
    radians = 1.0 / STEERING_RATIO_MAX <= per_unit <= STEERING_RATIO_MAX
    if neutral == 0.0 and radians:
        return CommandUnit()
    flipped = -STEERING_RATIO_MAX <= per_unit <= -1.0 / STEERING_RATIO_MAX
    return CommandUnit(neutral, -1.0 if neutral == 0.0 and flipped else float(f"{per_unit:.3g}"))


def _rounded(neutral: float, values: Floats) -> float:
    """The nearest round number, in steps of a tenth to a twentieth of the range of the values."""
    step = 0.5 * 10.0 ** math.floor(math.log10(float(np.ptp(values)) / 2.0))
    return step * round(neutral / step)
