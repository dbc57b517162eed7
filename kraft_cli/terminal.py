"""Where output goes: data to stdout, everything said to the person to stderr."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TextIO


def _stdout() -> TextIO:
    return sys.stdout


def _stderr() -> TextIO:
    return sys.stderr


@dataclass
class Terminal:
    """The two streams and how talkative to be; one per run of `main`."""

    out: TextIO = field(default_factory=_stdout)
    err: TextIO = field(default_factory=_stderr)
    quiet: bool = False
    verbose: bool = False
    traceback: bool = False

    @property
    def interactive(self) -> bool:
        """Whether a person watches stderr: progress bars only then."""
        return self.err.isatty()

    def data(self, text: str) -> None:
        """Print a result."""
        print(text, file=self.out)

    def json(self, schema: str, content: Mapping[str, Any]) -> None:
        """Print the one JSON object of ``--json``; NaN and infinities are refused, they are not JSON."""
        self.data(json.dumps({"schema": schema, **content}, indent=2, ensure_ascii=False, allow_nan=False))

    def table(self, heading: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Print aligned columns; the last one may be as long as it likes."""
        widths = [max(len(row[i]) for row in (heading, *rows)) for i in range(len(heading))]
        for number, row in enumerate((heading, *rows)):
            cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
            line = "  ".join(cells).rstrip()
            self.data(_styled(line, "1", self.out) if number == 0 else line)

    def say(self, text: str) -> None:
        """Tell the person something; ``-q`` silences it."""
        if not self.quiet:
            print(text, file=self.err)

    def detail(self, text: str) -> None:
        """Tell what only ``-v`` asks for."""
        if self.verbose:
            print(text, file=self.err)

    def problem(self, text: str) -> None:
        """Print one line about what is wrong; nothing silences it."""
        print(text, file=self.err)

    def error(self, text: str) -> None:
        """Print what ended the command."""
        print(f"{_styled('error:', '1;31', self.err)} {text}", file=self.err)


def _styled(text: str, code: str, stream: TextIO) -> str:
    if not stream.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\033[{code}m{text}\033[0m"
