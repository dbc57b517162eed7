"""Which extras the data show: those far from nothing, that matter, and that can be told from the rest.

Starting from all of them, those that are not go one after the other, as the linearised graph sees it: first the one
without which the others explain the data best.  Then the rest is fitted anew.  An extra is as uncertain as the noise
lets expect or the logs disagree about it, whichever is more: few logs may agree by chance about what they hardly show.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from kraft.sysid.auxiliary import extras_of, moves
from kraft.sysid.parameters import Parameters
from kraft.sysid.settings import Settings
from kraft.sysid.uncertainty import Uncertainty, inverse
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle

AUTOMATIC: Final = {"delay": 0.01, "lag_throttle": 0.01, "lag_steering": 0.01, "dead_band_throttle": 0.01,
                    "dead_band_steering": 0.005, "friction": 0.01, "lever": 0.01, "yaw_offset": 0.005}  # fmt: skip
"""Extras that are tried, and the value below which one does not matter (s, s, s, 1, rad, 1, m, rad)."""
SIGNIFICANT = 3.0
"""Standard deviations from nothing."""
TIGHTER = 0.5
"""Of the prior's standard deviation: data that say less than that do not show an extra."""
UNTOLD = 0.985
"""Correlation with another parameter from which an extra is not told from it, and left out."""


def asked_for(settings: Settings) -> frozenset[str]:
    """Names that are given a value or frozen: extras of these names stay whatever the data say."""
    return frozenset(settings.values) | frozenset(settings.frozen)


def to_try(vehicle: Vehicle, settings: Settings) -> tuple[str, ...]:
    """Extras that are in the first fit."""
    known, wanted = extras_of(vehicle), settings.extras
    if wanted == "none":
        return ()
    if isinstance(wanted, tuple):
        return tuple(name for name in known if name in wanted)
    names = {name for name in AUTOMATIC if wanted == "auto" or not moves(name)} | asked_for(settings)
    return tuple(name for name in known if name in names)


def not_sought(vehicle: Vehicle, settings: Settings) -> tuple[str, ...]:
    """Extras that would be in the first fit but for planning, which does not know them."""
    if settings.extras != "plan":
        return ()
    tried = to_try(vehicle, settings)
    return tuple(name for name in extras_of(vehicle) if name in AUTOMATIC and name not in tried)


def choice(tried: tuple[str, ...], kept: tuple[str, ...], asked: frozenset[str]) -> str:
    """What became of the extras that were tried: those that were asked for say nothing about the data."""
    if not tried:
        return "there are no extra parameters for this vehicle"
    given = [name for name in kept if name in asked]
    seen = [name for name in kept if name not in asked]
    dropped = [name for name in tried if name not in kept]
    said = [f"asked for, and kept: {', '.join(given)}"] if given else []
    if seen:
        said.append(f"the data show {', '.join(seen)}")
    elif dropped:
        said.append(f"the data show no {'other ' if given else ''}extra parameter")
    if dropped:
        said.append(f"not shown, and left out: {', '.join(dropped)}")
    return "; ".join(said)


def shown(parameters: Parameters, rho: Floats, uncertain: Uncertainty, asked: frozenset[str]) -> tuple[str, ...]:
    """Extras to keep; those `asked` for stay whatever the data say, and so do frozen ones."""
    names = [name for name, free in zip(parameters.names, parameters.free, strict=True) if free]
    prior = dict(zip(parameters.names, parameters.std, strict=True))
    left = list(range(len(names)))
    while True:
        value, graph, covariance = _refitted(rho[parameters.free], uncertain, left)
        variance = np.maximum(np.diag(covariance), np.diag(graph))
        doubtful = [
            i
            for i, name in enumerate(names[k] for k in left)
            if name in parameters.extras and name not in asked
            and (_untold(graph, i) or not _certain(name, value[i], variance[i], prior[name]))
        ]  # fmt: skip
        if not doubtful:
            break
        del left[min(doubtful, key=lambda i: value[i] ** 2 / graph[i, i])]
    dropped = set(names) - {names[k] for k in left}
    return tuple(name for name in parameters.extras if name not in dropped)


def _refitted(rho: Floats, uncertain: Uncertainty, left: list[int]) -> tuple[Floats, Matrix, Matrix]:
    """Values (left,) of those that are left if the others were nothing; covariances by the graph and as reported."""
    information = inverse(uncertain.graph)
    graph = inverse(information[np.ix_(left, left)])
    follow = graph @ information[left]  # how they follow what is taken away
    follow[:, left] = np.eye(len(left))
    moving = uncertain.covariance * np.outer(~uncertain.held, ~uncertain.held)
    return follow @ rho, graph, follow @ moving @ follow.T if uncertain.kind == "sandwich" else graph


def _untold(covariance: Matrix, k: int) -> bool:
    """Whether a parameter is not told from another one."""
    std = np.sqrt(np.diag(covariance))
    along = np.abs(covariance[k]) > UNTOLD * std[k] * std
    return bool(along.sum() > along[k])


def _certain(name: str, value: float, variance: float, prior: float) -> bool:
    """Whether an extra is far from nothing, matters, and is known better than before."""
    std = float(np.sqrt(variance))
    return abs(value) >= max(AUTOMATIC[name], SIGNIFICANT * std) and std <= TIGHTER * prior
