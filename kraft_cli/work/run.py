"""`kraft run` without a terminal: from its options to a trial that is driven and written."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kraft.config.overrides import parse_overrides, value_text
from kraft.driving.control import settings_for
from kraft.driving.messages import Cycle
from kraft.driving.needs import needs_of
from kraft.errors import InputError, Problems
from kraft.evaluation.experiment import Cell, Experiment, experiment_of
from kraft.evaluation.statistics import percentile, while_driving
from kraft.evaluation.summary import measures_json
from kraft.files import check_new_folder
from kraft.planning.compilation import ensure_all_compiled
from kraft.planning.feasibility import check_reachable
from kraft.planning.stated_speed import faster_than_stated
from kraft.scenario import Scenario
from kraft.text import MessageSink, counted, finite, metres, no_messages, percent
from kraft.trial.measures import BAND, Measures
from kraft.trial.result import TrialResult, TrialSpec, outcome_text
from kraft.trial.warnings import warnings_of
from kraft_cli.work.own_code import reported_own_code
from kraft_cli.work.run_folder import write_run
from kraft_cli.work.trial_outputs import NO_OUTPUT, OutputOptions, TrialOutputs
from kraft_cli.work.verbose import StageTimer, vehicle_details
from ompl_ext.vehicle import Footprint


@dataclass(frozen=True)
class RunRequest:
    """Options of `kraft run` as written; `out` is a new folder, None writes nothing."""

    scenario: str
    method: str = "kraft"
    vehicle: str | None = None
    seed: int = 0
    settings: tuple[str, ...] = ()
    out: Path | None = None
    outputs: OutputOptions = NO_OUTPUT


@dataclass(frozen=True)
class Run:
    """Request with its resolved trial, the values of keys that were set, the result, and warnings before the drive."""

    request: RunRequest
    spec: TrialSpec
    settings: Mapping[str, Any]
    result: TrialResult = field(repr=False)
    warnings: tuple[str, ...] = ()


def run_scenario(
    request: RunRequest,
    report: MessageSink,
    on_cycle: Callable[[Cycle], None] | None = None,
    detail: MessageSink = no_messages,
) -> Run:
    """Load, check, drive and write a trial.

    `report` receives messages about what takes long, `detail` those of ``-v``, and `on_cycle` each committed cycle.

    Raises:
        InputError: with the problems of the request and of the files it names, before the drive.
        Unreachable: if no path leads to the goal, before the drive.
        MissingDependency: if a video or a window is requested and no image can be rendered.
        Defect: if a plan fails its exact verification.
    """
    timer = StageTimer(detail)
    out, problems = request.out, Problems()
    experiment = problems.of(lambda: _experiment(request, report))
    problems.of(lambda: None if out is None else check_new_folder(out))
    problems.of(request.outputs.check)
    problems.check()
    assert experiment is not None, "every problem was raised"
    cell = experiment.cells[0]
    _log_details(detail, cell)
    experiment.check_available()
    timer.report("loaded and checked")
    ensure_all_compiled([needs_of(cell.method, cell.vehicle, cell.scenario.goal)], report)
    check_reachable(cell.scenario.task(), cell.vehicle)
    from kraft.trial.trial import run_trial  # loads the simulator

    found = (*warnings_of(cell.scenario, cell.method, cell.vehicle), faster_than_stated(cell.vehicle))
    warnings = tuple(filter(None, found))
    for text in warnings:
        report(f"warning: {text}")
    timer.report("kernels, maps and simulator loaded")
    spec = TrialSpec(cell.scenario, cell.method, cell.vehicle, request.seed)
    with (
        TrialOutputs(request.outputs, spec, on_cycle) as outputs,
        reported_own_code(cell.method.controller, report) as cycle_decided,
    ):

        def told(cycle: Cycle) -> None:
            cycle_decided()
            outputs.on_cycle(cycle)

        result = run_trial(spec, told, outputs.on_step, keep_trees=outputs.keep_trees)
        timer.report(f"{result.time:.2f} s driven")
        run = Run(request, spec, cell.entry.settings, result, warnings)
        if request.out is not None:  # first: a picture that cannot be written does not cost the results
            arguments = {
                "scenario": request.scenario,
                "method": request.method,
                "vehicle": request.vehicle,
                "set": list(request.settings),
            }
            write_run(request.out, experiment, arguments, cell.vehicle, run.result, run_json(run))
            timer.report("written")
        outputs.finish(result, report)
    if request.outputs != NO_OUTPUT:
        timer.report("drawn")
    return run


def _log_details(detail: MessageSink, cell: Cell) -> None:
    detail(f"scenario {cell.scenario.name}: {cell.scenario.source.file}")
    planner, controller = cell.method.planner, settings_for(cell.method.controller, cell.vehicle)
    detail(f"method {cell.method.name}: {cell.method.source.file}")
    detail(f"{planner.mode}, {controller.kind} at {controller.rate_hz:g} Hz, estimator {cell.method.estimator.kind}")
    for line in vehicle_details(cell.vehicle):
        detail(line)


def _experiment(request: RunRequest, report: MessageSink) -> Experiment:
    """Evaluation of this one trial, with its checks."""
    if not request.method:
        raise InputError.of_argument("method", "is empty", "expected the name of a method")
    problems, names, vehicle = Problems(), ([request.scenario], [request.method]), request.vehicle
    settings = problems.of(lambda: parse_overrides(request.settings, "set")) or ()
    experiment = problems.of(
        lambda: experiment_of(*names, settings=settings, vehicle=vehicle, trials=1, seed=request.seed, log=report)
    )
    problems.check()
    assert experiment is not None, "every problem was raised"
    return experiment


def run_json(run: Run) -> dict[str, Any]:
    """Content of the ``kraft.run/1`` object; `t_ex_s` is the time of the end, whatever the outcome."""
    spec, result = run.spec, run.result
    planning = _planning(result)
    return {
        "scenario": result.scenario,
        "method": result.method,
        "vehicle": spec.vehicle.name,
        "seed": result.seed,
        "outcome": result.outcome.value,
        "obstacle": result.obstacle,
        "cause": None if result.cause is None else result.cause.model_dump(mode="json"),
        "t_ex_s": float(result.time),
        "cycles": len(result.cycles),
        "contingencies": result.contingencies,
        "min_clearance_m": finite(result.min_clearance),
        "outside_m": outside_bounds(run.spec.scenario, run.spec.vehicle.footprint, result),
        "first_plan_ms": planning[0] if planning else None,
        "planning_ms_p50": percentile(while_driving([planning]), 0.5),
        "planning_ms_p99": percentile(while_driving([planning]), 0.99),
        "missed_deadlines": result.missed,
        "command_ms_p50": percentile(result.command_ms, 0.5),
        "command_ms_p99": percentile(result.command_ms, 0.99),
        "late_commands": result.late_commands,
        "set": dict(run.settings),
        **measures_json(result.measures),
        "folder": str(run.request.out) if run.request.out else None,
    }


def outside_bounds(scenario: Scenario, footprint: Footprint, result: TrialResult) -> float:
    """Distance by which the true footprint has left the bounds at most, m; 0 if it has not."""
    poses = np.array([step.pose for step in result.steps])
    if not len(poses):
        return 0.0
    (x, y), c, s = footprint.corners().T, np.cos(poses[:, 2]), np.sin(poses[:, 2])
    corners = poses[:, :2, None] + np.stack([np.outer(c, x) - np.outer(s, y), np.outer(s, x) + np.outer(c, y)], axis=1)
    low, high = np.array([scenario.bounds.x, scenario.bounds.y]).T
    return max(0.0, float(np.max(low - corners.min(axis=2))), float(np.max(corners.max(axis=2) - high)))


def run_table(run: Run) -> list[tuple[str, str]]:
    """Labels and values of the result table."""
    result, planning = run.result, _planning(run.result)
    outside = outside_bounds(run.spec.scenario, run.spec.vehicle.footprint, result)
    rows = [
        ("scenario", result.scenario),
        ("method", run.spec.method.title),
        ("vehicle", run.spec.vehicle.name),
        *_controller_row(run.spec),
        ("result", outcome_text(result.outcome, result.obstacle, result.time)),
        *([] if result.cause is None else [("cause", f"{result.cause.kind}: {result.cause.text}")]),
        ("clearance", f"{metres(result.min_clearance, '-')} at least"),
        *([("outside", f"of the bounds by up to {metres(outside)}: there is no wall")] if outside > 0.0 else []),
        ("cycles", cycles_text(result)),
        *measures_table(result.measures, result.contingencies),
    ]
    if planning:
        slow = f", {result.missed} exceeded the planning time" if result.missed else ""
        later = while_driving([planning])
        times = f"{percentile(later, 0.5):.1f} ms median, {max(later):.1f} ms worst{slow}"
        rows.append(("planning", f"{times}; first plan {planning[0]:.1f} ms"))
    if result.command_ms:
        late = f", {result.late_commands} took longer than the time between two" if result.late_commands else ""
        median, worst = percentile(result.command_ms, 0.5), max(result.command_ms)
        rows.append(("commands", f"{median:.2f} ms median, {worst:.2f} ms worst{late}"))
    rows += [("warning", text) for text in run.warnings]
    outputs = run.request.outputs
    made = (("film", outputs.video), ("picture", outputs.plot), ("bag", outputs.bag), ("written to", run.request.out))
    return rows + [(name, str(path)) for name, path in made if path is not None]


def cycles_text(result: TrialResult) -> str:
    """Number of cycles, of those that began with a contingency, and of those that the trial ended before."""
    text = f"{len(result.cycles)}, {result.contingencies} of them with the contingency"
    ahead = sum(cycle.time > result.time for cycle in result.cycles)
    return text + (f"; {ahead} decided, but not begun before the end" if ahead else "")


def _controller_row(spec: TrialSpec) -> list[tuple[str, str]]:
    """Row about the controller, if it is not the method's own."""
    own, used = spec.method.controller, settings_for(spec.method.controller, spec.vehicle)
    return [] if used == own else [("controller", f"{used.kind}, because {own.kind} is a law for cars")]


