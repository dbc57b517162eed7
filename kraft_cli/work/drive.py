"""`kraft drive` without a terminal: from its options to a drive that is driven and written."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from kraft.config import bundled
from kraft.config.overrides import parse_overrides
from kraft.driving.messages import Cycle
from kraft.driving.method import Method, load_method
from kraft.driving.needs import needs_of
from kraft.errors import Code, Diagnostic, InputError, MissingError, Problems, out_of_range
from kraft.evaluation.statistics import percentile, while_driving
from kraft.files import check_new_folder, write_json
from kraft.planning.compilation import ensure_all_compiled
from kraft.planning.feasibility import check_reachable
from kraft.provenance import SIMULATION, plain, versions
from kraft.robot.bag import check_bag
from kraft.robot.command import limited
from kraft.robot.connect import check_transport
from kraft.robot.drive import DriveResult, check_method, drive, on_the_clock
from kraft.robot.protocol import Checked, DriveSpec, Status
from kraft.robot.robot_file import Robot, load_robot
from kraft.robot.show import Display
from kraft.scenario import Scenario, load_scenario
from kraft.text import MessageSink, alternatives, counted
from kraft.trial.planning_vehicle import planning_vehicle
from kraft.trial.plant import camera_model
from kraft.vehicles.load import load_vehicle
from kraft_cli.work.run import cycle_line
from kraft_cli.work.verbose import vehicle_details
from ompl_ext.vehicle import Vehicle

DRIVE_SCHEMA: Final = "kraft.drive/1"
MANIFEST: Final = "manifest.json"
LEARNED_SHOWN: Final = 2
"""Parameters that the line of a cycle names at most."""


@dataclass(frozen=True)
class DriveRequest:
    """Options of `kraft drive` as written; `out` is a new folder, None writes nothing."""

    scenario: str
    robot: str | Robot
    method: str = "adaptive-kraft"
    vehicle: str | None = None
    seed: int = 0
    settings: tuple[str, ...] = ()
    out: Path | None = None
    bag: Path | None = None


@dataclass(frozen=True)
class Driven:
    """Request with its resolved drive and the result."""

    request: DriveRequest
    spec: DriveSpec
    result: DriveResult
    unwritten: tuple[str, ...] = ()
    """why some of its files are not complete"""

    @property
    def outcome(self) -> str:
        """``success``, ``timeout``, ``stopped``, ``interrupted``, or ``refused`` by the check list."""
        return "refused" if self.result.ended is None else self.result.ended.outcome

    @property
    def own_code_failed(self) -> bool:
        """Whether the user's own controller has failed and ended the drive."""
        return self.result.ended is not None and self.result.ended.own_code

    @property
    def reached(self) -> bool:
        """Whether the estimate was in the goal region."""
        return self.outcome == "success"


def drive_robot(request: DriveRequest, report: MessageSink, problem: MessageSink, detail: MessageSink) -> Driven:
    """Load, check, drive and write.

    Args:
        request: the options.
        report: receives messages about what goes on.
        problem: receives what prevents the drive or stops the vehicle.
        detail: receives the messages of ``-v``.

    Raises:
        InputError: with the problems of the request and of the files it names, before anything moves.
        Unreachable: if no path leads to the goal.
        MissingDependency: if a package of the transport is missing.
    """
    out, bag, spec = request.out, request.bag, resolve(request)
    check_transport(spec.robot)
    for line in vehicle_details(spec.vehicle):
        detail(line)
    goals = (spec.task.goal, *spec.other_goals)
    ensure_all_compiled([needs_of(spec.method, spec.vehicle, goal) for goal in goals], report)
    check_reachable(spec.task, spec.vehicle)
    on_check = partial(_report_checks, report=report, problem=problem)
    newest: list[Status] = []

    def on_status(status: Status) -> None:
        if status.note:
            problem(f"{status.time:6.2f} s  {status.note}")
        else:
            newest[:] = [status]

    try:
        if out is not None:
            out.mkdir(parents=True)
            write_json(out / MANIFEST, _manifest(request, spec))
        with Display(spec, bag) as display:

            def on_cycle(cycle: Cycle) -> None:
                known = () if cycle.parameters is None else cycle.parameters.tolist()
                learned = learned_text(known, spec.vehicle.parameters) if known else ""
                report(cycle_line(cycle) + "".join(map(_status, newest)) + learned)
                display.show(cycle)

            result = drive(
                spec, on_check, on_cycle, on_status, display.sensed, keep_trees=display.draws_trees,
                on_abandon=lambda known: _abandoned(Driven(request, spec, known, known.unwritten), problem),
            )  # fmt: skip
    except (InputError, MissingError, KeyboardInterrupt):
        if out is not None:
            _remove_undriven(out)
        raise
    unwritten = [*result.unwritten, *((display.problem,) if display.problem else ())]
    return _write_result(Driven(request, spec, result, tuple(unwritten)))


