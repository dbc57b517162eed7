"""How far an identification is: it consists of several fits, each with a cost of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True)
class FitProgress:
    """An iteration of one of several fits.  Costs of different fits have different terms and cannot be compared."""

    fit: int
    """number of the fit, from 1"""
    fits: int
    """number of fits that there will be, about: the results decide which of them are needed; at least `fit`"""
    iteration: int
    """number of the iteration in this fit, from 1"""
    cost: float
    """after this iteration"""


OnIteration: TypeAlias = Callable[[FitProgress], None]
OnStep: TypeAlias = Callable[[int, float], None]
"""Of one fit: receives the number of the iteration and the cost."""


def ignore_iteration(_: FitProgress) -> None:
    """Ignore an iteration."""


def ignore_step(_: int, __: float) -> None:
    """Ignore an iteration of a fit."""
