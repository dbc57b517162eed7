"""Arguments and options that several commands have with the same meaning."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from kraft_cli import completion
from kraft_cli.terminal import Terminal


def defaulting(meaning: str, default: str) -> str:
    """Help of an option whose default depends on something, written as typer writes the defaults that do not."""
    return f"{meaning}  [default: {default}]"


def vehicle_option(meaning: str, default: str) -> Any:
    """Option that names a vehicle; `meaning` is what for, `default` the one without the option."""
    text = defaulting(meaning, default)
    return typer.Option("--vehicle", metavar="NAME|FILE", help=text, autocompletion=completion.vehicles)


ScenarioName = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO", help="A bundled name or the path of a file.", autocompletion=completion.scenarios
    ),
]
PlanningModel = Annotated[str | None, vehicle_option("Model to plan with.", "the method's, else the scenario's")]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Replace the value of a key of the scenario.")
]


def _as_json(context: typer.Context, wanted: bool) -> bool:
    """Tell the terminal which object the command prints."""
    if wanted:
        terminal: Terminal = context.obj
        terminal.json_schema = f"kraft.{context.command_path.split()[1]}/1"
    return wanted


Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.", callback=_as_json)]
