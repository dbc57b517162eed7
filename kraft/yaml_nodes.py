"""Read YAML through its nodes, so that every value knows its line and column.

Anchors and aliases work (a value used through an alias is reported where it is written). Merge keys, tags,
repeated keys and several documents in one file are errors. Lists become tuples: configuration does not change
after it was read.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeAlias

import yaml

from kraft.errors import Diagnostic, InputError
from kraft.source import KeyPath, Position, Source
from kraft.yaml_scalars import AmbiguousScalar, Scalar, plain_scalar
from kraft.yaml_text import DEPTH_MAX, PLAIN, TOO_DEEP, compose, read_bytes

NODES_MAX: Final = 100_000  # after aliases are followed: a few lines of aliases can stand for billions

_STANDARD: Final = "tag:yaml.org,2002:"


class Unusable:
    """Stands for a value that was already reported."""

    def __repr__(self) -> str:
        return "<unusable>"


Value: TypeAlias = "Scalar | tuple[Value, ...] | dict[str, Value] | Unusable"


@dataclass(frozen=True)
class Document:
    """The content of one file.

    Attributes:
        data: the root value; lists are tuples, and what could not be read is an `Unusable`.
        source: where each value and key was written.
        problems: what was wrong with the YAML itself; `data` is usable apart from those places.
        unusable: the places in `data` that hold an `Unusable`.
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
    """Parse the content of a file; ``file`` is the name that errors carry.

    Raises:
        InputError: if it is too large, not UTF-8, or not one YAML document.
    """
    return _Converter(file).document(compose(content, file))


def _position(node: yaml.Node) -> Position:
    return Position(node.start_mark.line + 1, node.start_mark.column + 1)


@dataclass
class _Converter:
    """Turns nodes into values and notes every problem and position on the way."""

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

    def report(self, node: yaml.Node, path: KeyPath, problem: str, expected: str) -> None:
        at = Source(self.file, {path: _position(node)})
        self.problems.append(at.diagnostic(path, problem, expected))

    def reject(self, node: yaml.Node, path: KeyPath, problem: str, expected: str) -> Unusable:
        self.report(node, path, problem, expected)
        self.unusable.add(path)
        return Unusable()

    def value(self, node: yaml.Node, path: KeyPath) -> Value:
        self.values[path] = _position(node)
        self.count += 1
        if self.count > NODES_MAX:
            self.report(node, (), f"holds more than {NODES_MAX} values", "expected fewer aliases")
            raise InputError(self.problems)
        if node in self.open_nodes:
            return self.reject(node, path, "the alias stands for something it is part of", "expected a finite value")
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
        if any("\ud800" <= character <= "\udfff" for character in text):
            return self.reject(node, path, "holds half of a character", "expected text that UTF-8 can write")
        if node.tag != PLAIN:
            return text
        try:
            return plain_scalar(text)
        except AmbiguousScalar as error:
            return self.reject(node, path, error.problem, error.expected)

    def mapping(self, node: yaml.MappingNode, path: KeyPath) -> dict[str, Value]:
        result: dict[str, Value] = {}
        for key_node, value_node in node.value:
            key = self.key(key_node, path)
            if key is None:
                continue
            inner = (*path, key)
            if key in result:
                first = self.keys[inner]
                self.report(key_node, inner, f"the key is repeated; it is first at {first}", "expected it once")
                continue
            self.keys[inner] = _position(key_node)
            result[key] = self.value(value_node, inner)
        return result

    def key(self, node: yaml.Node, path: KeyPath) -> str | None:
        """Return the text of a key, or None after reporting that it is not text."""
        if not isinstance(node, yaml.ScalarNode) or node.tag not in (PLAIN, _STANDARD + "str"):
            self.report(node, path, "a key is a list, a mapping or tagged", "expected keys that are words")
        elif any("\ud800" <= character <= "\udfff" for character in node.value):
            self.report(node, path, "a key holds half of a character", "expected text that UTF-8 can write")
        elif node.value == "<<" and node.tag == PLAIN:
            self.report(node, path, "merge keys (<<) are not supported", "expected the keys written out")
        else:
            return str(node.value)
        return None
