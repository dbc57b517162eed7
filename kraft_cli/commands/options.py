"""Arguments and options that several commands have with the same meaning."""

from __future__ import annotations

from typing import Annotated

import typer

ScenarioName = Annotated[str, typer.Argument(metavar="SCENARIO", help="A bundled name or the path of a file.")]
PlanningModel = Annotated[
    str | None, typer.Option("--vehicle", metavar="NAME|FILE", help="Model to plan with, instead of the scenario's.")
]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Replace the value of a key of the scenario.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
