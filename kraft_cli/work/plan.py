"""`kraft plan` without a terminal: from names and paths to a plan that is written and drawn."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from kraft.config.overrides import Override, parse_overrides, plain_value
from kraft.errors import Code, Diagnostic, InputError, Problems
from kraft.files import check_all
from kraft.planning.compilation import Needs, ensure_all_compiled
from kraft.planning.feasibility import check_placement, memory_needed, needs_motions
from kraft.planning.plan import PlanResult, budget_of, plan_task
from kraft.planning.plan_file import NAME, Origin, check_plan_target, read_plan_file, write_plan
from kraft.planning.search import (
    Previous,
    check_previous,
    check_seed,
    check_threads,
    search_named,
    settings_without_effect,
)
from kraft.planning.stated_speed import faster_than_stated
from kraft.planning.workspace import start_state, vehicle_of_task
from kraft.scenario import Planning, Task, load_scenario
from kraft.scenario.unmapped import unstated_outside
from kraft.text import MessageSink, counted, finite, grouped, metres, no_messages
from kraft.vehicles.load import load_vehicle
from kraft_cli.work.parameters import parse_parameters
from kraft_cli.work.verbose import StageTimer, vehicle_details
from ompl_ext.memory import in_words
from ompl_ext.query_tree import Progress
from ompl_ext.vehicle import Vehicle

PARAMETERS_MAX = 12
"""Number of a vehicle's parameters up to which those that are 0 are printed too; -v prints them all."""
MUCH_MEMORY = 1_000_000_000
"""Size of the maps from which on the need of memory is reported without -v too, bytes."""
PROGRESS_INTERVAL = 5.0
"""Time between two lines about a long search, s."""


class SearchReporter:
    """Reports what a long search has done so far, a line every `PROGRESS_INTERVAL` s."""

    def __init__(self, report: MessageSink) -> None:
        self._report, self._last = report, clock.monotonic()

    def tell(self, progress: Progress) -> None:
        """Report the progress if a line is due."""
        if clock.monotonic() < self._last + PROGRESS_INTERVAL:
            return
        self._last = clock.monotonic()
        work = f"{grouped(progress.iterations, 'iteration')}, {grouped(progress.nodes, 'node')}"
        found = f"a plan of {progress.history[-1][1]:.2f} s" if progress.history else "no plan to the goal yet"
        self._report(f"  {progress.seconds:.0f} s: {work}, {found}")


@dataclass(frozen=True)
class PlanRequest:
    """Arguments of `kraft plan` as they were given.

    Attributes:
        scenario: bundled name or path.
        time, iterations: budget instead of the scenario's, s or a number; at most one.
        seed: of the random generator.
        planner, vehicle: instead of the scenario's.
        parameters: ``name=value`` each.
        out: folder for the plan file; None writes none.
        plot: picture; None draws none.
        previous: plan file to start from, `after` s after its beginning.
        settings: ``key=value`` each, for keys of the scenario.
        threads: number of trees that are grown at the same time.
    """

    scenario: str
    time: float | None = None
    iterations: int | None = None
    seed: int = 0
    planner: str | None = None
    vehicle: str | None = None
    parameters: tuple[str, ...] = ()
    out: Path | None = None
    plot: Path | None = None
    previous: Path | None = None
    after: float = 0.0
    settings: tuple[str, ...] = ()
    threads: int = 1


@dataclass(frozen=True)
class _Inputs:
    """What a request names, loaded and checked; `target` is the plan file."""

    settings: tuple[Override, ...]
    task: Task
    vehicle: Vehicle
    previous: Previous | None
    target: Path | None


@dataclass(frozen=True)
class PlanOutcome:
    """Request, its resolved task and vehicle, and the result; `plan_file` is None if none was written.

    `replaced` is true if an earlier plan that differs was in its place.
    """

    request: PlanRequest
    task: Task
    vehicle: Vehicle
    result: PlanResult
    plan_file: Path | None
    replaced: bool = False


