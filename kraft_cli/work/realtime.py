"""`kraft run --realtime`: the simulated robot and the drive as processes on the wall clock, joined by a socket."""

from __future__ import annotations

import contextlib
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from kraft.config.overrides import parse_overrides
from kraft.elapsed import elapsed_time
from kraft.errors import Code, Defect, Diagnostic, Problems
from kraft.gl import check_video_file
from kraft.robot.priority import leave_signals_to_planner, process_context
from kraft.robot.robot_file import JOINT_STATE, CommandOutput, Loopback, Robot, load_robot
from kraft.robot.world import RobotWorld, WorldResult
from kraft.text import MessageSink, finite, metres, no_messages
from kraft.trial.result import Outcome, outcome_text
from kraft.trial.warnings import warnings_of
from kraft.vehicles import is_car
from kraft_cli.work.drive import DriveFiles, Driven, DriveRequest, drive_json, drive_robot, drive_table, load_files
from kraft_cli.work.run import RunRequest
from kraft_cli.work.world import WorldRequest, pace_text, simulate

ROBOT: Final = "sim"
"""Bundled robot whose topics, units and rates are used."""
OPENING_TIME: Final = 120.0
"""Time to wait until the simulated robot is there, s."""
ENDING_TIME: Final = 30.0
"""Time after the result, or after a defect, for the process of the simulated robot to end, s."""


@dataclass(frozen=True)
class RealtimeRun:
    """A drive on the wall clock, and what was true in it."""

    request: RunRequest
    driven: Driven
    world: WorldResult

    @property
    def outcome(self) -> str:
        """``success`` or ``collision`` if that is true, else how the drive ended: ``timeout``, ``stopped``, ..."""
        if self.world.outcome is not Outcome.TIMEOUT:
            return self.world.outcome.value
        return self.driven.outcome if self.driven.outcome != "success" else "stopped"


def run_in_real_time(
    request: RunRequest, report: MessageSink, problem: MessageSink, detail: MessageSink
) -> RealtimeRun:
    """Drive a scenario over a socket, with a simulated robot in a process of its own.

    The callbacks are those of `drive_robot`.

    Raises:
        InputError: with the problems of the request and of the files it names, before anything moves.
        Unreachable: if no path leads to the goal.
        MissingDependency: if a video or a window is requested and no image can be rendered.
    """
    outputs = request.outputs
    with tempfile.TemporaryDirectory(prefix="kraft-") as folder:
        socket = Loopback(kind="loopback", socket=str(Path(folder) / "socket"))
        robot = load_robot(ROBOT).model_copy(update={"transport": socket, "clock": None})
        asked = DriveRequest(
            request.scenario, robot, request.method, request.vehicle, request.seed, request.settings, request.out,
            outputs.bag,
        )  # fmt: skip
        files = _load(request, asked)
        robot = _for_vehicle(robot, files, report)
        asked = replace(asked, robot=robot)
        simulated = WorldRequest(
            request.scenario, robot, request.vehicle, request.seed, request.settings, 1.0, outputs.video, outputs.view,
            driver=f"{files.method.title}, on the wall clock",
        )  # fmt: skip
        report("starting the simulated robot, a process of its own ...")
        with _world(simulated, report) as ended:
            report("the simulated robot is there: starting the drive ...")
            driven = drive_robot(asked, report, problem, detail)
            return RealtimeRun(request, driven, ended())


def _load(request: RunRequest, asked: DriveRequest) -> DriveFiles:
    """What the options name.

    Raises:
        InputError: with the problems of all options and files.
    """
    problems, outputs = Problems(), request.outputs
    if outputs.plot is not None:
        expected = "expected --out and --bag with --realtime"
        problems.found.append(Diagnostic("plot", "draws a trial", expected, code=Code.CONFLICT, argument=True))
    video = outputs.video  # whether it can be drawn is checked in the simulated robot's process
    problems.of(lambda: None if video is None else check_video_file(video))
    files = problems.of(lambda: load_files(asked))
    problems.check()
    assert files is not None, "every problem was raised"
    return files


def _for_vehicle(robot: Robot, files: DriveFiles, report: MessageSink) -> Robot:
    """The robot with commands for the vehicle that drives: of a car, or joints with the controls of another one.

    `report` receives warnings.
    """
    for text in warnings_of(files.scenario, files.method, files.vehicle):
        report(f"warning: {text}")
    if is_car(files.vehicle):
        return robot
    own = robot.command
    joints = CommandOutput(topic=own.topic, type=JOINT_STATE, frame=own.frame, timeout=own.timeout)
    return robot.model_copy(update={"command": joints})


