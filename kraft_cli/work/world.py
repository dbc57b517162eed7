"""`kraft world` without a terminal: the simulated robot from its options to how the drive ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from kraft.config.overrides import parse_overrides
from kraft.driving.method import load_method
from kraft.planning.workspace import vehicle_of_task
from kraft.robot.connect import open_robot
from kraft.robot.priority import prefer_this_process
from kraft.robot.robot_file import Rosbridge, load_robot
from kraft.robot.world import RobotWorld, WorldResult
from kraft.scenario import load_scenario
from kraft.text import counted, finite, metres
from kraft.trial.result import TrialResult, TrialSpec, check_robot, outcome_text
from kraft.vehicles.load import load_vehicle
from kraft_cli.work.trial_outputs import OutputOptions, TrialOutputs

WORLD_SCHEMA: Final = "kraft.world/1"


@dataclass(frozen=True)
class WorldRequest:
    """Options of `kraft world` as written."""

    scenario: str
    robot: str
    vehicle: str | None = None
    seed: int = 0
    settings: tuple[str, ...] = ()
    video: Path | None = None
    view: bool = False


def simulate(request: WorldRequest, report: Callable[[str], None]) -> WorldResult:
    """Load, check and simulate until the drive has ended.

    Raises:
        InputError: with the problems of the request and of the files it names.
        MissingDependency: if a package of the transport is missing, or a video is requested and nothing can be drawn.
    """
    robot = load_robot(request.robot)
    scenario = load_scenario(request.scenario, parse_overrides(request.settings, "set"))
    vehicle = vehicle_of_task(scenario) if request.vehicle is None else load_vehicle(request.vehicle)
    check_robot(scenario, vehicle)
    options = OutputOptions(request.video, request.view)
    options.check()
    spec = TrialSpec(scenario, load_method("kraft"), vehicle, request.seed)
    prefer_this_process()  # a robot does not wait for other programs
    transport = open_robot(robot)
    try:
        world = RobotWorld(scenario, vehicle, robot, transport, request.seed)
        where = robot.transport
        place = where.url if isinstance(where, Rosbridge) else "DDS"
        report(f"{scenario.name} is on {place}: poses on {robot.pose.topic}, commands from {robot.command.topic}")
        with TrialOutputs(options, spec) as outputs:
            result = world.run(outputs.on_step if request.video or request.view else None)
            outputs.finish(_as_trial(result))
    finally:
        transport.close()
    return result


def _as_trial(result: WorldResult) -> TrialResult:
    """The end of the drive, for film and window."""
    return TrialResult(
        result.scenario,
        "robot",
        result.seed,
        result.outcome,
        result.time,
        result.obstacle,
        result.min_clearance,
        (),
        (),
    )


def world_json(result: WorldResult) -> dict[str, Any]:
    """Content of the ``kraft.world/1`` object."""
    return {
        "scenario": result.scenario,
        "seed": result.seed,
        "outcome": result.outcome.value,
        "obstacle": result.obstacle,
        "t_s": float(result.time),
        "min_clearance_m": finite(result.min_clearance),
        "commands": result.commands,
        "multiplexer_stops": result.mux_stops,
        "lag_ms": 1000 * result.lag,
        "standing": result.standing,
    }


def world_table(result: WorldResult) -> list[tuple[str, str]]:
    """Labels and values of the result table."""
    return [
        ("scenario", result.scenario),
        ("result", outcome_text(result.outcome, result.obstacle, result.time)),
        ("clearance", f"{metres(result.min_clearance, '-')} at least"),
        ("commands", f"{result.commands}, {counted(result.mux_stops, 'stop')} by the multiplexer"),
        ("simulation", f"{1000 * result.lag:.0f} ms behind the clock at most"),
    ]
