"""`kraft list`: list the names that the command line accepts."""

from __future__ import annotations

from typing import Annotated

import typer

from kraft_cli import completion
from kraft_cli.commands.options import Json
from kraft_cli.terminal import Terminal

THINGS = ("scenarios", "suites", "methods", "vehicles", "planners", "robots")


def list_(
    context: typer.Context,
    what: Annotated[
        str, typer.Argument(metavar="|".join(THINGS), help="What to list.", autocompletion=completion.words(*THINGS))
    ],
    json: Json = False,
) -> None:
    """List what is bundled, each with its description.

    Scenarios, suites, methods, vehicles, planners or robots.
    """
    terminal: Terminal = context.obj
    described = _described(what)
    if json:
        items = [{"name": name, "description": text} for name, text in described.items()]
        terminal.json("kraft.list/1", {"kind": what, "items": items})
    elif described:
        terminal.table(("NAME", "DESCRIPTION"), list(described.items()))
    else:
        terminal.info(f"there are no {what}")


def _described(what: str) -> dict[str, str]:
    from kraft.config import bundled
    from kraft.errors import Code, InputError
    from kraft.text import suggestion

    if what == "planners":
        from kraft.scenario.planners import PLANNERS

        return PLANNERS
    kinds: dict[str, bundled.Kind] = {
        "scenarios": "scenario",
        "methods": "method",
        "vehicles": "vehicle",
        "suites": "suite",
        "robots": "robot",
    }
    if what not in kinds:
        raise InputError.of(what, "cannot be listed", suggestion(what, THINGS), Code.UNKNOWN)
    return bundled.descriptions(kinds[what])
