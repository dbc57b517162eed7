"""YAML text to PyYAML's nodes, with errors that describe frequent mistakes.

libyaml's parser reads the text; PyYAML's own, which is slower, explains what it cannot read.
"""

from __future__ import annotations

from typing import Any, Final

import yaml

from kraft.config.document import BYTES_MAX, DEPTH_MAX, TOO_DEEP, decode, syntax_error
from kraft.config.source import Position
from kraft.errors import Code, InputError

PLAIN: Final = "plain"
"""Tag of an unquoted word, whose value `kraft.config.scalar.plain_scalar` decides."""
WRITTEN: Final = "written "
"""Prefix of a tag that is written in the file, so that none of them is one that the composer gives."""
_VALID: Final = "expected YAML, such as 'key: value'"


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
        raise syntax_error(file, None, "the file is empty", "expected a mapping")
    return root


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
        raise syntax_error(file, Position(line, column), problem, "expected printable text") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise syntax_error(file, _marked(mark), *_explained(error)) from error
    except (ValueError, OverflowError) as error:  # PyYAML raises these for some invalid escapes and directives
        position = _marked(loader.get_mark()) if loader else None
        raise syntax_error(file, position, "not valid YAML (a number out of range)", _VALID) from error
    return node


class _Composer(yaml.composer.Composer):
    """PyYAML's composer with a limit of depth, which leaves unquoted words as they are and marks tags of the file.

    Composing is recursive: libyaml's own composer overflows the stack in a text that is nested too deep.
    """

    depth = 0

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        if kind is yaml.ScalarNode and implicit[0]:
            return PLAIN
        return super().resolve(kind, value, implicit)  # type: ignore[misc]

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.depth += 1
        event = self.peek_event()  # type: ignore[attr-defined]
        if self.depth > DEPTH_MAX:
            raise yaml.MarkedYAMLError(problem=TOO_DEEP, problem_mark=event.start_mark)
        if getattr(event, "tag", None) is not None:
            event.tag = WRITTEN + event.tag
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


def _marked(mark: Any) -> Position | None:
    return Position(mark.line + 1, mark.column + 1) if mark else None
