"""Warnings about an identification; each names the manoeuvre to drive or the setting to change."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.sysid.initial_values import SmoothedPoses
from kraft.sysid.interface import AT_BOUND, CORRELATION_HIGH, correlations
from kraft.sysid.optimiser import Optimum, ParameterUncertainty
from kraft.sysid.parameters import Parameters, ParameterSpec
from kraft.sysid.problem import Problem, residual_ratio
from kraft.text import counted
from ompl_ext.arrays import Floats
from ompl_ext.times import SAME_TIME

if TYPE_CHECKING:
    from kraft.logs.log import Log

PRIOR_STD_RATIO = 0.7
"""Standard deviation by the stated noise over that of the prior, above which the data do not identify a parameter."""
RESIDUAL_RATIO_HIGH, RESIDUAL_RATIO_LOW = 2.0, 0.4
"""Ratio of the squared residual of a typical pose to its expectation under the stated noise."""
DISAGREEMENT_RATIO = 3.0
"""Ratio of the standard deviation between logs to that under the stated noise."""
STEERING_CORRELATION_LOW = 0.5
"""Correlation of steering and curvature below which they count as unrelated."""
STEERING_CORRELATION_PRESENT = 0.7
"""Correlation of steering and curvature above which a small steering signal counts as the cause of turning."""
MOVING_SPEED_SHARE = 0.3
"""Share of the highest speed below which curvature is not evaluated."""
STEERING_STD_MIN = 0.02
"""Least standard deviation of a steering signal that identifies anything, rad."""
STEERING_SPREAD_MIN, OTHER_SIDE = 0.03, 0.01
"""Least standard deviation of the steering, and least steering to a side, as shares of the largest one; and the share
of the poses that must have it."""
STEERING_CHANGES_MIN = 5.0
"""Least sum of all changes of the steering while the vehicle moves, over its range, that shows a lag of the wheels."""
MOVING_SHARE = 0.1
"""Share of the high speeds of a log above which the vehicle counts as moving."""
FOREIGN_THROTTLE: Final = 10.0
"""Largest throttle over that of the vehicle above which it is in another unit; speeds in m/s are within it."""
_ARCS: Final = "arcs to the left and to the right, of several radii"
_THROTTLE_STEPS: Final = "steps of the throttle up and down, from rest and back to it"
_THROTTLE_LEVELS: Final = "several constant throttles, low ones too, for some seconds each"
_COMMAND_CHANGES: Final = "sudden changes of the commands while driving"
_RETURNS: Final = "steering to either side and back to straight, held for a second each"
_MANOEUVRES: Final = {
    "L": _ARCS,
    "phi_diff": _ARCS,
    "v_delta": _THROTTLE_LEVELS,
    "tau": _THROTTLE_STEPS,
    "u_0": _THROTTLE_LEVELS,
    "delay": _COMMAND_CHANGES,
    "friction": _THROTTLE_STEPS,
    "dead_band_throttle": _THROTTLE_LEVELS,
    "dead_band_steering": _ARCS,
    "play_steering": _RETURNS,
    "lever": _ARCS,
    "side": _ARCS,
    "yaw_offset": _ARCS,
}


@dataclass(frozen=True)
class SteeringInMotion:
    """What logs show of the steering: its commands while the vehicle moves.

    Attributes:
        varies: whether there are several, and not one alone.
        both_sides: whether they are to both sides.
        changes: whether they change during the motion, so that lags of the steering show.
    """

    varies: bool = True
    both_sides: bool = True
    changes: bool = True

    @classmethod
    def of(cls, logs: Sequence[Log]) -> SteeringInMotion:
        """Of logs of one vehicle; for one without steering nothing is missing."""
        if "steering" not in logs[0].controls:
            return cls()
        commands, moved, turned = [], [], 0.0
        for log in logs:
            k = log.controls.index("steering")
            ways = [np.hypot(*np.diff(part.poses[:, :2], axis=0).T) for part in log.parts]
            least = MOVING_SHARE * np.quantile(np.concatenate(ways), 0.95)
            for part, way in zip(log.parts, ways, strict=True):
                at = np.searchsorted(part.command_times, part.pose_times, side="right") - 1
                own = part.commands[np.maximum(at, 0), k]
                moving = way > least
                turned += float(np.abs(np.diff(own))[moving].sum())
                commands.append(own[1:][moving])
                moved.append(way[moving])
        given, weight = np.concatenate(commands), np.concatenate(moved)
        if not weight.sum() > 0.0:
            return cls()
        full, mean = float(np.abs(given).max()), float(np.average(given, weights=weight))
        spread = math.sqrt(float(np.average((given - mean) ** 2, weights=weight)))
        low, high = np.quantile(given, [OTHER_SIDE, 1.0 - OTHER_SIDE])
        return cls(
            varies=spread > STEERING_SPREAD_MIN * full,
            both_sides=bool(low < -STEERING_SPREAD_MIN * full and high > STEERING_SPREAD_MIN * full),
            changes=turned > STEERING_CHANGES_MIN * float(high - low),
        )


@dataclass(frozen=True, eq=False)
class SolvedProblem:
    """A solved problem with its data: what the checks and the result are made from."""

    problem: Problem
    optimum: Optimum
    uncertainty: ParameterUncertainty
    data: SmoothedPoses
    logs: Sequence[str]
    """names"""
    noise_measured: bool
    iterations: int
    """of the optimiser, those of model selection included"""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the estimated parameters."""
        return self.problem.parameters.free_names


