"""`kraft drive` and `kraft world`: a robot on its topics, and the simulated robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kraft_cli import completion
from kraft_cli.commands.options import Json, PlanningModel, ScenarioName, Set, vehicle_option
from kraft_cli.commands.run import Video, View, driven_status
from kraft_cli.exit_status import ExitStatus
from kraft_cli.terminal import Terminal

RobotName = Annotated[
    str,
    typer.Option(
        "--robot", metavar="NAME|FILE", help="The robot (kraft list robots).", autocompletion=completion.robots
    ),
]
Method = Annotated[
    str,
    typer.Option(metavar="NAME|FILE", help="Method with a contingency on board.", autocompletion=completion.methods),
]
PlannerSeed = Annotated[int, typer.Option(metavar="N", help="Seed of the planner; the drive depends on the clock too.")]
WorldSeed = Annotated[int, typer.Option(metavar="N", help="Seed of the camera's errors and of the motion's noise.")]
SimulatedVehicle = Annotated[str | None, vehicle_option("Vehicle whose true robot is simulated.", "the scenario's")]
Out = Annotated[Path | None, typer.Option(metavar="DIR", help="Write the drive into a new folder, as it is driven.")]
Bag = Annotated[Path | None, typer.Option(metavar="FILE", help="Write the drive as ROS 2 messages: FILE.mcap.")]
Speed = Annotated[float, typer.Option(metavar="X", help="Seconds of the simulation in a second of the clock.")]


def drive(
    context: typer.Context,
    scenario: ScenarioName,
    robot: RobotName,
    method: Method = "adaptive-kraft",
    vehicle: PlanningModel = None,
    seed: PlannerSeed = 0,
    set_: Set = None,
    out: Out = None,
    bag: Bag = None,
    json: Json = False,
) -> ExitStatus:
    """Drive a robot over its topics on the wall clock.

    The exit code is 1 if the goal is not reached.
    """
    from kraft_cli.tables import show_rows
    from kraft_cli.work.drive import DRIVE_SCHEMA, DriveRequest, drive_json, drive_robot, drive_table

    terminal: Terminal = context.obj
    request = DriveRequest(scenario, robot, method, vehicle, seed, tuple(set_ or ()), out, bag)
    driven = drive_robot(request, terminal.info, terminal.problem, terminal.detail)
    if json:
        terminal.json(DRIVE_SCHEMA, drive_json(driven))
    else:
        show_rows(terminal, drive_table(driven), good=driven.reached)
    return driven_status(terminal, driven.outcome, driven)


def world(
    context: typer.Context,
    scenario: ScenarioName,
    robot: RobotName,
    vehicle: SimulatedVehicle = None,
    seed: WorldSeed = 0,
    set_: Set = None,
    speed: Speed = 1,
    video: Video = None,
    view: View = False,
    json: Json = False,
) -> ExitStatus:
    """Simulate a robot on its topics in real time.

    The exit code is 1 if it does not reach the goal.
    """
    from kraft_cli.tables import show_rows
    from kraft_cli.work.world import WORLD_SCHEMA, WorldRequest, simulate, world_json, world_table

    terminal: Terminal = context.obj
    request = WorldRequest(scenario, robot, vehicle, seed, tuple(set_ or ()), speed, video, view)
    result = simulate(request, terminal.info)
    success = result.outcome == "success"
    if json:
        terminal.json(WORLD_SCHEMA, world_json(result))
    else:
        show_rows(terminal, world_table(result), good=success)
    return ExitStatus.DONE if success else ExitStatus.NEGATIVE
