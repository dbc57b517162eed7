"""Parameter values from the command line."""

from __future__ import annotations

import math
from collections.abc import Iterable

from kraft.errors import Code, Diagnostic


def parse_parameters(items: Iterable[str], problems: list[Diagnostic]) -> dict[str, float]:
    """Values of those ``name=value`` items that can be read.

    Every item that is not a name and a finite number, and every repeated name, is added to ``problems``.
    """
    values: dict[str, float] = {}
    for item in items:
        name, equals, text = item.partition("=")
        number = _number(text)
        if not equals or not name.strip() or number is None:
            problems.append(
                Diagnostic("param", f"is {item!r}", "expected name=number", code=Code.SYNTAX, argument=True)
            )
        elif name.strip() in values:
            problems.append(
                Diagnostic(
                    "param", f"{name.strip()} is given twice", "expected it once", code=Code.DUPLICATE, argument=True
                )
            )
        else:
            values[name.strip()] = number
    return values


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