def warnings_of(solution: SolvedProblem, *, windows: bool = False) -> tuple[str, ...]:
    """All warnings, the most important first.

    With `windows`, those of a fit of open-loop windows: its residuals are the model's errors and no noise, and how well
    its terms are known shows in its predictions.
    """
    checks: list[Callable[[SolvedProblem], Iterator[str]]] = [
        _steering,  # why a fit fails comes before how
        _throttle,
        _convergence,
        _bounds,
        _negative_delay,
    ]
    if not windows:
        checks += [_unidentified, _unbounded, _correlation, _residuals, _disagreement]
    return tuple(warning for check in checks for warning in check(solution))


def at_bound(solution: SolvedProblem) -> dict[str, str]:
    """Parameters at a bound, with `lower` or `upper`."""
    p = solution.problem.parameters
    margin = AT_BOUND * (p.high - p.low)
    rho = solution.optimum.point.rho
    found = {}
    for k, name in enumerate(p.names):
        if p.free[k] and (rho[k] <= p.low[k] + margin[k] or rho[k] >= p.high[k] - margin[k]):
            found[name] = "lower" if rho[k] <= p.low[k] + margin[k] else "upper"
    return found


def unidentified(solution: SolvedProblem) -> tuple[str, ...]:
    """Parameters whose uncertainty the data hardly reduce below that of the prior."""
    p = solution.problem.parameters
    prior = p.std[p.free]
    std = np.sqrt(np.diag(solution.uncertainty.graph))
    return tuple(name for name, a, b in zip(solution.names, std, prior, strict=True) if a > PRIOR_STD_RATIO * b)


def _convergence(solution: SolvedProblem) -> Iterator[str]:
    if not solution.optimum.converged:
        yield (
            f"the optimiser had not converged after {counted(solution.iterations, 'iteration')}: values and intervals "
            "are where it stopped; freeze parameters that the logs do not identify, or exclude auxiliary parameters"
        )


def _bounds(solution: SolvedProblem) -> Iterator[str]:
    for spec, which, bound in _at_bounds(solution):
        if not (_is_off(spec, bound) or _is_a_step(solution, spec, bound)):
            yield (
                f"{spec.name} is at its {which} bound {bound:g}{spec.unit_text}: widen the bound if it is wrong; "
                "otherwise the model lacks an effect that the parameter compensates for"
            )


def notes_of(solution: SolvedProblem) -> Iterator[str]:
    """What parameters at a bound tell, if nothing is to be done about it."""
    for spec, which, bound in _at_bounds(solution):
        at = f"{spec.name} is {bound:g}{spec.unit_text if bound else ''}, its {which} bound"
        if _is_off(spec, bound):
            yield f"{at}: the data show no such effect, and a model without it suffices"
        elif _is_a_step(solution, spec, bound):
            yield (
                f"{at} and the shortest lag that the model has: that of the vehicle is the same or shorter, and the "
                "delay and other terms may make up for the difference"
            )


def _at_bounds(solution: SolvedProblem) -> Iterator[tuple[ParameterSpec, str, float]]:
    """Parameters at a bound, which one, and its value."""
    p = solution.problem.parameters
    for name, which in at_bound(solution).items():
        spec = p.specs[p.index(name)]
        yield spec, which, spec.min if which == "lower" else spec.max


def _is_off(spec: ParameterSpec, bound: float) -> bool:
    """Whether a bound is where the parameter has no effect."""
    return bound in (0.0, spec.neutral)


def _is_a_step(solution: SolvedProblem, spec: ParameterSpec, bound: float) -> bool:
    """Whether a bound is the shortest lag that the steps of the model allow."""
    return spec.unit == "s" and 0.0 < bound <= float(solution.problem.chains.h.max()) + SAME_TIME


