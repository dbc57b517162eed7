"""Area that a drive needs."""

from __future__ import annotations

import math
from bisect import bisect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ompl_ext.arrays import Floats, Matrix

PATH_STEP: Final = 0.1
"""Time between two poses whose place is checked, s."""
TURNS: Final = np.radians(np.arange(0.0, 90.0, 5.0))
"""Headings at which a path is laid into an area."""
MARGIN_PER_METRE: Final = 0.1
"""Additional space for each metre from the start, because the vehicle deviates from its model."""


@dataclass(frozen=True)
class Area:
    """Free rectangle, m."""

    length: float
    width: float

    def holds(self, path: Matrix) -> bool:
        """Whether a path (n, 3) fits into it at some heading, with the margin."""
        long, short = max(self.length, self.width), min(self.length, self.width)
        return any(max(sides) <= long and min(sides) <= short for sides in _sides(path))

    def room(self, _: int, path: Matrix) -> float:
        """Time for which a path (n, 3) of poses `PATH_STEP` apart fits into it, s."""
        fits = bisect(range(2, len(path) + 1), 0, key=lambda n: not self.holds(path[:n]))
        return PATH_STEP * fits


def needed_area(path: Matrix) -> Area:
    """Smallest rectangle that a path (n, 3) needs, with the margin."""
    length, width = min(((max(sides), min(sides)) for sides in _sides(path)), key=math.prod)
    return Area(length, width)


def _sides(path: Matrix) -> Iterator[tuple[float, float]]:
    """Sides of the rectangle around a path at each heading, m."""
    margin = MARGIN_PER_METRE * np.hypot(path[:, 0], path[:, 1])
    for turn in TURNS:
        c, s = math.cos(turn), math.sin(turn)
        x, y = c * path[:, 0] + s * path[:, 1], c * path[:, 1] - s * path[:, 0]
        yield float(np.ptp([x + margin, x - margin])), float(np.ptp([y + margin, y - margin]))


def extent(poses: Sequence[Floats]) -> Area:
    """Rectangle along the axes that holds the poses (n, 3) of all logs."""
    both = np.concatenate([each[:, :2] for each in poses])
    length, width = (both.max(axis=0) - both.min(axis=0)).tolist()
    return Area(length, width)
