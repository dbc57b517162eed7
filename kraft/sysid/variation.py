"""Parameters that vary from drive to drive and during one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ompl_ext.arrays import Floats

WITHIN_SHARE: Final = 0.05
"""Variation within a drive over the one between drives."""


@dataclass(frozen=True, eq=False)
class Variation:
    """How far nv parameters vary: standard deviations in their units."""

    names: tuple[str, ...]
    between: Floats
    """(nv,) of a drive's mean from rho"""
    within: Floats
    """(nv,) of a window from the mean of its drive"""

    @classmethod
    def of(cls, names: Sequence[str], between: Floats) -> Variation:
        """Variation of which a fixed share is within a drive.

        That share is chosen, not estimated: the windows of a drive whose commands change slowly are explained as well
        by a parameter that varies with them as by the effect of the commands.
        """
        return cls(tuple(names), between, WITHIN_SHARE * between)

    @classmethod
    def independent(cls, stated: Mapping[str, float]) -> Variation:
        """Variation of windows of which no two are of the same drive."""
        return cls(tuple(stated), np.zeros(len(stated)), np.array(list(stated.values())))

    @property
    def total(self) -> dict[str, float]:
        """Standard deviation of a window from rho, by parameter."""
        return dict(zip(self.names, map(float, np.hypot(self.within, self.between)), strict=True))
