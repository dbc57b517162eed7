"""Checks of the functions of a vehicle before planning: each compiles and returns the right values."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numba
from numba import types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError

from kraft.errors import Code, Diagnostic, InputError
from kraft.text import counted
from ompl_ext.interrupts import interrupts_between_passes
from ompl_ext.kernels.specialise import is_cached
from ompl_ext.vehicle import Vehicle

_LINE_MAX = 160  # longest part of a message of numba to repeat, characters


def check_functions(vehicle: Vehicle, reference: str) -> None:
    """Compile and call each function alone; does nothing for a vehicle whose kernels are in the cache.

    Raises:
        InputError: with every problem of every function, each naming `reference`.
    """
    if is_cached(vehicle):
        return
    with interrupts_between_passes():
        problems = [
            Diagnostic(reference, problem, expected, code=Code.CODE)
            for function, arguments, count, what in _functions(vehicle)
            for problem, expected in _problems(function, arguments, count, what)
        ]
    if problems:
        raise InputError(problems)


def _functions(vehicle: Vehicle) -> Iterator[tuple[Callable[..., Any], tuple[Any, ...], int, str]]:
    """Each function with arguments for a call, the required number of values, and its signature."""
    x = (0.0,) * len(vehicle.state)
    u = tuple(0.5 * (low + high) for low, high in vehicle.controls.values())
    p = tuple(float(value) for value in vehicle.parameter_array)
    inputs = u
    if vehicle.actuation is not None:
        inputs = (0.5,) * len(vehicle.inputs)
        yield vehicle.actuation, (u, p), len(vehicle.inputs), "actuation(u, p)"
    yield vehicle.derivative, (x, inputs, p), len(vehicle.state), "derivative(x, u, p)"
    if vehicle.stop is not None:
        yield vehicle.stop, (x, p, 0), len(vehicle.controls), "stop(x, p, k)"


def _problems(
    function: Callable[..., Any], arguments: tuple[Any, ...], count: int, what: str
) -> Iterator[tuple[str, str]]:
    name = getattr(function, "__name__", "?")
    label = f"{what.partition('(')[0]} {name!r}"
    if not isinstance(function, Dispatcher):
        yield f"{label} is not compiled", "expected @derivative above it (from ompl_ext.vehicle import derivative)"
        return
    dispatcher, library = _untyped(function), _untyped(numba)
    signature = tuple(library.typeof(value) for value in arguments)
    try:
        dispatcher.compile(signature)
        returned: Any = dispatcher.overloads[signature].signature.return_type
    except (NumbaError, TypeError) as error:  # TypeError: another number of arguments
        yield f"{label} does not compile: {readable(error)}", f"expected {what}, arithmetic on tuples of floats"
        return
    kinds = list(_untyped(returned)) if isinstance(returned, types.BaseTuple) else None
    if kinds is None or not all(isinstance(kind, types.Number) for kind in kinds):
        yield f"{label} returns {_named(returned)}", f"expected a tuple of {count} numbers"
    elif len(kinds) != count:
        yield f"{label} returns {counted(len(kinds), 'value')}", f"expected {count}, one for each of {_of(what)}"
    else:
        yield from _not_finite(dispatcher, arguments, label)


def _not_finite(dispatcher: Any, arguments: tuple[Any, ...], label: str) -> Iterator[tuple[str, str]]:
    try:
        values = dispatcher(*arguments)
    except ArithmeticError as error:  # a function compiled with error_model="python" raises
        yield f"{label} fails at rest: {error}", "expected finite numbers"
        return
    if not all(math.isfinite(value) for value in values):
        listed = ", ".join(f"{value:g}" for value in values)
        yield f"{label} returns ({listed}) at rest", "expected finite numbers"


def _untyped(value: Any) -> Any:
    """The same value without a type: numba has annotations in part only."""
    return value


def readable(error: Exception) -> str:
    """One line of numba's message, and the line of code that it is about."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    if "NRT required" in text:
        return "it creates a list or an array, but kernels cannot allocate memory"
    lines = [line.strip() for line in text.splitlines()]
    sentence = next((line for line in lines if line and not line.startswith(("Failed in", "- Resolution"))), text)
    place = re.search(r'File "(?P<file>[^"]+)", line (?P<line>\d+):', text)
    short = sentence if len(sentence) <= _LINE_MAX else sentence[: _LINE_MAX - 3] + "..."
    return f"{short} ({place['file']}:{place['line']})" if place else short


def _named(returned: object) -> str:
    if isinstance(returned, types.Number):
        return "one number"
    if not isinstance(returned, types.BaseTuple):
        return str(returned)
    kinds = [
        _untyped(types).unliteral(kind) for kind in _untyped(returned)
    ]  # versions of Python differ in which types are literal
    return "(" + ", ".join("text" if isinstance(kind, types.UnicodeType) else str(kind) for kind in kinds) + ")"


def _of(what: str) -> str:
    return {"d": "the state's components", "a": "the inputs", "s": "the controls"}[what[0]]
