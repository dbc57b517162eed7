"""`kraft run`: drive one trial."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kraft.elapsed import loading
from kraft_cli import completion
from kraft_cli.commands.options import Json, PlanningModel, ScenarioName, Set, defaulting
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

if TYPE_CHECKING:
    from kraft_cli.work.drive import Driven
    from kraft_cli.work.run import RunRequest

Method = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE",
        help=defaulting("Method (kraft list methods).", "kraft; with --realtime adaptive-kraft"),
        autocompletion=completion.methods,
    ),
]
Seed = Annotated[
    int, typer.Option(metavar="N", help="Seed: the same one gives the same trial, except with --realtime.")
]
Out = Annotated[Path | None, typer.Option(metavar="DIR", help="Write the trial into a new folder.")]
Video = Annotated[Path | None, typer.Option(metavar="FILE", help="Film the trial: FILE.mp4, or FILE.webp for a page.")]
View = Annotated[bool, typer.Option("--view", help="Show the trial in a window, in real time.")]
Plot = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the trial: FILE.png, .svg or .pdf.")]
Bag = Annotated[Path | None, typer.Option(metavar="FILE", help="Write the trial as ROS 2 messages: FILE.mcap.")]
Realtime = Annotated[
    bool, typer.Option("--realtime", help="On the wall clock, as kraft drive does, with the simulated robot beside it.")
]


def run(
    context: typer.Context,
    scenario: ScenarioName,
    method: Method = None,
    vehicle: PlanningModel = None,
    seed: Seed = 0,
    set_: Set = None,
    out: Out = None,
    video: Video = None,
    view: View = False,
    plot: Plot = None,
    bag: Bag = None,
    realtime: Realtime = False,
    json: Json = False,
) -> ExitStatus:
    """Drive a scenario once in simulation.

    The exit code is 1 if the goal is not reached.
    """
    terminal: Terminal = context.obj
    with loading(terminal.info):
        from kraft.trial.result import Outcome
        from kraft_cli.tables import show_rows
        from kraft_cli.work.run import RunRequest, cycle_line, run_json, run_scenario, run_table
        from kraft_cli.work.run_folder import SCHEMA
        from kraft_cli.work.trial_outputs import OutputOptions

    if method is None:
        method = "adaptive-kraft" if realtime else "kraft"
    request = RunRequest(scenario, method, vehicle, seed, tuple(set_ or ()), out, OutputOptions(video, view, plot, bag))
    if realtime:
        return _run_in_real_time(terminal, request, json)
    driven = run_scenario(request, terminal.info, lambda cycle: terminal.info(cycle_line(cycle)), terminal.detail)
    success = driven.result.outcome is Outcome.SUCCESS
    if json:
        terminal.json(SCHEMA, run_json(driven))
    else:
        show_rows(terminal, run_table(driven), good=success)
    return ExitStatus.DONE if success else ExitStatus.NEGATIVE


def _run_in_real_time(terminal: Terminal, request: RunRequest, json: bool) -> ExitStatus:
    with loading(terminal.info):
        from kraft_cli.tables import show_rows
        from kraft_cli.work.realtime import realtime_json, realtime_table, run_in_real_time
        from kraft_cli.work.run_folder import SCHEMA

    run = run_in_real_time(request, terminal.info, terminal.problem, terminal.detail)
    success = run.outcome == "success"
    if json:
        terminal.json(SCHEMA, realtime_json(run))
    else:
        show_rows(terminal, realtime_table(run), good=success)
    return driven_status(terminal, run.outcome, run.driven)


def driven_status(terminal: Terminal, outcome: str, driven: Driven) -> ExitStatus:
    """Exit code of a drive with an outcome, after a report of what could not be written."""
    for problem in driven.unwritten:
        terminal.problem(problem)
    if outcome == "interrupted":
        return ExitStatus(128 + driven.result.signal) if driven.result.signal else ExitStatus.INTERRUPTED
    if driven.unwritten or driven.own_code_failed:
        return ExitStatus.INVALID
    return ExitStatus.DONE if outcome == "success" else ExitStatus.NEGATIVE
