"""`kraft record`: drive open-loop manoeuvres in simulation and write their logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kraft_cli import completion
from kraft_cli.commands.options import Json, defaulting, vehicle_option
from kraft_cli.exit_status import ExitStatus
from kraft_cli.signals import handled, status_of
from kraft_cli.terminal import Terminal

if TYPE_CHECKING:
    from kraft_cli.work.record import RecordedRun

Scenario = Annotated[
    str | None,
    typer.Argument(
        metavar="SCENARIO",
        help=defaulting("A bundled name or the path of a file.", "training"),
        autocompletion=completion.scenarios,
    ),
]
Out = Annotated[Path, typer.Option(metavar="LOGS", help="New folder for the logs.")]
VehicleName = Annotated[str | None, vehicle_option("Vehicle to drive.", "the scenario's")]
Runs = Annotated[
    int | None, typer.Option(metavar="N", help=defaulting("Number of runs, 20 s each.", "10; with --for 3"))
]
For = Annotated[
    str | None,
    typer.Option(
        "--for",
        metavar="NAME|FILE",
        help="Drive what shows the parameters of this model, from its priors.",
        autocompletion=completion.vehicles,
    ),
]
Commands = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE|FOLDER", help="Drive these commands: files, or a folder of kraft sysid --commands."),
]
Seed = Annotated[int | None, typer.Option(metavar="N", help=defaulting("Seed: the same one gives the same logs.", "0"))]
Bag = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write the runs as ROS 2 messages too: FILE_01.mcap and so on.")
]

Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Continue the recording in LOGS with the same options, or more --runs.",
    ),
]


def record(
    context: typer.Context,
    scenario: Scenario = None,
    vehicle: VehicleName = None,
    out: Out = Path("logs"),
    runs: Runs = None,
    seed: Seed = None,
    for_: For = None,
    commands: Commands = None,
    bag: Bag = None,
    resume: Resume = False,
    json: Json = False,
) -> ExitStatus:
    """Drive manoeuvres in simulation and log them, for kraft sysid.

    They are driven without feedback; the logs have commands and measured poses.
    """
    from kraft.text import counted
    from kraft_cli.work.record import record_logs, request_of, resume_command

    terminal: Terminal = context.obj
    request = request_of(scenario, out, runs, seed, vehicle, for_, tuple(commands or ()), bag, resume=resume)
    done: list[RecordedRun] = []

    def ended(run: RecordedRun) -> None:
        done.append(run)
        if run.kept:
            return
        note = f"; {run.note}" if run.note else ""
        poses = counted(run.poses, "pose")
        terminal.info(f"{len(done)}/{run.of}  {run.folder}: {run.manoeuvre}, {run.duration:.1f} s, {poses}{note}")

    def kept() -> str:
        runs_kept = f"{len(done)} of {counted(done[-1].of, 'run')} kept in {out}"
        return f"{runs_kept}; to resume: {resume_command(request)}"

    try:
        model = record_logs(request, terminal.info, ended).model
    except KeyboardInterrupt as error:
        with handled(lambda _: None):  # another signal would end the command before it says what is kept
            terminal.problem(f"stopped; {kept()}" if done else "stopped before the first run ended")
        return status_of(error)
    except Exception:
        if done:
            terminal.problem(kept())
        raise
    if json:
        terminal.json("kraft.record/1", _content(request.scenario, request.seed, out, done))
    else:
        stated = "" if model is None else f" --model {model}"
        terminal.data(
            f"{counted(len(done), 'log')} in {out}; kraft sysid {out}{stated} identifies the vehicle from them"
        )
    return ExitStatus.DONE


def _content(scenario: str, seed: int, out: Path, done: list[RecordedRun]) -> dict[str, object]:
    runs = [
        {
            "folder": str(run.folder),
            "manoeuvre": run.manoeuvre,
            "duration_s": run.duration,
            "commands": run.commands,
            "poses": run.poses,
            "note": run.note,
            "kept": run.kept,
        }
        for run in done
    ]
    return {"scenario": scenario, "seed": seed, "folder": str(out), "runs": runs}
