"""Values of parameters as they are written on a command line."""

from __future__ import annotations

import math
from collections.abc import Iterable

from kraft.errors import Code, Diagnostic, InputError


def parse_parameters(items: Iterable[str]) -> dict[str, float]:
    """Read ``name=value`` items.

    Raises:
        InputError: with every item that is not a name and a finite number, and every name that comes twice.
    """
    values: dict[str, float] = {}
    problems = []
    for item in items:
        name, equals, text = item.partition("=")
        number = _number(text)
        if not equals or not name.strip() or number is None:
            problems.append(Diagnostic("--param", f"is {item!r}", "expected name=number"))
        elif name.strip() in values:
            problems.append(
                Diagnostic("--param", f"{name.strip()} is given twice", "expected it once", code=Code.DUPLICATE)
            )
        else:
            values[name.strip()] = number
    if problems:
        raise InputError(problems)
    return values


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