def _throttle(solution: SolvedProblem) -> Iterator[str]:
    controls = list(solution.problem.parameters.vehicle.controls)
    if "throttle" in controls:
        k = controls.index("throttle")
        values = np.concatenate([s.part.commands[:, k] for s in solution.problem.chains.segments])
        if np.ptp(values) == 0.0:
            yield f"the throttle is always {values[0]:g}: drive {_THROTTLE_LEVELS}"
        low, high = solution.problem.parameters.vehicle.controls["throttle"]
        largest = float(values[np.argmax(np.abs(values))])
        if abs(largest) > FOREIGN_THROTTLE * max(abs(low), abs(high)):
            yield (
                f"the throttle reaches {largest:g}, and the vehicle takes {low:g} to {high:g}: state the unit in a "
                "mapping file, as in commands.controls.throttle: {column: ..., scale: 0.01} for per cent"
            )


def _negative_delay(solution: SolvedProblem) -> Iterator[str]:
    p = solution.problem.parameters
    k = p.auxiliary_index("delay")
    delay = float(solution.optimum.point.rho[k]) if k >= 0 and p.free[k] else 0.0
    if delay < 0.0 and "delay" not in at_bound(solution):
        yield (
            f"the vehicle responds {-1000.0 * delay:.0f} ms before its commands were recorded: their clock is ahead of "
            "that of the poses, or each record is of an older command; state the offset in a mapping file "
            f"(commands.time: {{column: ..., zero: {-delay:.2g}}}, in the unit of the column)"
        )


def _unidentified(solution: SolvedProblem) -> Iterator[str]:
    p = solution.problem.parameters
    for name in unidentified(solution):
        yield (
            f"the logs do not identify {name}: its uncertainty is hardly smaller than before; "
            f"drive {informative_manoeuvres(p, name)}, or freeze it"
        )


def _unbounded(solution: SolvedProblem) -> Iterator[str]:
    p = solution.problem.parameters
    known = {*at_bound(solution), *unidentified(solution)}  # these have warnings of their own
    half = solution.uncertainty.quantile * solution.uncertainty.std
    values = solution.optimum.point.rho[p.free]
    for name, value, reach in zip(solution.names, values, half, strict=True):
        spec = p.specs[p.index(name)]
        if name in known or spec.min <= value - reach <= value + reach <= spec.max:
            continue
        yield (
            f"the data do not bound {name}: its 95 % interval, {value - reach:.3g} to {value + reach:.3g}, "
            f"reaches beyond its bounds {spec.min:g} to {spec.max:g}{spec.unit_text} and is truncated there; "
            f"drive {informative_manoeuvres(p, name)}, or freeze it"
        )


def _correlation(solution: SolvedProblem) -> Iterator[str]:
    reported, stated = correlations(solution.uncertainty.covariance), correlations(solution.uncertainty.graph)
    lasting = lasting_correlations(solution.uncertainty)
    names = solution.names
    for i, j in zip(*np.nonzero(np.tri(len(names), k=-1)), strict=True):
        # either correlation counts; the reported one has precedence
        by_noise = abs(lasting[i, j]) <= CORRELATION_HIGH
        found = stated[i, j] if by_noise else reported[i, j]
        if abs(found) > CORRELATION_HIGH:
            yield (
                f"{names[j]} and {names[i]} are nearly indistinguishable (correlation {found:.2f}"
                f"{' under the stated noise' if by_noise else ''}): drive "
                f"{informative_manoeuvres(solution.problem.parameters, names[j], names[i])}, or freeze one of them"
            )


def lasting_correlations(uncertainty: ParameterUncertainty) -> Floats:
    """(free, free) reported correlations, of those between logs the smallest in magnitude without any one log.

    One log that differs from the others, such as one of another car, moves all parameters together.
    """
    found = correlations(uncertainty.covariance)
    if uncertainty.kind == "graph":
        return found
    for k in range(len(uncertainty.shifts)):
        others = np.delete(uncertainty.shifts, k, axis=0)
        without = correlations(np.cov(others, rowvar=False, ddof=0).reshape(found.shape))
        # not a number, and so not smaller, where the others agree to the last bit
        found = np.where(np.abs(without) < np.abs(found), without, found)
    return found


def _residuals(solution: SolvedProblem) -> Iterator[str]:
    ratio = residual_ratio(solution.problem, solution.optimum.point)
    whose = "measured" if solution.noise_measured else "stated"
    noise = solution.problem.noise.noise
    expectation = (
        f"expected under the {whose} noise ({noise.position:.3g} m, {noise.yaw:.3g} rad) and the process noise"
    )
    if ratio > RESIDUAL_RATIO_HIGH:
        yield (
            f"residuals are {np.sqrt(ratio):.1f} times as large as {expectation}: one of the two is stated too small, "
            "or the model lacks an effect"
        )
    elif ratio < RESIDUAL_RATIO_LOW:
        yield f"residuals are {np.sqrt(ratio):.2f} times as large as {expectation}: one of the two is stated too large"


