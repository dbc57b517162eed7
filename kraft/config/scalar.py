"""Values of unquoted words: numbers, truth values, null, or the word itself.

A word that YAML readers read differently is an error, so that a file has one meaning.
"""

from __future__ import annotations

import math
import re
from typing import Final, TypeAlias

Scalar: TypeAlias = str | int | float | bool | None

_NULL = frozenset({"", "~", "null", "Null", "NULL"})
_TRUE = frozenset({"true", "True", "TRUE"})
_FALSE = frozenset({"false", "False", "FALSE"})
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?\Z")
_LEADING_ZERO = re.compile(r"([-+]?)0+([0-9]+)\Z")
_OTHER_BASE = re.compile(r"[-+]?0[xXoObB][0-9a-fA-F_]+\Z")
_UNDERSCORED = re.compile(r"[-+]?[0-9][0-9_]*_[0-9_]*(\.[0-9_]*)?\Z")
_NOT_FINITE = re.compile(r"([-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))\Z")
DIGITS_MAX: Final = 18
"""Most digits of an integer that people write: all of 18 digits fit 64 bits."""


class AmbiguousScalar(ValueError):  # noqa: N818 - it names the word
    """Unquoted word without an unambiguous value."""

    def __init__(self, problem: str, expected: str) -> None:
        super().__init__(problem, expected)
        self.problem = problem
        self.expected = expected


def plain_scalar(word: str, digits_max: int = DIGITS_MAX) -> Scalar:
    """Value of an unquoted word.

    Raises:
        AmbiguousScalar: for an integer with leading zeros, another base or underscores, a number that is
            not finite, and an integer beyond `digits_max` digits.
    """
    if word in _NULL:
        return None
    if word in _TRUE or word in _FALSE:
        return word in _TRUE
    if _INTEGER.match(word):
        if len(word.lstrip("+-")) > digits_max:
            raise AmbiguousScalar(f"the number {_short(word)} is too large", f"expected at most {digits_max} digits")
        return int(word)
    _refuse_ambiguous(word)
    if _FLOAT.match(word):
        value = float(word)
        if not math.isfinite(value):
            raise AmbiguousScalar(f"the number {_short(word)} is too large", "expected a finite number")
        return value
    return word


def _refuse_ambiguous(word: str) -> None:
    if zeros := _LEADING_ZERO.match(word):
        decimal = zeros[1] + (zeros[2].lstrip("0") or "0")
        raise AmbiguousScalar(
            f"{_short(word)} is octal to some YAML readers and decimal to others",
            f"expected {_short(decimal)}, or quotes where the key takes text",
        )
    if _OTHER_BASE.match(word) or _UNDERSCORED.match(word):
        raise AmbiguousScalar(
            f"{_short(word)} is a number to some YAML readers and text to others",
            "expected a plain decimal number, or quotes where the key takes text",
        )
    if _NOT_FINITE.match(word):
        raise AmbiguousScalar(f"{word} is not a finite number", "expected a finite number")


def _short(word: str) -> str:
    return word if len(word) <= 40 else f"{word[:37]}..."
