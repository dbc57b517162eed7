"""Tell how an identification goes, if it takes long enough for somebody to wonder."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

EVERY: Final = 2.0
"""Least time between two remarks, and before the first one, s."""


class Pace:
    """Tells iterations to `say`, now and then."""

    def __init__(self, say: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        """Begin to wait."""
        self._say, self._clock, self._last = say, clock, clock()

    def __call__(self, iterations: int, cost: float) -> None:
        """Hear how many iterations were made, and what the point costs."""
        now = self._clock()
        if now - self._last >= EVERY:
            self._last = now
            self._say(f"iteration {iterations}, cost {cost:.6g}")
