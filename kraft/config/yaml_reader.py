"""YAML reader that keeps line and column of every value, so that later errors can point at them.

A `Source` has the positions of all values.  Anchors and aliases work (a value used through an alias is reported where
it is written).  Merge keys, tags, repeated keys and several documents in one file are errors. Unquoted words have one
meaning only, see `plain_scalar`.  Lists become tuples, because configuration does not change after reading.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Final

import yaml

from kraft.config.document import DEPTH_MAX, TOO_DEEP, Document, Unusable, Value, holds_surrogate, read_bytes
from kraft.config.scalar import AmbiguousScalar, plain_scalar
from kraft.config.source import KeyPath, Position, Source
from kraft.config.yaml_nodes import PLAIN, WRITTEN, compose
from kraft.errors import Code, Diagnostic, InputError

NODES_MAX: Final = 100_000
"""Largest number of values after resolving aliases: a few lines of aliases can stand for billions."""
_STANDARD: Final = "tag:yaml.org,2002:"


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
        tag = node.tag.removeprefix(WRITTEN).replace(_STANDARD, "!!")
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
