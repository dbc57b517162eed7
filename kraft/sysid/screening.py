"""Screening of logs before an identification: what commands and motion say of each other without a model.

Regressions of the yaw rate on speed and steering of a car, and of the change of the speed on throttle and speed, are
enough to see that commands and poses do not belong together: an offset of their clocks, swapped columns, two cars.  For
a robot with two driven sides `kraft.sysid.sides_response` has the regressions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.sysid import sides_response
from kraft.sysid.log_groups import RIDGE, Response, Samples, groups_problem
from kraft.sysid.log_motion import SPAN, STEP, SWEEPS, LogMotion, are_of_cars, followed, motions, sums_of
from kraft.sysid.sides_response import drive_samples, motions_of_sides, responses_of_sides, turn_samples
from ompl_ext.arrays import Floats, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Log


FINE_DELAYS: Final = tuple(0.01 * k for k in range(-10, 11))
"""Delays at which the response to the steering is sought, s."""
UNEXPLAINED_MAX: Final = 0.5
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
FINE_STEP: Final = 0.01
"""Resolution of the offset of the clocks, s."""
FINE_COUNT: Final = 25
"""Number of such steps to either side of the coarse offset."""
OFFSET_WIDTH: Final = 1.0
"""Time from the found offset at which commands must explain less, s."""
RATE_SPAN: Final = 0.6
"""Time over which the yaw rate of different logs is averaged and compared, s.

