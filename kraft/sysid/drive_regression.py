"""First values of the drive of a car: regressions of the change of its speed on throttle and speed.

With a known dead zone the change of the speed over a span is linear in drive and losses, which have one best value.  A
speed controller that limits the acceleration is not, and its limit has no effect on a fit that begins beyond it: a
second regression begins at several limits, round ones first, which have an effect before they are reached.

The speed of a car with a quick controller follows the throttle within the delay of the commands, which is not known
before a fit.  Its changes then seem slow, and a limit of the acceleration explains them as well; a fit that begins
beyond the limit does not learn the drive.  For such a car the steady speed over the throttle gives values without a
limit, and the regressions are made again with the delay that the first fits find.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np

from kraft.sysid.chains import Chains
from kraft.sysid.initial_values import SmoothedPoses
from kraft.sysid.parameters import Parameters
from kraft.vehicles.car import COASTING
from ompl_ext.arrays import Floats, Ints, Matrix

DEAD_ZONES: Final = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3)
"""Dead zones that the linear regression tries, as shares of the full throttle."""
SLOW: Final = 0.05
"""Speed below which friction does not act in full, m/s."""
SPAN: Final = 0.5
"""Time over which changes of the speed are explained, s."""
LEAST_COAST: Final = -0.5
"""Least first value of `coast` over the damping: at -1 the car coasts without loss, and less of it has no effect."""
LARGEST: Final = 0.98
"""Quantile of the accelerations that counts as the largest one."""
LIMITS: Final = (2.0, 1.0, 0.5, 0.25)
"""Limits of the acceleration at which the second regression begins, over the largest one."""
POWERS: Final = (4, 16, 64)
"""Powers of the demand, from a round limit to a sharp one."""
FIRST_EVALUATIONS, EVALUATIONS = 8, 15
"""Most evaluations of a regression with the first power, and with each of the others."""
OUTLIER: Final = 0.05
"""Change of the speed that is not explained from which on it counts less, m/s."""
CLEARLY_BETTER: Final = 0.9
"""Loss of the second regression over that of the first up to which its values are worth a fit."""
FOLLOWING: Final = (2.0, 5.0, 10.0, 20.0)
"""Dampings that are tried of a car whose speed follows the throttle, 1/s."""
FOLLOWING_MAX: Final = 10.0
"""Loss of these values over that of the first regression from which on the speed does not follow the throttle.

