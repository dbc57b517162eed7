"""`report.html`: the results of an evaluation as a page for a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from kraft.evaluation.report.page import page
from kraft.evaluation.report.results import CommandLine, Results, read_results
from kraft.files import check_writable, write_whole

NAME: Final = "report.html"


def write_report(
    folder: Path, out: Path | None = None, command_line: CommandLine | None = None
) -> tuple[Results, Path]:
    """Write the page of a results folder to `out`, by default into the folder, replacing an earlier page.

    With `command_line` the page has commands that repeat the trials.

    Raises:
        InputError: if the folder is not a results folder, or the page cannot be written.
    """
    path = out or folder / NAME
    results = read_results(folder, command_line)
    check_writable(path)
    write_whole(path, page(results).encode())
    return results, path


__all__ = ["NAME", "CommandLine", "Results", "page", "read_results", "write_report"]
