"""Diagnostics as tests compare them: by place, key and code, not by their sentences."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from kraft.errors import Diagnostic, InputError


def located(diagnostics: Iterable[Diagnostic]) -> list[str]:
    """``LINE:COLUMN path.to.key code`` of each diagnostic; what it does not have is left out."""
    return [
        " ".join(filter(None, (":".join(str(n) for n in (d.line, d.column) if n is not None), d.path, str(d.code))))
        for d in diagnostics
    ]


def raised(call: Callable[[], object]) -> tuple[Diagnostic, ...]:
    """Diagnostics of the InputError that a call raises; none if it raises nothing."""
    try:
        call()
    except InputError as error:
        return error.diagnostics
    return ()
