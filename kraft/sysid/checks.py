"""What is doubtful about an identification, said in sentences that name what to drive or to change."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.sysid.optimiser import Optimum
from kraft.sysid.parameters import Parameters
from kraft.sysid.problem import Problem, residual_ratio
from kraft.sysid.result import AT_BOUND, correlations
from kraft.sysid.start import Smooth
from kraft.sysid.uncertainty import Uncertainty
from kraft.text import counted
from ompl_ext.arrays import Floats

HARDLY_TOLD = 0.95
"""Correlation from which two parameters are hardly told apart: a warning.  From `selection.UNTOLD` an extra goes, and
from `verdict.SAME` the parameters are not identified."""
NOT_TIGHTER = 0.7
"""Share of the prior's standard deviation that the data must stay below."""
TOO_LARGE, TOO_SMALL = 2.0, 0.4
"""Mean squared residual, in those that the noise lets expect."""
DISAGREE = 3.0
"""Standard deviations by the logs, in those by the stated noise."""
UNRELATED = 0.5
"""Correlation of steering and curvature."""
TURNS_WITH = 0.7
"""Correlation from which the vehicle turns with the steering, however little that is said to be."""
SLOW = 0.3
"""Share of the highest speed below which curvature is not looked at."""
STEERS = 0.02
"""Standard deviation of a steering that shows anything, rad."""


@dataclass(frozen=True, eq=False)
class Case:
    """Everything that the checks look at."""

    problem: Problem
    optimum: Optimum
    uncertain: Uncertainty
    data: Smooth
    logs: Sequence[str]
    """names"""
    noise_measured: bool
    iterations: int
    """of the optimiser, trying extras included"""

    @property
    def names(self) -> list[str]:
        """Of the parameters that were estimated."""
        parameters = self.problem.parameters
        return [name for name, free in zip(parameters.names, parameters.free, strict=True) if free]


def warnings_of(case: Case) -> tuple[str, ...]:
    """All that is doubtful, most important first."""
    checks = (_convergence, _steering, _bounds, _prior, _open, _correlation, _residuals, _disagreement)
    return tuple(warning for check in checks for warning in check(case))


def at_bound(case: Case) -> dict[str, str]:
    """Parameters at a bound and which one it is; 0 of an extra that cannot be negative is none."""
    p = case.problem.parameters
    margin = AT_BOUND * (p.high - p.low)
    rho = case.optimum.point.rho
    found = {}
    for k, name in enumerate(p.names):
        if p.free[k] and (rho[k] <= p.low[k] + margin[k] or rho[k] >= p.high[k] - margin[k]):
            found[name] = "lower" if rho[k] <= p.low[k] + margin[k] else "upper"
    return found


def unidentified(case: Case) -> tuple[str, ...]:
    """Parameters of the model about which the data say next to nothing beyond the prior."""
    p = case.problem.parameters
    prior = p.std[p.free]
    std = np.sqrt(np.diag(case.uncertain.graph))
    return tuple(name for name, a, b in zip(case.names, std, prior, strict=True) if a > NOT_TIGHTER * b)


def _convergence(case: Case) -> Iterator[str]:
    if not case.optimum.converged:
        yield (
            f"the optimiser had not converged after {counted(case.iterations, 'iteration')}: values and intervals are "
            "where it stopped; freeze parameters that the logs do not show, or leave out extra ones (extras none)"
        )


def _bounds(case: Case) -> Iterator[str]:
    p = case.problem.parameters
    for name, which in at_bound(case).items():
        number = p.numbers[p.index(name)]
        if name in p.extras and number.min == 0.0 and which == "lower":
            yield f"{name} is 0, the least it can be: the data show none"
            continue
        bound = number.min if which == "lower" else number.max
        yield (
            f"{name} is at its {which} bound {bound:g} {number.unit}".rstrip()
            + ": widen the bound if it is wrong, else the model lacks something that this parameter stands in for"
        )


def _prior(case: Case) -> Iterator[str]:
    p = case.problem.parameters
    for name in unidentified(case):
        yield (
            f"{name} is known no better than before: the logs do not show it; drive {lacking(p, name)}, or freeze it"
        )


def _open(case: Case) -> Iterator[str]:
    p, known = case.problem.parameters, {*at_bound(case), *unidentified(case)}  # those have warnings of their own
    half = case.uncertain.quantile * case.uncertain.std
    values = case.optimum.point.rho[p.free]
    for name, value, reach in zip(case.names, values, half, strict=True):
        number = p.numbers[p.index(name)]
        if name in known or number.min <= value - reach <= value + reach <= number.max:
            continue
        yield (
            f"the data do not bound {name}: its 95 % interval, {value - reach:.3g} to {value + reach:.3g}, "
            f"reaches beyond its bounds {number.min:g} to {number.max:g} {number.unit}".rstrip()
            + f" and is cut there; drive {lacking(p, name)}, or freeze it"
        )


