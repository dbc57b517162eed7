"""Least true distance to the obstacles in a trial."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

Distance: TypeAlias = Callable[[float, float, float], float]
"""Distance (m) of a footprint at a pose (m, rad) to the obstacles."""


class _Measured(NamedTuple):
    """Number of a pose and its distance, m."""

    pose: int
    distance: float


_Between: TypeAlias = tuple[float, _Measured, _Measured]
"""Lower bound of the distances between two measured poses (m), and these two."""


class ClosestApproach:
    """Smallest distance (m) between a footprint and the obstacles over the added poses.

    No point of the footprint moves farther than its centre moves plus its reach times the change of heading, and the
    distance changes by at most as much.  Two measured distances therefore bound all distances between them; the span
    with the lowest bound is halved until no bound is below the smallest measured distance.
    """

    def __init__(self, distance: Distance, reach: float) -> None:
        """Measure with `distance(x, y, theta)` (m); `reach` is the distance of the footprint's farthest point (m)."""
        self._distance, self._reach = distance, reach
        self._poses: list[tuple[float, float, float]] = []
        self._travelled: list[float] = []  # bound of the distance that any point has moved up to each pose

    def add(self, x: float, y: float, theta: float) -> None:
        """Add a pose (m, rad)."""
        x0, y0, theta0 = self._poses[-1] if self._poses else (x, y, theta)
        moved = math.hypot(x - x0, y - y0) + self._reach * abs(math.remainder(theta - theta0, math.tau))
        self._poses.append((x, y, theta))
        self._travelled.append(moved + (self._travelled[-1] if self._travelled else 0.0))

    def least(self) -> float:
        """Smallest distance (m); inf without poses."""
        if not self._poses:
            return math.inf
        first, last = self._measured(0), self._measured(len(self._poses) - 1)
        least = min(first.distance, last.distance)
        spans = [self._between(first, last)]
        while least > 0.0 and spans and spans[0][0] < least:
            _, first, last = heapq.heappop(spans)
            middle = self._measured((first.pose + last.pose) // 2)
            least = min(least, middle.distance)
            for a, b in ((first, middle), (middle, last)):
                if b.pose - a.pose > 1:
                    heapq.heappush(spans, self._between(a, b))
        return least

    def _measured(self, pose: int) -> _Measured:
        return _Measured(pose, self._distance(*self._poses[pose]))

    def _between(self, a: _Measured, b: _Measured) -> _Between:
        way = self._travelled[b.pose] - self._travelled[a.pose]
        return 0.5 * (a.distance + b.distance - way), a, b