def run_plan(request: PlanRequest, report: MessageSink, detail: MessageSink = no_messages) -> PlanOutcome:
    """Load, check, plan, write, draw; `report` gets progress and remarks, `detail` the messages of ``-v``.

    The request is checked completely before planning.

    Raises:
        InputError: with the problems of the request or the files it names.
        Defect: if a plan of DIRT fails verification.
    """
    timer = StageTimer(detail)
    inputs = _inputs(request, report)
    task, vehicle, previous, target = inputs.task, inputs.vehicle, inputs.previous, inputs.target
    _report_inputs(detail, request, task, vehicle)
    timer.report("loaded and checked")
    polish = task.planning.polish and task.planning.planner == "dirt"
    modules = ("sst",) if task.planning.planner == "sst" else ()
    needs = Needs(vehicle, polish=bool(polish), modules=modules) | Needs.of_goal(vehicle, task.goal)
    ensure_all_compiled([needs], report)
    for warning in (unstated_outside(task), faster_than_stated(vehicle), settings_without_effect(task.planning)):
        if warning:
            report(f"warning: {warning}")
    needed = memory_needed(task, vehicle)
    (report if needed >= MUCH_MEMORY else detail)(f"the maps need at most {in_words(needed)} of memory")
    result = plan_task(
        task, vehicle, seed=request.seed, previous=previous, threads=request.threads,
        on_progress=SearchReporter(report).tell,
    )  # fmt: skip
    timer.report("planned, with maps and verification,")
    replaced = False
    if target is not None and result.plan is not None:
        changed = {each.key: plain_value(each.value) for each in inputs.settings}
        origin = Origin(request.scenario, request.vehicle or task.vehicle, previous, changed)
        earlier = target.read_bytes() if target.exists() else None
        write_plan(target, task, vehicle, result, origin)
        replaced = earlier not in (None, target.read_bytes())
    else:
        target = None
    if request.plot is not None:
        _draw(request.plot, task, vehicle, result)
    if target is not None or request.plot is not None:
        timer.report("written and drawn")
    return PlanOutcome(request, task, vehicle, result, target, replaced)


def _inputs(request: PlanRequest, report: MessageSink) -> _Inputs:
    """Load what the request names.

    Raises:
        InputError: with the problems of all options and files.
    """
    problems = Problems()
    settings = problems.of(lambda: parse_overrides(request.settings, "set"))
    scenario = problems.of(lambda: load_scenario(request.scenario, settings or ()).task())
    planning = _planning(request, scenario.planning if scenario else Planning(), problems)
    task = replace(scenario, planning=planning) if scenario else None
    problems.of(lambda: check_seed(request.seed))
    problems.of(lambda: check_threads(planning.planner, request.threads))
    vehicle = _vehicle(request, task, problems)
    previous = problems.of(lambda: _previous(request, task, report))
    target = None if request.out is None else request.out / NAME
    problems.of(lambda: _check_places(target, request.plot))
    problems.check()
    assert settings is not None, "every problem was raised"
    assert task is not None, "every problem was raised"
    assert vehicle is not None, "every problem was raised"
    problems.of(lambda: check_previous(planning.planner, previous, vehicle))
    if not needs_motions(task):  # otherwise it is done when the vehicle's kernels are compiled
        problems.of(lambda: _check_placement(task, vehicle, previous))
    problems.check()
    return _Inputs(settings, task, vehicle, previous, target)


def _check_placement(task: Task, vehicle: Vehicle, previous: Previous | None) -> None:
    """Check where planning starts, unless the previous plan is over by then, and the goal."""
    if previous is None:
        check_placement(task, vehicle, start_state(task, vehicle))
    elif 0.0 <= previous.elapsed < previous.plan.cost:
        check_placement(task, vehicle, previous.state, previous.origin)


def _check_places(target: Path | None, plot: Path | None) -> None:
    """Check before planning that plan file and picture can be written."""
    checks: list[Callable[[], object]] = []
    if target is not None:
        checks.append(partial(check_plan_target, target))
    if plot is not None:
        from kraft.plot import check_picture

        checks.append(partial(check_picture, plot))
    check_all(*checks)


def _planning(request: PlanRequest, planning: Planning, problems: Problems) -> Planning:
    """Settings with the budget and the planner of the request, as far as these are valid."""
    if request.time is not None or request.iterations is not None:
        changed = problems.of(lambda: planning.with_budget(iterations=request.iterations, time=request.time))
        planning = changed or planning
    name = request.planner
    if name is not None and problems.of(lambda: search_named(name)) is not None:
        planning = planning.model_copy(update={"planner": name})
    return planning


