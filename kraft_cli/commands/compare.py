"""`kraft compare`: compare two evaluations trial by trial."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kraft_cli.commands.options import Json
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

One = Annotated[Path, typer.Argument(metavar="A", help="Results folder of kraft eval: the reference.")]
Other = Annotated[Path, typer.Argument(metavar="B", help="Results folder to compare with it.")]


def compare(context: typer.Context, a: One, b: Other, json: Json = False) -> ExitStatus:
    """Compare two evaluations on the trials that both have.

    Of two versions of a method file, of a vehicle or of kraft.
    """
    from kraft.evaluation.comparison import compare as compared
    from kraft.evaluation.comparison import comparison_json
    from kraft_cli.tables import show_comparison

    terminal: Terminal = context.obj
    comparison = compared(a, b)
    if json:
        terminal.json("kraft.compare/1", comparison_json(comparison))
    else:
        show_comparison(terminal, comparison)
    return ExitStatus.DONE
