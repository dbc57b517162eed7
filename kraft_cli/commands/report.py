"""`kraft report`: write the page of an evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

Folder = Annotated[Path, typer.Argument(metavar="RESULTS", help="Results folder of kraft eval.")]
Out = Annotated[Path | None, typer.Option(metavar="FILE", help="The page to write; report.html in the folder.")]


def report(context: typer.Context, results: Folder, out: Out = None) -> ExitStatus:
    """Write a page for a browser about the results of kraft eval, also while it runs or after it was stopped."""
    from kraft.evaluation.report import write_report
    from kraft.text import counted
    from kraft_cli.work.run import run_command

    terminal: Terminal = context.obj
    found, path = write_report(results, out, run_command)
    terminal.data(str(path))
    missing = found.expected - len(found.rows)
    if missing:
        terminal.info(f"{missing} of {counted(found.expected, 'trial')} not run yet")
    return ExitStatus.DONE
