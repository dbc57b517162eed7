"""YAML reader that keeps line and column of every value, so that later errors can point at them.

A `Source` has the positions of all values.  Anchors and aliases work (a value used through an alias is reported where
it is written).  Merge keys, tags, repeated keys and several documents in one file are errors. Unquoted words have one
meaning only, see `plain_scalar`.  Lists become tuples, because configuration does not change after reading.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, TypeAlias

import yaml

from kraft.errors import Code, Diagnostic, InputError

KeyPath: TypeAlias = tuple[str | int, ...]
"""Keys and list indices from the root: ``("obstacles", 1, "box")`` is written ``obstacles[1].box``."""


@dataclass(frozen=True, order=True)
class Position:
    """Line and column in a file, both counted from 1."""

    line: int
    column: int

    def __str__(self) -> str:
        return f"line {self.line}, column {self.column}"


def format_path(path: KeyPath) -> str:
    """Key path as text: ``obstacles[1].box.size[0]``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            text += f".{part}" if text else part
    return text


def parse_path(text: str) -> KeyPath:
    """Inverse of `format_path`. Keys must not contain ``.``, ``[`` or ``]``."""
    return tuple(int(index) if index else key for key, index in re.findall(r"([^.\[\]]+)|\[(\d+)\]", text) or [])


@dataclass(frozen=True)
class Place:
    """Place where the value of an override was given: an argument, or a position in another file.

    Relative paths in the value begin at `folder`, by default the working directory.
    """

    file: str
    position: Position | None = None
    argument: bool = False
    folder: Path | None = None

    def diagnostic(self, key: str, problem: str, expected: str, code: Code = Code.VALUE) -> Diagnostic:
        """Diagnostic at this place about a dotted key."""
        line, column = (self.position.line, self.position.column) if self.position else (None, None)
        return Diagnostic(self.file, problem, expected, line, column, key, code, self.argument)


@dataclass(frozen=True)
class Source:
    """Positions of the values and keys of one file, and the places of values that replace those of the file.

    A scenario that was built in code has an empty source, which has no positions.
    """

    file: str = "<built in code>"
    values: Mapping[KeyPath, Position] = field(default_factory=dict, repr=False)
    keys: Mapping[KeyPath, Position] = field(default_factory=dict, repr=False)
    replaced: Mapping[KeyPath, Place] = field(default_factory=dict, repr=False)

    def where(self, path: KeyPath | str) -> Position | None:
        """Position of the value at ``path``.

        A key that the file omits has the position of the nearest enclosing key.  None if nothing was read from a
        file.
        """
        parts = parse_path(path) if isinstance(path, str) else path
        for end in range(len(parts), -1, -1):
            for table in (self.values, self.keys) if end == len(parts) else (self.keys, self.values):
                if parts[:end] in table:
                    return table[parts[:end]]
        return None

    def replacement(self, path: KeyPath) -> Place | None:
        """Place of the override that the value at `path` comes from; None if it comes from the file."""
        return next((self.replaced[path[:end]] for end in range(len(path) + 1) if path[:end] in self.replaced), None)

    def diagnostic(
        self, path: KeyPath | str, problem: str, expected: str, *, at_key: bool = False, code: Code = Code.VALUE
    ) -> Diagnostic:
        """Diagnostic at the value of ``path``, or at the key itself if the key is wrong."""
        parts = parse_path(path) if isinstance(path, str) else path
        if (place := self.replacement(parts)) is not None:
            return place.diagnostic(format_path(parts), problem, expected, code)
        position = self.keys.get(parts) if at_key else None
        position = position or self.where(parts)
        line, column = (position.line, position.column) if position else (None, None)
        return Diagnostic(self.file, problem, expected, line, column, format_path(parts), code)


BYTES_MAX: Final = 256 * 1024
DEPTH_MAX: Final = 50
NODES_MAX: Final = 100_000  # after resolving aliases: a few lines of aliases can stand for billions of values
TOO_DEEP: Final = "nested too deep"
PLAIN: Final = "!plain"
"""Tag of an unquoted word, whose value `plain_scalar` decides."""
_STANDARD: Final = "tag:yaml.org,2002:"
_VALID: Final = "expected YAML, such as 'key: value'"
Scalar: TypeAlias = str | int | float | bool | None
Value: TypeAlias = "Scalar | tuple[Value, ...] | dict[str, Value] | Unusable"


