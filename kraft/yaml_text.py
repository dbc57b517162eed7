"""From the bytes of a file to the nodes of its one YAML document; what is wrong is said with its place."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import yaml

from kraft.errors import Diagnostic, InputError

BYTES_MAX: Final = 256 * 1024
DEPTH_MAX: Final = 50
TOO_DEEP: Final = "nested too deep"
PLAIN: Final = "!plain"
"""Tag of a word without quotes, whose meaning is not decided here."""

_VALID: Final = "expected YAML, such as 'key: value'"


class _Loader(yaml.SafeLoader):
    """PyYAML's reader with a depth limit and without any opinion about unquoted words."""

    depth = 0

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        if kind is yaml.ScalarNode and implicit[0]:
            return PLAIN
        return super().resolve(kind, value, implicit)  # type: ignore[no-untyped-call]

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.depth += 1
        if self.depth > DEPTH_MAX:
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.MarkedYAMLError(problem=TOO_DEEP, problem_mark=mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def read_bytes(path: Path) -> bytes:
    """Read a configuration file, or a little more than the largest one allowed.

    Raises:
        InputError: if it cannot be read.
    """
    file = str(path)
    try:
        with path.open("rb") as stream:
            return stream.read(BYTES_MAX + 1)
    except FileNotFoundError:
        raise InputError.of(file, "there is no such file", "expected a YAML file") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError.of(file, f"cannot be read ({reason})", "expected a readable YAML file") from error


def compose(content: bytes | str, file: str) -> yaml.Node:
    """Return the root node of a file's content; ``file`` is the name that errors carry.

    Raises:
        InputError: if it is empty, too large, not UTF-8, or not one YAML document.
    """
    if len(content) > BYTES_MAX:
        raise InputError.of(file, f"is larger than {BYTES_MAX // 1024} KiB", "expected a configuration file")
    text = _decoded(content, file) if isinstance(content, bytes) else content.removeprefix("\ufeff")
    root = _composed(text, file)
    if root is None:
        raise InputError([Diagnostic(file, "the file is empty", "expected a mapping", 1, 1)])
    return root


def _decoded(content: bytes, file: str) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        column = error.start - (content.rfind(b"\n", 0, error.start) + 1) + 1
        problem = "is not UTF-8 text"
        raise InputError([Diagnostic(file, problem, "expected the file saved as UTF-8", line, column)]) from error


def _composed(text: str, file: str) -> yaml.Node | None:
    loader: _Loader | None = None
    try:
        loader = _Loader(text)
        node: yaml.Node | None = loader.get_single_node()
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
        code = error.character if isinstance(error.character, int) else ord(str(error.character))
        problem = f"the character U+{code:04X} is not allowed"
        raise InputError([Diagnostic(file, problem, "expected printable text", line, column)]) from error
    except yaml.MarkedYAMLError as error:
        raise _syntax_error(file, error.problem_mark or error.context_mark, *_explained(error)) from error
    except (ValueError, OverflowError) as error:  # PyYAML lets these out for absurd escapes and directives
        mark = loader.get_mark() if loader else None
        raise _syntax_error(file, mark, "not valid YAML (a number out of range)", _VALID) from error
    return node


def _explained(error: yaml.MarkedYAMLError) -> tuple[str, str]:
    """Say what is wrong and what was expected, for the mistakes people make."""
    problem = error.problem or "cannot be read"
    if error.context == "expected a single document in the stream":
        return "a second document begins here", "expected one document in a file"
    if "'\\t'" in problem:
        return "a tab is used for indentation", "expected spaces"
    if problem == TOO_DEEP:
        return problem, f"expected at most {DEPTH_MAX} levels"
    return f"not valid YAML ({problem}{f', {error.context}' if error.context else ''})", _VALID


def _syntax_error(file: str, mark: Any, problem: str, expected: str) -> InputError:
    line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
    return InputError([Diagnostic(file, problem, expected, line, column)])
