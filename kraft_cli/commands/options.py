"""Arguments and options that several commands have with the same meaning."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from kraft_cli import completion
from kraft_cli.terminal import Terminal


def vehicle_option(meaning: str) -> Any:
    """Option that names a vehicle; `meaning` is what for."""
    return typer.Option("--vehicle", metavar="NAME|FILE", help=meaning, autocompletion=completion.vehicles)


ScenarioName = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO", help="A bundled name or the path of a file.", autocompletion=completion.scenarios
    ),
]
PlanningModel = Annotated[str | None, vehicle_option("Model to plan with, instead of the method's and the scenario's.")]
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
