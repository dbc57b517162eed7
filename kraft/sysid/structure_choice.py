"""Structures of a model, the terms that are on, and the choice among fitted ones by errors in cross-validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from kraft.sysid.multistep import MultiStep
from kraft.sysid.optimiser import Optimum
from ompl_ext.arrays import Floats, Matrix

OFFSETS: Final = ("lever", "yaw_offset")
"""Terms of the poses alone, which no effect of discrete steps looks like."""
CLEARLY_WORSE: Final = 0.1
"""Share by which a structure predicts worse that counts as clearly worse; without a needed term it is a multiple."""
NEGLIGIBLE_LOSS: Final = 0.04
"""Share by which a simpler structure may predict worse: a term that only makes up for discrete steps gains as much."""
NEGLIGIBLE_OFFSET: Final = 0.02
"""The same for a structure that lacks an offset of the poses."""


@dataclass(frozen=True, eq=False)
class Structure:
    """A fitted structure: the terms that are on, and its errors on logs that it was not fitted to."""

    terms: tuple[str, ...]
    """parameters that could be switched off and are on"""
    graph: MultiStep
    optimum: Optimum
    errors: Matrix
    """(folds, horizons) over their time, m/s; NaN of what no window of a fold reaches"""
    others: Matrix
    """(folds, np) parameters that the other folds give, to first order"""
    without: str = ""
    """terms that were switched off last, separated by commas"""
    added: str = ""
    """terms that were switched on again, separated by commas"""

    @cached_property
    def scores(self) -> Floats:
        """(folds,) mean of the errors over their time, m/s; NaN of a fold that is too short to be predicted."""
        known = ~np.isnan(self.errors)
        with np.errstate(invalid="ignore"):
            scores: Floats = np.nansum(self.errors, axis=1) / known.sum(axis=1)
        return scores

    @property
    def score(self) -> float:
        """Mean of the scores of the folds that are predicted, m/s."""
        return float(np.nanmean(self.scores))


def best_of(path: Sequence[Structure]) -> Structure:
    """The structure with the least mean error."""
    return min(path, key=lambda s: s.score)


def chosen(path: Sequence[Structure]) -> Structure:
    """The simplest structure that is as good as the best."""
    best = best_of(path)
    strict = _simplest([s for s in path if is_near(s, best, NEGLIGIBLE_OFFSET)])
    needed = set(OFFSETS) & set(strict.terms)
    return _simplest([s for s in path if needed <= set(s.terms) and is_near(s, best, NEGLIGIBLE_LOSS)])


def _simplest(structures: Sequence[Structure]) -> Structure:
    """The structure with the fewest terms, and among those the one with the least mean error."""
    return min(structures, key=lambda s: (len(s.terms), s.score))


def is_near(structure: Structure, best: Structure, share: float, most: float = math.inf) -> bool:
    """Whether the mean error is within one standard error, but at most a share `most`, or a share of the best one."""
    difference = structure.scores - best.scores
    difference = difference[~np.isnan(difference)]
    deviation = float(difference.std(ddof=1)) if len(difference) > 1 else 0.0
    by_chance = min(deviation / math.sqrt(len(difference)), most * best.score)
    return float(difference.mean()) <= max(by_chance, share * best.score)


def may_be_near(structure: Structure, best: Structure) -> bool:
    """Whether a structure is not clearly worse, or in a single fold alone.

    The other folds may not show a term at all: what they leave of it is then its prior, whichever other terms are on.
    """
    difference = structure.scores - best.scores
    others = np.arange(len(difference)) != int(np.nanargmax(difference))
    others &= ~np.isnan(difference)
    if not others.any():
        return is_near(structure, best, CLEARLY_WORSE)
    own, of_best = (replace(s, errors=s.errors[others]) for s in (structure, best))
    return is_near(structure, best, CLEARLY_WORSE) or is_near(own, of_best, CLEARLY_WORSE)
