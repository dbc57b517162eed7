"""Schemas of files, and the validation of a document against its schema: every problem is reported at its place."""

from __future__ import annotations

import sys
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import (
    Annotated,
    Any,
    ClassVar,
    Final,
    Literal,
    Self,
    TypeAlias,
    TypeGuard,
    TypeVar,
    Union,
    get_args,
    get_origin,
)

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints, ValidationError, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from kraft.config.document import Document, Value, frozen
from kraft.config.source import KeyPath, Source
from kraft.config.yaml_reader import read_document
from kraft.errors import Code, Diagnostic, InputError
from kraft.text import counted, nearest, suggestion
from ompl_ext.names import SYMBOL


class StrictModel(BaseModel):
    """Mapping in a file: frozen, without unknown keys, without conversions between types."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    synonyms: ClassVar[Mapping[str, str]] = {}
    """Keys for unknown ones that mean the same, for suggestions."""

    @model_validator(mode="after")
    def _check_across_keys(self) -> Self:
        for error in self.across_keys(self.model_dump()):
            raise error
        return self

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Copy with other values for some keys, which are checked as those of a file are; they may be those of numpy.

        Raises:
            InputError: with every key that does not exist, and every value that is not allowed.
        """
        if not update:
            return super().model_copy(deep=deep)
        checked = build(type(self), {**dict(self), **frozen(update)}, type(self).__name__)
        # a key may decide what others are; those that keep their value do not count as given
        changed = {key: value for key, value in checked if key in update or value != getattr(self, key)}
        return super().model_copy(update=changed, deep=deep)

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Problems between keys, see `refuse`; checked even if single keys are wrong, where pydantic checks nothing.

        `content` is the mapping as it was written, with values of any type, or that of a valid model.
        """
        yield from ()


def refuse(problem: str, expected: str, at: KeyPath = (), code: Code = Code.VALUE) -> PydanticCustomError:
    """Error for a validator to raise; ``at`` is its place relative to the validated value."""
    context = {"problem": problem, "expected": expected, "at": at, "code": code}
    return PydanticCustomError("kraft", "{problem}; {expected}", context)


def _ascending(interval: tuple[float, float]) -> tuple[float, float]:
    low, high = interval
    if low >= high:
        raise refuse(f"the interval [{low:g}, {high:g}] is empty or inverted", "expected [low, high] with low < high")
    if high - low < LENGTH_MIN:
        raise refuse(f"the interval [{low:g}, {high:g}] is too short", f"expected at least {LENGTH_MIN:g} m")
    return interval


LENGTH_MIN: Final = 0.001
"""Metres. No robot and no map resolves less, and products of tiny lengths underflow to 0."""
LENGTH_MAX: Final = 10_000.0
"""Metres. A larger workspace is a typing mistake, and grids over it would not fit into memory."""

MASS_MIN: Final = 0.001
"""Kilograms. Nothing lighter resists a push, and MuJoCo refuses moments of inertia below 1e-15 kg m^2."""

_USUAL: Final = frozenset({"name", "description"})
"""Keys of files of most kinds."""
KEYS_OF_ANOTHER_KIND: Final = 3
"""Number of unknown keys from which on a file without a known one counts as a file of another kind."""

NAME: Final = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,99}$"
"""Pattern of the name of what a file defines."""
Name: TypeAlias = Annotated[str, StringConstraints(pattern=NAME)]
Coordinate: TypeAlias = Annotated[float, Field(ge=-LENGTH_MAX, le=LENGTH_MAX)]
Length: TypeAlias = Annotated[float, Field(ge=LENGTH_MIN, le=LENGTH_MAX)]
Angle: TypeAlias = Annotated[float, Field(ge=-1e6, le=1e6)]
Mass: TypeAlias = Annotated[float, Field(ge=MASS_MIN, le=1e6)]
Positive: TypeAlias = Annotated[float, Field(gt=0, le=1e6)]
NonNegative: TypeAlias = Annotated[float, Field(ge=0, le=1e6)]
Probability: TypeAlias = Annotated[float, Field(ge=0, le=1)]
Symbol: TypeAlias = Annotated[str, StringConstraints(pattern=f"^{SYMBOL}$")]
ParameterValue: TypeAlias = Annotated[float, Field(ge=-1e9, le=1e9)]
Number: TypeAlias = Annotated[float, Field(ge=-1e12, le=1e12)]
Point: TypeAlias = tuple[Coordinate, Coordinate]
Size: TypeAlias = tuple[Length, Length]
Span: TypeAlias = Annotated[tuple[Coordinate, Coordinate], AfterValidator(_ascending)]


Model = TypeVar("Model", bound=BaseModel)
_NOUNS = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "string_type": "text",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
    "dict_type": "a mapping",
    "mapping_type": "a mapping",
}
_KEY_NOUNS: Final[Mapping[Any, str]] = {float: "a number", int: "a whole number"}
"""What a missing key is to be given, where its description is only a unit or a quantity."""
_LIMITS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "of at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "of at most"),
}


def read_model(path: Path, model: type[Model]) -> tuple[Model, Document]:
    """Read a file and validate it against its schema.

    Raises:
        InputError: with every problem of the file.
    """
    document = read_document(path)
    return valid(model, document), document


def valid(model: type[Model], document: Document) -> Model:
    """Validate a document.

    Raises:
        InputError: with every problem.
    """
    value, problems = check(model, document)
    if value is None:
        raise InputError(problems)
    return value


def check(model: type[Model], document: Document, *, across_keys: bool = True) -> tuple[Model | None, list[Diagnostic]]:
    """Validate a document. Returns the model or None, and all problems, those of the syntax included.

    Without `across_keys` the problems between keys are left out: the document is a part of one.
    """
    problems = list(document.problems)
    if _is_of_another_kind(model, document.data):
        expected = f"expected the keys {', '.join(_fields(model))}"
        other = document.source.diagnostic((), "none of the keys is known", expected, code=Code.MISMATCH)
        return None, [*problems, other]
    value = None
    try:
        value = model.model_validate(document.data)
    except ValidationError as error:
        details = error.errors(include_url=False)
        misspelt = _misspelt(model, details)
        for detail in details:
            if _counts_bad_items_as_absent(detail) or (detail["type"] == "missing" and detail["loc"] in misspelt):
                continue
            if detail["type"] == "kraft" and not across_keys:
                continue
            unknown = detail["type"] == "extra_forbidden"  # reported even if its value is unusable too
            if unknown or not _already_reported(in_file(model, detail["loc"]), document):
                problems.append(_diagnostic(model, document, detail))
        between = _across_keys(model, document) if across_keys else ()
        problems = list(dict.fromkeys([*problems, *between]))
    return (None if problems else value), problems


def _is_of_another_kind(model: type[BaseModel], data: object) -> bool:
    """Whether a file has several keys, and none of them is one of the schema alone, not even misspelt."""
    keys = {str(key) for key in data} - _USUAL if isinstance(data, Mapping) else set()
    known = _fields(model)
    return len(keys) >= KEYS_OF_ANOTHER_KIND and not any(key in known or nearest(key, known) for key in keys)


def build(model: type[Model], content: Mapping[str, Any], origin: str) -> Model:
    """Model from values that were not read from a file; errors name ``origin``.

    Raises:
        InputError: with every problem.
    """
    return valid(model, Document(dict(content), Source(origin)))


def part(model: type[Model], value: Value) -> Model | None:
    """``value`` as a model, or None if it is invalid; `check` of the whole document reports the errors."""
    try:
        return model.model_validate(value)
    except ValidationError:
        return None


def _across_keys(model: type[BaseModel], document: Document) -> Iterator[Diagnostic]:
    """Problems between keys of one mapping, which pydantic checks only if every single key of it is right."""
    for at, section, content in _sections(model, document.data):
        for error in section.across_keys(content):
            context = error.context or {}
            path = (*at, *context["at"])
            if not _already_reported(path, document):
                problem, expected = context["problem"], context["expected"]
                yield document.source.diagnostic(path, problem, expected, code=context["code"])


def _sections(
    annotation: Any, value: object, at: KeyPath = ()
) -> Iterator[tuple[KeyPath, type[StrictModel], Mapping[str, object]]]:
    """Every mapping in a value that has a schema of its own, with its path and its schema."""
    annotation = _bare(annotation)
    if isinstance(value, tuple):
        items = get_args(annotation)
        if get_origin(annotation) is tuple and Ellipsis in items:
            for k, item in enumerate(value):
                yield from _sections(items[0], item, (*at, k))
    elif isinstance(value, Mapping):
        annotation = _kinds(annotation).get(str(value.get("kind")), annotation)
        if isinstance(annotation, type) and issubclass(annotation, StrictModel):
            yield at, annotation, value
            for key, known in _fields(annotation).items():
                yield from _sections(known.annotation, value.get(key), (*at, key))
        elif get_origin(annotation) in (dict, Mapping) and len(get_args(annotation)) == 2:
            for key, item in value.items():
                yield from _sections(get_args(annotation)[1], item, (*at, str(key)))


def _misspelt(model: type[BaseModel], details: list[ErrorDetails]) -> set[KeyPath]:
    """Missing keys that an unknown key beside them probably stands for: one mistake gives one problem."""
    unknown = [detail["loc"] for detail in details if detail["type"] == "extra_forbidden"]
    meant = [(path[:-1], nearest(str(path[-1]), lookup(model, path[:-1]).keys)) for path in unknown]
    return {(*parent, key) for parent, key in meant if key is not None}


def _counts_bad_items_as_absent(detail: ErrorDetails) -> bool:
    """Whether pydantic reports a list as too short only because it does not count invalid items."""
    given = detail["input"]
    return detail["type"] == "too_short" and isinstance(given, tuple) and len(given) >= detail["ctx"]["min_length"]


def _already_reported(path: tuple[int | str, ...], document: Document) -> bool:
    return any(path[:end] in document.unusable for end in range(len(path) + 1))


def _diagnostic(model: type[BaseModel], document: Document, detail: ErrorDetails) -> Diagnostic:
    path: KeyPath = in_file(model, detail["loc"])
    kind, given, context = detail["type"], detail["input"], detail.get("ctx", {})
    if path and path[-1] == "[key]":  # pydantic's mark of an invalid key
        expected = "expected letters, digits and _, no digit first"
        return document.source.diagnostic(path[:-1], "is no valid name", expected, at_key=True)
    source = document.source
    known = lookup(model, detail["loc"])
    about = f" ({known.description})" if known.description else ""
    if kind == "kraft":
        at, problem, expected = context["at"], context["problem"], context["expected"]
        return source.diagnostic((*path, *at), problem, expected, code=context["code"])
    if kind == "extra_forbidden":
        beside, key = lookup(model, detail["loc"][:-1]), str(path[-1])
        meant = beside.synonyms.get(key.lower())
        expected = suggestion(key, beside.keys) if meant is None else f"did you mean {meant!r}?"
        return source.diagnostic(path, "unknown key", expected, at_key=True, code=Code.UNKNOWN)
    if kind in ("missing", "union_tag_not_found"):
        return _missing(source, path, known, "kind" if kind == "union_tag_not_found" else "")
    if kind == "union_tag_invalid":
        tags = [tag.strip(" '") for tag in context["expected_tags"].split(",")]
        return source.diagnostic((*path, "kind"), f"is {describe(given['kind'])}", suggestion(context["tag"], tags))
    if kind == "too_long":
        most = counted(context["max_length"], "item")
        return source.diagnostic(path, "the list is too long", f"expected {most}{about}")
    if kind == "too_short":
        least = counted(context["min_length"], "item")
        return source.diagnostic(path, "the list is too short", f"expected {least} or more")
    if kind == "literal_error":
        return source.diagnostic(path, f"is {describe(given)}", suggestion(str(given), known.choices))
    if kind in _LIMITS:
        key, words = _LIMITS[kind]
        return source.diagnostic(path, f"is {describe(given)}", f"expected a number {words} {context[key]:g}{about}")
    if kind == "string_pattern_mismatch":
        return source.diagnostic(path, f"is {describe(given)}", f"expected a {known.description}")
    if kind in _NOUNS:
        code = Code.VALUE if kind == "finite_number" else Code.TYPE
        return source.diagnostic(path, f"is {describe(given)}", f"expected {_NOUNS[kind]}{about}", code=code)
    return source.diagnostic(path, detail["msg"][:1].lower() + detail["msg"][1:], f"expected another value{about}")


def _missing(source: Source, path: KeyPath, known: KeySchema, discriminator: str) -> Diagnostic:
    if discriminator:
        path, expected = (*path, discriminator), "expected which one it is"
    elif isinstance(path[-1], int):  # an item of a list of fixed length
        about = f" ({known.description})" if known.description else ""
        return source.diagnostic(path[:-1], "the list is too short", f"expected {known.length} items{about}")
    else:
        noun, meaning = _KEY_NOUNS.get(known.annotation), known.description
        expected = f"expected {noun} ({meaning})" if noun and meaning else f"expected {meaning or noun or 'it'}"
    return source.diagnostic(path, "the key is missing", expected, code=Code.MISSING)


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value of a file, which may be anything, is a number that can be computed with."""
    if isinstance(value, int) and not isinstance(value, bool):
        return abs(value) <= sys.float_info.max
    return isinstance(value, float)


