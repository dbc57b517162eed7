"""Output of the command line: data on stdout, messages on stderr."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, TextIO

from kraft.errors import Diagnostic


def _stdout() -> TextIO:
    return sys.stdout


def _stderr() -> TextIO:
    return sys.stderr


@dataclass
class Terminal:
    """Output streams and verbosity; one per run of `main`."""

    out: TextIO = field(default_factory=_stdout)
    err: TextIO = field(default_factory=_stderr)
    quiet: bool = False
    verbose: bool = False
    traceback: bool = False
    json_schema: str = ""  # with --json; its object also says why there is no result

    @property
    def interactive(self) -> bool:
        """Whether stderr is a terminal; progress bars are shown only there."""
        return self.err.isatty()

    def data(self, text: str) -> None:
        """Print a result."""
        print(text, file=self.out)

    def json(self, schema: str, content: Mapping[str, Any]) -> None:
        """Print the one JSON object of ``--json``; NaN and infinities are refused, they are not JSON."""
        self.data(json.dumps({"schema": schema, **content}, indent=2, ensure_ascii=False, allow_nan=False))

    def table(self, heading: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Print aligned columns; the last one has no limit of width."""
        widths = [max(len(row[i]) for row in (heading, *rows)) for i in range(len(heading))]
        for number, row in enumerate((heading, *rows)):
            cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
            line = "  ".join(cells).rstrip()
            self.data(_styled(line, "1", self.out) if number == 0 else line)

    def info(self, text: str) -> None:
        """Print a message, unless ``-q`` is given."""
        if not self.quiet:
            self._say(text)

    def detail(self, text: str) -> None:
        """Print a message if ``-v`` is given."""
        if self.verbose:
            self._say(text)

    def problem(self, text: str) -> None:
        """Print one problem, even if ``-q`` is given."""
        self._say(text)

    def error(self, text: str) -> None:
        """Print the error that ends the command."""
        self._say(f"{_styled('error:', '1;31', self.err)} {text}")

    def _say(self, text: str) -> None:
        """Print a message; one that nobody can read any more, because the terminal is gone, ends no command."""
        try:
            print(text, file=self.err, flush=True)
        except (OSError, ValueError):  # ValueError: the stream is closed
            discard(self.err)


def discard(stream: TextIO) -> None:
    """Redirect a stream that cannot be written to the null device, so that the flush of Python at exit succeeds."""
    with contextlib.suppress(OSError, ValueError):  # it is closed, or no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def diagnostic_json(diagnostic: Diagnostic) -> dict[str, Any]:
    """Problem as in the JSON objects: its place and what is wrong, without the flag for arguments of functions."""
    return {key: value for key, value in asdict(diagnostic).items() if key != "argument"}


def _styled(text: str, code: str, stream: TextIO) -> str:
    if not stream.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\033[{code}m{text}\033[0m"