def _write_result(driven: Driven) -> Driven:
    """Write `result.json` if the drive is written; the result also says if that was not possible."""
    if driven.request.out is None:
        return driven
    try:
        write_json(driven.request.out / "result.json", {"schema": DRIVE_SCHEMA, **drive_json(driven)})
    except InputError as error:  # the result is printed
        return replace(driven, unwritten=(*driven.unwritten, str(error)))
    return driven


def _abandoned(driven: Driven, problem: MessageSink) -> None:
    """Write what is known at the second signal, and say where."""
    written, ended = _write_result(driven), driven.result.ended
    assert ended is not None, "it was interrupted"
    for text in (ended.reason, *written.unwritten):
        problem(text)
    if driven.request.out is not None:
        problem(f"written to {driven.request.out}: the drive up to now")


def _remove_undriven(out: Path) -> None:
    """Remove the folder of a drive that has not begun, which is empty if the manifest could not be written."""
    if out.is_dir() and all(path.name == MANIFEST for path in out.iterdir()):
        (out / MANIFEST).unlink(missing_ok=True)
        out.rmdir()


def _report_checks(checked: Checked, report: MessageSink, problem: MessageSink) -> None:
    """Report the check list."""
    for check in checked.checks:
        say = problem if check.state == "problem" else report
        say(f"{check.state:8s} {check.name}: {check.detail}")


def _status(status: Status) -> str:
    """Age of the newest pose and, if there were any, late ticks and missed deadlines, for the line of a cycle."""
    if math.isinf(status.pose_age):
        return ""  # the drive has not begun
    totals = [(status.late_ticks, "late tick"), (status.missed, "missed deadline")]
    counts = ", ".join(counted(number, name) for number, name in totals if number)
    return f"  pose {1000 * status.pose_age:.0f} ms old{f', so far {counts}' if counts else ''}"


class DriveFiles(NamedTuple):
    """What the options of a drive name."""

    robot: Robot
    method: Method
    scenario: Scenario
    vehicle: Vehicle


def load_files(request: DriveRequest) -> DriveFiles:
    """Load what the options name, and check the other options.

    Raises:
        InputError: with the problems of all options and files.
    """
    problems, named, reference = Problems(), request.robot, request.vehicle
    out, bag = request.out, request.bag
    robot = problems.of(lambda: load_robot(named) if isinstance(named, str) else named)
    method = problems.of(lambda: _method(request.method))
    settings = problems.of(lambda: parse_overrides(request.settings, "set"))
    scenario = problems.of(lambda: load_scenario(request.scenario, settings or ()))
    problems.found += out_of_range("seed", request.seed, 0)
    problems.of(lambda: None if out is None else check_new_folder(out))
    problems.of(lambda: None if bag is None else check_bag(bag, new=True))
    if scenario is not None and method is not None:
        vehicle = problems.of(partial(planning_vehicle, scenario, method, reference))
    else:  # the model alone
        vehicle = problems.of(lambda: None if reference is None else load_vehicle(reference))
    problems.check()
    assert robot is not None, "every problem was raised"
    assert method is not None, "every problem was raised"
    assert scenario is not None, "every problem was raised"
    assert vehicle is not None, "every problem was raised"
    return DriveFiles(robot, method, scenario, vehicle)


def resolve(request: DriveRequest) -> DriveSpec:
    """Load everything that a drive needs, and check that it fits together.

    Raises:
        InputError: with the problems of all options and files; then of what they are together.
    """
    robot, method, scenario, vehicle = load_files(request)
    camera = camera_model(scenario) if robot.pose.level_camera else None
    spec = DriveSpec(
        scenario.task(), on_the_clock(method), limited(vehicle, robot), robot, scenario.trial.timeout, request.seed,
        request.out, camera,
    )  # fmt: skip
    problems = list[Diagnostic]()
    if late := robot.too_slow(1.0 / spec.period):
        problem = f"{spec.method.name} sends {1.0 / spec.period:g} a second, {late[0]}"
        problems.append(robot.source.diagnostic("command.timeout", problem, f"{late[1]} (rate_hz)"))
    if robot.goal is not None and robot.goal.heading_tolerance_deg is not None and vehicle.index("theta") < 0:
        problem, expected = f"{vehicle.name} has no heading: its state has no component theta", "expected it left out"
        key = "goal.heading_tolerance_deg"
        problems.append(robot.source.diagnostic(key, problem, expected, code=Code.MISMATCH))
    if problems:
        raise InputError(problems)
    return spec


