"""`report.html`: the results of an evaluation as a page for a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from kraft.errors import InputError, Problems
from kraft.evaluation.report.page import page
from kraft.evaluation.report.results import CommandLine, Results, read_results
from kraft.files import check_writable, write_whole

NAME: Final = "report.html"
SUFFIXES: Final = (".html", ".htm")
"""Those by which a browser takes a file for a page."""


def write_report(
    folder: Path, out: Path | None = None, command_line: CommandLine | None = None
) -> tuple[Results, Path]:
    """Write the page of a results folder to `out`, by default into the folder, replacing an earlier page.

    With `command_line` the page has commands that repeat the trials.

    Raises:
        InputError: if the folder is not a results folder, the suffix of `out` is neither .html nor .htm, or the page
            cannot be written.
    """
    path = out or folder / NAME
    problems = Problems()
    problems.of(lambda: _check_suffix(path))
    results = problems.of(lambda: read_results(folder, command_line))
    problems.check()
    assert results is not None, "every problem was raised"
    check_writable(path)
    write_whole(path, page(results).encode())
    return results, path


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        ends = f"ends in {path.suffix!r}" if path.suffix else "has no suffix"
        raise InputError.of(str(path), f"the page's name {ends}", f"expected {' or '.join(SUFFIXES)}")


__all__ = ["NAME", "CommandLine", "Results", "page", "read_results", "write_report"]