It is long beside the lags of steering and commands, about 0.1 s, which differ from log to log without another car; and
short beside the curves that a car drives, which would be averaged away.
"""
GROUP_DELAYS: Final = (0.1, 0.3)
"""Delays of the response with which groups are sought, s: that of a mixture would say nothing about either."""
GRIP_QUANTILES: Final = (0.4, 0.8)
"""Quantiles of steering times squared speed (lateral acceleration but for a factor) that tyres may hold at most."""
GROUP_TURN_LEAST, GROUP_TURN_RATIO = 0.008, 0.5
"""Share of the yaw rate that two groups explain in addition, at least, and of what is left by them, at most."""
GROUP_DRIVE_LEAST, GROUP_DRIVE_RATIO = 0.05, 0.6
"""The same for changes of the speed."""


def yaw_error(found: Sequence[LogMotion], delay: float, *, swapped: bool = False) -> float:
    """Share of the yaw rate that speed and steering do not explain, with steering from `delay` s before."""
    control = 0 if swapped else 1
    terms = [np.column_stack([m.speed, m.speed * m.commands(delay)[:, control]]) for m in found]
    return unexplained(np.concatenate(terms), np.concatenate([m.rate for m in found]))


def speed_error(found: Sequence[LogMotion], delay: float, *, swapped: bool = False) -> float:
    """Share of the change of the speed that throttle and speed do not explain, with throttle from `delay` s before."""
    control, count, terms, changes = 1 if swapped else 0, round(SPAN / STEP), [], []
    for m in found:
        mean = sums_of(m.commands(delay)[:, control], count) / count
        terms.append(np.column_stack([np.ones(len(mean)), mean, m.speed[:-count]]))
        changes.append(m.speed[count:] - m.speed[:-count])
    change = np.concatenate(changes)
    return unexplained(np.concatenate(terms), change - np.mean(change))


def unexplained(terms: Matrix, values: Floats) -> float:
    """Share of the sum of squares of `values` (n,) that is left by least squares on `terms` (n, k)."""
    return regressed(terms, values)[1]


def regressed(terms: Matrix, values: Floats) -> tuple[Floats, float]:
    """Factors (k,) of `terms` (n, k) by least squares, and the share of the squares of `values` (n,) that is left."""
    whole = float(values @ values)
    if whole <= 0.0:
        return np.zeros(terms.shape[1]), 1.0
    scale = np.sqrt(np.mean(terms**2, axis=0)) + 1e-12
    scaled = terms / scale
    slope = scaled.T @ values
    fit = np.linalg.solve(scaled.T @ scaled + RIDGE * len(values) * np.eye(scaled.shape[1]), slope)
    return fit / scale, max(1.0 - float(fit @ (2.0 * slope - scaled.T @ (scaled @ fit))) / whole, 0.0)


def turns_before_steered(logs: Sequence[Log]) -> bool:
    """Whether the yaw rate precedes the steering: commands are recorded later than they act."""
    if not logs or not are_of_cars(logs):
        return False
    found = motions(logs)
    if not found:
        return False
    errors = np.array([yaw_error(found, delay) for delay in FINE_DELAYS])
    best = int(np.argmin(errors))
    return bool(FINE_DELAYS[best] < 0.0 and errors[best] < UNEXPLAINED_MAX and errors.max() > 1.2 * errors[best])


def two_cars(logs: Sequence[Log]) -> str:
    """The logs that drive differently from the others, if they fall into two groups, with what to do; else empty."""
    if found := motions_of_sides(logs):
        problem = groups_problem(found, logs, responses_of_sides(found))
    elif are_of_cars(logs) and (found := motions(logs)):
        problem = _check_groups(found, logs)
    else:
        return ""
    return "" if problem is None else f"{problem.problem}; {problem.expected}"


def check_direction(logs: Sequence[Log]) -> None:
    """Refuse logs of a car, most of which have a yaw that does not follow the direction of motion.

    Such a car seems to move sideways, which hides what its commands do: other checks come after this one.

    Raises:
        InputError: with these logs and what was found in each.
    """
    if not are_of_cars(logs):
        return
    astray = [(log, finding) for log in logs for finding in log.findings if finding.kind == "heading"]
    if 2 * len(astray) > len(logs):
        expected = "expected x, y and yaw of one pose"
        raise InputError([Diagnostic(log.name, found.text, expected, code=Code.MISMATCH) for log, found in astray])


def check_consistency(logs: Sequence[Log]) -> None:
    """Refuse logs whose commands and poses do not belong together, or that are of two vehicles.

    Logs of other vehicles than cars and robots with two driven sides are not checked.

    Raises:
        InputError: if throttle and steering are swapped, if the clocks of commands and poses are apart, or if the logs
            fall into two groups; with what to do.
    """
    if found := motions_of_sides(logs):
        problem = (
            _check_clock(partial(_side_error, found), partial(_turn_error, found), sides_response.USUAL_DELAY)
            or groups_problem(found, logs, responses_of_sides(found))
        )  # fmt: skip
    elif logs and are_of_cars(logs) and (found := motions(logs)):
        problem = (
            _check_columns(found)
            or _check_clock(partial(_car_error, found), partial(yaw_error, found), USUAL_DELAY)
            or _check_groups(found, logs)
        )
    else:
        return
    if problem is not None:
        raise InputError([problem])


def _car_error(found: Sequence[LogMotion], delay: float, *, swapped: bool = False) -> float:
    """Sum of both shares that the commands of a car leave unexplained."""
    return yaw_error(found, delay, swapped=swapped) + speed_error(found, delay, swapped=swapped)


def _turn_error(found: Sequence[LogMotion], delay: float) -> float:
    """Share of the change of the turning rate that the commands of both sides do not explain."""
    return _unexplained_by([turn_samples(m, delay) for m in found])


def _side_error(found: Sequence[LogMotion], delay: float) -> float:
    """Sum of both shares that the commands of both sides leave unexplained."""
    return _turn_error(found, delay) + _unexplained_by([drive_samples(m, delay) for m in found])


def _unexplained_by(samples: Samples) -> float:
    """Share of a motion that its terms leave unexplained in all parts together."""
    return unexplained(np.concatenate([terms for terms, _ in samples]), np.concatenate([y for _, y in samples]))


Error = Callable[[float], float]
"""Share of motions that commands leave unexplained, by the time (s) for which they are delayed."""


def _least(error: Error, delays: Iterable[float]) -> tuple[float, float]:
    """Least error, and its delay."""
    return min((error(float(d)), float(d)) for d in delays)


def _check_columns(found: Sequence[LogMotion]) -> Diagnostic | None:
    stated, _delay = _least(partial(_car_error, found), NEAR_DELAYS)
    swapped, _delay = _least(partial(_car_error, found, swapped=True), NEAR_DELAYS)
    if stated - swapped < SWAPPED_LEAST or swapped > SWAPPED_RATIO * stated:
        return None
    problem = "throttle and steering are swapped: the vehicle turns with the throttle"
    expected = "state the other column of each in a mapping file, commands.controls: {throttle: ..., steering: ...}"
    return Diagnostic("logs", problem, expected, code=Code.MISMATCH)


def _check_clock(error: Error, turning: Error, usual: float) -> Diagnostic | None:
    """The offset of the clocks, if commands of another time explain both motions better.

    `turning` is the error of the yaw alone, which the commands explain best `usual` s later where clocks agree.
    """
    near, _delay = _least(error, NEAR_DELAYS)
    far, delay = _least(error, FAR_DELAYS)
    if near - far < OFFSET_LEAST or far > OFFSET_RATIO * near:
        return None
    beside, _delay = _least(error, (delay - OFFSET_WIDTH, delay + OFFSET_WIDTH))
    if beside - far < 0.5 * OFFSET_LEAST:  # slow ramps are explained by commands of any time
        return None
    offset = usual - _fine_delay(error, turning, delay)
    problem = (
        f"the commands are recorded {abs(offset):.2f} s {'later' if offset > 0.0 else 'earlier'} than they act: their "
        "clock is not that of the poses"
    )
    expected = f"state the offset in a mapping file, commands.time: {{column: ..., zero: {offset:.2f}}} for seconds"
    return Diagnostic("logs", problem, expected, code=Code.MISMATCH)


def _fine_delay(error: Error, turning: Error, delay: float) -> float:
    """The delay near a coarse one: that of the yaw rate, or of both motions where the commands hardly explain it.

    The inertia of the drive spreads a change of the speed over a time in which it shows no delay.
    """
    delays = (delay + FINE_STEP * np.arange(-FINE_COUNT, FINE_COUNT + 1)).tolist()
    errors = [turning(each) for each in delays]
    if min(errors) < UNEXPLAINED_MAX:
        return float(delays[int(np.argmin(errors))])
    return _least(error, delays)[1]


def _check_groups(found: Sequence[LogMotion], logs: Sequence[Log]) -> Diagnostic | None:
    driving = [[driving_terms(m, delay) for m in found] for delay in GROUP_DELAYS]
    return groups_problem(
        found,
        logs,
        (
            Response("turn", _turning(found), GROUP_TURN_LEAST, GROUP_TURN_RATIO),
            Response("accelerate", driving, GROUP_DRIVE_LEAST, GROUP_DRIVE_RATIO),
        ),
    )


def _turning(found: Sequence[LogMotion]) -> list[list[tuple[Matrix, Floats]]]:
    """Terms of the yaw rate and the yaw rate of all motions, for each delay and each time that a slow servo may take.

    Without these times, the logs of a slow servo fall into those in which the steering is held and those in which it
    changes.
    """
    steering = [[m.commands(delay)[:, 1] for m in found] for delay in GROUP_DELAYS]
    full = max(float(np.abs(s).max()) for s in steering[0])
    slow = [[followed(s, full * STEP / sweep) for s in steering[0]] for sweep in SWEEPS if full > 0.0]
    asked = np.concatenate([np.abs(s) * m.speed**2 for m, s in zip(found, steering[0], strict=True)])
    limits = np.maximum(np.quantile(asked, GRIP_QUANTILES), 1e-9).tolist()
    return [[_turning_terms(m, s, limits) for m, s in zip(found, turned, strict=True)] for turned in (*steering, *slow)]


def _turning_terms(m: LogMotion, s: Floats, limits: Sequence[float]) -> tuple[Matrix, Floats]:
    """Terms of the yaw rate with steering `s` (n,) and the yaw rate, averaged over a time that is long for lags.

    The tyres limit the lateral acceleration: `limits` are values that steering times squared speed may not exceed.
    """
    v = m.speed
    held = [v * s / (1.0 + np.abs(s) * v**2 / limit) for limit in limits]
    table = np.column_stack([v, v * s, v * s * np.abs(s), v**3 * s, v**3, *held, m.rate])
    count = min(round(RATE_SPAN / STEP), len(v) - 1)
    total = np.cumsum(np.vstack([np.zeros(table.shape[1]), table]), axis=0)
    mean = (total[count:] - total[:-count]) / count
    return mean[:, :-1], mean[:, -1]


def driving_terms(m: LogMotion, delay: float) -> tuple[Matrix, Floats]:
    """Terms of the change of the speed and the change.

    One of them is what a car that slides sideways gains or loses along itself because it turns away from its motion.
    """
    count, u, v = round(SPAN / STEP), m.commands(delay)[:, 0], m.speed
    mean, before = sums_of(u, count) / count, v[:-count]
    turned = np.abs(m.commands(delay)[:-count, 1])
    terms = [np.ones(len(mean)), mean, mean * np.abs(mean), before, before * np.abs(before), np.tanh(10.0 * before)]
    turned_away = sums_of(m.rate * m.side, count) / count
    return np.column_stack([*terms, before * turned, turned_away]), v[count:] - before
