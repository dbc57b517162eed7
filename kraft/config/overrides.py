"""Overrides: values of dotted keys that replace those of a file before it is validated.

An override comes from an argument (``sensing.noise_scale=2``), from a mapping in Python, or from a suite file.  A
problem of its value is reported where it was given, not in the file that it changes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, TypeVar

from kraft.config.document import Document, Unusable, Value, frozen
from kraft.config.source import KeyPath, Place, format_path, parse_path
from kraft.config.yaml_reader import parse_document
from kraft.errors import Code, Diagnostic, InputError

EXAMPLE: Final = "expected KEY=VALUE, as in sensing.noise_scale=2"
SWEEP_EXAMPLE: Final = "expected KEY=V1,V2, as in sensing.noise_scale=0,1,2"
_WORD: Final = re.compile(r"[A-Za-z_./][\w./-]*")
"""Text that needs no quotes in YAML, unless it is `_UNQUOTED`."""
_UNQUOTED: Final = re.compile(r"null|true|false|[-+.]?(inf|nan|[\d.]+.*)", re.IGNORECASE)

Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Override:
    """Value of a dotted key, and the place where it was given; relative paths in it begin at `folder`."""

    key: str
    value: Value
    place: Place = field(compare=False)

    @property
    def path(self) -> KeyPath:
        """Keys and list indices from the root of the file."""
        return _parsed(self.key)

    def diagnostic(self, problem: str, expected: str, code: Code = Code.VALUE) -> Diagnostic:
        """Diagnostic at the place where the override was given."""
        return self.place.diagnostic(self.key, problem, expected, code)


def parse_overrides(texts: Iterable[str], argument: str) -> tuple[Override, ...]:
    """Overrides from ``KEY=VALUE`` texts, with the value in YAML; `argument` is the name of the argument.

    Raises:
        InputError: with every problem.
    """
    found: list[Override] = []
    problems: list[Diagnostic] = []
    for text in texts:
        try:
            key, value = _split(text, argument)
            found.append(Override(key, _value(key, value, argument), Place(argument, argument=True)))
        except InputError as error:
            problems += error.diagnostics
    problems += repeated(found)
    if problems:
        raise InputError(problems)
    return tuple(found)


def parse_sweeps(texts: Iterable[str], argument: str) -> tuple[tuple[Override, ...], ...]:
    """Overrides of each ``KEY=V1,V2,...``, one tuple for each key; the values are those of a YAML list.

    Raises:
        InputError: with every problem.
    """
    found: list[tuple[Override, ...]] = []
    problems: list[Diagnostic] = []
    for text in texts:
        try:
            key, values = _split(text, argument, SWEEP_EXAMPLE)
            given = _value(key, f"[{values}]", argument)
            place = Place(argument, argument=True)
            if not isinstance(given, tuple) or not given:
                raise InputError([place.diagnostic(key, "has no value", SWEEP_EXAMPLE, Code.MISSING)])
            problems += repeated_values(key, given, place)
            found.append(tuple(Override(key, value, place) for value in given))
        except InputError as error:
            problems += error.diagnostics
    problems += repeated([sweep[0] for sweep in found])
    if problems:
        raise InputError(problems)
    return tuple(found)


def repeated_values(key: str, values: Sequence[Value], place: Place) -> list[Diagnostic]:
    """Problems of the values of a varied key that are given twice."""
    return [
        place.diagnostic(key, f"has the value {value_text(value)} twice", "expected it once", Code.DUPLICATE)
        for k, value in enumerate(values)
        if any(value == other and isinstance(value, bool) == isinstance(other, bool) for other in values[:k])
    ]


def overrides_of(values: Mapping[str, Any] | Sequence[Override], argument: str = "settings") -> tuple[Override, ...]:
    """Overrides from a mapping of dotted keys to values, as in Python code; `argument` is the name of the argument.

    Overrides stay as they are.

    Raises:
        InputError: if a key is not a dotted key, or lies within another one.
        TypeError: if the values are neither.
    """
    if not isinstance(values, Mapping):
        return all_of_kind(Override, values, argument)
    place = Place(argument, argument=True)
    found = [Override(str(key), frozen(value), place) for key, value in values.items()]
    problems = [each.diagnostic("is not a dotted key", EXAMPLE, Code.SYNTAX) for each in found if not each.path]
    problems += repeated(found)
    if problems:
        raise InputError(problems)
    return tuple(found)


def all_of_kind(kind: type[Kind], values: Sequence[Kind], argument: str) -> tuple[Kind, ...]:
    """Values of an argument that may be a mapping and is not, all of one kind.

    Raises:
        TypeError: if they are not.
    """
    if isinstance(values, Sequence) and all(isinstance(each, kind) for each in values):
        return tuple(values)
    raise TypeError(f"{argument}: expected a mapping of dotted keys, not {type(values).__name__}")


def repeated(overrides: Sequence[Override]) -> list[Diagnostic]:
    """Problems of overrides whose keys are equal or lie within one another."""
    problems = []
    for k, later in enumerate(overrides):
        for earlier in overrides[:k]:
            short, long = sorted((earlier.path, later.path), key=len)
            if long[: len(short)] == short:
                problem = "is set twice" if long == short else f"is set together with {earlier.key}"
                problems.append(later.diagnostic(problem, "expected each key once", Code.DUPLICATE))
                break
    return problems


def overridden(document: Document, overrides: Sequence[Override]) -> Document:
    """Document with the values of `overrides`; missing mappings on the way to a key are added.

    Raises:
        InputError: if a key lies within a value that has no keys, or an index is beyond the end of a list.
    """
    data, places = document.data, dict(document.source.replaced)
    problems: list[Diagnostic] = []
    for override in overrides:
        try:
            path, data = _replaced(data, override.path, override)
            kept = {at: place for at, place in places.items() if at[: len(path)] != path}  # others are overwritten
            places = kept | {path: override.place}
        except InputError as error:
            problems += error.diagnostics
    if problems:
        raise InputError(problems)
    replaced = {override.path for override in overrides}
    usable = frozenset(at for at in document.unusable if not any(at[: len(path)] == path for path in replaced))
    return replace(document, data=data, source=replace(document.source, replaced=places), unusable=usable)


def value_text(value: Any, digits: int | None = None) -> str:
    """Value in one line of YAML, numbers exactly or with some digits; lists may be tuples."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_text(key)}: {value_text(each, digits)}" for key, each in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(value_text(each, digits) for each in value) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, float):
        short = f"{value:.{digits or 12}g}"
        return short if digits or float(short) == value else repr(value)
    return str(value)