def describe(value: object) -> str:
    """Value as a phrase: ``the text 'x'``, ``the number 3``, ``a list``."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        whole = isinstance(value, float) and value.is_integer()  # 2e4: no whole number, because it is written as 2e4
        return f"the number {value:.12g}" if isinstance(value, float) and not whole else f"the number {value}"
    if isinstance(value, str):
        return f"the text {value if len(value) <= 40 else value[:37] + '...'!r}"
    if isinstance(value, Mapping):
        return "a mapping"
    return "a list" if isinstance(value, list | tuple) else f"a value of type {type(value).__name__}"


@dataclass(frozen=True)
class KeySchema:
    """Description, type, keys and their synonyms, choices and length that the schema has for one place."""

    description: str | None = None
    annotation: Any = None
    keys: tuple[str, ...] = ()
    choices: tuple[str, ...] = ()
    length: int = 0
    synonyms: Mapping[str, str] = field(default_factory=dict)


def lookup(model: type[BaseModel], path: KeyPath) -> KeySchema:
    """Schema at a key path of pydantic's."""
    annotation, description, length = _follow(model, path)
    if annotation is None:
        return KeySchema()
    annotation = _bare(annotation)
    keys: tuple[str, ...] = ()
    synonyms: Mapping[str, str] = {}
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        keys = tuple(_fields(annotation))
        synonyms = annotation.synonyms if issubclass(annotation, StrictModel) else {}
    choices = tuple(str(c) for c in get_args(annotation)) if get_origin(annotation) is Literal else ()
    return KeySchema(description, annotation, keys, choices, length, synonyms)