class Unusable:
    """Placeholder of a value whose problem is already reported."""

    def __repr__(self) -> str:
        return "<unusable>"


@dataclass(frozen=True)
class Document:
    """The content of one file.

    Attributes:
        data: root value; lists are tuples, and a value that could not be read is an `Unusable`.
        source: positions of values and keys.
        problems: problems of the syntax; `data` is usable apart from their places.
        unusable: places in `data` that hold an `Unusable`.
    """

    data: Value
    source: Source
    problems: tuple[Diagnostic, ...] = ()
    unusable: frozenset[KeyPath] = frozenset()


def read_document(path: Path) -> Document:
    """Read the file at ``path``.

    Raises:
        InputError: if the file cannot be read, is too large, is not UTF-8, or is not one YAML document.
    """
    return parse_document(read_bytes(path), str(path))


def parse_document(content: bytes | str, file: str) -> Document:
    """Parse the content of a file; errors name ``file``.

    Raises:
        InputError: if it is too large, not UTF-8, or not one YAML document.
    """
    return _Converter(file).document(_root(content, file))


@lru_cache(maxsize=16)
def _root(content: bytes | str, file: str) -> yaml.Node:
    """`compose`, which takes most of the time, once for a file that is read repeatedly; nobody changes the nodes."""
    return compose(content, file)


def read_bytes(path: Path, bytes_max: int = BYTES_MAX, expected: str = "expected a YAML file") -> bytes:
    """Content of a file of at most `bytes_max` bytes; errors end with `expected`.

    Raises:
        InputError: if it cannot be read or is larger.
    """
    file = str(path)
    try:
        with path.open("rb") as stream:
            content = stream.read(bytes_max + 1)
    except FileNotFoundError:
        raise InputError.of(file, "there is no such file", expected, Code.NOT_FOUND) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError.of(file, f"cannot be read ({reason})", expected, Code.UNREADABLE) from error
    if len(content) > bytes_max:
        raise InputError.of(file, f"is larger than {bytes_max // 1024} KiB", expected, Code.UNREADABLE)
    return content


def compose(content: bytes | str, file: str) -> yaml.Node:
    """Root node of the content of a file; errors name ``file``.

    Raises:
        InputError: if it is empty, too large, not UTF-8, or not one YAML document.
    """
    if len(content) > BYTES_MAX:
        problem = f"is larger than {BYTES_MAX // 1024} KiB"
        raise InputError.of(file, problem, "expected a configuration file", Code.UNREADABLE)
    text = decode(content, file) if isinstance(content, bytes) else content.removeprefix("\ufeff")
    root = _composed(text, file)
    if root is None:
        raise _syntax_error(file, None, "the file is empty", "expected a mapping")
    return root


def decode(content: bytes, file: str) -> str:
    """Text of a file without its byte order mark.

    Raises:
        InputError: if it is not UTF-8.
    """
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        column = error.start - (content.rfind(b"\n", 0, error.start) + 1) + 1
        raise _syntax_error(
            file, Position(line, column), "is not UTF-8 text", "expected the file saved as UTF-8"
        ) from error


def _composed(text: str, file: str) -> yaml.Node | None:
    try:
        node: yaml.Node | None = _FastLoader(text).get_single_node()
    except (yaml.YAMLError, ValueError, OverflowError):
        return _composed_or_explained(text, file)
    return node


def _composed_or_explained(text: str, file: str) -> yaml.Node | None:
    """As `_composed`, by PyYAML's own parser, which describes what is wrong better."""
    loader: _Loader | None = None
    try:
        loader = _Loader(text)
        node: yaml.Node | None = loader.get_single_node()
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
        code = error.character if isinstance(error.character, int) else ord(str(error.character))
        problem = f"the character U+{code:04X} is not allowed"
        raise _syntax_error(file, Position(line, column), problem, "expected printable text") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise _syntax_error(file, _marked(mark), *_explained(error)) from error
    except (ValueError, OverflowError) as error:  # PyYAML raises these for some invalid escapes and directives
        position = _marked(loader.get_mark()) if loader else None
        raise _syntax_error(file, position, "not valid YAML (a number out of range)", _VALID) from error
    return node


