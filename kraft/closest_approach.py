"""The smallest distance to obstacles along a drive, exact, computed only where it can become smaller."""

from __future__ import annotations

import math
from collections.abc import Callable

Distance = Callable[[float, float, float], float]


class ClosestApproach:
    """Smallest distance (m) of a footprint to the obstacles at the poses it is shown; `least` is inf before the first.

    No point of the footprint moves farther than its centre does plus its reach times the turn, and the distance changes
    by no more than that: where this cannot lead below the smallest distance so far, the distance is not computed.
    """

    def __init__(self, distance: Distance, reach: float) -> None:
        """Measure with `distance(x, y, theta)` (m); `reach` (m) is that of the footprint's farthest point."""
        self._distance, self._reach = distance, reach
        self.least = math.inf
        self._from, self._there = (0.0, 0.0, 0.0), -math.inf  # a pose and the distance there

    def show(self, x: float, y: float, theta: float) -> None:
        """Take in a pose (m, rad)."""
        x0, y0, theta0 = self._from
        moved = math.hypot(x - x0, y - y0) + self._reach * abs(math.remainder(theta - theta0, math.tau))
        if self._there - moved >= self.least:
            return
        self._from, self._there = (x, y, theta), self._distance(x, y, theta)
        self.least = min(self.least, self._there)