def in_file(model: type[BaseModel], path: KeyPath) -> KeyPath:
    """Key path in the file for one of pydantic's, which contains the kinds of union members as if they were keys."""
    return tuple(part for i, part in enumerate(path) if part not in _kinds(_bare(_follow(model, path[:i])[0])))


def _follow(model: type[BaseModel], path: KeyPath) -> tuple[Any, str | None, int]:
    """Annotation at a path (None if there is none), its description, and the length of the list it is in."""
    annotation: Any = model
    description: str | None = None
    length = 0
    for part in path:
        annotation = _bare(annotation)
        arguments = get_args(annotation)
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            found = _fields(annotation).get(str(part))
            if found is None:
                return None, None, 0
            annotation, description = found.annotation, found.description
        elif part in _kinds(annotation):
            annotation = _kinds(annotation)[str(part)]
        elif get_origin(annotation) is tuple and isinstance(part, int):
            length = len(arguments)
            if Ellipsis in arguments:  # the description belongs to the list, not to an item
                annotation, description = arguments[0], None
            else:
                annotation = arguments[min(part, length - 1)]
        elif len(arguments) == 2:
            annotation, description = arguments[1], None
        else:
            return None, None, 0
    return annotation, description, length


def _fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """Fields of a model by their key in the file."""
    return {field.alias or name: field for name, field in model.model_fields.items()}


def _bare(annotation: Any) -> Any:
    """Strip ``Annotated`` and ``| None``."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return _bare(get_args(annotation)[0])
    if origin in (Union, types.UnionType):
        members = [a for a in get_args(annotation) if a is not type(None)]
        return _bare(members[0]) if len(members) == 1 else annotation
    return annotation


def _kinds(annotation: Any) -> dict[str, Any]:
    """Members of a union of models by their ``kind``, empty if the annotation is no such union."""
    if get_origin(annotation) not in (Union, types.UnionType):
        return {}
    members = [m for m in get_args(annotation) if isinstance(m, type) and issubclass(m, BaseModel)]
    return {get_args(m.model_fields["kind"].annotation)[0]: m for m in members if "kind" in m.model_fields}
