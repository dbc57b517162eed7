"""Experiment: scenarios, methods, vehicles and seeds of an evaluation, resolved from names, and `manifest.json`.

All problems of the names are reported at once.  The manifest has the arguments, the resolved configuration and the
versions; they are compared when the evaluation is resumed.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias

from kraft.driving.method import Method, check_vehicle, load_method
from kraft.errors import Code, Diagnostic, InputError, Problems, out_of_range
from kraft.evaluation.job import Job
from kraft.evaluation.suite import Entry, ScenarioLike, Settings, Sweeps, entries_of, list_problems, repeated_names
from kraft.planning.feasibility import check_placement
from kraft.planning.plan_file import vehicle_content
from kraft.planning.workspace import start_state
from kraft.provenance import SIMULATION, plain, plain_hash, versions
from kraft.scenario import Scenario
from kraft.trial.planning_vehicle import (
    check_robot,
    load_planning_vehicle,
    other_robot,
    uncorrected_slope,
    vehicle_reference,
)
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


WARNINGS: Final[tuple[Callable[[Cell], str], ...]] = (
    lambda cell: cell.scenario.far_camera(),
    lambda cell: other_robot(cell.scenario, cell.vehicle),
    lambda cell: uncorrected_slope(cell.scenario, cell.method, cell.vehicle),
)
"""What may be wrong with a row though it can be driven; each is empty where it is not."""


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
    problems = Problems()
    problems.found += [*out_of_range("trials", trials, 1, TRIALS_MAX), *out_of_range("seed", seed, 0)]
    entries = problems.of(lambda: entries_of(scenarios, suite=suite, settings=settings, vary=vary)) or []
    loaded = _methods(methods, problems)
    reference = None if vehicle is None else problems.of(lambda: _reference(vehicle))
    problems.check()
    if realtime:
        problems.found += [diagnostic for method in loaded for diagnostic in _too_little_time(method)]
    cells = tuple(_cells(entries, loaded, reference, problems.found))
    problems.check()
    return Experiment(cells, trials, seed, realtime)


def _reference(vehicle: str) -> str:
    """Reference of a vehicle that loads, which holds in any folder.

    Raises:
        InputError: if there is none, or it cannot be loaded.
    """
    try:
        reference = resolve_vehicle(vehicle, Path.cwd())
    except VehicleProblem as error:
        raise InputError.of(vehicle, error.problem, error.expected, error.code) from None
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
    named = [each for each in given if each != ""]
    loaded = [each if isinstance(each, Method) else problems.of(partial(load_method, each)) for each in named]
    found = [method for method in loaded if method is not None]
    problems.found += repeated_names("method", (method.name for method in found))
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


MANIFEST: Final = "manifest.json"
MANIFEST_SCHEMA: Final = "kraft.eval-manifest/1"
DESCRIPTIVE: Final = ("arguments", "began", "host", "bounds_s")
"""Keys that may differ when an evaluation is resumed."""
TEXTS: Final = ("title", "description")
"""Keys of scenarios and methods that no result depends on."""
SECTIONS: Final = ("scenarios", "methods", "vehicles")
"""Sections with one entry for each name."""
ESTIMATION: Final = ("ranges", "gravity_share", "delay", "errors_by_speed")
"""What of a vehicle only estimators use."""
ROW_KEYS: Final = {"scenario", "method", "vehicle"}
MISSING: Final = object()


def manifest_of(experiment: Experiment, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Content of the manifest; `arguments` are those of the user, as written."""
    cells = experiment.cells
    vehicles = {cell.reference: vehicle_content(cell.vehicle, cell.reference) for cell in cells}
    labels = _labels({cell.reference: cell.vehicle.name for cell in cells})
    for reference, content in vehicles.items():
        vehicle = next(cell.vehicle for cell in cells if cell.reference == reference)
        content["code"] = vehicle.hash
        content |= {name: plain(getattr(vehicle, name)) for name in ESTIMATION}
        del content["reference"]  # the content of a file matters, not its path
    return {
        "schema": MANIFEST_SCHEMA,
        "arguments": dict(arguments),
        "began": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "trials": experiment.trials,
        "seed": experiment.seed,
        "realtime": experiment.realtime,
        "bounds_s": {entry: round(seconds, 6) for entry, seconds in experiment.bounds.items()},
        "rows": [
            {
                "entry": cell.entry.name,
                "base": cell.entry.base,
                "scenario": cell.scenario.name,
                "reference": cell.entry.reference,
                "set": dict(cell.entry.settings),
                "method": cell.method.name,
                "title": cell.method.title,
                "vehicle": labels[cell.reference],
                **_score(cell.scenario),
            }
            for cell in cells
        ],
        "scenarios": {cell.entry.name: scenario_content(cell.scenario) for cell in cells},
        "methods": {cell.method.name: _hashed(_method(cell.method)) for cell in cells},
        "vehicles": {labels[reference]: _hashed(content) for reference, content in vehicles.items()},
        "versions": versions(SIMULATION),
    }


