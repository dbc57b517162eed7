"""Which extras the data show: those far from nothing, that matter, and that can be told from the rest.

Starting from all of them, those that are not go one after the other, as the linearised graph sees it: first the one
without which the others explain the data best.  Then the rest is fitted anew.  An extra is as uncertain as the noise
lets expect or the logs disagree about it, whichever is more: few logs may agree by chance about what they hardly show.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from kraft.sysid.auxiliary import affects_motion, auxiliary_parameters
from kraft.sysid.parameters import Parameters
from kraft.sysid.result import CORRELATION_REMOVED
from kraft.sysid.settings import Settings
from kraft.sysid.uncertainty import Uncertainty, inverse
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle

NEGLIGIBLE: Final = {"delay": 0.01, "lag_throttle": 0.01, "lag_steering": 0.01, "dead_band_throttle": 0.01,
                    "dead_band_steering": 0.005, "friction": 0.01, "lever": 0.01, "yaw_offset": 0.005}  # fmt: skip
"""Extras that are tried, and the value below which one does not matter (s, s, s, 1, rad, 1, m, rad)."""
SIGNIFICANCE = 3.0
"""Standard deviations from nothing."""
STD_RATIO_MAX = 0.5
"""Of the prior's standard deviation: data that say less than that do not show an extra."""


def requested_names(settings: Settings) -> frozenset[str]:
    """Names that are given a value or frozen: extras of these names stay whatever the data say."""
    return frozenset(settings.values) | frozenset(settings.frozen)


def candidates_of(vehicle: Vehicle, settings: Settings) -> tuple[str, ...]:
    """Extras that are in the first fit."""
    known, wanted = auxiliary_parameters(vehicle), settings.auxiliary
    if wanted == "none":
        return ()
    if isinstance(wanted, tuple):
        return tuple(name for name in known if name in wanted)
    names = {name for name in NEGLIGIBLE if wanted == "auto" or not affects_motion(name)} | requested_names(settings)
    return tuple(name for name in known if name in names)


def excluded_for_planning(vehicle: Vehicle, settings: Settings) -> tuple[str, ...]:
    """Extras that would be in the first fit but for planning, which does not know them."""
    if settings.auxiliary != "plan":
        return ()
    candidates = candidates_of(vehicle, settings)
    return tuple(name for name in auxiliary_parameters(vehicle) if name in NEGLIGIBLE and name not in candidates)


def selection_note(candidates: tuple[str, ...], kept: tuple[str, ...], requested: frozenset[str]) -> str:
    """What became of the extras that were tried: those that were asked for say nothing about the data."""
    if not candidates:
        return "there are no extra parameters for this vehicle"
    given = [name for name in kept if name in requested]
    seen = [name for name in kept if name not in requested]
    dropped = [name for name in candidates if name not in kept]
    said = [f"asked for, and kept: {', '.join(given)}"] if given else []
    if seen:
        said.append(f"the data show {', '.join(seen)}")
    elif dropped:
        said.append(f"the data show no {'other ' if given else ''}extra parameter")
    if dropped:
        said.append(f"not shown, and left out: {', '.join(dropped)}")
    return "; ".join(said)


def selected(
    parameters: Parameters, rho: Floats, uncertainty: Uncertainty, requested: frozenset[str]
) -> tuple[str, ...]:
    """Extras to keep; those `requested` for stay whatever the data say, and so do frozen ones."""
    names = [name for name, free in zip(parameters.names, parameters.free, strict=True) if free]
    prior = dict(zip(parameters.names, parameters.std, strict=True))
    remaining = list(range(len(names)))
    while True:
        value, graph, covariance = _reduced(rho[parameters.free], uncertainty, remaining)
        variance = np.maximum(np.diag(covariance), np.diag(graph))
        removable = [
            i
            for i, name in enumerate(names[k] for k in remaining)
            if name in parameters.auxiliary and name not in requested
            and (_indistinguishable(graph, i) or not _significant(name, value[i], variance[i], prior[name]))
        ]  # fmt: skip
        if not removable:
            break
        del remaining[min(removable, key=lambda i: value[i] ** 2 / graph[i, i])]
    dropped = set(names) - {names[k] for k in remaining}
    return tuple(name for name in parameters.auxiliary if name not in dropped)


def _reduced(rho: Floats, uncertainty: Uncertainty, remaining: list[int]) -> tuple[Floats, Matrix, Matrix]:
    """Values (left,) of those that are left if the others were nothing; covariances by the graph and as reported."""
    information = inverse(uncertainty.graph)
    graph = inverse(information[np.ix_(remaining, remaining)])
    follow = graph @ information[remaining]  # how they follow what is taken away
    follow[:, remaining] = np.eye(len(remaining))
    moving = uncertainty.covariance * np.outer(~uncertainty.held, ~uncertainty.held)
    return follow @ rho, graph, follow @ moving @ follow.T if uncertainty.kind == "sandwich" else graph


def _indistinguishable(covariance: Matrix, k: int) -> bool:
    """Whether a parameter is not told from another one."""
    std = np.sqrt(np.diag(covariance))
    along = np.abs(covariance[k]) > CORRELATION_REMOVED * std[k] * std
    return bool(along.sum() > along[k])


def _significant(name: str, value: float, variance: float, prior: float) -> bool:
    """Whether an extra is far from nothing, matters, and is known better than before."""
    std = float(np.sqrt(variance))
    return abs(value) >= max(NEGLIGIBLE[name], SIGNIFICANCE * std) and std <= STD_RATIO_MAX * prior
