"""`kraft sysid`: identify a vehicle's parameters from logs of real or simulated drives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kraft_cli import completion
from kraft_cli.commands.options import Json, defaulting
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

if TYPE_CHECKING:
    from kraft_cli.work.sysid import SysidResult

Logs = Annotated[list[Path], typer.Argument(metavar="LOGS", help="Folders and files with logs.")]
Model = Annotated[
    str,
    typer.Option(
        "--model",
        metavar="auto|NAME|FILE",
        help="auto: the model that predicts best; or a vehicle (kraft list vehicles), a file, or code.",
        autocompletion=completion.names("vehicle", "auto"),
    ),
]
Holdout = Annotated[
    float | None,
    typer.Option(
        metavar="FRACTION",
        help=defaulting("Share of the logs to hold out for testing.", "0.25 of four logs or more, else 0"),
    ),
]
Out = Annotated[Path | None, typer.Option(metavar="FILE", help="Write a vehicle file: FILE.yaml.")]
Plot = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw data and fit: FILE.png, .svg or .pdf.")]
MappingFile = Annotated[
    Path | None,
    typer.Option("--mapping", metavar="FILE", help="Mapping file: columns and topics, where the guess is wrong."),
]
Freeze = Annotated[list[str] | None, typer.Option("--freeze", metavar="A,B", help="Parameters that keep their value.")]
Parameters = Annotated[list[str] | None, typer.Option("--param", metavar="K=V", help="Initial value of a parameter.")]
AuxiliarySelection = Annotated[
    str,
    typer.Option(
        metavar="auto|plan|none|A,B",
        help=defaulting(
            "Auxiliary parameters. auto: those that the logs need; plan: of them those that planning models; or these.",
            "auto; with --out plan",
        ),
        show_default=False,
    ),
]
PoseNoise = Annotated[
    str | None,
    typer.Option(
        "--pose-noise", metavar="M,RAD", help=defaulting("Standard deviations of position and yaw.", "measured")
    ),
]
Graph = Annotated[
    str,
    typer.Option(
        metavar="fast|paper", help="Form of the graph. fast: states eliminated; paper: every factor explicit."
    ),
]
Horizon = Annotated[float, typer.Option(metavar="S", help="Time over which the chosen model is to predict well.")]
Next = Annotated[int | None, typer.Option("--next", metavar="N", help="Recommend the next N drives, which show most.")]
Area = Annotated[
    str | None, typer.Option(metavar="L,W", help=defaulting("Free area for the next drives, m.", "that of the logs"))
]
Commands = Annotated[
    Path | None, typer.Option(metavar="FOLDER", help="New folder for the commands of the next drives.")
]


def sysid(
    context: typer.Context,
    logs: Logs,
    model: Model = "auto",
    holdout: Holdout = None,
    out: Out = None,
    plot: Plot = None,
    mapping: MappingFile = None,
    freeze: Freeze = None,
    param: Parameters = None,
    extras: AuxiliarySelection = "auto",
    pose_noise: PoseNoise = None,
    graph: Graph = "fast",
    horizon: Horizon = 3,
    next_: Next = None,
    area: Area = None,
    commands: Commands = None,
    json: Json = False,
) -> ExitStatus:
    """Identify a vehicle's parameters from logs.

    The exit code is 1 if the logs do not identify them.
    """
    from kraft_cli.work.sysid import run_sysid
    from kraft_cli.work.sysid_report import SCHEMA, sysid_json
    from kraft_cli.work.sysid_request import SysidRequest

    terminal: Terminal = context.obj
    request = SysidRequest(
        logs=tuple(logs),
        model=model,
        holdout=holdout,
        out=out,
        plot=plot,
        mapping=mapping,
        freeze=tuple(freeze or ()),
        extras=extras,
        graph=graph,
        horizon=horizon,
        pose_noise=pose_noise,
        param=tuple(param or ()),
        next=next_,
        area=area,
        commands=commands,
    )
    result = run_sysid(request, terminal.info, terminal.problem, terminal.detail)
    _report_details(terminal, result)
    if json:
        terminal.json(SCHEMA, sysid_json(result))
    else:
        _print(terminal, result)
    for warning in result.identification.warnings:
        terminal.problem(f"warning: {warning}")
    if result.next_error is not None:
        terminal.json_schema = ""  # its object is printed
        raise result.next_error
    if not result.objections:
        return ExitStatus.DONE
    unwritten = f"; {out} was not written" if out is not None else ""
    terminal.error(f"not identified: {'; '.join(result.objections)}{unwritten}")
    return ExitStatus.NEGATIVE


def _report_details(terminal: Terminal, result: SysidResult) -> None:
    """Report the details that -v requests."""
    from kraft.text import counted
    from kraft_cli.work.sysid_report import BY_TERMS, STEPS_CAPTION, TERMS_LEGEND, choice_lines, model_table

    initial = ", ".join(f"{name} {value:g}" for name, value in result.base.vehicle.parameters.items())
    terminal.detail(f"model {result.base.model}, from {initial}")
    state = "converged" if result.identification.converged else "not converged"
    terminal.detail(
        f"identified in {result.seconds:.2f} s: {state} after {counted(result.identification.iterations, 'iteration')}"
    )
    trials = result.identification.trials
    if not trials:
        return
    heading, rows = model_table(trials)
    steps = ("  ".join(cells).rstrip() for cells in (heading, *rows))
    for line in (STEPS_CAPTION, *steps, TERMS_LEGEND, *choice_lines(trials, BY_TERMS)):
        terminal.detail(line)


def _print(terminal: Terminal, result: SysidResult) -> None:
    from kraft_cli.work import sysid_report as report

    models = result.identification.models
    if models:
        terminal.data(report.model_caption(result))
    for (heading, rows), below in (
        (report.model_table(models), [report.TERMS_LEGEND, *report.choice_lines(models, report.BY_MODEL)]),
        (report.parameter_table(result), []),
        (report.prediction_table(result), []),
    ):
        if rows:
            terminal.table(heading, rows)
            for line in (*below, ""):
                terminal.data(line)
    for line in report.summary_lines(result):
        terminal.data(line)
    if result.request.out is not None and not result.objections:
        with_it = "kraft plan turns" if result.fits_bundled_scenarios else "kraft generate rooms"
        terminal.data(f"vehicle file {result.request.out}: {with_it} --vehicle {result.request.out}")
    if result.request.plot is not None:
        terminal.data(f"picture {result.request.plot}")
    if result.next_drives is not None:
        from kraft_cli.work.next_drives import next_lines

        terminal.data("")
        for line in next_lines(result.next_drives):
            terminal.data(line)