def _method(name: str) -> Method:
    """Method that may drive a robot.

    Raises:
        InputError: if there is none; at its lines if it may not, or for a bundled method at the option.
    """
    method = load_method(name)
    try:
        check_method(method)
    except InputError as error:
        if not bundled.is_name(name):
            raise
        expected = f"expected {alternatives(methods_for_robots())}, or a method file"
        raise InputError(
            Diagnostic("method", f"is {name}, whose {d.path} {d.problem}", expected, code=d.code, argument=True)
            for d in error.diagnostics
        ) from error
    return method


def methods_for_robots() -> tuple[str, ...]:
    """Names of the bundled methods that may drive a robot."""
    found = []
    for name in bundled.names("method"):
        with contextlib.suppress(InputError):
            check_method(load_method(name))
            found.append(name)
    return tuple(found)


def learned_text(parameters: Sequence[float], before: Mapping[str, float]) -> str:
    """The parameters that differ most from those of the file, of all that do by a tenth; empty if none does."""
    changes = {
        name: (abs(float(value) - old) / max(abs(old), 0.05), float(value))
        for (name, old), value in zip(before.items(), parameters, strict=True)
    }
    most = sorted((name for name in changes if changes[name][0] > 0.1), key=lambda name: -changes[name][0])
    shown = [f"{name} {changes[name][1]:.3g}" for name in most[:LEARNED_SHOWN]]
    if len(most) > len(shown):
        shown.append(counted(len(most) - len(shown), "other parameter"))
    return f"  learned {', '.join(shown)}" if shown else ""


def _manifest(request: DriveRequest, spec: DriveSpec) -> dict[str, Any]:
    arguments = {name: plain(value) for name, value in vars(request).items() if name not in ("out", "bag")}
    return {
        "schema": "kraft.drive-manifest/1",
        "arguments": {**arguments, "bag": None if request.bag is None else str(request.bag)},
        "scenario": spec.task.name,
        "method": plain(spec.method),
        "robot": plain(spec.robot),
        "vehicle": {"name": spec.vehicle.name, "parameters": dict(spec.vehicle.parameters)},
        "versions": versions(SIMULATION),
    }


def drive_json(driven: Driven) -> dict[str, Any]:
    """Content of the ``kraft.drive/1`` object."""
    result, spec, ended = driven.result, driven.spec, driven.result.ended
    decisions = result.decisions
    return {
        "scenario": spec.task.name,
        "robot": spec.robot.name,
        "method": spec.method.name,
        "vehicle": spec.vehicle.name,
        "seed": spec.seed,
        "outcome": driven.outcome,
        "reason": "" if ended is None else ended.reason,
        "t_s": 0.0 if ended is None else float(ended.time),
        "cycles": len(decisions.planning_ms),
        "contingencies": sum(ended is not None and begin <= ended.time for begin in decisions.contingencies),
        "watchdog_stops": 0 if ended is None else ended.stops,
        "refused_poses": {} if ended is None else ended.refused,
        "controller": {} if ended is None else {k: None if math.isnan(v) else v for k, v in ended.measures.items()},
        "first_plan_ms": decisions.planning_ms[0] if decisions.planning_ms else None,
        "planning_ms_p50": percentile(while_driving([decisions.planning_ms]), 0.5),
        "planning_ms_p99": percentile(while_driving([decisions.planning_ms]), 0.99),
        "checks": [{"name": c.name, "state": c.state, "detail": c.detail} for c in result.checked.checks],
        "folder": str(driven.request.out) if driven.request.out else None,
        "unwritten": list(driven.unwritten),
    }


def drive_table(driven: Driven) -> list[tuple[str, str]]:
    """Labels and values of the result table."""
    content, ended = drive_json(driven), driven.result.ended
    if ended is None:
        return [("result", "refused: the check list found problems")]
    measures = ended.measures
    rows = [
        ("scenario", content["scenario"]),
        ("robot", content["robot"]),
        ("method", driven.spec.method.title),
        ("result", f"{ended.outcome} after {ended.time:.2f} s{f': {ended.reason}' if ended.reason else ''}"),
        ("cycles", f"{content['cycles']}, {content['contingencies']} of them with the contingency"),
    ]
    if "ticks" in measures:
        late = f"{measures['late_ticks']:.0f} of {measures['ticks']:.0f} ticks over 3 ms late"
        rows.append(("watchdog", counted(ended.stops, "stop")))
        rows.append(("controller", f"{late}, {measures['worst_late_ms']:.1f} ms at most"))
    else:
        rows.append(("controller", "ended without a report of its ticks and of the watchdog's stops"))
    if (taken := measures.get("own_command_ms")) is not None:
        due = 1000.0 * driven.spec.period
        rows.append(("commands", f"{taken:.1f} ms each, measured before the drive; one is due every {due:.1f} ms"))
    rows += [("refused poses", f"{count}: {why}") for why, count in ended.refused.items()]
    made = (("bag", driven.request.bag), ("written to", driven.request.out))
    return rows + [(name, str(path)) for name, path in made if path is not None and path.exists()]
