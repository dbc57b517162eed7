"""What the readers of YAML and JSON share: the content of a file with its positions and problems, and its text."""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

from kraft.config.scalar import Scalar
from kraft.config.source import KeyPath, Position, Source
from kraft.errors import Code, Diagnostic, InputError

BYTES_MAX: Final = 256 * 1024
DEPTH_MAX: Final = 50
TOO_DEEP: Final = "nested too deep"
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


def frozen(value: Any) -> Any:
    """Value of Python or numpy as the readers give it: lists are tuples, numbers those of Python, paths text."""
    if isinstance(value, Mapping):
        return {str(key): frozen(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return tuple(frozen(each) for each in value)
    if hasattr(value, "tolist"):  # arrays and scalars of numpy, which is not imported for them
        return frozen(value.tolist())
    return str(value) if isinstance(value, Path) else value


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


def decode(content: bytes, file: str) -> str:
    """Text of a file without its byte order mark.

    Raises:
        InputError: if it is not UTF-8.
    """
    content = content.removeprefix(BOM_UTF8)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        before = content[: error.start].decode("utf-8")
        at = Position(before.count("\n") + 1, len(before) - before.rfind("\n"))
        raise syntax_error(file, at, "is not UTF-8 text", "expected the file saved as UTF-8") from error


def syntax_error(file: str, at: Position | None, problem: str, expected: str) -> InputError:
    """Error at a position, by default the beginning of the file."""
    line, column = (at.line, at.column) if at else (1, 1)
    return InputError([Diagnostic(file, problem, expected, line, column, code=Code.SYNTAX)])


_SURROGATE = re.compile("[\ud800-\udfff]")


def holds_surrogate(text: str) -> bool:
    """Whether a text contains a surrogate, which escapes can write and UTF-8 cannot."""
    return _SURROGATE.search(text) is not None