def scenario_content(scenario: Scenario) -> dict[str, Any]:
    """Content and SHA-256 of a scenario without its vehicle, which has a section of its own."""
    names = (f.name for f in fields(scenario) if f.compare and f.name not in ("vehicle", *TEXTS))
    return _hashed({name: plain(getattr(scenario, name)) for name in names})


def _score(scenario: Scenario) -> dict[str, Any]:
    """Score of a scenario as a part of its row, if it has one."""
    score = scenario.trial.score
    return {} if score is None else {"score": score.model_dump()}


def read_manifest(path: Path) -> dict[str, Any]:
    """Read a manifest.

    Raises:
        InputError: if the file cannot be read, is not a JSON object with this schema, or has no rows.
    """
    expected = "expected a manifest as kraft eval writes it"
    try:
        content = json.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise InputError.of(str(path), f"cannot be read: {error.strerror}", expected, Code.UNREADABLE) from None
    except (ValueError, RecursionError) as error:
        raise InputError.of(str(path), f"is not JSON: {error}", expected, Code.SYNTAX) from None
    if not isinstance(content, dict) or not isinstance(content.get("schema"), str):
        raise InputError.of(str(path), "has no schema", expected, Code.MISSING)
    if content["schema"] != MANIFEST_SCHEMA:
        problem = f"has the schema {content['schema']!r}"
        raise InputError.of(str(path), problem, f"expected {MANIFEST_SCHEMA!r}", Code.MISMATCH)
    rows = content.get("rows")
    if not isinstance(rows, list) or not all(isinstance(row, dict) and row.keys() >= ROW_KEYS for row in rows):
        raise InputError([Diagnostic(str(path), "is damaged", expected, path="rows", code=Code.SYNTAX)])
    return content


def check_same_manifest(path: Path, was: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Check that a manifest is of the same evaluation.

    Raises:
        InputError: with every difference.
    """
    before, after = _compared(was), _compared(now)
    for rows in (before["rows"], after["rows"]):  # rows of one side alone are reported by their scenario or method
        for row in rows.keys() - (before["rows"].keys() & after["rows"].keys()):
            del rows[row]
    differing = list(_differences(before, after))
    if differing:
        raise InputError(
            Diagnostic(
                str(path),
                _difference(key, before, after),
                "expected no change, or another folder",
                path=key,
                code=Code.MISMATCH,
            )
            for key, before, after in differing
        )


def _compared(content: Mapping[str, Any]) -> dict[str, Any]:
    """Fields that must be equal, as read back from JSON; rows by name, because their order does not matter."""
    kept = {key: value for key, value in content.items() if key not in DESCRIPTIVE}
    rows = {f"{row.get('entry', row['scenario'])}, {row['method']}": row["vehicle"] for row in kept["rows"]}
    result: dict[str, Any] = json.loads(json.dumps({**kept, "rows": rows}))
    return result


def _differences(was: Any, now: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Key and both values of every difference; a hash only where no value differs."""
    if isinstance(was, dict) and isinstance(now, dict):
        found = [
            difference
            for key in {**was, **now}
            for difference in _differences(was.get(key, MISSING), now.get(key, MISSING), f"{path}.{key}".lstrip("."))
        ]
        of_values = [difference for difference in found if not difference[0].endswith(".sha256")]
        yield from of_values or found
    elif was != now:
        yield path, was, now


def _difference(key: str, before: Any, after: Any) -> str:
    """Message about a difference."""
    section, _, name = key.partition(".")
    part = f"{section.removesuffix('s')} {name}"
    known = section in SECTIONS and "." not in name
    if before is MISSING:
        return f"{part} is not in the folder's evaluation" if known else f"was absent, is {_json(after)} now"
    if after is MISSING:
        return f"{part} is missing now" if known else f"was {_json(before)}, is absent now"
    return f"was {_json(before)}, is {_json(after)} now"


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _labels(names: Mapping[str, str]) -> dict[str, str]:
    """Label of each reference: the vehicle's name, or the reference where two vehicles have the same name."""
    counts = list(names.values())
    return {reference: name if counts.count(name) == 1 else reference for reference, name in names.items()}


def _method(method: Method) -> dict[str, Any]:
    return method.model_dump(mode="json", exclude=set(TEXTS))


def _hashed(content: Any) -> dict[str, Any]:
    return {"sha256": plain_hash(content), "content": content}