def run_command(
    scenario: str,
    method: str,
    vehicle: str | None,
    seed: int,
    video: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> str:
    """Command that repeats a trial with `settings` of the scenario's keys, and films it into `video`."""
    words = ["kraft", "run", scenario, "--method", method]
    for key, value in (settings or {}).items():
        words += ["--set", f"{key}={value_text(value)}"]
    words += [] if vehicle is None else ["--vehicle", vehicle]
    words += ["--seed", str(seed)]
    words += [] if video is None else ["--video", video]
    return shlex.join(words)


def measures_table(measures: Measures, contingencies: int) -> list[tuple[str, str]]:
    """Labels and values of the measures: clearance, decisions, covariance; only those that the method has."""
    rows: list[tuple[str, str]] = []
    kept, consistency = measures.clearance, measures.consistency
    if kept.coverage is not None and kept.delta_mean is not None:
        rows.append(("delta(v)", f"held at {_share(kept.coverage)} of the ticks, {metres(kept.delta_mean)} on average"))
    quantiles = measures.deviation_quantiles((0.5, 0.99))
    if quantiles:
        until, half, most = quantiles[-1]
        rows.append(("deviation", f"{metres(half)} median, {metres(most)} at 99 %, {until:g} s after the commit"))
    if contingencies:
        new = contingencies - measures.in_hand - measures.emergencies
        emergencies = counted(measures.emergencies, "emergency")
        rows.append(("contingencies", f"{new} verified at once, {measures.in_hand} earlier, {emergencies}"))
    if measures.compared:
        reasons = ", ".join(f"{count} {reason}" for reason, count in measures.regressions.items())
        total = sum(measures.regressions.values())
        rows.append(("regressions", f"{total} of {measures.compared} cycles" + (f" ({reasons})" if reasons else "")))
    if measures.messages_lost:
        rows.append(("radio", f"{counted(measures.messages_lost, 'message')} lost"))
    if measures.watchdog_stops:
        rows.append(("watchdog", counted(measures.watchdog_stops, "stop")))
    if consistency is not None and consistency.share is not None and consistency.mean is not None:
        low, high = BAND
        rows.append(
            (
                "covariance",
                f"normalised squared error {consistency.mean:.1f} on average (3 if the stated covariance is right, "
                f"less if it is cautious, more if errors exceed it); {_share(consistency.share)} of poses in its "
                f"95 % band, {low:.2g} to {high:.2g}",
            )
        )
    return rows


def _share(share: float) -> str:
    """A share with a space before the sign, as the other percentages of the table."""
    return percent(share).replace("%", " %")


def cycle_line(cycle: Cycle) -> str:
    """Progress line of a cycle: its start, speed, cost to goal, clearance, what was committed and why."""
    to_goal = f"{cycle.cost_to_goal:5.2f} s" if math.isfinite(cycle.cost_to_goal) else "  -    "
    reason = f": {cycle.reason}" if cycle.reason else ""
    return (
        f"{cycle.time:6.2f} s  {cycle.speed:5.2f} m/s  to goal {to_goal}  clearance {metres(cycle.clearance, '-')}  "
        f"{cycle.kind}{reason}"
    )


def _planning(result: TrialResult) -> list[float]:
    return [cycle.planning_ms for cycle in result.cycles]