def _disagreement(solution: SolvedProblem) -> Iterator[str]:
    if solution.uncertainty.kind != "sandwich" or not solution.names:
        return
    graph = np.sqrt(np.diag(solution.uncertainty.graph))
    ratio = solution.uncertainty.std / graph
    worst = int(np.argmax(ratio))
    if ratio[worst] > DISAGREEMENT_RATIO:
        odd = int(np.argmax(np.abs(solution.uncertainty.shifts[:, worst])))
        share = solution.uncertainty.shifts[odd, worst] ** 2 / max(
            np.sum(solution.uncertainty.shifts[:, worst] ** 2), 1e-300
        )
        deviating = f"; {solution.logs[odd]} differs most" if share > 2.0 / len(solution.logs) else ""
        yield (
            f"the logs disagree about {solution.names[worst]}, {ratio[worst]:.1f} times the uncertainty "
            f"under the stated noise{deviating}: something changed between them, or the model lacks an effect"
        )


def _steering(solution: SolvedProblem) -> Iterator[str]:
    vehicle = solution.problem.parameters.vehicle
    controls = list(vehicle.controls)
    if "steering" not in controls or vehicle.index("theta") < 0:
        return
    steering = solution.problem.actuators.mean(solution.optimum.point.rho)[0][:, controls.index("steering")]
    at = solution.problem.chains.state
    rates, yaw = solution.data.rates[at], solution.data.poses[at, 2]
    speed = rates[:, 0] * np.cos(yaw) + rates[:, 1] * np.sin(yaw)
    moving = np.abs(speed) > MOVING_SPEED_SHARE * np.quantile(np.abs(speed), 0.95)
    enough = moving.sum() >= 10
    full = vehicle.parameters.get("full_steering")  # of a car whose commands are in any unit
    least = STEERING_STD_MIN if full is None else STEERING_SPREAD_MIN * full
    correlation = _best_correlation(steering, rates[:, 2] / np.where(moving, speed, 1.0), moving) if enough else 0.0
    if not enough or np.std(steering[moving]) < least:
        low, high = (float(np.min(steering)), float(np.max(steering))) if len(steering) else (0.0, 0.0)
        hint = (
            "nevertheless the vehicle turns with it: were radians taken for degrees?"
            if full is None and abs(correlation) > STEERING_CORRELATION_PRESENT
            else "drive arcs to the left and to the right"
        )
        unit = " rad" if full is None else ""
        yield f"the steering hardly changes while driving ({low:.2g} to {high:.2g}{unit}): {hint}"
        return
    if correlation < -STEERING_CORRELATION_LOW:
        yield f"steering and curvature have opposite signs (correlation {correlation:.2f}): is positive to the left?"
    elif correlation < STEERING_CORRELATION_LOW:
        yield (
            f"steering does not correlate with curvature (correlation {correlation:.2f}): are commands and poses of "
            "the same drive, on the same clock, the steering in radians?"
        )
    elif np.min(steering[moving]) > -least or np.max(steering[moving]) < least:
        side = "left" if np.min(steering[moving]) > -least else "right"
        yield f"the vehicle only steers to the {side}: drive arcs to the left and to the right"


def _best_correlation(steering: Floats, curvature: Floats, moving: Floats) -> float:
    """Rank correlation, robust to outliers; the largest in magnitude over delays of up to half a second."""
    best = 0.0
    for shift in range(0, 11, 2):
        chosen = moving[shift:]
        if chosen.sum() < 2:  # of a short log nothing is left
            break
        a = _ranks(steering[: len(steering) - shift][chosen])
        b = _ranks(curvature[shift:][chosen])
        value = float(np.corrcoef(a, b)[0, 1]) if np.std(a) > 0.0 and np.std(b) > 0.0 else 0.0
        best = value if abs(value) > abs(best) else best
    return best


def _ranks(values: Floats) -> Floats:
    """(n,) ranks, equal ones for equal values."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    ranks: Floats = (last - 0.5 * (counts - 1))[place]
    return ranks


def informative_manoeuvres(parameters: Parameters, *names: str) -> str:
    """Manoeuvres that identify the named parameters, as part of a sentence."""
    controls = ", ".join(parameters.vehicle.controls)
    general = f"steps of each command ({controls}) one at a time, at several levels and of both signs"
    found = dict.fromkeys(_of(name, general) for name in names)
    return " and ".join(found)


def _of(name: str, general: str) -> str:
    return _COMMAND_CHANGES if name.startswith(("delay_", "lag_")) else _MANOEUVRES.get(name, general)
