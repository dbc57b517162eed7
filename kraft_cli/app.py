"""Command line application: all commands and their common options."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Final

import typer

from kraft import __version__
from kraft_cli.command import Command
from kraft_cli.commands.compare import compare
from kraft_cli.commands.doctor import doctor
from kraft_cli.commands.drive import drive, world
from kraft_cli.commands.eval import eval_
from kraft_cli.commands.listing import list_
from kraft_cli.commands.plan import plan
from kraft_cli.commands.record import record
from kraft_cli.commands.report import report
from kraft_cli.commands.run import run
from kraft_cli.commands.sysid import sysid
from kraft_cli.commands.validate import validate
from kraft_cli.commands.worlds import generate, import_
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

GLOBAL_FLAGS = ("-q", "--quiet", "-v", "--verbose", "--traceback")
"""Options that are allowed anywhere on the command line; `kraft_cli.main` moves them to the front."""

app = typer.Typer(
    name="kraft",
    help="Plan and drive safely with an approximate model of the vehicle.",
    invoke_without_command=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(context: typer.Context, requested: bool) -> None:
    if requested and not context.resilient_parsing:  # otherwise the shell completes a line that has the option
        typer.echo(f"kraft {__version__}")
        raise typer.Exit


@app.callback()
def common(
    context: typer.Context,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print results and errors only.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Print details.")] = False,
    traceback: Annotated[bool, typer.Option("--traceback", help="Print the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Read the options common to all commands."""
    terminal: Terminal = context.obj
    terminal.quiet, terminal.verbose, terminal.traceback = quiet, verbose, traceback
    if context.invoked_subcommand is None:
        terminal.problem(context.get_help())
        raise typer.Exit(ExitStatus.INVALID)


_COMMANDS: Final[dict[str, Callable[..., Any]]] = {
    "plan": plan,
    "run": run,
    "eval": eval_,
    "drive": drive,
    "world": world,
    "report": report,
    "compare": compare,
    "record": record,
    "sysid": sysid,
    "import": import_,
    "generate": generate,
    "validate": validate,
    "list": list_,
    "doctor": doctor,
}
for _name, _function in _COMMANDS.items():
    app.command(_name, cls=Command)(_function)
