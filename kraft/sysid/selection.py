"""Which extras the data show: those far from nothing, that matter, and that can be told from the rest.

Starting from all of them, the one that is least certain goes first, as the linearised graph sees it; then the rest is
fitted anew.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from kraft.sysid.parameters import Parameters
from kraft.sysid.uncertainty import Uncertainty
from ompl_ext.arrays import Floats, Matrix

AUTOMATIC: Final = {"delay": 0.01, "dead_band_throttle": 0.01, "dead_band_steering": 0.005, "lever": 0.01,
                    "yaw_offset": 0.005}  # fmt: skip
"""Extras that are tried, and the value below which one does not matter (s, 1, rad, m, rad)."""
SIGNIFICANT = 3.0
"""Standard deviations from nothing."""
TIGHTER = 0.5
"""Of the prior's standard deviation: data that say less than that do not show an extra."""


ALIKE = 0.985
"""Correlation with another parameter from which an extra is left out."""


def shown(parameters: Parameters, rho: Floats, uncertain: Uncertainty, asked: frozenset[str]) -> tuple[str, ...]:
    """Extras to keep; those `asked` for stay whatever the data say, and so do frozen ones."""
    names = [name for name, free in zip(parameters.names, parameters.free, strict=True) if free]
    value, covariance, graph = rho[parameters.free].copy(), uncertain.covariance.copy(), uncertain.graph.copy()
    prior = parameters.std[parameters.free]
    removable = {k for k, name in enumerate(names) if name in parameters.extras and name not in asked}
    dropped: set[str] = set()
    while removable:
        ratio = {
            k: 0.0 if _alike(graph, k) else _certainty(names[k], value[k], covariance[k, k], prior[k])
            for k in removable
        }
        worst = min(removable, key=lambda k: ratio[k])
        if ratio[worst] >= SIGNIFICANT:
            break
        gain = covariance[:, worst] / max(covariance[worst, worst], 1e-300)  # the rest, if this one is nothing
        value -= gain * value[worst]
        covariance -= np.outer(gain, covariance[worst])
        graph -= np.outer(graph[:, worst], graph[worst]) / max(graph[worst, worst], 1e-300)
        removable.remove(worst)
        dropped.add(names[worst])
    return tuple(name for name in parameters.extras if name not in dropped)


def _alike(covariance: Matrix, k: int) -> bool:
    """Whether a parameter cannot be told from another one that is still there."""
    variance = np.diag(covariance)
    there = variance > 0.0
    there[k] = False
    correlation = covariance[k, there] / np.sqrt(variance[k] * variance[there])
    return bool((np.abs(correlation) > ALIKE).any())


def _certainty(name: str, value: float, variance: float, prior: float) -> float:
    """Distance from nothing in standard deviations; 0 if the extra does not matter or is hardly known."""
    std = float(np.sqrt(max(variance, 0.0)))
    if abs(value) < AUTOMATIC[name] or std > TIGHTER * prior:
        return 0.0
    return abs(value) / max(std, 1e-300)
