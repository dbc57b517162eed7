"""Checks of one file of any kind, for `kraft validate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

from pydantic import BaseModel, ValidationError

from kraft.config import bundled
from kraft.config.document import Document
from kraft.config.schema import check, valid
from kraft.config.source import Source
from kraft.config.user_code import is_code
from kraft.config.yaml_reader import read_document
from kraft.driving.control import check_code
from kraft.driving.control.user_controller import user_class
from kraft.driving.control_settings import UserCode
from kraft.driving.method import Method, check_vehicle, load_method
from kraft.errors import Code, Diagnostic, InputError, MissingError, Problems, Unreachable
from kraft.evaluation.suite import SuiteFile, load_suite
from kraft.logs.mapping import Mapping
from kraft.planning.compilation import ensure_checks_compiled
from kraft.planning.feasibility import check_placement, check_reachable
from kraft.planning.plan_file import SCHEMA as PLAN_SCHEMA
from kraft.planning.plan_file import read_plan
from kraft.planning.workspace import start_state, vehicle_of_task
from kraft.robot.robot_file import Robot
from kraft.scenario import Scenario
from kraft.scenario.geometry import MapServerFile, read_map
from kraft.scenario.loader import scenario_from
from kraft.scenario.schema import ScenarioFile
from kraft.scenario.unmapped import unstated_outside
from kraft.text import MessageSink, nearest
from kraft.trial.camera_view import check_view
from kraft.trial.planning_vehicle import check_own_robot, check_robot, other_robot, own_robot
from kraft.trial.warnings import near_start
from kraft.vehicles.config import VehicleConfig
from kraft.vehicles.load import configured, load_vehicle, read_vehicle_file
from kraft.vehicles.true_robot import CarDimensions
from ompl_ext.cache_error import CacheError
from ompl_ext.vehicle import Vehicle

FileKind: TypeAlias = Literal["scenario", "vehicle", "method", "suite", "map", "mapping", "plan", "robot"]

_SCHEMAS: Final[dict[FileKind, type[BaseModel]]] = {
    "scenario": ScenarioFile,  # first: a file without a known key is checked as a scenario
    "vehicle": VehicleConfig,
    "method": Method,
    "suite": SuiteFile,
    "map": MapServerFile,
    "mapping": Mapping,
    "robot": Robot,
}
KEYS_COMPARED: Final = 100
"""First keys of a file by which its kind is recognised: comparing many unknown ones takes long."""
_WRITTEN: Final = "kraft."
"""Prefix of the `schema` of files that kraft writes."""


@dataclass(frozen=True)
class FileReport:
    """Kind of a file (None if it could not be read that far) and everything wrong with it.

    `defect` is an error of the check itself, after which nothing more is known of the file.
    """

    file: str
    kind: FileKind | None
    problems: tuple[Diagnostic, ...] = ()
    defect: Exception | None = None

    @property
    def valid(self) -> bool:
        """Whether the file was checked and has no problem."""
        return not self.problems and self.defect is None


def check_file(name_or_path: str | Path, report: MessageSink) -> FileReport:
    """Check a file, a bundled file by name, or a vehicle in code. Problems and defects are returned, not raised.

    `report` receives messages about what is compiled, and warnings of what is valid but may be wrong.

    Raises:
        MissingError: if something that the check needs is not installed.
        CacheError: if kernels cannot be kept.
    """
    kind: FileKind | None = None
    file = str(name_or_path)
    try:
        if is_code(file):
            kind = "vehicle"
            _check_code(file)
            return FileReport(file, kind)
        path = _find(name_or_path)
        file = str(path)
        document = read_document(path)
        kind = "plan" if _schema(document) == PLAN_SCHEMA else recognise(document)
        _check_as(kind, document, path, report)
    except (InputError, Unreachable) as error:
        return FileReport(file, kind, error.diagnostics)
    except (MissingError, CacheError):
        raise
    except Exception as error:  # one file must not keep the others from being checked
        return FileReport(file, kind, defect=error)
    return FileReport(file, kind)


def recognise(document: Document) -> FileKind:
    """Kind of a file by its top-level keys; misspelt keys decide between kinds with equally many known keys.

    A robot file is one with a transport or a command: `pose` alone may be the misspelt `poses` of a mapping.
    """
    keys = set(list(document.data)[:KEYS_COMPARED]) if isinstance(document.data, dict) else set()
    kinds = [kind for kind in _SCHEMAS if kind != "robot" or keys & {"transport", "command"}]

    def likeness(kind: FileKind) -> tuple[int, int]:
        known = _SCHEMAS[kind].model_fields
        misspelt = sum(nearest(str(key), known) is not None for key in keys - set(known))
        return len(keys & set(known)), misspelt

    return max(kinds, key=likeness)


def _schema(document: Document) -> str | None:
    """Schema of a file that kraft wrote; None for other files.

    Raises:
        InputError: if files of this schema cannot be checked.
    """
    schema = document.data.get("schema") if isinstance(document.data, dict) else None
    if not isinstance(schema, str) or not schema.startswith(_WRITTEN):
        return None
    if schema != PLAN_SCHEMA:
        expected = f"expected a {', '.join(_SCHEMAS)} file, or a plan file ({PLAN_SCHEMA})"
        problem = f"is a file that kraft wrote, {schema}"
        raise InputError([document.source.diagnostic("schema", problem, expected, code=Code.MISMATCH)])
    return schema


def _find(name_or_path: str | Path) -> Path:
    kinds: tuple[bundled.Kind, ...] = ("vehicle", "method", "suite", "robot")
    for kind in kinds:
        if name_or_path in bundled.names(kind):
            return bundled.find(kind, name_or_path)
    if isinstance(name_or_path, str) and bundled.is_name(name_or_path) and Path(name_or_path).is_file():
        if Path(name_or_path).suffix not in ("", ".json"):
            expected = f"expected the .yaml file of a {', '.join(_SCHEMAS)}, or a plan file (.json)"
            raise InputError.of(name_or_path, "is no file that can be checked", expected, Code.MISMATCH)
        return Path(name_or_path)
    return bundled.find("scenario", name_or_path)


def _check_as(kind: FileKind, document: Document, path: Path, report: MessageSink) -> None:
    if kind == "scenario":
        _check_scenario(scenario_from(document, path.parent), report)
    elif kind == "vehicle":
        _check_vehicle(document, path, report)
    elif kind == "method":
        _check_method(document, path)
    elif kind == "suite":
        load_suite(path)
    elif kind == "plan":
        read_plan(path)
    elif kind in ("mapping", "robot"):
        valid(_SCHEMAS[kind], document)
    else:
        read_map(path, height=0.2, name=None)


def _check_scenario(scenario: Scenario, report: MessageSink) -> None:
    """Check start, goal and robot of a scenario, and that a path leads to the goal."""
    task = scenario.task()
    vehicle = vehicle_of_task(task)
    ensure_checks_compiled(task, vehicle, report)
    check_placement(task, vehicle, start_state(task, vehicle))
    check_robot(scenario, vehicle)
    check_view(scenario)
    check_reachable(task, vehicle)
    for warning in (unstated_outside(task), near_start(task, vehicle), other_robot(scenario, vehicle)):
        if warning:
            report(f"warning: {scenario.source.file}: {warning}")


def _check_vehicle(document: Document, path: Path, report: MessageSink) -> None:
    """Check a vehicle file, and the car that it states as its true robot also if another key is wrong."""
    problems = Problems()
    if problems.of(lambda: configured(read_vehicle_file(path))) is None:
        problems.of(lambda: _check_car(document))
    problems.check()
    vehicle = load_vehicle(str(path))
    check_own_robot(vehicle)
    if warning := own_robot(vehicle):
        report(f"warning: {path}: {warning}")


def _check_code(reference: str) -> None:
    """Check a vehicle in code; of a controller's class, which only a method file describes, say where it is checked."""
    try:
        vehicle = load_vehicle(reference)
    except InputError:
        if not _is_controller(reference):
            raise
        problem, expected = "is the class of a controller", "expected the method file that names it, or a vehicle"
        raise InputError.of(reference, problem, expected, Code.MISMATCH) from None
    check_own_robot(vehicle)


