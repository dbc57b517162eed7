"""`kraft import` and `kraft generate`: scenario files of worlds from elsewhere and of random ones, with a suite."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kraft.text import counted
from kraft_cli import completion
from kraft_cli.commands.options import Json, defaulting, vehicle_option
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

if TYPE_CHECKING:  # so that `kraft --help` does not load what only these commands need
    from kraft.worlds.world import Written

Sources = Annotated[list[Path], typer.Argument(metavar="SOURCE", help="Files; for barn also folders of them.")]
Start = Annotated[
    str | None,
    typer.Option(metavar="X,Y,HEADING", help=defaulting("Start in m and degrees; a map needs it.", "the source's")),
]
Goal = Annotated[
    str | None, typer.Option(metavar="X,Y[,RADIUS]", help=defaulting("Goal in m; a map needs it.", "the source's"))
]
ImportedVehicle = Annotated[
    str | None, vehicle_option("Vehicle of the scenarios.", "barn jackal, dynobench the problem's, map mushr")
]
GeneratedVehicle = Annotated[
    str | None, vehicle_option("Vehicle of the scenarios.", "mushr; for posts jackal, for track f1tenth")
]
Skip = Annotated[bool, typer.Option("--skip", help="Leave out shapes that cannot be obstacles.")]
Out = Annotated[Path, typer.Option(metavar="DIR", help="New folder for the scenarios and suite.yaml.")]
Seed = Annotated[int, typer.Option(metavar="N", help="Seed of the first world; the next ones follow.")]
Count = Annotated[int, typer.Option(metavar="N", help="Number of worlds, up to 10,000.")]
Density = Annotated[
    float | None,
    typer.Option(
        metavar="SHARE", help=defaulting("Areas of all clutter over that of the floor between start and goal.", "0.15")
    ),
]


def import_(
    context: typer.Context,
    kind: Annotated[str, typer.Argument(metavar="barn|dynobench|map", help="What the sources are.")],
    sources: Sources,
    start: Start = None,
    goal: Goal = None,
    vehicle: ImportedVehicle = None,
    skip: Skip = False,
    out: Out = Path("worlds"),
    json: Json = False,
) -> ExitStatus:
    """Write scenarios from worlds of BARN, dynobench, or maps.

    Worlds are Gazebo files (BARN), problems of dynobench, or occupancy maps.
    """
    from kraft_cli.work.worlds import ImportRequest, imported_json, robot_warnings, run_import

    terminal: Terminal = context.obj
    found = run_import(ImportRequest(kind, tuple(sources), out, start, goal, vehicle, skip), terminal.info)
    for each in found.imported:
        if each.skipped:
            left = ", ".join(f"{number} x {shape}" for shape, number in each.skipped.items())
            terminal.problem(f"{each.world.name}: left out: {left}")
        if each.missing:
            terminal.info(f"{each.world.name}: no score: {each.missing}")
    warnings = robot_warnings(found.written, vehicle)
    _warn(terminal, warnings)
    if json:
        terminal.json("kraft.import/1", imported_json(kind, found, warnings))
    else:
        _report(terminal, found.written)
    return ExitStatus.DONE


def generate(
    context: typer.Context,
    kind: Annotated[
        str,
        typer.Argument(
            metavar="|".join(completion.WORLDS),
            help="What the worlds are; mixed: all kinds in turn.",
            autocompletion=completion.worlds,
        ),
    ],
    seed: Seed = 0,
    count: Count = 1,
    vehicle: GeneratedVehicle = None,
    density: Density = None,
    out: Out = Path("worlds"),
    json: Json = False,
) -> ExitStatus:
    """Write random scenarios and a suite.

    The same seed gives the same world, for which the vehicle has a plan.
    """
    from kraft.worlds.generate import generate_worlds
    from kraft_cli.work.worlds import generated_json, robot_warnings

    terminal: Terminal = context.obj
    written = generate_worlds(kind, out, seed=seed, count=count, vehicle=vehicle, density=density, log=terminal.info)
    warnings = robot_warnings(written, vehicle)
    _warn(terminal, warnings)
    if json:
        terminal.json("kraft.generate/1", generated_json(kind, seed, written, warnings))
    else:
        _report(terminal, written)
    return ExitStatus.DONE


def _warn(terminal: Terminal, warnings: Sequence[str]) -> None:
    for text in warnings:
        terminal.problem(f"warning: {text}")


def _report(terminal: Terminal, written: Written) -> None:
    """Print how many scenarios were written, and the command that drives in them."""
    terminal.data(
        f"{counted(len(written.scenarios), 'scenario')} in {written.folder}; kraft eval --suite {written.suite}"
    )
