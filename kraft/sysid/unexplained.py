"""Parts of logs that no model of a car explains: a hand on the car, a lifted wheel, a wall, a glitch of the tracker.

Three robust regressions over all logs predict the change of the speed from throttle and speed, the yaw rate from
steering and speed, and the sideways speed from yaw rate and speed, with commands of the last 0.4 s, so that lags and
delays count as explained; so do a slow servo, a speed controller, and tyres at the limit of their grip.  A stretch
is unexplained where what they leave, averaged over some tenths of a second, is many times its usual size and large for
a car.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.sysid.log_motion import STEP, SWEEPS, LogMotion, are_of_cars, followed, motions, sums_of
from kraft.sysid.smoothing import MAD
from ompl_ext.arrays import Bools, Floats, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


TAPS: Final = (0.0, 0.1, 0.2, 0.3, 0.4)
"""Ages of the commands that take part, s."""
SLOW: Final = 0.5
"""Share of what is left with a command that acts at once, up to which one of these times explains it."""
NEUTRAL: Final = 0.05
"""Share of the largest throttle up to which a car may coast otherwise than it is driven."""
LOOK_AHEAD: Final = 0.5
"""Time over which the change of the speed is explained, s."""
SMOOTHED: Final = 5
"""Number of samples over which what is left is averaged."""
DEVIATIONS: Final = 8.0
"""Usual sizes of what is left, above which a sample is unexplained, ..."""
SPEED_SHARE, RATE_SHARE, SIDE_SHARE = 0.35, 0.5, 0.25
"""... if it is also larger than this share of the high speeds, yaw rates and, sideways, speeds."""
GRIP_QUANTILE, GRIP_SHARE = 0.99, 0.7
"""Quantile of the lateral accelerations that counts as high, and share of it from which on tyres may slide."""
ROUNDS: Final = 12
"""Iterations of the robust regressions."""
INDEPENDENT: Final = 1e-8
"""Least share of the largest singular value from which on terms count as independent of the others."""
MARGIN: Final = 0.25
"""Time that is left out before and after an unexplained stretch, s."""
JOINED: Final = 0.6
"""Time between two unexplained stretches below which they are one, s."""
SAMPLES_MIN: Final = 4
"""Least number of samples of a stretch: the first and last pose of a log have none on one side."""
POSE_INTERVAL_MAX: Final = 0.15
"""Time between two poses up to which they show when the vehicle turns or slows down, s."""
SHARE_MAX: Final = 0.3
"""Share of the logs above which unexplained stretches are the rule, and show that the regressions do not apply."""


@dataclass(frozen=True)
class Stretch:
    """An unexplained stretch of a log."""

    log: str
    begin: float
    """s, as in the log"""
    end: float
    what: str
    """what the motion was that the commands do not explain"""

    def __str__(self) -> str:
        return f"{self.log}: {self.begin:.1f} to {self.end:.1f} s: {self.what}"


def unexplained_stretches(logs: Sequence[Log]) -> tuple[Stretch, ...]:
    """Stretches that no model explains; none if the logs are of no car, too short, or with too few poses a second."""
    if not are_of_cars(logs):
        return ()
    found = [m for m in motions(logs) if len(m.times) > round(2 * LOOK_AHEAD / STEP) and _is_dense(m.part)]
    if not found:
        return ()
    left = _left(found)
    stretches: list[Stretch] = []
    for m, (speed, rate, side) in zip(found, left, strict=True):
        stretches += _stretches(logs[m.log].name, m, speed, rate, side)
    whole = sum(m.times[-1] - m.times[0] for m in found)
    if sum(s.end - s.begin for s in stretches) > SHARE_MAX * whole:
        return ()
    return tuple(stretches)


def _is_dense(part: Part) -> bool:
    return float(np.median(np.diff(part.pose_times))) <= POSE_INTERVAL_MAX


def _left(found: Sequence[LogMotion]) -> list[tuple[Floats, Floats, Floats]]:
    """What the regressions leave of speed, yaw rate and sideways speed, over the least that counts; (n,) each."""
    ahead = round(LOOK_AHEAD / STEP)
    changes = [m.speed[ahead:] - m.speed[:-ahead] for m in found]
    speed = _residuals_of(found, 0, changes, lambda m, throttle: _speed_terms(m, throttle, ahead))
    rate = _residuals_of(found, 1, [m.rate for m in found], _rate_terms)
    side = _residuals([_side_terms(m) for m in found], [m.side for m in found])
    high = float(np.quantile(np.abs(np.concatenate([m.speed for m in found])), 0.9))
    turning = float(np.quantile(np.abs(np.concatenate([m.rate for m in found])), 0.9))
    scaled = []
    for residuals, least in ((speed, SPEED_SHARE * high), (rate, RATE_SHARE * turning), (side, SIDE_SHARE * high)):
        averaged = [_averaged(r) for r in residuals]
        usual = MAD * float(np.median(np.abs(np.concatenate(averaged))))
        scaled.append([a / max(DEVIATIONS * usual, least, 1e-9) for a in averaged])
    speeds, rates, sides = scaled
    return [
        (_larger(v, ahead), np.where(slides, 0.0, r), s)
        for v, r, s, slides in zip(speeds, rates, sides, _sliding(found, rates), strict=True)
    ]


def _sliding(found: Sequence[LogMotion], left: Sequence[Floats]) -> list[Bools]:
    """Whether the tyres may slide at each sample (n,), `left` (n,) the yaw rate that is not explained.

    A car at the limit of its grip turns less than it is steered: no regression that is linear in the steering says so,
    and these are the very drives that show the limit.  A car that is held has little lateral acceleration.
    """
    lateral = [np.abs(m.speed * m.rate) for m in found]
    least = GRIP_SHARE * float(np.quantile(np.concatenate(lateral), GRIP_QUANTILE))
    return [(size >= least) & (m.rate * own < 0.0) for m, size, own in zip(found, lateral, left, strict=True)]


def _larger(change: Floats, ahead: int) -> Floats:
    """The larger of what is left of the changes (n - ahead,) that begin and that end at each sample (n,)."""
    pad = np.zeros(ahead)
    begun, ended = np.append(change, pad), np.append(pad, change)
    return np.where(np.abs(begun) >= np.abs(ended), begun, ended)


def _speed_terms(m: LogMotion, throttle: Floats, ahead: int) -> Matrix:
    """Terms (n - ahead, k) of the change of the speed over the next samples; `throttle` (n,) acts in them."""
    v, terms = m.speed[:-ahead], []
    least = NEUTRAL * float(np.abs(throttle).max())
    for age in TAPS[::2]:
        u = _before(throttle, age)
        for signal in (u, u * np.abs(u), np.maximum(u, 0.0)):
            terms.append(sums_of(signal, ahead) / ahead)
        terms.append(v * sums_of((np.abs(u) <= least).astype(float), ahead) / ahead)
    return np.column_stack([*terms, v, v * np.abs(v), np.tanh(10.0 * v), v * m.rate[:-ahead] ** 2, np.ones(len(v))])


def _residuals_of(
    found: Sequence[LogMotion], column: int, values: Sequence[Floats], terms: Callable[[LogMotion, Floats], Matrix]
) -> list[Floats]:
    """What is left of values (n,) if a command acts at once or, where that explains far more, gradually as well."""
    commands = [m.commands()[:, column] for m in found]
    full = max(float(np.abs(u).max()) for u in commands)
    prompt = [terms(m, u) for m, u in zip(found, commands, strict=True)]
    at_once = _residuals(prompt, values)

    def slow(sweep: float) -> list[Floats]:
        gradual = [terms(m, followed(u, full * STEP / sweep)) for m, u in zip(found, commands, strict=True)]
        return _residuals([np.column_stack(both) for both in zip(prompt, gradual, strict=True)], values)

    best = min((slow(sweep) for sweep in SWEEPS), key=_square, default=at_once)
    return best if _square(best) < SLOW * _square(at_once) else at_once


def _square(residuals: Sequence[Floats]) -> float:
    return float(np.mean(np.concatenate(residuals) ** 2))


def _rate_terms(m: LogMotion, turned: Floats) -> Matrix:
    """Terms (n, k) of the yaw rate with wheels that are `turned` (n,), in the unit of the command."""
    v, terms = m.speed, []
    for age in TAPS:
        s = _before(turned, age)
        terms += [v * s, v * s * np.abs(s)]
    s = _before(turned, 0.2)
    return np.column_stack([*terms, v, v * np.abs(v) * s, v**3 * s])


def _before(values: Floats, age: float) -> Floats:
    """Values (n,) of `age` s before each sample; of the first one before that."""
    count = round(age / STEP)
    return np.concatenate([np.full(count, values[0]), values[: len(values) - count]])


def _side_terms(m: LogMotion) -> Matrix:
    """Terms (n, k) of the sideways speed."""
    return np.column_stack([m.rate, m.speed, m.speed * np.abs(m.speed) * m.rate, m.rate * np.abs(m.rate)])


def _residuals(terms: Sequence[Matrix], values: Sequence[Floats]) -> list[Floats]:
    """What a robust regression (Cauchy loss) leaves of the values, part by part."""
    x, y = np.concatenate(terms), np.concatenate(values)
    basis = _orthonormal(x / (np.sqrt(np.mean(x**2, axis=0)) + 1e-12))
    weight = np.ones(len(y))
    left = y
    for _ in range(ROUNDS):
        weighted = (basis * weight[:, None]).T
        left = y - basis @ np.linalg.lstsq(weighted @ basis, weighted @ y, rcond=None)[0]
        scale = MAD * float(np.median(np.abs(left))) + 1e-9
        weight = 1.0 / (1.0 + (left / (2.0 * scale)) ** 2)
    return list(np.split(left, np.cumsum([len(v) for v in values])[:-1]))


def _orthonormal(x: Matrix) -> Matrix:
    """Basis (n, rank) of the columns of x (n, k), so that normal equations in it are as exact as x itself."""
    q, r = np.linalg.qr(x)
    turned, size, _ = np.linalg.svd(r)
    basis: Matrix = q @ turned[:, size > INDEPENDENT * size[0]]
    return basis


def _averaged(values: Floats) -> Floats:
    return np.convolve(np.pad(values, SMOOTHED // 2, mode="edge"), np.ones(SMOOTHED) / SMOOTHED, "valid")


def _stretches(log: str, m: LogMotion, speed: Floats, rate: Floats, side: Floats) -> list[Stretch]:
    kinds = np.array([np.abs(speed), np.abs(rate), np.abs(side)])
    bad = np.flatnonzero(kinds.max(axis=0) > 1.0)
    if not len(bad):
        return []
    groups = np.split(bad, np.flatnonzero(np.diff(bad) * STEP > JOINED) + 1)
    found = []
    for group in groups:
        if len(group) < SAMPLES_MIN:
            continue
        worst = int(np.argmax(kinds[:, group].max(axis=1)))
        sign = speed[group][int(np.argmax(kinds[0, group]))]
        what = ("slower than commanded" if sign < 0.0 else "faster than commanded",
                "turns otherwise than steered", "moves sideways")[worst]  # fmt: skip
        found.append(Stretch(log, float(m.times[group[0]]) - MARGIN, float(m.times[group[-1]]) + MARGIN, what))
    return found


def without(logs: Sequence[Log], stretches: Sequence[Stretch]) -> tuple[Log, ...]:
    """The logs without the stretches: their parts end before them, and others begin after them."""
    cut = []
    for log in logs:
        own = [s for s in stretches if s.log == log.name]
        parts = tuple(piece for part in log.parts for piece in _pieces(part, own))
        if not own:
            cut.append(log)
        elif parts:
            cut.append(replace(log, parts=parts))
    return tuple(cut)


def _pieces(part: Part, stretches: Sequence[Stretch]) -> list[Part]:
    times = part.pose_times
    kept: Bools = np.ones(len(times), bool)
    for s in stretches:
        kept &= (times < s.begin) | (times > s.end)
    index = np.flatnonzero(kept)
    runs = np.split(index, np.flatnonzero(np.diff(index) > 1) + 1) if len(index) else []
    return [
        replace(part, pose_times=times[run].copy(), poses=part.poses[run].copy())
        for run in runs
        if len(run) > 2 and times[run[-1]] - times[run[0]] > 2.0 * MARGIN
    ]
