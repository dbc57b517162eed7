"""Import of vehicles from ``module:attribute`` or ``path/to/file.py:attribute``, and the check of their functions."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import CellType, FunctionType, ModuleType
from typing import Any, Final, NamedTuple

import numba
from numba import types
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError, UnsupportedBytecodeError

from kraft.config.document import Document
from kraft.config.schema import Name, StrictModel, check
from kraft.config.source import Source
from kraft.config.user_code import import_error, imported, place_of
from kraft.errors import Code, Diagnostic, InputError
from kraft.text import counted, suggestion
from kraft.vehicles.config import Delay, Footprint
from ompl_ext.interrupts import interrupts_between_passes
from ompl_ext.kernels.specialise import are_steps_cached, is_cached
from ompl_ext.vehicle import Vehicle

_EXPECTED: Final = "expected code that defines a Vehicle"


def vehicle_of(reference: str, subject: str = "") -> Vehicle:
    """Vehicle of a reference to code; a relative path is relative to the working directory.

    Errors name `subject`, by default the reference.

    Raises:
        InputError: if the module cannot be imported, or the attribute is missing or not a vehicle.
    """
    subject = subject or reference
    module, attribute = imported(reference, subject, _EXPECTED)
    return _attribute(module, attribute, subject) if attribute else _only(module, subject)


class StatedByCode(StrictModel):
    """What recordings and vehicle files repeat of a vehicle, which code may state in any way."""

    name: Name
    """short name of letters, digits, - and _"""
    footprint: Footprint
    """{length, width, offset}, about the point whose poses are recorded"""
    delay: Delay | None = None
    """delay of commands {value, std}, if the vehicle states it"""

    @classmethod
    def content(cls, vehicle: Vehicle) -> dict[str, Any]:
        """Values of a vehicle, by the keys of a file."""
        shape, delay = vehicle.footprint, vehicle.delay
        return {
            "name": vehicle.name,
            "footprint": {"length": shape.length, "width": shape.width, "offset": shape.offset},
            "delay": None if delay is None else {"value": delay[0], "std": delay[1]},
        }


def vehicle_in_code(reference: str, subject: str = "") -> Vehicle:
    """As `vehicle_of`, for a vehicle without a file, whose name, footprint and delay are those of its code.

    Raises:
        InputError: as `vehicle_of`, or if a vehicle file could not state them.
    """
    vehicle = vehicle_of(reference, subject)
    check_stated(vehicle, subject or reference)
    return vehicle


def check_stated(vehicle: Vehicle, subject: str) -> None:
    """Check that a vehicle file could state the name, the footprint and the delay of a vehicle.

    Raises:
        InputError: with every problem, each naming `subject`.
    """
    _, problems = check(StatedByCode, Document(StatedByCode.content(vehicle), Source(subject)))
    if problems:
        raise InputError(replace(d, problem=f"{d.path} {d.problem}", path="", code=Code.CODE) for d in problems)


def _attribute(module: ModuleType, attribute: str, subject: str) -> Vehicle:
    vehicles = _vehicles(module)
    try:
        value = getattr(module, attribute)
    except AttributeError:
        expected = suggestion(attribute, vehicles, none="expected the name of a Vehicle, and it defines none")
        problem = f"there is no {attribute} in {place_of(module)}"
        raise InputError.of(subject, problem, expected, Code.NOT_FOUND) from None
    except (Exception, SystemExit) as error:  # a user's __getattr__ may raise anything
        raise import_error(error, subject, _EXPECTED) from error
    if not isinstance(value, Vehicle):
        expected = suggestion(attribute, vehicles, none="expected an ompl_ext.vehicle.Vehicle")
        kind = "a class" if isinstance(value, type) else f"of type {type(value).__name__}"
        problem = f"{attribute} is {kind}, not a Vehicle"
        raise InputError.of(subject, problem, expected, Code.TYPE)
    return value


def _only(module: ModuleType, subject: str) -> Vehicle:
    vehicles = _defined(module)
    if len(vehicles) != 1:
        found = f"defines {len(vehicles)} vehicles" if vehicles else "defines no Vehicle"
        expected = f"expected one of {', '.join(f'{subject}:{name}' for name in vehicles)}"
        if not vehicles:
            expected = "expected a module-level ompl_ext.vehicle.Vehicle"
        raise InputError.of(subject, found, expected, Code.CODE)
    return next(iter(vehicles.values()))


def _vehicles(module: ModuleType) -> dict[str, Vehicle]:
    return {name: value for name, value in vars(module).items() if isinstance(value, Vehicle)}


def _defined(module: ModuleType) -> dict[str, Vehicle]:
    """Vehicles of a module, each by its first name, without those of other modules if it defines one of its own."""
    found = {id(value): name for name, value in reversed(_vehicles(module).items())}
    others = [vars(other).values() for other in list(sys.modules.values()) if other is not module]
    imported = {id(value) for values in others for value in list(values) if isinstance(value, Vehicle)}
    own = {key: name for key, name in found.items() if key not in imported} or found
    return {name: getattr(module, name) for name in reversed(own.values())}


_LINE_MAX = 160
"""Longest part of a message of numba to repeat, characters."""


def check_functions(vehicle: Vehicle, reference: str) -> None:
    """Compile and call each function alone.

    Those of a vehicle whose kernels are in the cache were compiled before with other values of the parameters: they are
    only called, in Python, and compiled if that does not give finite numbers.

    Raises:
        InputError: with every problem of every function, each naming `reference`.
    """
    compiled = is_cached(vehicle) or are_steps_cached(vehicle)
    with interrupts_between_passes():
        problems = [
            Diagnostic(reference, problem, expected, code=Code.CODE)
            for function in _functions(vehicle)
            if not (compiled and _is_right_at_rest(function))
            for problem, expected in _problems(function)
        ]
    if problems:
        raise InputError(problems)


class _Function(NamedTuple):
    """Function of a vehicle with `arguments` for a call.

    `role` is what it is for the vehicle, `parameters` are the names of its arguments.  It has to return so many
    `values`, one for each of the `components`.
    """

    code: Callable[..., Any]
    arguments: tuple[Any, ...]
    role: str
    parameters: str
    values: int
    components: str


def _functions(vehicle: Vehicle) -> Iterator[_Function]:
    """Each function of a vehicle."""
    x = (0.0,) * len(vehicle.state)
    u = tuple(0.5 * (low + high) for low, high in vehicle.controls.values())
    p = tuple(float(value) for value in vehicle.parameter_array)
    inputs = u
    if vehicle.actuation is not None:
        inputs = (0.5,) * len(vehicle.inputs)
        yield _Function(vehicle.actuation, (u, p), "actuation", "(u, p)", len(vehicle.inputs), "the inputs")
    count = len(vehicle.state)
    yield _Function(vehicle.derivative, (x, inputs, p), "derivative", "(x, u, p)", count, "the state's components")
    if vehicle.stop is not None:
        yield _Function(vehicle.stop, (x, p, 0), "stop", "(x, p, k)", len(vehicle.controls), "the controls")


def _is_right_at_rest(function: _Function) -> bool:
    """Whether a function returns finite numbers in Python."""
    try:
        values = _interpreted(function.code, {})(*function.arguments)
        return len(values) == function.values and all(map(math.isfinite, values))
    except Exception:  # a division by zero, or what Python computes in another way: the compiled function decides
        return False


def _interpreted(function: Any, done: dict[int, Any]) -> Any:
    """A compiled function, and those that it calls, as functions of Python; `done` holds those that were converted."""
    if not isinstance(function, Dispatcher):
        return function
    if id(function) not in done:
        plain = _untyped(function).py_func
        names, cells = dict(plain.__globals__), tuple(CellType() for _ in plain.__closure__ or ())
        done[id(function)] = FunctionType(plain.__code__, names, plain.__name__, plain.__defaults__, cells)
        for name in set(plain.__code__.co_names) & set(names):
            names[name] = _interpreted(names[name], done)
        for cell, original in zip(cells, plain.__closure__ or (), strict=True):
            cell.cell_contents = _interpreted(original.cell_contents, done)
    return done[id(function)]


def _problems(function: _Function) -> Iterator[tuple[str, str]]:
    """What is wrong with a function, and what is expected."""
    code, count = function.code, function.values
    label = f"{function.role} {getattr(code, '__name__', '?')!r}"
    if not isinstance(code, Dispatcher):
        yield f"{label} is not compiled", "expected @derivative above it (from ompl_ext.vehicle import derivative)"
        return
    dispatcher, library = _untyped(code), _untyped(numba)
    signature = tuple(library.typeof(value) for value in function.arguments)
    try:
        dispatcher.compile(signature)
        returned: Any = dispatcher.overloads[signature].signature.return_type
    except (NumbaError, UnsupportedBytecodeError, TypeError) as error:  # TypeError: another number of arguments
        expected = f"expected {function.role}{function.parameters}, arithmetic on tuples of floats"
        yield f"{label} does not compile: {readable(error)}", expected
        return
    kinds = list(_untyped(returned)) if isinstance(returned, types.BaseTuple) else None
    if kinds is None or not all(_is_real(kind) for kind in kinds):
        yield f"{label} returns {_named(returned)}", f"expected a tuple of {count} numbers"
    elif len(kinds) != count:
        yield (
            f"{label} returns {counted(len(kinds), 'value')}",
            f"expected {count}, one for each of {function.components}",
        )
    else:
        yield from _not_finite(dispatcher, function.arguments, label)


def _not_finite(dispatcher: Any, arguments: tuple[Any, ...], label: str) -> Iterator[tuple[str, str]]:
    try:
        values = dispatcher(*arguments)
    except Exception as error:  # its own `raise` or `assert`, or an arithmetic error with error_model="python"
        text = str(error) or type(error).__name__
        yield f"{label} fails at rest: {text}", "expected finite numbers"
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
    # an `UnsupportedBytecodeError` has its place at the end of its sentence
    text = re.sub(r"\.* Raised from (?:None|(.+) \((\d+)\))", r'\nFile "\1", line \2:', text)
    lines = [line.strip() for line in text.splitlines()]
    sentence = next((line for line in lines if line and not line.startswith(("Failed in", "- Resolution"))), text)
    place = re.search(r'File "(?P<file>[^"]+)", line (?P<line>\d+):', text)
    short = sentence if len(sentence) <= _LINE_MAX else sentence[: _LINE_MAX - 3] + "..."
    return f"{short} ({place['file']}:{place['line']})" if place else short


def _is_real(kind: object) -> bool:
    return isinstance(kind, types.Number) and not isinstance(kind, types.Complex)


def _named(returned: object) -> str:
    if _is_real(returned):
        return "one number"
    if not isinstance(returned, types.BaseTuple):
        return str(returned)
    kinds = [
        _untyped(types).unliteral(kind) for kind in _untyped(returned)
    ]  # versions of Python differ in which types are literal
    return "(" + ", ".join("text" if isinstance(kind, types.UnicodeType) else str(kind) for kind in kinds) + ")"
