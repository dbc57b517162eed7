"""`kraft report`: write or serve the page of an evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kraft_cli.commands.options import defaulting
from kraft_cli.exit_status import ExitStatus
from kraft_cli.signals import status_of
from kraft_cli.terminal import Terminal

Folder = Annotated[Path, typer.Argument(metavar="RESULTS", help="Results folder of kraft eval.")]
Out = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help=defaulting("The page to write: FILE.html.", "report.html in the folder")),
]
Serve = Annotated[
    bool, typer.Option("--serve", help="Show the page to this machine's browser instead, with every replay.")
]


def report(context: typer.Context, results: Folder, out: Out = None, serve: Serve = False) -> ExitStatus:
    """Write a page for a browser about the results of kraft eval.

    Also while it runs, or after it was stopped.
    """
    from kraft.errors import Code, InputError
    from kraft.evaluation.report import write_report
    from kraft.text import counted
    from kraft_cli.work.run import run_command

    terminal: Terminal = context.obj
    if serve:
        if out is not None:
            expected = "expected one of both: nothing is written"
            raise InputError.of_argument("serve", "is given together with a file", expected, Code.CONFLICT)
        return _serve(terminal, results)
    found, path = write_report(results, out, run_command)
    terminal.data(str(path))
    missing = found.expected - len(found.rows)
    if missing:
        terminal.info(f"{missing} of {counted(found.expected, 'trial')} not run yet")
    return ExitStatus.DONE


def _serve(terminal: Terminal, results: Path) -> ExitStatus:
    """Serve the page until a signal; an interrupt is the usual way to end it."""
    from kraft.evaluation.report.server import ReportServer
    from kraft_cli.work.run import run_command

    with ReportServer(results, run_command) as server:
        terminal.data(server.url)
        terminal.info("the page is for this machine only; Ctrl-C ends it")
        try:
            server.serve_forever()
        except KeyboardInterrupt as error:
            if status_of(error) is not ExitStatus.INTERRUPTED:
                raise
    return ExitStatus.DONE
