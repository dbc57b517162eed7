"""Text of everything that a compiled function depends on: its own source and all that it refers to.

A cached kernel is stale when any of it changes: the function, a helper it calls, the modules of both, or a constant
that it reads from its module, another module or an enclosing function.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from types import CodeType, ModuleType
from typing import Any

import numpy as np

_COVERED = ("ompl_ext.", "numpy.", "math.", "numba.")  # in every cache key by source or version


def fingerprint(function: Callable[..., Any]) -> str:
    """Text that differs whenever the machine code of `function` may differ.

    Raises:
        OSError: the function has no source, because it was defined at a prompt.
    """
    return "\n".join(_parts(function, set()))


def _parts(function: Callable[..., Any], visited: set[int]) -> Iterator[str]:
    plain = getattr(function, "py_func", function)
    if id(plain) in visited:
        return
    visited.add(id(plain))
    yield f"# {plain.__module__}"  # cached machine code imports it
    yield inspect.getsource(plain)
    cells = plain.__closure__ or ()
    values = dict(zip(plain.__code__.co_freevars, (cell.cell_contents for cell in cells), strict=True))
    names = sorted(_names(plain.__code__))
    values.update((name, plain.__globals__[name]) for name in names if name in plain.__globals__)
    values.update(_defaults(plain))
    for name, value in values.items():
        yield from _value(name, value, names, visited)


def _defaults(plain: Callable[..., Any]) -> Iterator[tuple[str, Any]]:
    """Values of parameters that a call may leave out: the source has only their expressions."""
    function: Any = plain
    for k, value in enumerate(function.__defaults__ or ()):
        yield f"default {k}", value
    for name, value in (function.__kwdefaults__ or {}).items():
        yield f"default {name}", value


def _value(name: str, value: Any, names: list[str], visited: set[int]) -> Iterator[str]:
    if isinstance(value, ModuleType):
        if not f"{value.__name__}.".startswith(_COVERED):
            for attribute in names:  # the byte code does not tell which module an attribute belongs to
                if hasattr(value, attribute):
                    yield from _value(f"{name}.{attribute}", getattr(value, attribute), names, visited)
    elif hasattr(getattr(value, "py_func", value), "__code__"):
        if not f"{value.__module__}.".startswith(_COVERED):
            yield from _parts(value, visited)
    elif isinstance(value, np.ndarray):
        yield f"{name} = {value.dtype} {value.shape} {value.tobytes().hex()}"
    elif isinstance(value, tuple | list):  # the text of an array in it would have eight digits
        yield f"{name}: {type(value).__name__} of {len(value)}"
        for k, item in enumerate(value):
            yield from _value(f"{name}[{k}]", item, names, visited)
    elif isinstance(value, dict):
        yield f"{name}: {type(value).__name__} of {len(value)}"
        for key, item in value.items():
            yield from _value(f"{name}[{key!r}]", item, names, visited)
    else:
        yield f"{name} = {value!r}"


def _names(code: CodeType) -> set[str]:
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*(_names(part) for part in inner))