def _text(value: str) -> str:
    """Text in YAML, in quotes where it needs them; characters that cannot be printed are escaped."""
    if _WORD.fullmatch(value) and not _UNQUOTED.fullmatch(value):
        return value
    quoted = json.dumps(value, ensure_ascii=False)  # otherwise with surrogates, which YAML does not have
    return "".join(each if each.isprintable() else f"\\U{ord(each):08x}" for each in quoted)


def plain_value(value: Value) -> Any:
    """Value for a JSON file."""
    if isinstance(value, dict):
        return {key: plain_value(each) for key, each in value.items()}
    return [plain_value(each) for each in value] if isinstance(value, tuple) else value


def _split(text: str, argument: str, expected: str = EXAMPLE) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not _parsed(key):
        raise InputError([Place(argument, argument=True).diagnostic("", f"is {text!r}", expected, Code.SYNTAX)])
    return key, value


def _value(key: str, text: str, argument: str) -> Value:
    """Value from YAML; an empty text is null."""
    if not text.strip():
        return None
    place = Place(argument, argument=True)
    try:
        document = parse_document(text, argument)
    except InputError as error:
        raise InputError(place.diagnostic(key, d.problem, d.expected, d.code) for d in error.diagnostics) from None
    if document.problems:
        raise InputError(place.diagnostic(key, d.problem, d.expected, d.code) for d in document.problems)
    return document.data


def _parsed(key: str) -> KeyPath:
    """Keys and indices of a dotted key; empty if it is malformed.  An index may be written ``[0]`` or ``.0``."""
    path = parse_path(key)
    well_formed = format_path(path) == key and all(part != "" for part in path)
    return tuple(int(p) if isinstance(p, str) and p.isdecimal() else p for p in path) if well_formed else ()


def _replaced(data: Value, path: KeyPath, override: Override) -> tuple[KeyPath, Value]:
    """`data` with the override's value at `path`, and before it the path of what is new in it."""
    if not path:
        return (), override.value
    if isinstance(data, Unusable):  # its problem is reported, and what is in it is not known
        return path, data
    first, rest = path[0], path[1:]
    if isinstance(data, tuple):
        if not isinstance(first, int):
            raise InputError([override.diagnostic(f"{first} is not an index of a list", "expected a whole number")])
        if first >= len(data):
            problem = f"there is no item {first}"
            raise InputError([override.diagnostic(problem, f"expected less than {len(data)}", Code.UNKNOWN)])
        at, value = _replaced(data[first], rest, override)
        return (first, *at), (*data[:first], value, *data[first + 1 :])
    before = format_path(override.path[: len(override.path) - len(path)])
    if data is None and isinstance(first, int):
        problem = f"there is no item {first}: the file has no {before}"
        raise InputError([override.diagnostic(problem, f"expected the whole list, as in {before}=[...]", Code.UNKNOWN)])
    if isinstance(data, dict) or data is None:
        key = str(first)
        inner = data or {}
        at, value = _replaced(inner.get(key), rest, override)
        return (key, *at) if key in inner else (key,), {**inner, key: value}
    raise InputError([override.diagnostic(f"{before} has no keys", "expected a key of the file", Code.UNKNOWN)])
