"""Whether an identification may be used: a planner must not be given numbers that logs do not show, nor worse ones."""

from __future__ import annotations

from typing import Final

import numpy as np

from kraft.sysid.comparison import far_worse
from kraft.sysid.forecast import Predicted
from kraft.sysid.result import Identification, correlations

SAME: Final = 0.99
"""Correlation from which two parameters cannot be told apart: the logs show what they do together, neither alone."""


def objections(identification: Identification, predicted: Predicted) -> tuple[str, ...]:
    """Why the parameters are not identified, as parts of a sentence; nothing if they are."""
    found = [] if identification.converged else ["the fit did not converge"]
    if not identification.names:
        found.append("every parameter that is left is frozen, and the data show no other")
    hidden = [name for name in identification.unidentified if name not in identification.extras]
    if hidden:
        found.append(f"the logs do not show {', '.join(hidden)}")
    found += [f"{a} and {b} cannot be told apart" for a, b in _pairs(identification)]
    return (*found, *(() if predicted.held_out is None else far_worse(predicted.held_out)))


def _pairs(identification: Identification) -> list[tuple[str, str]]:
    """Pairs of parameters that are one by the stated noise; how far the logs differ says nothing about that."""
    names, alike = identification.names, np.abs(correlations(identification.graph_covariance)) > SAME
    rows, columns = np.nonzero(np.triu(alike, 1))
    return [(names[i], names[j]) for i, j in zip(rows, columns, strict=True)]