def _is_controller(reference: str) -> bool:
    """Whether code is a class with the function `command`."""
    try:
        user_class(UserCode(kind="code", code=reference))
    except (InputError, ValidationError):  # the latter: code without the name of a class
        return False
    return True


def _check_car(document: Document) -> None:
    """Check the dimensions of a simulated car; those that the schema refuses are reported already.

    Raises:
        InputError: if it cannot be simulated.
    """
    truth = document.data.get("truth") if isinstance(document.data, dict) else None
    content = truth.get("car") if isinstance(truth, dict) else None
    if not isinstance(content, dict):
        return
    car, _ = check(CarDimensions, Document(content, document.source))
    if car is None:
        return
    from kraft.simulation.car import design_of, design_problem  # loads the simulator

    if (found := design_problem(design_of(car))) is not None:
        raise InputError([document.source.diagnostic(("truth", "car"), *found, code=Code.GEOMETRY)])


def _check_method(document: Document, path: Path) -> None:
    """Check a method file and its code, and the vehicle that it or its base names also if another key is wrong."""
    problems = Problems()
    method = problems.of(lambda: load_method(path))
    planner = document.data.get("planner") if isinstance(document.data, dict) else None
    named = planner.get("vehicle") if isinstance(planner, dict) else None
    source = document.source
    if method is not None:
        named, source = method.planner.vehicle, method.source
    vehicle = problems.of(lambda: _planning_vehicle(named, source)) if isinstance(named, str) else None
    problems.of(lambda: None if method is None else check_code(method))
    problems.check()
    if method is not None and vehicle is not None:
        check_vehicle(method, vehicle, own=True)


def _planning_vehicle(reference: str, source: Source) -> Vehicle:
    """Vehicle that a method names; problems of the reference are reported at its line."""
    try:
        return load_vehicle(reference, source.folder("planner.vehicle"))
    except InputError as error:
        raise InputError(
            source.diagnostic("planner.vehicle", d.problem, d.expected, code=d.code) if d.file == reference else d
            for d in error.diagnostics
        ) from error