def _report_inputs(detail: MessageSink, request: PlanRequest, task: Task, vehicle: Vehicle) -> None:
    detail(f"scenario {task.name}: {task.source.file}")
    for line in vehicle_details(vehicle):
        detail(line)
    budget = budget_of(task)
    amount = f"{budget.iterations} iterations" if budget.iterations is not None else f"{budget.seconds:g} s"
    threads = f", {request.threads} threads" if request.threads > 1 else ""
    detail(f"planner {task.planning.planner}: {amount}, seed {request.seed}{threads}")


def _vehicle(request: PlanRequest, task: Task | None, problems: Problems) -> Vehicle | None:
    """Vehicle with the values of ``--param``; None if there are problems, or no task to take the vehicle from."""
    parameters = parse_parameters(request.parameters, problems.found)
    if request.vehicle is not None:
        named, folder = request.vehicle, Path.cwd()
        vehicle = problems.of(lambda: load_vehicle(named))
    elif task is not None:
        named, folder = task.vehicle, Path(task.source.file).parent
        vehicle = problems.of(lambda: vehicle_of_task(task))
    else:
        return None
    if vehicle is None or not parameters:
        return vehicle
    try:
        return load_vehicle(named, folder, parameters)
    except InputError as error:  # the vehicle is valid without them
        problems.found += [_at_parameter_option(d, parameters) for d in error.diagnostics]
        return None


def _at_parameter_option(diagnostic: Diagnostic, parameters: Mapping[str, float]) -> Diagnostic:
    """Same problem, reported at the option that causes it."""
    section, _, rest = diagnostic.path.partition(".")
    name = rest.partition(".")[0] if section == "parameters" else diagnostic.file
    where = f"--param {name}" if name in parameters else "--param"
    path = "" if name in parameters else diagnostic.path
    return replace(diagnostic, file=where, line=None, column=None, path=path)


def _previous(request: PlanRequest, task: Task | None, report: MessageSink) -> Previous | None:
    if request.previous is None:
        if request.after != 0.0:
            raise InputError.of("--after", "is given without --from", "expected --from PLAN too", Code.CONFLICT)
        return None
    if not (math.isfinite(request.after) and request.after >= 0):
        raise InputError.of("--after", f"is {request.after:g}", "expected a number of at least 0, s")
    content = read_plan_file(request.previous)
    scenario = content.scenario.name
    if task is not None and scenario != task.name:
        report(f"note: {request.previous} is a plan of {scenario or 'a scenario without a name'}, not of {task.name}")
    return Previous(content.plan(), request.after, str(request.previous), content.names)


def _draw(path: Path, task: Task, vehicle: Vehicle, result: PlanResult) -> None:
    from kraft.plot import plot_plan

    shown = notes(task, vehicle, result)
    plot_plan(path, task, vehicle, result.plan, result.tree, notes=shown, cycle=task.planning.cycle)


def plan_json(outcome: PlanOutcome) -> dict[str, Any]:
    """Content of the ``kraft.plan/1`` object; missing values are null, as is a clearance without obstacles."""
    result, plan, progress = outcome.result, outcome.result.plan, outcome.result.progress
    first = progress.first_solution
    verification = result.verification
    return {
        "scenario": outcome.task.name,
        "vehicle": outcome.vehicle.name,
        "planner": outcome.task.planning.planner,
        "seed": result.seed,
        "threads": result.threads,
        "solved": result.solved,
        "reason": result.reason or None,
        "cost_s": plan.cost if plan else None,
        "cost_to_go_s": plan.cost_to_go if plan else None,
        "first_solution_ms": 1000 * first[0] if first else None,
        "first_cost_s": first[1] if first else None,
        "planning_ms": 1000 * progress.seconds,
        "setup_ms": 1000 * result.setup_seconds,
        "verify_ms": 1000 * result.verify_seconds,
        "iterations": progress.iterations,
        "edges": progress.edges or None,
        "edges_per_s": _rate(result),
        "nodes": progress.nodes,
        "retained": progress.retained,
        "unsafe": progress.unsafe,
        "min_clearance_m": finite(verification.min_clearance) if verification else None,
        "contingency": plan.contingency.manoeuvre if plan and plan.contingency else None,
        "contingency_clearance_m": finite(verification.contingency_clearance) if verification else None,
        "safe": result.safe,
        "problems": [str(problem) for problem in verification.problems] if verification else [],
        "plan_file": str(outcome.plan_file) if outcome.plan_file else None,
        "replaced": outcome.replaced,
    }


