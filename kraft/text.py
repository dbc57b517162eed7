"""Words and numbers for messages and files: counts, lengths, suggestions for misspelt names."""

from __future__ import annotations

import math
from collections.abc import Iterable
from difflib import get_close_matches


def counted(number: int, noun: str) -> str:
    """``1 trial``, ``2 trials``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def grouped(number: int, noun: str) -> str:
    """The same for numbers that may be large: ``20,000 iterations``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def suggestion(word: str, options: Iterable[str], *, none: str = "there is nothing to choose from") -> str:
    """Say what to write instead of ``word``: the near miss if there is one, else all ``options``."""
    options = list(options)
    near = nearest(word, options)
    if near is not None:
        return f"did you mean {near!r}?"
    return f"expected {alternatives(options)}" if options else none


def nearest(word: str, options: Iterable[str]) -> str | None:
    """Return the option most like ``word`` (case and ``-``/``_`` do not count), or None."""
    folded = {_folded(option): option for option in options}
    for candidate, option in folded.items():  # a unit that was left out: yaw for yaw_deg
        if candidate.startswith(f"{_folded(word)}-"):
            return option
    close = get_close_matches(_folded(word)[:100], folded, n=1, cutoff=0.65)
    return folded[close[0]] if close else None


def _folded(word: str) -> str:
    return word.lower().replace("_", "-")


def alternatives(options: Iterable[str]) -> str:
    """List ``options`` for a sentence: ``a``, ``a or b``, ``one of a, b, c``."""
    options = list(options)
    if len(options) <= 2:
        return " or ".join(options)
    return "one of " + ", ".join(options)


def decimals(value: float | None, digits: int, none: str = "-") -> str:
    """A number with `digits` after the point; `none` where it is None, infinite or not a number."""
    return none if finite(value) is None else f"{value:.{digits}f}"


def metres(value: float | None, none: str = "no obstacle") -> str:
    """Clearance as ``0.123 m``; `none` where it is None, infinite or not a number."""
    return none if finite(value) is None else f"{value:.3f} m"


def finite(value: float | None) -> float | None:
    """A number as JSON can hold it: None instead of infinities and NaN."""
    return float(value) if value is not None and math.isfinite(value) else None