@contextmanager
def _world(request: WorldRequest, report: MessageSink) -> Iterator[Callable[[], WorldResult]]:
    """The simulated robot in a process of its own; the function ends it and returns what was true.

    `report` receives the progress of its film.
    """
    context = process_context()
    here, there = context.Pipe()
    process = context.Process(target=_simulate, args=(request, there, here), name="kraft world", daemon=True)
    process.start()
    there.close()
    try:
        with elapsed_time(report, "waiting for the simulated robot"):
            if not here.poll(OPENING_TIME):
                raise Defect("the simulated robot has not started")
        _received(here)

        def ended() -> WorldResult:
            with contextlib.suppress(BrokenPipeError):  # a collision has ended it before
                here.send("the drive is over")
            while isinstance(message := _received(here), str):
                report(message)
            result: WorldResult = message
            return result

        yield ended
    finally:
        here.close()  # which ends a world that still runs
        process.join(ENDING_TIME)
        if process.is_alive():
            process.kill()


def _received(connection: Connection) -> Any:
    """What the world sends; an error of it is raised."""
    try:
        message = connection.recv()
    except (EOFError, ConnectionResetError):
        raise Defect("the process of the simulated robot has ended") from None
    if isinstance(message, Exception):
        raise message
    return message


def _simulate(request: WorldRequest, connection: Connection, other: Connection) -> None:
    """Main function of the world's process, until the drive has ended or its process has."""
    other.close()
    leave_signals_to_planner()  # which stops the vehicle first

    def opened(world: RobotWorld) -> None:
        threading.Thread(target=wait_for_end, args=(world,), name="end of the drive", daemon=True).start()
        connection.send("the topics are there")

    def wait_for_end(world: RobotWorld) -> None:
        connection.poll(None)  # a message, or the end of the other process
        world.cancelled = True

    message: WorldResult | Exception
    try:
        message = simulate(request, no_messages, opened, on_drawing=connection.send)
    except Exception as error:  # the other process raises it
        message = error
    with contextlib.suppress(BrokenPipeError):  # the other process has ended
        connection.send(message)


def realtime_json(run: RealtimeRun) -> dict[str, Any]:
    """Content of the ``kraft.run/1`` object of a drive on the wall clock."""
    drive, world = drive_json(run.driven), run.world
    return {
        "scenario": drive["scenario"],
        "method": drive["method"],
        "vehicle": drive["vehicle"],
        "seed": drive["seed"],
        "realtime": True,
        "outcome": run.outcome,
        "obstacle": world.obstacle,
        "reason": drive["reason"],
        "t_ex_s": float(world.time),
        "cycles": drive["cycles"],
        "contingencies": drive["contingencies"],
        "watchdog_stops": drive["watchdog_stops"],
        "min_clearance_m": finite(world.min_clearance),
        "first_plan_ms": drive["first_plan_ms"],
        "planning_ms_p50": drive["planning_ms_p50"],
        "planning_ms_p99": drive["planning_ms_p99"],
        "missed_deadlines": drive["controller"].get("missed_commitments", 0),
        "controller": drive["controller"],
        "multiplexer_stops": world.mux_stops,
        "lag_ms": 1000 * world.lag,
        "lost_s": world.lost,
        "checks": drive["checks"],
        "set": {each.key: each.value for each in parse_overrides(run.request.settings, "set")},
        "folder": drive["folder"],
        "unwritten": drive["unwritten"],
    }


def realtime_table(run: RealtimeRun) -> list[tuple[str, str]]:
    """Labels and values of the result table: those of the drive, and what was true."""
    world = run.world
    ended_before = world.outcome is Outcome.TIMEOUT and run.driven.outcome != Outcome.TIMEOUT
    true = outcome_text("not in the goal" if ended_before else world.outcome, world.obstacle, world.time)
    rows = drive_table(run.driven)
    if run.driven.result.ended is None:
        return rows
    at = next(i for i, (name, _) in enumerate(rows) if name == "result") + 1
    clearance = ("clearance", f"{metres(world.min_clearance, '-')} at least")
    simulated = ("in truth", f"{true}, in the simulated world; the result is by the robot's estimate")
    return [*rows[:at], simulated, clearance, *rows[at:], ("simulation", pace_text(world))]
