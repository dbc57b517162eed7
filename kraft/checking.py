"""Check one configuration file of any kind, for `kraft validate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

from pydantic import BaseModel

from kraft import resources
from kraft.errors import Diagnostic, InputError
from kraft.placement import check_placement
from kraft.scenario.loader import scenario_from
from kraft.scenario.occupancy import MapServerFile, read_map
from kraft.scenario.schema import ScenarioFile
from kraft.validation import check
from kraft.vehicle import load_vehicle, vehicle_of_task
from kraft.vehicle_config import VehicleConfig
from kraft.workspace import start_state
from kraft.yaml_nodes import Document, read_document

FileKind: TypeAlias = Literal["scenario", "vehicle", "map"]

_SCHEMAS: Final[dict[FileKind, type[BaseModel]]] = {
    "scenario": ScenarioFile,  # first: what no key gives away is checked as a scenario
    "vehicle": VehicleConfig,
    "map": MapServerFile,
}


@dataclass(frozen=True)
class Checked:
    """What a file was taken for (None if it could not be read that far) and everything wrong with it."""

    file: str
    kind: FileKind | None
    problems: tuple[Diagnostic, ...] = ()


def check_file(name_or_path: str | Path) -> Checked:
    """Check a file, or a bundled scenario or vehicle by name. Problems are returned, not raised."""
    kind: FileKind | None = None
    file = str(name_or_path)
    try:
        path = _find(name_or_path)
        file = str(path)
        document = read_document(path)
        kind = recognise(document)
        _check_as(kind, document, path)
    except InputError as error:
        return Checked(file, kind, error.diagnostics)
    return Checked(file, kind)


def recognise(document: Document) -> FileKind:
    """Tell from its top-level keys what a file is meant to be."""
    keys = set(document.data) if isinstance(document.data, dict) else set()
    return max(_SCHEMAS, key=lambda kind: len(keys & set(_SCHEMAS[kind].model_fields)))


def _find(name_or_path: str | Path) -> Path:
    if name_or_path in resources.names("vehicle"):
        return resources.find("vehicle", name_or_path)
    if isinstance(name_or_path, str) and Path(name_or_path).suffix == "" and Path(name_or_path).is_file():
        return Path(name_or_path)
    return resources.find("scenario", name_or_path)


def _check_as(kind: FileKind, document: Document, path: Path) -> None:
    if kind == "scenario":
        task = scenario_from(document, path.parent).task()
        vehicle = vehicle_of_task(task)
        check_placement(task, vehicle, start_state(task, vehicle))
    elif kind == "vehicle":
        _, problems = check(VehicleConfig, document)
        if problems:
            raise InputError(problems)
        load_vehicle(str(path))
    else:
        read_map(path, height=0.2, name=None)
