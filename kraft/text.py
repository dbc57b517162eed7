"""Who receives messages, and phrases for them and for names of files: counts with nouns, lists, suggestions."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from typing import Final, TypeAlias

MessageSink: TypeAlias = Callable[[str], None]
"""Receives messages for people, one at a time."""


def no_messages(_: str) -> None:
    """Receive a message and ignore it."""


def listed(items: Iterable[object], most: int = 3) -> str:
    """Items with semicolons between them, the first few alone: ``a; b; c; and 9 more``."""
    texts = list(map(str, items))
    more = [f"and {len(texts) - most} more"] if len(texts) > most else []
    return "; ".join([*texts[:most], *more])


def counted(number: int, noun: str) -> str:
    """Number with its noun: ``1 trial``, ``2 trials``, ``2 emergencies``."""
    return f"{number} {noun if number == 1 else _plural(noun)}"


def grouped(number: int, noun: str) -> str:
    """Number with separators between thousands and its noun: ``20,000 iterations``."""
    return f"{number:,} {noun if number == 1 else _plural(noun)}"


def _plural(noun: str) -> str:
    is_y_after_consonant = noun.endswith("y") and noun[-2:-1] not in "aeiou"
    return f"{noun[:-1]}ies" if is_y_after_consonant else f"{noun}s"


def suggestion(word: str, options: Iterable[str], *, none: str = "there are no alternatives") -> str:
    """Phrase with the option most similar to ``word``, or with all ``options`` if none is similar."""
    options = list(options)
    near = nearest(word, options)
    if near is not None:
        return f"did you mean {near!r}?"
    return f"expected {alternatives(options)}" if options else none


def nearest(word: str, options: Iterable[str]) -> str | None:
    """Option most similar to ``word``, ignoring case and ``-``/``_``; None if none is similar."""
    folded = {_folded(option): option for option in options}
    if _folded(word) in folded:
        return folded[_folded(word)]
    for candidate, option in folded.items():  # a missing unit: yaw for yaw_deg
        if candidate.startswith(f"{_folded(word)}-"):
            return option
    own = _folded(word)[:100]
    near = get_close_matches(own, folded, n=3, cutoff=0.65)
    alike = [each for each in near if each[0] == own[0]]  # few slips change the first letter, and then no other
    close = [*get_close_matches(own, near, n=1, cutoff=0.75), *alike]
    return folded[close[0]] if close else None


def _folded(word: str) -> str:
    return word.lower().replace("_", "-")


def alternatives(options: Iterable[str]) -> str:
    """Options as a phrase: ``a``, ``a or b``, ``one of a, b, c``."""
    options = list(options)
    if len(options) <= 2:
        return " or ".join(options)
    return "one of " + ", ".join(options)


def decimals(value: float | None, digits: int, none: str = "-") -> str:
    """A number with `digits` after the point; `none` where it is None, infinite or not a number."""
    return none if finite(value) is None else f"{value:.{digits}f}"


def percent(share: float | None, none: str = "-") -> str:
    """A share in percent, ``100%`` only if it is all, else ``99.9%`` at most; `none` where it is None."""
    if share is None:
        return none
    text = f"{share:.0%}"
    return f"{min(share, 0.999):.1%}" if text == "100%" and share < 1.0 else text


SLUG_MAX: Final = 100
"""Most bytes of a slug before its number: names of files have at most 255."""


def slugs(names: Iterable[str]) -> dict[str, str]:
    """Each name as a part of a file's name or of an address, with hyphens for other characters; all are different."""
    found: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        slug = unique = re.sub(r"[^\w.=+-]+", "-", name).encode()[:SLUG_MAX].decode(errors="ignore")
        number = 1
        while unique in taken:
            number += 1
            unique = f"{slug}-{number}"
        taken.add(unique)
        found[name] = unique
    return found


def metres(value: float | None, none: str = "no obstacle") -> str:
    """Clearance as ``0.123 m``; `none` where it is None, infinite or not a number."""
    return none if finite(value) is None else f"{value:.3f} m"


def finite(value: float | None) -> float | None:
    """A number as JSON can hold it: None instead of infinities and NaN."""
    return float(value) if value is not None and math.isfinite(value) else None
