"""JSON reader that keeps line and column of every value, as `kraft.config.yaml_reader` does for YAML.

For files that kraft writes itself: they may be large, and the YAML reader is much slower.  Numbers and words have the
same values in both, and integers may have more digits here: a seed is any whole number.  Repeated keys are errors.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_right
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from kraft.config.document import DEPTH_MAX, Document, Unusable, Value, decode, holds_surrogate, read_bytes
from kraft.config.scalar import AmbiguousScalar, plain_scalar
from kraft.config.source import KeyPath, Position, Source
from kraft.errors import Code, Diagnostic, InputError

_SPACE: Final = re.compile(r"[ \t\r\n]*")
_WORD: Final = re.compile(r"[-+.\w]+")
_JSON_WORD: Final = re.compile(r"-?(0|[1-9][0-9]*)(\.[0-9]+)?([eE][-+]?[0-9]+)?\Z|true\Z|false\Z|null\Z")
_STRINGS: Final = json.JSONDecoder()
_DIGITS_MAX: Final = 300
"""Most digits of an integer: all of 300 digits are finite as a float."""
_HALF_PAIR: Final = "contains half of a surrogate pair"


def read_json(path: Path, bytes_max: int, expected: str) -> Document:
    """Read the file at `path`; errors end with `expected`.

    Raises:
        InputError: if the file cannot be read, is larger than `bytes_max`, is not UTF-8, or is not JSON.
    """
    file = str(path)
    content = read_bytes(path, bytes_max, expected)
    return _Scanner(file, decode(content, file), expected).document()


@dataclass
class _Scanner:
    """Converts text to values and records every problem and position."""

    file: str
    text: str
    expected: str
    values: dict[KeyPath, Position] = field(default_factory=dict)
    keys: dict[KeyPath, Position] = field(default_factory=dict)
    problems: list[Diagnostic] = field(default_factory=list)
    unusable: set[KeyPath] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.line_starts = [0, *(newline.end() for newline in re.finditer("\n", self.text))]

    def document(self) -> Document:
        data, end = self.value(self.skip(0), ())
        if self.skip(end) < len(self.text):
            raise self.syntax_error(self.skip(end), "text follows the value")
        source = Source(self.file, self.values, self.keys)
        return Document(data, source, tuple(self.problems), frozenset(self.unusable))

    def value(self, at: int, path: KeyPath) -> tuple[Value, int]:
        """Value that begins at an offset, and the offset of its end."""
        self.values[path] = self.position(at)
        if len(path) >= DEPTH_MAX:
            raise self.syntax_error(at, "nested too deep")
        match self.text[at : at + 1]:
            case "{":
                return self.mapping(at, path)
            case "[":
                return self.sequence(at, path)
            case '"':
                text, end = self.string(at)
                if holds_surrogate(text):
                    return self.reject(at, path, _HALF_PAIR, "expected text that UTF-8 can write", Code.SYNTAX), end
                return text, end
        return self.word(at, path)

    def mapping(self, at: int, path: KeyPath) -> tuple[dict[str, Value], int]:
        result: dict[str, Value] = {}
        at = self.skip(at + 1)
        while self.text[at : at + 1] != "}":
            if result:
                at = self.skip(self.expect(",", at))
            if self.text[at : at + 1] != '"':
                raise self.syntax_error(at, "a key in double quotes is missing")
            position = self.position(at)
            key, end = self.string(at)
            if holds_surrogate(key):
                raise self.syntax_error(at, f"a key {_HALF_PAIR}")
            inner = (*path, key)
            if key in result:
                problem = f"the key is repeated; it is first at {self.keys[inner]}"
                self.report(position, inner, problem, "expected it once", Code.DUPLICATE)
            self.keys.setdefault(inner, position)
            value, end = self.value(self.skip(self.expect(":", self.skip(end))), inner)
            result.setdefault(key, value)
            at = self.skip(end)
        return result, at + 1

    def sequence(self, at: int, path: KeyPath) -> tuple[tuple[Value, ...], int]:
        items: list[Value] = []
        at = self.skip(at + 1)
        while self.text[at : at + 1] != "]":
            if items:
                at = self.skip(self.expect(",", at))
            item, end = self.value(at, (*path, len(items)))
            items.append(item)
            at = self.skip(end)
        return tuple(items), at + 1

    def string(self, at: int) -> tuple[str, int]:
        try:
            return _STRINGS.raw_decode(self.text, at)
        except json.JSONDecodeError as error:
            raise self.syntax_error(error.pos, error.msg[:1].lower() + error.msg[1:]) from None

    def word(self, at: int, path: KeyPath) -> tuple[Value, int]:
        word = _WORD.match(self.text, at)
        if word is None:
            raise self.syntax_error(at, "a value is missing")
        if not _JSON_WORD.match(word[0]):
            raise self.syntax_error(at, f"{word[0][:40]} is neither a number nor true, false or null")
        try:
            return plain_scalar(word[0], _DIGITS_MAX), word.end()
        except AmbiguousScalar as error:
            return self.reject(at, path, error.problem, error.expected, Code.VALUE), word.end()

    def skip(self, at: int) -> int:
        """Offset of the next character that is not white space."""
        space = _SPACE.match(self.text, at)
        return space.end() if space else at

    def expect(self, character: str, at: int) -> int:
        if self.text[at : at + 1] != character:
            raise self.syntax_error(at, f"{character!r} is missing")
        return at + 1

    def position(self, at: int) -> Position:
        line = bisect_right(self.line_starts, at)
        return Position(line, at - self.line_starts[line - 1] + 1)

    def report(self, position: Position, path: KeyPath, problem: str, expected: str, code: Code) -> None:
        at = Source(self.file, {path: position})
        self.problems.append(at.diagnostic(path, problem, expected, code=code))

    def reject(self, at: int, path: KeyPath, problem: str, expected: str, code: Code) -> Unusable:
        self.report(self.position(at), path, problem, expected, code)
        self.unusable.add(path)
        return Unusable()

    def syntax_error(self, at: int, problem: str) -> InputError:
        line, column = self.position(at).line, self.position(at).column
        return InputError(
            [Diagnostic(self.file, f"not JSON ({problem})", self.expected, line, column, code=Code.SYNTAX)]
        )
