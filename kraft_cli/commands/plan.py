"""`kraft plan`: plan a scenario once; print, write and draw the result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kraft_cli import completion
from kraft_cli.commands.options import Json, ScenarioName, Set, defaulting, vehicle_option
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

Iterations = Annotated[
    int | None,
    typer.Option(
        metavar="N", help=defaulting("Plan for N iterations: the same plan on every run.", "the scenario's budget")
    ),
]
Time = Annotated[
    float | None,
    typer.Option(metavar="S", help=defaulting("Plan for S seconds of wall-clock time.", "the scenario's budget")),
]
Seed = Annotated[int, typer.Option(metavar="N", help="Seed of the random generator.")]
Planner = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=defaulting("Planner (kraft list planners).", "the scenario's"),
        autocompletion=completion.planners,
    ),
]
VehicleName = Annotated[str | None, vehicle_option("Vehicle: a name, a YAML file, or code.", "the scenario's")]
Parameters = Annotated[
    list[str] | None, typer.Option("--param", metavar="K=V", help="Replace a parameter of the vehicle.")
]
Threads = Annotated[int, typer.Option(metavar="N", help="Grow trees on N cores, up to 64, which share the best cost.")]
Out = Annotated[Path | None, typer.Option(metavar="DIR", help="Write plan.json into DIR.")]
Plot = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the plan: FILE.png, .svg or .pdf.")]
From = Annotated[
    Path | None, typer.Option("--from", metavar="PLAN", help="Start from a plan file and retain its remaining edges.")
]
After = Annotated[float, typer.Option(metavar="S", help="With --from: S seconds after the start of that plan.")]


def plan(
    context: typer.Context,
    scenario: ScenarioName,
    time: Time = None,
    iterations: Iterations = None,
    seed: Seed = 0,
    planner: Planner = None,
    vehicle: VehicleName = None,
    param: Parameters = None,
    set_: Set = None,
    threads: Threads = 1,
    out: Out = None,
    plot: Plot = None,
    from_: From = None,
    after: After = 0,
    json: Json = False,
) -> ExitStatus:
    """Plan a scenario and print the result.

    The exit code is 1 if no plan reaches the goal.
    """
    from kraft_cli.tables import show_rows
    from kraft_cli.work.plan import PlanRequest, plan_json, run_plan, table_rows

    terminal: Terminal = context.obj
    request = PlanRequest(
        scenario, time, iterations, seed, planner, vehicle, tuple(param or ()), out, plot, from_, after,
        tuple(set_ or ()), threads,
    )  # fmt: skip
    outcome = run_plan(request, terminal.info, terminal.detail)
    if json:
        terminal.json("kraft.plan/1", plan_json(outcome))
    else:
        show_rows(terminal, table_rows(outcome), good=outcome.result.solved)
    if outcome.result.reason:
        longer = "" if outcome.result.plan is None else "; a longer search (--iterations, --time) may reach it"
        terminal.error(outcome.result.reason + longer)
    return ExitStatus.DONE if outcome.result.solved else ExitStatus.NEGATIVE