def _correlation(case: Case) -> Iterator[str]:
    reported, stated = correlations(case.uncertain.covariance), correlations(case.uncertain.graph)
    names = case.names
    for i, j in zip(*np.nonzero(np.tri(len(names), k=-1)), strict=True):
        # either says that one makes up for the other; the one that is reported is named first
        by_noise = abs(reported[i, j]) <= HARDLY_TOLD
        found = stated[i, j] if by_noise else reported[i, j]
        if abs(found) > HARDLY_TOLD:
            yield (
                f"{names[j]} and {names[i]} are hardly told apart (correlation {found:.2f}"
                f"{' by the stated noise' if by_noise else ''}): drive "
                f"{lacking(case.problem.parameters, names[j], names[i])}, or freeze one of them"
            )


def _residuals(case: Case) -> Iterator[str]:
    ratio = residual_ratio(case.problem, case.optimum.point)
    whose = "measured" if case.noise_measured else "stated"
    noise = case.problem.noise.noise
    said = f"the {whose} noise ({noise.position:.3g} m, {noise.yaw:.3g} rad) and the process noise"
    if ratio > TOO_LARGE:
        yield (
            f"residuals are {np.sqrt(ratio):.1f} times as large as {said} let expect: one is stated too small, or "
            "the model lacks something"
        )
    elif ratio < TOO_SMALL:
        yield f"residuals are {np.sqrt(ratio):.2f} times as large as {said} let expect: one is stated too large"


def _disagreement(case: Case) -> Iterator[str]:
    if case.uncertain.kind != "sandwich" or not case.names:
        return
    graph = np.sqrt(np.diag(case.uncertain.graph))
    ratio = case.uncertain.std / graph
    worst = int(np.argmax(ratio))
    if ratio[worst] > DISAGREE:
        odd = int(np.argmax(np.abs(case.uncertain.moves[:, worst])))
        share = case.uncertain.moves[odd, worst] ** 2 / max(np.sum(case.uncertain.moves[:, worst] ** 2), 1e-300)
        said = f"; {case.logs[odd]} differs most" if share > 2.0 / len(case.logs) else ""
        yield (
            f"the logs disagree about {case.names[worst]}, {ratio[worst]:.1f} times what noise explains{said}: "
            "something changed between them, or the model lacks something"
        )


def _steering(case: Case) -> Iterator[str]:
    vehicle = case.problem.parameters.vehicle
    controls = list(vehicle.controls)
    if "steering" not in controls or vehicle.index("theta") < 0:
        return
    steering = case.problem.commands.mean(case.optimum.point.rho)[0][:, controls.index("steering")]
    at = case.problem.chains.state
    rates, yaw = case.data.rates[at], case.data.poses[at, 2]
    speed = rates[:, 0] * np.cos(yaw) + rates[:, 1] * np.sin(yaw)
    moving = speed > SLOW * np.quantile(speed, 0.95)
    enough = moving.sum() >= 10
    correlation = _best_correlation(steering, rates[:, 2] / np.where(moving, speed, 1.0), moving) if enough else 0.0
    if not enough or np.std(steering[moving]) < STEERS:
        low, high = (float(np.min(steering)), float(np.max(steering))) if len(steering) else (0.0, 0.0)
        hint = (
            "the vehicle turns with it all the same: were radians taken for degrees?"
            if abs(correlation) > TURNS_WITH
            else "drive arcs to the left and to the right"
        )
        yield f"the steering hardly changes while driving ({low:.2f} to {high:.2f} rad): {hint}"
        return
    if correlation < -UNRELATED:
        yield f"steering and curvature have opposite signs (correlation {correlation:.2f}): is positive to the left?"
    elif correlation < UNRELATED:
        yield (
            f"steering does not correlate with curvature (correlation {correlation:.2f}): are commands and poses of "
            "the same drive, on the same clock, the steering in radians?"
        )
    elif np.min(steering[moving]) > -STEERS or np.max(steering[moving]) < STEERS:
        side = "left" if np.min(steering[moving]) > -STEERS else "right"
        yield f"the vehicle only steers to the {side}: drive arcs to the left and to the right"


def _best_correlation(steering: Floats, curvature: Floats, moving: Floats) -> float:
    """Rank correlation (outliers do not count), the largest in size over delays of up to half a second."""
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
    """Ranks, equal for equal values."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: Floats = (np.cumsum(counts) - 0.5 * counts)[inverse]
    return ranks


_TURNS: Final = "arcs to the left and to the right, of several radii"
_STEPS: Final = "steps of the throttle up and down, from rest and back to it"
_LEVELS: Final = "stretches at several constant throttles, low ones too"
_CHANGES: Final = "sudden changes of the commands while driving"
_KNOWN: Final = {
    "L": _TURNS,
    "phi_diff": _TURNS,
    "v_delta": _LEVELS,
    "tau": _STEPS,
    "u_0": _LEVELS,
    "delay": _CHANGES,
    "friction": _STEPS,
    "dead_band_throttle": _LEVELS,
    "dead_band_steering": _TURNS,
    "lever": _TURNS,
    "side": _TURNS,
    "yaw_offset": _TURNS,
}


def lacking(parameters: Parameters, *names: str) -> str:
    """The manoeuvres that would show some parameters, for a sentence."""
    controls = ", ".join(parameters.vehicle.controls)
    general = f"steps of each command ({controls}) one at a time, at several levels and of both signs"
    found = dict.fromkeys(_of(name, general) for name in names)
    return " and ".join(found)


def _of(name: str, general: str) -> str:
    return _CHANGES if name.startswith(("delay_", "lag_")) else _KNOWN.get(name, general)
