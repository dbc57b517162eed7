"""`kraft world` without a terminal: the simulated robot from its options to how the drive ended."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from kraft.config.overrides import parse_overrides
from kraft.driving.method import load_method
from kraft.errors import Code, InputError, Problems
from kraft.planning.workspace import vehicle_of_task
from kraft.robot.connect import open_transport
from kraft.robot.priority import lock_memory, prefer_this_process
from kraft.robot.robot_file import Loopback, Robot, Rosbridge, load_robot
from kraft.robot.world import RobotWorld, WorldResult
from kraft.scenario import Scenario, load_scenario
from kraft.text import MessageSink, counted, finite, metres
from kraft.trial.planning_vehicle import check_robot, other_robot
from kraft.trial.result import TrialResult, TrialSpec, outcome_text
from kraft.trial.warnings import far_camera
from kraft.vehicles.load import load_vehicle
from kraft_cli.work.trial_outputs import OutputOptions, TrialOutputs
from ompl_ext.vehicle import Vehicle

WORLD_SCHEMA: Final = "kraft.world/1"
SPEEDS: Final = (0.05, 10.0)
"""Slowest and fastest simulation, as a multiple of real time."""


@dataclass(frozen=True)
class WorldRequest:
    """Options of `kraft world` as written."""

    scenario: str
    robot: str | Robot
    vehicle: str | None = None
    seed: int = 0
    settings: tuple[str, ...] = ()
    speed: float = 1.0
    video: Path | None = None
    view: bool = False
    driver: str = "simulated robot"
    """title of what drives, in films"""


def simulate(
    request: WorldRequest,
    report: MessageSink,
    on_open: Callable[[RobotWorld], None] | None = None,
    on_drawing: Callable[[str], None] | None = None,
) -> WorldResult:
    """Load, check and simulate until the drive has ended.

    `on_open` is called when the topics are there; it is up to it to end the simulation, unless the car collides.
    `on_drawing` receives the progress of a film instead of `report`.

    Raises:
        InputError: with the problems of the request and of the files it names.
        MissingDependency: if a package of the transport is missing, or a video is requested and nothing can be drawn.
    """
    options = OutputOptions(request.video, request.view)
    robot, scenario, vehicle = _resolved(request, options)
    spec = TrialSpec(scenario, load_method("kraft"), vehicle, request.seed)
    prefer_this_process()  # a robot does not wait for other programs
    lock_memory()
    transport = open_transport(robot, "robot")
    try:
        world = RobotWorld(scenario, vehicle, robot, transport, request.seed)
        on = f"poses on {robot.pose.topic}, commands from {robot.command.topic}"
        report(f"{scenario.name} is on {place_of(robot)}: {on}; waiting for kraft drive or another program")
        for text in (far_camera(scenario), other_robot(scenario, vehicle)):
            if text:
                report(f"warning: {text}")
        with TrialOutputs(options, spec, driver=request.driver) as outputs:
            if on_open is not None:
                on_open(world)
            watched = outputs.on_step if request.video or request.view else None
            result = world.run(watched, speed=request.speed, stays=on_open is not None, report=report)
            outputs.finish(_as_trial(result), on_drawing or report)
    finally:
        transport.close()
    return result


def _resolved(request: WorldRequest, options: OutputOptions) -> tuple[Robot, Scenario, Vehicle]:
    """Robot, scenario and vehicle of a request.

    Raises:
        InputError: with the problems of all options and files.
        MissingDependency: if a video is requested and nothing can be drawn.
    """
    problems, named, model = Problems(), request.robot, request.vehicle
    robot = problems.of(lambda: load_robot(named) if isinstance(named, str) else named)
    if robot is not None:
        problems.of(partial(check_speed, request, robot))
    settings = problems.of(partial(parse_overrides, request.settings, "set"))
    scenario = problems.of(partial(load_scenario, request.scenario, settings or {}))
    vehicle = None if model is None else problems.of(partial(load_vehicle, model))
    problems.of(options.check)
    problems.check()
    assert robot is not None, "otherwise there are problems"
    assert scenario is not None, "otherwise there are problems"
    chosen = vehicle_of_task(scenario) if vehicle is None else vehicle
    check_robot(scenario, chosen)
    return robot, scenario, chosen


def place_of(robot: Robot) -> str:
    """Where the topics of a robot are, for messages."""
    where = robot.transport
    if isinstance(where, Rosbridge):
        return where.url
    return where.socket or "loopback" if isinstance(where, Loopback) else "DDS"


def check_speed(request: WorldRequest, robot: Robot) -> None:
    """Check that the simulation can run so fast, and that the one who drives the robot can know the time.

    Raises:
        InputError: if not.
    """
    low, high = SPEEDS
    if not low <= request.speed <= high:
        raise InputError.of_argument("speed", f"is {request.speed:g}", f"expected {low:g} to {high:g}")
    if request.speed != 1.0 and robot.clock is None:
        problem = f"is {request.speed:g}, but {robot.name} has no topic of the time"
        expected = "expected 1, or `clock: {topic: /clock}` in the robot file of both programs"
        raise InputError.of_argument("speed", problem, expected, Code.CONFLICT)


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
        "lost_s": result.lost,
        "standing": result.standing,
    }


def world_table(result: WorldResult) -> list[tuple[str, str]]:
    """Labels and values of the result table."""
    return [
        ("scenario", result.scenario),
        ("result", outcome_text(result.outcome, result.obstacle, result.time)),
        ("clearance", f"{metres(result.min_clearance, '-')} at least"),
        ("commands", f"{result.commands}, {counted(result.mux_stops, 'stop')} by the multiplexer"),
        ("simulation", pace_text(result)),
    ]


def pace_text(result: WorldResult) -> str:
    """How well a simulation kept to the clock."""
    lost = f", {result.lost:.1f} s lost: the computer is overloaded" if result.lost > 0.0 else ""
    return f"{1000 * result.lag:.0f} ms behind the clock at most{lost}"
