"""Progress of an identification on the terminal: which fit of how many, and how long the others will take."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from kraft.sysid.fit_progress import FitProgress
from kraft.text import MessageSink

PROGRESS_INTERVAL: Final = 2.0
"""Least time between two progress messages, and before the first one, s."""

KNOWN_SHARE: Final = 0.1
"""Share of the fits from which on they tell how long the others take: the first ones, of all terms, take longest."""


class ProgressReporter:
    """Reports the fits of a stage, at most once per `PROGRESS_INTERVAL`.

    It tells no costs: those of different fits cannot be compared, and one after the other they look as if the
    identification diverged.
    """

    def __init__(self, info: MessageSink, stage: str = "", clock: Callable[[], float] = time.monotonic) -> None:
        """Start the clock."""
        self._info, self._clock = info, clock
        self._last = clock()
        self._stage, self._began = stage, self._last

    def begin(self, stage: str) -> None:
        """Note what is fitted from now on."""
        self._stage, self._began = stage, self._clock()

    def __call__(self, progress: FitProgress) -> None:
        """Report the fit, and the time that the others of the stage take if they last as long; unless too early."""
        now = self._clock()
        if now - self._last < PROGRESS_INTERVAL:
            return
        self._last = now
        done = progress.fit - 1
        left = ""
        if done > 0 and done >= KNOWN_SHARE * progress.fits:
            seconds = (now - self._began) / done * (progress.fits - done)
            left = f", about {max(seconds, 1.0):.0f} s remain"
        self._info(f"{self._stage}: fit {progress.fit} of about {progress.fits}, iteration {progress.iteration}{left}")
