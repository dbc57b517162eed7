"""Scenarios, methods, vehicles and seeds of an evaluation, resolved from names; all problems are reported at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeAlias, TypeVar

from kraft.driving.method import Method, check_vehicle, load_method
from kraft.errors import Code, Diagnostic, InputError, out_of_range
from kraft.evaluation.job import Job
from kraft.evaluation.suite import Entry, ScenarioLike, Settings, Sweeps, entries_of
from kraft.planning.feasibility import check_placement
from kraft.planning.workspace import start_state
from kraft.scenario import Scenario
from kraft.trial.result import check_robot, load_planning_vehicle, vehicle_reference
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.reference import VehicleProblem, resolve_vehicle
from ompl_ext.vehicle import Vehicle

SUITE: Final = "paper"
METHODS: Final = (
    "oneshot-openloop",
    "oneshot-geometric",
    "oneshot-kinodynamic",
    "replanner-openloop",
    "cons-replanner-openloop",
    "kraft",
    "conservative-kraft",
)
TRIALS: Final = 30
TRIALS_MAX: Final = 100_000
"""Largest number of trials of a method in an entry; the list of all trials is kept in memory."""

MethodLike: TypeAlias = str | Path | Method
Loaded = TypeVar("Loaded")
Given = TypeVar("Given")


@dataclass(frozen=True)
class Cell:
    """Row of a results table: a method in an entry, with its planning model."""

    entry: Entry
    method: Method
    reference: str
    vehicle: Vehicle

    @property
    def scenario(self) -> Scenario:
        """Scenario of the entry, with all its keys set."""
        return self.entry.scenario

    @property
    def key(self) -> tuple[str, str]:
        """Names of entry and method."""
        return self.entry.name, self.method.name


@dataclass(frozen=True)
class Experiment:
    """Cells of an evaluation; each is run with the seeds `seed`, `seed + 1`, ... `seed + trials - 1`.

    `bounds` are lower bounds of the time to the goal (s), by entry, as far as they are known.
    """

    cells: tuple[Cell, ...]
    trials: int
    seed: int
    realtime: bool = False
    bounds: Mapping[str, float] = field(default_factory=dict)

    @property
    def seeds(self) -> range:
        """Seeds of the trials."""
        return range(self.seed, self.seed + self.trials)

    def jobs(self) -> Iterator[Job]:
        """Trials of all cells, cell by cell."""
        for cell in self.cells:
            for seed in self.seeds:
                yield Job(cell.entry.name, cell.scenario, cell.method, cell.reference, seed, self.realtime)


def experiment_of(
    scenarios: Sequence[ScenarioLike],
    methods: Sequence[MethodLike],
    *,
    suite: str | Path | None = None,
    settings: Settings = (),
    vary: Sweeps = (),
    vehicle: str | None = None,
    trials: int = TRIALS,
    seed: int = 0,
    realtime: bool = False,
) -> Experiment:
    """Load scenarios, methods and vehicles and check starts and goals.

    The planning model is `vehicle`, else the method's own, else the scenario's.  `suite`, `settings` and `vary` are
    those of `kraft.evaluation.suite.entries_of`.

    Raises:
        InputError: with every problem of names, files, keys, numbers, starts and goals.
    """
    problems = [*out_of_range("trials", trials, 1, TRIALS_MAX), *out_of_range("seed", seed, 0)]
    entries: list[Entry] = []
    try:
        entries = entries_of(scenarios, suite=suite, settings=settings, vary=vary)
    except InputError as error:
        problems += error.diagnostics
    found_methods = _loaded("method", methods, _method, problems)
    if vehicle is not None:
        try:
            vehicle = resolve_vehicle(vehicle, Path.cwd())
            load_vehicle(vehicle)
        except VehicleProblem as error:
            problems.append(Diagnostic(vehicle, error.problem, error.expected, code=error.code))
        except InputError as error:
            problems += error.diagnostics
    if problems:
        raise InputError(problems)
    if realtime:
        problems += [diagnostic for method in found_methods for diagnostic in _too_little_time(method)]
    cells = tuple(_cells(entries, found_methods, vehicle, problems))
    if problems:
        raise InputError(problems)
    return Experiment(cells, trials, seed, realtime)


def _too_little_time(method: Method) -> Iterator[Diagnostic]:
    planner = method.planner
    if planner.clock_budget <= 0.0:
        most = planner.clock_budget + planner.lead
        problem = f"leaves no wall-clock time for planning: {most:g} s - {planner.lead:g} s"
        yield method.source.diagnostic("planner.lead", problem, f"expected less than {most:g}", code=Code.CONFLICT)


def _method(given: MethodLike) -> Method:
    return given if isinstance(given, Method) else load_method(given)


def _loaded(
    kind: str, given: Sequence[Given], load: Callable[[Given], Loaded], problems: list[Diagnostic]
) -> list[Loaded]:
    """Load each; problems are added to `problems`."""
    found: list[Loaded] = []
    if not given:
        expected = f"expected at least one {kind}"
        problems.append(Diagnostic(f"{kind}s", "none are given", expected, code=Code.MISSING, argument=True))
    for each in given:
        if each == "":
            problems.append(
                Diagnostic(f"{kind}s", "there is an empty name", f"expected names of {kind}s", argument=True)
            )
            continue
        try:
            found.append(load(each))
        except InputError as error:
            problems += error.diagnostics
    names = Counter(str(getattr(each, "name", "")) for each in found)
    problems += [
        Diagnostic(name, f"the {kind} is given {count} times", "expected each name once", code=Code.DUPLICATE)
        for name, count in names.items()
        if count > 1
    ]
    return found


def _cells(
    entries: list[Entry], methods: list[Method], vehicle: str | None, problems: list[Diagnostic]
) -> Iterator[Cell]:
    loaded: dict[str, Vehicle] = {}
    for entry in entries:
        scenario = entry.scenario
        checked: set[str] = set()
        for method in methods:
            try:
                reference = vehicle_reference(scenario, method, vehicle)
                if reference not in loaded:
                    loaded[reference] = load_planning_vehicle(scenario, reference)
                model = loaded[reference]
                check_vehicle(method, model, own=reference not in (vehicle, scenario.vehicle))
                if reference not in checked:
                    checked.add(reference)
                    check_placement(scenario, model, start_state(scenario, model))
                    check_robot(scenario, model)
                yield Cell(entry, method, reference, model)
            except InputError as error:
                problems += error.diagnostics
