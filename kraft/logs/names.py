"""Take the name of a column or topic apart: its words, and the unit that it ends with."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from typing import Final

from kraft.logs.units import SPELLINGS, Unit

_BRACKETS: Final = re.compile(r"[\[(]\s*([^\])]*?)\s*[\])]")
_WORD: Final = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+|°")
_GLUED: Final = {
    **{f"{word}{axis}": (word, axis) for word in ("pos", "pose", "position") for axis in "xyz"},
    **{f"{axis}pos": ("pos", axis) for axis in "xyz"},
    **{f"p{axis}": ("pos", axis) for axis in "xyz"},
    **{f"q{axis}": ("quaternion", axis) for axis in "xyzw"},
    **{f"v{axis}": ("velocity", axis) for axis in "xyz"},
    **{f"{word}{unit}": (word, unit) for word in ("yaw", "theta", "heading", "steering") for unit in ("deg", "rad")},
    "yawrate": ("yaw", "rate"),
    "deadman": ("dead", "man"),
    "tcmd": ("cmd", "t"),
    "tpose": ("pose", "t"),
}


@dataclass(frozen=True)
class Name:
    """A name taken apart.

    Attributes:
        words: in lower case, without the unit.
        unit: what the name says about the unit, if it does.
    """

    words: tuple[str, ...]
    unit: Unit | None = None


@cache
def parse(name: str) -> Name:
    """Take a name apart: ``pose.heading_deg`` is ``pose heading`` in ``deg``."""
    bracketed = _BRACKETS.search(name)
    unit = SPELLINGS.get(bracketed.group(1).lower()) if bracketed else None
    found = _WORD.findall(_BRACKETS.sub(" ", name) if unit else name)
    words = tuple(part for word in found for part in _GLUED.get(word.lower(), (word.lower(),)))
    if unit is None and len(words) > 1 and words[-1] in SPELLINGS:
        return Name(words[:-1], SPELLINGS[words[-1]])
    return Name(words, unit)
