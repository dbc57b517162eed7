"""Experiment: scenarios, methods, vehicles and seeds of an evaluation, resolved from names.

All problems of the names are reported at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Final, TypeAlias

from kraft.driving.control import check_available
from kraft.driving.method import Method, check_vehicle, load_method
from kraft.errors import Code, Diagnostic, InputError, Problems, out_of_range
from kraft.evaluation.job import Job
from kraft.evaluation.paper import is_of_paper
from kraft.evaluation.suite import Entry, ScenarioLike, SettingsLike, Sweeps, entries_of, list_problems, repeated_names
from kraft.planning.compilation import ensure_compiled
from kraft.planning.feasibility import check_placement, needs_motions
from kraft.planning.workspace import start_state
from kraft.scenario import Scenario
from kraft.text import MessageSink, no_messages
from kraft.trial.camera_view import check_view
from kraft.trial.planning_vehicle import check_robot, load_planning_vehicle, vehicle_reference
from kraft.trial.robot_content import vehicle_hash
from kraft.vehicles.load import load_vehicle, resolved_reference
from kraft.vehicles.reference import reference_of
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


@dataclass(frozen=True)
class Cell:
    """Row of a results table: a method in an entry, with its planning model.

    `of_paper` is whether scenario, method and planning model are the bundled ones of a result of the paper.
    """

    entry: Entry
    method: Method
    reference: str
    vehicle: Vehicle
    of_paper: bool

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

    `bounds` are lower bounds of the time to the goal (s), by entry, as far as they are known.  `warnings` say what is
    probably a mistake.
    """

    cells: tuple[Cell, ...]
    trials: int
    seed: int
    realtime: bool = False
    bounds: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def seeds(self) -> range:
        """Seeds of the trials."""
        return range(self.seed, self.seed + self.trials)

    @cached_property
    def vehicle_hashes(self) -> Mapping[str, str]:
        """Hash of each planning vehicle by its reference, as it is when they are first asked for."""
        vehicles = {cell.reference: cell.vehicle for cell in self.cells}
        return {reference: vehicle_hash(vehicle) for reference, vehicle in vehicles.items()}

    def check_available(self) -> None:
        """Check that what methods or cameras need is there, before anything is compiled: packages of extras, code.

        Raises:
            MissingDependency: if a package is missing.
            InputError: if a controller in code is wrong.
        """
        for cell in self.cells:
            check_available(cell.method)
            if cell.scenario.sensing.preset == "rendered":
                from kraft.simulation.imager import opencv  # loads the simulator

                opencv()

    def jobs(self) -> Iterator[Job]:
        """Trials of all cells, cell by cell."""
        for cell in self.cells:
            vehicle = cell.reference, self.vehicle_hashes[cell.reference]
            for seed in self.seeds:
                yield Job(cell.entry.name, cell.scenario, cell.method, *vehicle, seed, self.realtime)


def experiment_of(
    scenarios: Sequence[ScenarioLike],
    methods: Sequence[MethodLike],
    *,
    suite: str | Path | None = None,
    settings: SettingsLike = (),
    vary: Sweeps = (),
    vehicle: str | Path | None = None,
    trials: int = TRIALS,
    seed: int = 0,
    realtime: bool = False,
    log: MessageSink = no_messages,
) -> Experiment:
    """Load scenarios, methods and vehicles and check starts and goals.

    The planning model is `vehicle`, else the method's own, else the scenario's.  `suite`, `settings` and `vary` are
    those of `kraft.evaluation.suite.entries_of`.  `log` gets messages about kernels that the checks compile.

    Raises:
        InputError: with every problem of names, files, keys, numbers, starts and goals.
    """
    problems = Problems()
    problems.found += [*out_of_range("trials", trials, 1, TRIALS_MAX), *out_of_range("seed", seed, 0)]
    entries = problems.of(lambda: entries_of(scenarios, suite=suite, settings=settings, vary=vary)) or []
    loaded = _methods(methods, problems)
    reference = None if vehicle is None else problems.of(lambda: _reference(reference_of(vehicle)))
    problems.check()
    if realtime:
        problems.found += [diagnostic for method in loaded for diagnostic in _too_little_time(method)]
    cells = tuple(_cells(entries, loaded, reference, problems.found, log))
    problems.check()
    return Experiment(cells, int(trials), int(seed), realtime)


def _reference(vehicle: str) -> str:
    """Reference of a vehicle that loads, which holds in any folder.

    Raises:
        InputError: if there is none, or it cannot be loaded.
    """
    reference = resolved_reference(vehicle, Path.cwd())
    load_vehicle(reference)
    return reference


def _too_little_time(method: Method) -> Iterator[Diagnostic]:
    planner = method.planner
    if planner.clock_budget <= 0.0:
        most = planner.clock_budget + planner.lead
        problem = f"leaves no wall-clock time for planning: {most:g} s - {planner.lead:g} s"
        yield method.source.diagnostic("planner.lead", problem, f"expected less than {most:g}", code=Code.CONFLICT)


def _methods(given: Sequence[MethodLike], problems: Problems) -> list[Method]:
    """Load those that can be loaded; the problems of the others and of the list are added to `problems`."""
    problems.found += list_problems("method", given)
    named = [each for each in given if each != ""] if not isinstance(given, str | Path) else []
    loaded = [each if isinstance(each, Method) else problems.of(partial(load_method, each)) for each in named]
    found = [method for method in loaded if method is not None]
    problems.found += repeated_names("method", (method.name for method in found))
    return found


def _cells(
    entries: list[Entry], methods: list[Method], vehicle: str | None, problems: list[Diagnostic], log: MessageSink
) -> Iterator[Cell]:
    loaded: dict[str, Vehicle] = {}
    for entry in entries:
        scenario = entry.scenario
        checked: set[str] = set()
        try:
            check_view(scenario)
        except InputError as error:
            problems += error.diagnostics
        for method in methods:
            try:
                reference = vehicle_reference(scenario, method, vehicle)
                if reference not in loaded:
                    loaded[reference] = load_planning_vehicle(scenario, reference)
                model = loaded[reference]
                check_vehicle(method, model, own=reference not in (vehicle, scenario.vehicle))
                if reference not in checked:
                    checked.add(reference)
                    if needs_motions(scenario):
                        ensure_compiled(model, log)
                    check_placement(scenario, model, start_state(scenario, model))
                    check_robot(scenario, model)
                given = vehicle is not None and reference != vehicle_reference(scenario, method)
                unchanged = not entry.settings and not given
                yield Cell(entry, method, reference, model, unchanged and is_of_paper(scenario, method))
            except InputError as error:
                problems += error.diagnostics