class _Composer(yaml.composer.Composer):
    """PyYAML's composer with a limit of depth, which leaves unquoted words as they are.

    Composing is recursive: libyaml's own composer overflows the stack in a text that is nested too deep.
    """

    depth = 0

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        if kind is yaml.ScalarNode and implicit[0]:
            return PLAIN
        return super().resolve(kind, value, implicit)  # type: ignore[misc]

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.depth += 1
        if self.depth > DEPTH_MAX:
            mark = self.peek_event().start_mark  # type: ignore[attr-defined]
            raise yaml.MarkedYAMLError(problem=TOO_DEEP, problem_mark=mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


class _Loader(_Composer, yaml.SafeLoader):
    """Loader with PyYAML's own parser."""


if yaml.__with_libyaml__:

    class _CLoader(_Composer, yaml.CSafeLoader):
        """Loader with libyaml's parser, which takes a sixth of the time."""

        def __init__(self, text: str) -> None:
            yaml.CSafeLoader.__init__(self, text)
            yaml.composer.Composer.__init__(self)


_FastLoader: Any = _CLoader if yaml.__with_libyaml__ else _Loader


def _explained(error: yaml.MarkedYAMLError) -> tuple[str, str]:
    """Problem and expectation of a syntax error, with clear words for frequent mistakes."""
    problem = error.problem or "cannot be read"
    if error.context == "expected a single document in the stream":
        return "a second document begins here", "expected one document in a file"
    if "'\\t'" in problem:
        return "a tab is used for indentation", "expected spaces"
    if problem == TOO_DEEP:
        return problem, f"expected at most {DEPTH_MAX} levels"
    return f"not valid YAML ({problem}{f', {error.context}' if error.context else ''})", _VALID


def _syntax_error(file: str, at: Position | None, problem: str, expected: str) -> InputError:
    """Error at a position, by default the beginning of the file."""
    line, column = (at.line, at.column) if at else (1, 1)
    return InputError([Diagnostic(file, problem, expected, line, column, code=Code.SYNTAX)])


def _marked(mark: Any) -> Position | None:
    return Position(mark.line + 1, mark.column + 1) if mark else None


_SURROGATE = re.compile("[\ud800-\udfff]")


def holds_surrogate(text: str) -> bool:
    """Whether a text contains a surrogate, which escapes can write and UTF-8 cannot."""
    return _SURROGATE.search(text) is not None


@dataclass
class _Converter:
    """Converts nodes to values and records every problem and position."""

    file: str
    values: dict[KeyPath, Position] = field(default_factory=dict)
    keys: dict[KeyPath, Position] = field(default_factory=dict)
    problems: list[Diagnostic] = field(default_factory=list)
    unusable: set[KeyPath] = field(default_factory=set)
    open_nodes: list[yaml.Node] = field(default_factory=list)
    count: int = 0

    def document(self, root: yaml.Node) -> Document:
        data = self.value(root, ())
        source = Source(self.file, self.values, self.keys)
        return Document(data, source, tuple(self.problems), frozenset(self.unusable))

    def report(self, node: yaml.Node, path: KeyPath, problem: str, expected: str, code: Code = Code.SYNTAX) -> None:
        at = Source(self.file, {path: _position(node)})
        self.problems.append(at.diagnostic(path, problem, expected, code=code))

    def reject(self, node: yaml.Node, path: KeyPath, problem: str, expected: str, code: Code = Code.SYNTAX) -> Unusable:
        self.report(node, path, problem, expected, code)
        self.unusable.add(path)
        return Unusable()

    def value(self, node: yaml.Node, path: KeyPath) -> Value:
        self.values[path] = _position(node)
        self.count += 1
        if self.count > NODES_MAX:
            self.report(node, (), f"holds more than {NODES_MAX} values", "expected fewer aliases")
            raise InputError(self.problems)
        if node in self.open_nodes:
            return self.reject(node, path, "the alias refers to a value that contains it", "expected a finite value")
        if len(self.open_nodes) >= DEPTH_MAX:
            return self.reject(node, path, TOO_DEEP, f"expected at most {DEPTH_MAX} levels")
        self.open_nodes.append(node)
        value = self.content(node, path)
        self.open_nodes.pop()
        return value

    def content(self, node: yaml.Node, path: KeyPath) -> Value:
        if isinstance(node, yaml.SequenceNode) and node.tag == _STANDARD + "seq":
            return tuple(self.value(item, (*path, i)) for i, item in enumerate(node.value))
        if isinstance(node, yaml.MappingNode) and node.tag == _STANDARD + "map":
            return self.mapping(node, path)
        if isinstance(node, yaml.ScalarNode) and node.tag in (PLAIN, _STANDARD + "str"):
            return self.scalar(node, path)
        tag = node.tag.replace(_STANDARD, "!!")
        return self.reject(node, path, f"the tag {tag} is not supported", "expected the value without a tag")

    def scalar(self, node: yaml.ScalarNode, path: KeyPath) -> Value:
        text: str = node.value
        if holds_surrogate(text):
            return self.reject(node, path, "contains half of a surrogate pair", "expected text that UTF-8 can write")
        if node.tag != PLAIN:
            return text
        try:
            return plain_scalar(text)
        except AmbiguousScalar as error:
            return self.reject(node, path, error.problem, error.expected, Code.VALUE)

    def mapping(self, node: yaml.MappingNode, path: KeyPath) -> dict[str, Value]:
        result: dict[str, Value] = {}
        for key_node, value_node in node.value:
            key = self.key(key_node, path)
            if key is None:
                continue
            inner = (*path, key)
            if key in result:
                first = self.keys[inner]
                problem = f"the key is repeated; it is first at {first}"
                self.report(key_node, inner, problem, "expected it once", Code.DUPLICATE)
                continue
            self.keys[inner] = _position(key_node)
            result[key] = self.value(value_node, inner)
        return result

    def key(self, node: yaml.Node, path: KeyPath) -> str | None:
        """Text of a key, or None after a report if it is not text."""
        if not isinstance(node, yaml.ScalarNode) or node.tag not in (PLAIN, _STANDARD + "str"):
            self.report(node, path, "a key is a list, a mapping or tagged", "expected keys that are words")
        elif holds_surrogate(node.value):
            self.report(node, path, "a key contains half of a surrogate pair", "expected text that UTF-8 can write")
        elif node.value == "<<" and node.tag == PLAIN:
            self.report(node, path, "merge keys (<<) are not supported", "expected the keys written out")
        else:
            return str(node.value)
        return None


def _position(node: yaml.Node) -> Position:
    return Position(node.start_mark.line + 1, node.start_mark.column + 1)


_NULL = frozenset({"", "~", "null", "Null", "NULL"})
_TRUE = frozenset({"true", "True", "TRUE"})
_FALSE = frozenset({"false", "False", "FALSE"})
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?\Z")
_LEADING_ZERO = re.compile(r"([-+]?)0+([0-9]+)\Z")
_OTHER_BASE = re.compile(r"[-+]?0[xXoObB][0-9a-fA-F_]+\Z")
_UNDERSCORED = re.compile(r"[-+]?[0-9][0-9_]*_[0-9_]*(\.[0-9_]*)?\Z")
_NOT_FINITE = re.compile(r"([-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))\Z")
_DIGITS_MAX = 18  # every integer of 18 digits fits 64 bits


class AmbiguousScalar(ValueError):  # noqa: N818 - it names the word
    """Unquoted word without an unambiguous value."""

    def __init__(self, problem: str, expected: str) -> None:
        super().__init__(problem, expected)
        self.problem = problem
        self.expected = expected


def plain_scalar(word: str) -> Scalar:
    """Value of an unquoted word.

    Raises:
        AmbiguousScalar: for an integer with leading zeros, another base or underscores, a number that is
            not finite, and an integer beyond 18 digits.
    """
    if word in _NULL:
        return None
    if word in _TRUE or word in _FALSE:
        return word in _TRUE
    if _INTEGER.match(word):
        if len(word.lstrip("+-")) > _DIGITS_MAX:
            raise AmbiguousScalar(f"the number {_short(word)} is too large", "expected at most 18 digits")
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
            f"expected {_short(decimal)}, or quotes if it is text",
        )
    if _OTHER_BASE.match(word) or _UNDERSCORED.match(word):
        raise AmbiguousScalar(
            f"{_short(word)} is a number to some YAML readers and text to others",
            "expected a plain decimal number, or quotes if it is text",
        )
    if _NOT_FINITE.match(word):
        raise AmbiguousScalar(f"{word} is not a finite number", "expected a finite number")


def _short(word: str) -> str:
    return word if len(word) <= 40 else f"{word[:37]}..."
