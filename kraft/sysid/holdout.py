"""Which logs are kept out of the fit, so that the prediction can be tested on drives that it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.errors import InputError
from kraft.text import counted

if TYPE_CHECKING:
    from kraft.logs.log import Log

FRACTION: Final = 0.25
FEW: Final = 4
"""With fewer logs than this none is held out, unless it is asked for: the fit needs them all."""


@dataclass(frozen=True)
class Split:
    """Logs to fit and logs to test with, each in their order, and what was decided, as a sentence."""

    fitted: tuple[Log, ...]
    held_out: tuple[Log, ...]
    note: str


def split(logs: Sequence[Log], fraction: float | None = None) -> Split:
    """Hold out a fraction of the logs, by default a quarter if there are at least `FEW`.

    Which ones depends on how many there are and on nothing else.  One log at least is fitted; a fraction above 0 holds
    out one at least.

    Raises:
        InputError: if the fraction is not in [0, 1), or the only log is asked to be held out.
    """
    if fraction is not None and not 0.0 <= fraction < 1.0:
        raise InputError.of("--holdout", f"is {fraction:g}", "expected a fraction of at least 0 and below 1")
    count = len(logs)
    if fraction is None and count < FEW:
        note = f"{counted(count, 'log')}: none is held out (from {FEW} on a quarter is, or --holdout)"
        return Split(tuple(logs), (), note)
    wanted = FRACTION if fraction is None else fraction
    if wanted == 0.0:
        return Split(tuple(logs), (), "no log is held out")
    if count == 1:
        raise InputError.of("--holdout", "is given, and there is one log", "expected two logs at least, or --holdout 0")
    held = min(max(round(wanted * count), 1), count - 1)
    # drawn, since every fourth or fifth log may well be of the same manoeuvre
    chosen = set(np.random.default_rng(0).permutation(count)[:held].tolist())
    out = tuple(log for k, log in enumerate(logs) if k in chosen)
    fitted = tuple(log for k, log in enumerate(logs) if k not in chosen)
    return Split(fitted, out, f"{held} of {counted(count, 'log')} held out: {', '.join(log.name for log in out)}")
