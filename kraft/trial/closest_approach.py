"""The smallest distance to obstacles along a drive, exact, computed only where it can be the smallest."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

Distance = Callable[[float, float, float], float]


class _Measured(NamedTuple):
    pose: int
    distance: float


_Span: TypeAlias = tuple[float, _Measured, _Measured]
"""A lower bound of the distances between two that are measured (m), and these."""


class ClosestApproach:
    """Smallest distance (m) of a footprint to the obstacles at the poses it is shown.

    No point of the footprint moves farther than its centre does plus its reach times the turn, and the distance changes
    by no more than that.  So two distances bound all those between them, and the drive is halved where the bound is
    lowest until none is below the smallest distance found.
    """

    def __init__(self, distance: Distance, reach: float) -> None:
        """Measure with `distance(x, y, theta)` (m); `reach` (m) is that of the footprint's farthest point."""
        self._distance, self._reach = distance, reach
        self._poses: list[tuple[float, float, float]] = []
        self._travelled: list[float] = []  # up to each pose, by the farthest that any point has moved

    def add(self, x: float, y: float, theta: float) -> None:
        """Take in a pose (m, rad)."""
        x0, y0, theta0 = self._poses[-1] if self._poses else (x, y, theta)
        moved = math.hypot(x - x0, y - y0) + self._reach * abs(math.remainder(theta - theta0, math.tau))
        self._poses.append((x, y, theta))
        self._travelled.append(moved + (self._travelled[-1] if self._travelled else 0.0))

    def least(self) -> float:
        """The smallest distance (m), inf before the first pose."""
        if not self._poses:
            return math.inf
        first, last = self._measured(0), self._measured(len(self._poses) - 1)
        least = min(first.distance, last.distance)
        spans = [self._span(first, last)]
        while least > 0.0 and spans and spans[0][0] < least:
            _, first, last = heapq.heappop(spans)
            middle = self._measured((first.pose + last.pose) // 2)
            least = min(least, middle.distance)
            for a, b in ((first, middle), (middle, last)):
                if b.pose - a.pose > 1:
                    heapq.heappush(spans, self._span(a, b))
        return least

    def _measured(self, pose: int) -> _Measured:
        return _Measured(pose, self._distance(*self._poses[pose]))

    def _span(self, a: _Measured, b: _Measured) -> _Span:
        way = self._travelled[b.pose] - self._travelled[a.pose]
        return 0.5 * (a.distance + b.distance - way), a, b
