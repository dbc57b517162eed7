"""Where a value of a configuration comes from: its position in a file, or the override that replaces it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from kraft.errors import Code, Diagnostic

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
    """Place where a value was given that is not in the file itself: an argument, or a position in another file.

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
    """Positions of the values and keys of one file, and the places of values that it does not state itself.

    Those are values that replace the ones of the file, and values of its base.

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
        """Place of the override that the value at `path` comes from; None if it comes from the file.

        It is the innermost one: an override may have added the section that another one sets a key of.
        """
        ends = range(len(path), -1, -1)
        return next((self.replaced[path[:end]] for end in ends if path[:end] in self.replaced), None)

    def folder(self, path: KeyPath | str) -> Path:
        """Folder that a relative path in the value at `path` begins at."""
        place = self.replacement(parse_path(path) if isinstance(path, str) else path)
        return Path(self.file).parent if place is None else place.folder or Path.cwd()

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