That of cars whose speed does is up to 5 while the delay is not known; of others it is 18 and more."""
LIMITED: Final = (
    "a_drive", "damping", "neutral_damping", "friction", "drag", "scrub", "back_emf", "brake", "dead_zone", "effort",
)  # fmt: skip
"""Values of the second regression, ..."""
LOW: Final = np.array([-50.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
HIGH: Final = np.array([50.0, 20.0, 40.0, 5.0, 3.0, 5.0, 20.0, 10.0, 0.5, 5.0])
TYPICAL: Final = np.array([1.0, 1.0, 1.0, 0.3, 0.1, 0.3, 1.0, 1.0, 0.1, 0.3])
"""... their bounds, and their usual sizes."""


@dataclass(frozen=True, eq=False)
class _Samples:
    """Throttle, speed (m/s) and yaw rate (rad/s) in each step, and the changes of the speed over spans of steps."""

    throttle: Floats
    """(n,) share of the full one"""
    speed: Floats
    rate: Floats
    duration: Floats
    """(n,) s"""
    begin: Ints
    """(m,) first step of each span"""
    steps: int
    """of a span"""
    change: Floats
    """(m,) of the speed, m/s"""
    wheelbase: float

    @cached_property
    def largest(self) -> float:
        """The largest acceleration, m/s^2."""
        span = self.steps * float(self.duration[0])
        return max(float(np.quantile(np.abs(self.change), LARGEST)) / span, 1e-9)

    def over_spans(self, acceleration: Floats) -> Floats:
        """(m,) change of the speed over each span by an acceleration (n,)."""
        total = np.concatenate([[0.0], np.cumsum(acceleration * self.duration)])
        change: Floats = total[self.begin + self.steps] - total[self.begin]
        return change

    @cached_property
    def losses(self) -> dict[str, Floats]:
        """Accelerations (n,) by a unit of the losses that do not depend on the throttle."""
        sense, v, r = np.tanh(self.speed / SLOW), self.speed, self.rate
        return {"friction": -sense, "drag": -v * np.abs(v), "scrub": -sense * r * r * self.wheelbase}


def values_with_drive(
    parameters: Parameters, chains: Chains, data: SmoothedPoses, mean: Matrix, rho: Floats
) -> list[Floats]:
    """Values `rho` (np,) with the drive and losses of `kraft.vehicles.car` that the logs show, the best ones first.

    Empty for other models, and where all parts of the logs are shorter than the span of the regression.

    Args:
        parameters: of the model; the throttle is in the unit of their nominal `full_throttle`.
        chains: of the logs.
        data: smoothed poses at the states of the chains.
        mean: controls (N, nu) that act in the steps.
        rho: values of all other parameters (np,).
    """
    own = {"a_drive", "damping", "back_emf", "friction", "drag", "scrub", "dead_zone", "effort", "coast", "brake"}
    if not own <= set(parameters.names):
        return []
    samples = _samples(parameters, chains, data, mean)
    if not len(samples.change):
        return []
    names, free = parameters.names, parameters.free
    found = [np.array([v.get(name, x) for name, x in zip(names, rho, strict=True)]) for v in _drives(samples)]
    return [parameters.within_bounds(np.where(free, values, parameters.nominal)) for values in found]


def _drives(samples: _Samples) -> list[dict[str, float]]:
    """Drive and losses that are worth a fit, the best ones first."""
    linear = _linear(samples)
    limited = _limited(samples, linear)
    following = _following(samples)
    found = [{**linear, "effort": 1.0 / samples.largest}]
    losses = [_loss(_residual(samples, values)) for values in (limited, _as_limited(linear), following)]
    if losses[0] < CLEARLY_BETTER * losses[1]:
        found.insert(0, _named(limited))
    if losses[2] < FOLLOWING_MAX * losses[1]:
        found.append(_named(following))
    return [_with_coast(values) for values in found]


def _samples(parameters: Parameters, chains: Chains, data: SmoothedPoses, mean: Matrix) -> _Samples:
    rates, yaw = data.rates[chains.state], data.poses[chains.state, 2]
    v = rates[:, 0] * np.cos(yaw) + rates[:, 1] * np.sin(yaw)
    steps = max(1, round(SPAN / float(chains.h[0])))
    spans = [np.arange(begin, end - steps, max(1, steps // 2)) for begin, end in pairwise(chains.first_step)]
    begin = np.concatenate(spans).astype(np.int64)
    throttle = mean[:, list(parameters.vehicle.controls).index("throttle")]
    full, wheelbase = (float(parameters.nominal[parameters.index(name)]) for name in ("full_throttle", "L"))
    change = v[begin + steps] - v[begin]
    return _Samples(throttle / full, v, rates[:, 2], chains.h, begin, steps, change, wheelbase)


def _linear(samples: _Samples) -> dict[str, float]:
    """Drive and losses without a limit, none of them negative, with the best of some dead zones."""
    from scipy.optimize import nnls  # only identification from logs needs it, and it is slow to load

    best: tuple[float, dict[str, float]] = (np.inf, {})
    for dead_zone in DEAD_ZONES:
        u, v = _beyond(samples.throttle, dead_zone), samples.speed
        neutral = np.abs(u) < COASTING
        terms = {"a_drive": u, "back_emf": -np.abs(u) * v, "damping": -v, **samples.losses}
        if neutral.any() and not neutral.all():
            terms |= {"damping": np.where(neutral, 0.0, -v), "neutral_damping": np.where(neutral, -v, 0.0)}
        effects = np.column_stack([samples.over_spans(term) for term in terms.values()])
        scale = np.sqrt(np.mean(effects**2, axis=0)) + 1e-9
        for sign in (1.0, -1.0):
            signs = np.where(np.arange(len(scale)) == 0, sign, 1.0)
            found, left = nnls(effects / scale * signs, samples.change)
            if left < best[0]:
                values = found / scale * signs
                best = (left, {**dict(zip(terms, map(float, values), strict=True)), "dead_zone": dead_zone})
    return best[1]


def _limited(samples: _Samples, linear: dict[str, float]) -> Floats:
    """Values of `LIMITED` (10,) from the best of some limits of the acceleration."""
    starts = []
    for share in LIMITS:
        first = _as_limited(linear)
        drive, damping, neutral = (LIMITED.index(name) for name in ("a_drive", "damping", "neutral_damping"))
        first[drive] *= 2.0 if share < max(LIMITS) else 1.0  # a limit makes the drive seem weak
        first[damping], first[neutral] = max(first[damping], 0.5), max(first[neutral], 0.3)
        first[LIMITED.index("effort")] = 1.0 / (share * samples.largest)
        starts.append(_regressed(samples, first, POWERS[0], FIRST_EVALUATIONS))
    values = min(starts, key=lambda found: _loss(_residual(samples, found, POWERS[0])))
    for power in POWERS:
        values = _regressed(samples, values, power, EVALUATIONS)
    return values


def _following(samples: _Samples) -> Floats:
    """Values of `LIMITED` (10,) of a car whose speed follows the throttle, with the best of some dampings."""
    u, v = samples.throttle, samples.speed
    gain = float(u @ v) / max(float(u @ u), 1e-9)
    free = dict.fromkeys(set(LIMITED) - {"brake", "neutral_damping"}, 0.0)
    tried = [_as_limited({**free, "a_drive": damping * gain, "damping": damping}) for damping in FOLLOWING]
    return min(tried, key=lambda values: _loss(_residual(samples, values)))


def _regressed(samples: _Samples, first: Floats, power: int, evaluations: int) -> Floats:
    from scipy.optimize import least_squares  # as above

    def residual(values: Floats) -> Floats:
        return _residual(samples, values, power)

    margin = 1e-6 * (HIGH - LOW)
    begin = np.clip(first, LOW + margin, HIGH - margin)
    found: Floats = least_squares(
        residual, begin, bounds=(LOW, HIGH), loss="soft_l1", f_scale=OUTLIER, x_scale=TYPICAL, max_nfev=evaluations
    ).x
    return found


def _residual(samples: _Samples, values: Floats, power: int = POWERS[-1]) -> Floats:
    """(m,) change of the speed by values of `LIMITED`, less that of the car."""
    a, damping, neutral_damping, friction, drag, scrub, back_emf, brake, dead_zone, effort = values
    u, v = _beyond(samples.throttle, dead_zone), samples.speed
    push = a * u * np.where(a * u * v < 0.0, brake, 1.0)
    demand = push - (damping + back_emf * np.abs(u)) * v
    driven = demand / (1.0 + np.abs(effort * demand) ** power) ** (1.0 / power)
    driven = np.where(np.abs(u) < COASTING, -neutral_damping * v, driven)
    losses = samples.losses
    lost = friction * losses["friction"] + drag * losses["drag"] + scrub * losses["scrub"]
    return samples.over_spans(driven + lost) - samples.change


def _beyond(throttle: Floats, dead_zone: float) -> Floats:
    beyond: Floats = np.sign(throttle) * np.maximum(np.abs(throttle) - dead_zone, 0.0)
    return beyond


def _as_limited(linear: dict[str, float]) -> Floats:
    """Values of `LIMITED` (10,) without a limit."""
    return np.array([{"brake": 1.0, "neutral_damping": linear["damping"], "effort": 0.0, **linear}[n] for n in LIMITED])


def _named(values: Floats) -> dict[str, float]:
    """Values of `LIMITED` (10,) by their names."""
    return dict(zip(LIMITED, map(float, values), strict=True))


def _loss(residual: Floats) -> float:
    """Mean loss of the regression, in which outliers count less than squared."""
    return float(np.mean(np.sqrt(1.0 + (residual / OUTLIER) ** 2) - 1.0))


def _with_coast(values: dict[str, float]) -> dict[str, float]:
    """The values with `coast` instead of the damping at neutral throttle."""
    damping = values["damping"]
    coast = values.get("neutral_damping", damping) - damping
    rest = {name: value for name, value in values.items() if name != "neutral_damping"}
    return {**rest, "coast": max(coast, LEAST_COAST * damping)}