def table_rows(outcome: PlanOutcome) -> list[tuple[str, str]]:
    """Label and value of each line of the printed table."""
    result, plan, progress = outcome.result, outcome.result.plan, outcome.result.progress
    rows = [("scenario", outcome.task.name), ("vehicle", vehicle_text(outcome.vehicle))]
    rows.append(("result", _outcome(result)))
    if plan is not None:
        rows.append(("plan", f"{plan.cost:.2f} s in {counted(len(plan.durations), 'edge')}"))
    if progress.first_solution is not None:
        seconds, cost = progress.first_solution
        rows.append(("first solution", f"{cost:.2f} s, found after {1000 * seconds:.2f} ms"))
    if result.verification is not None:
        rows.append(("clearance", f"{metres(result.verification.min_clearance)} at least, verified with FCL"))
    if plan is not None and plan.contingency is not None:
        stop = plan.contingency
        text = f"{stop.manoeuvre} at {stop.times[0]:.2f} s, stands {stop.times[-1] - stop.times[0]:.1f} s later"
        if result.verification is not None:
            text += f", clearance {metres(result.verification.contingency_clearance)} at least"
        rows.append(("contingency", text))
    if result.verification is not None and result.verification.problems:
        rows.append(("not safe", "\n".join(map(str, result.verification.problems))))
    if progress.retained:
        rows.append(("retained", f"{counted(progress.retained, 'edge')} of the earlier plan"))
    if progress.iterations:
        rows.append(("search", _search(result)))
    if outcome.plan_file is not None:
        remark = ", instead of another plan that was there" if outcome.replaced else ""
        rows.append(("plan file", f"{outcome.plan_file}{remark}"))
    if outcome.request.plot is not None:
        rows.append(("picture", str(outcome.request.plot)))
    return rows


def notes(task: Task, vehicle: Vehicle, result: PlanResult) -> dict[str, str]:
    """Key numbers of the picture, and what it is of; none depends on the clock: equal plans give equal pictures."""
    plan, verification = result.plan, result.verification
    subject = {"vehicle": vehicle.name, "planner": task.planning.planner, "seed": str(result.seed)}
    if plan is None or verification is None:
        measured = f" ({result.progress.seconds:.3g} s)"
        return {"why there is no plan": result.reason.replace(measured, ""), **subject}
    found = {"duration": f"{plan.cost:.2f} s", "clearance": metres(verification.min_clearance)}
    if plan.contingency is not None:
        clearance = metres(verification.contingency_clearance)
        found["contingency"] = f"{plan.contingency.manoeuvre}, clearance {clearance}"
    progress = result.progress
    return {**found, "iterations": f"{progress.iterations:,}", "nodes": f"{progress.nodes:,}", **subject}


def vehicle_text(vehicle: Vehicle) -> str:
    """Name and parameters; of many, without those that are 0."""
    parameters = vehicle.parameters
    shown = {name: value for name, value in parameters.items() if value != 0.0 or len(parameters) <= PARAMETERS_MAX}
    values = ", ".join(f"{name} {value:g}" for name, value in shown.items())
    if len(shown) < len(parameters):
        values += f"; {len(parameters) - len(shown)} others are 0"
    return f"{vehicle.name} ({values})" if values else vehicle.name


def _outcome(result: PlanResult) -> str:
    if result.solved:
        return "solved"
    return "no plan" if result.plan is None else "not solved; the plan ends nearest to the goal"


def _search(result: PlanResult) -> str:
    progress = result.progress
    rate = _rate(result)
    speed = f", {rate / 1e6:.2f} M edges/s" if rate is not None else ""
    work = f"{grouped(progress.iterations, 'iteration')}, {grouped(progress.nodes, 'node')}"
    return f"{work}, {1000 * progress.seconds:.0f} ms{speed}"


def _rate(result: PlanResult) -> float | None:
    progress = result.progress
    return progress.edges / progress.seconds if progress.edges and progress.seconds > 0 else None
