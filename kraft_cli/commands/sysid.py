"""`kraft sysid`: identify a vehicle's parameters from logs of real or simulated drives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

if TYPE_CHECKING:
    from kraft_cli.work.sysid import Identified

Logs = Annotated[list[Path], typer.Argument(metavar="LOGS...", help="Folders and files with logs.")]
Model = Annotated[
    str,
    typer.Option("--model", metavar="NAME|FILE", help="Vehicle to identify (kraft list vehicles), a file, or code."),
]
Holdout = Annotated[
    float | None,
    typer.Option(metavar="FRACTION", help="Share of the logs to test with instead; a quarter, of four logs or more."),
]
Out = Annotated[Path | None, typer.Option(metavar="FILE", help="Write a vehicle file: FILE.yaml.")]
Plot = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw data and fit: FILE.png, .svg or .pdf.")]
MappingFile = Annotated[
    Path | None, typer.Option("--mapping", metavar="FILE", help="Which column or topic is what, if the guess is wrong.")
]
Freeze = Annotated[list[str] | None, typer.Option("--freeze", metavar="A,B", help="Parameters that keep their value.")]
Parameters = Annotated[
    list[str] | None, typer.Option("--param", metavar="K=V", help="Another initial value of a parameter.")
]
Extras = Annotated[
    str,
    typer.Option(
        metavar="auto|plan|none|A,B", help="Parameters beside the model's: those that the data show, or these."
    ),
]
PoseNoise = Annotated[
    str | None,
    typer.Option(
        "--pose-noise", metavar="M,RAD", help="Standard deviations of position and yaw; measured if left out."
    ),
]
Graph = Annotated[str, typer.Option(metavar="fast|paper", help="The same graph: eliminated, or every factor explicit.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def sysid(
    context: typer.Context,
    logs: Logs,
    model: Model = "mushr-lag",
    holdout: Holdout = None,
    out: Out = None,
    plot: Plot = None,
    mapping: MappingFile = None,
    freeze: Freeze = None,
    param: Parameters = None,
    extras: Extras = "auto",
    pose_noise: PoseNoise = None,
    graph: Graph = "fast",
    json: Json = False,
) -> ExitStatus:
    """Identify a vehicle's parameters from logs; it ends with 1 if the logs do not show them."""
    from kraft_cli.work.sysid import Options, Request, carry_out
    from kraft_cli.work.sysid_report import SCHEMA, json_content

    terminal: Terminal = context.obj
    options = Options(tuple(freeze or ()), extras, graph, pose_noise, tuple(param or ()))
    request = Request(tuple(logs), model, holdout, out, plot, mapping, options)
    done = carry_out(request, terminal.say, terminal.problem, terminal.detail)
    _tell(terminal, done)
    if json:
        terminal.json(SCHEMA, json_content(done))
    else:
        _show(terminal, done)
    for warning in done.result.warnings:
        terminal.problem(f"warning: {warning}")
    if not done.objections:
        return ExitStatus.DONE
    unwritten = f"; {out} was not written" if out is not None else ""
    terminal.error(f"not identified: {'; '.join(done.objections)}{unwritten}")
    return ExitStatus.NEGATIVE


def _tell(terminal: Terminal, done: Identified) -> None:
    """What -v asks for."""
    from kraft.text import counted

    initial = ", ".join(f"{name} {value:g}" for name, value in done.subject.vehicle.parameters.items())
    terminal.detail(f"model {done.subject.model}, from {initial}")
    state = "converged" if done.result.converged else "not converged"
    terminal.detail(f"identified in {done.seconds:.2f} s: {state} after {counted(done.result.iterations, 'iteration')}")


def _show(terminal: Terminal, done: Identified) -> None:
    from kraft_cli.work.sysid_report import parameter_table, prediction_table, remarks

    for heading, rows in (parameter_table(done), prediction_table(done)):
        terminal.table(heading, rows)
        terminal.data("")
    for remark in remarks(done):
        terminal.data(remark)
    if done.request.out is not None and not done.objections:
        terminal.data(f"vehicle file {done.request.out}: kraft plan turns --vehicle {done.request.out}")
    if done.request.plot is not None:
        terminal.data(f"picture {done.request.plot}")
