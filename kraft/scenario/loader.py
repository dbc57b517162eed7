"""Scenario and task as plain geometry, in metres and radians, and their loading: read, validate, convert."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from kraft.config import bundled
from kraft.config.document import Document, Value
from kraft.config.overrides import Override, overridden, overrides_of
from kraft.config.schema import check, part
from kraft.config.source import KeyPath
from kraft.config.yaml_reader import parse_document, read_document
from kraft.errors import Code, Diagnostic, InputError
from kraft.files import path_from
from kraft.scenario.geometry import (
    NOT_AN_IMAGE,
    Box,
    Circle,
    Obstacle,
    OccupancyMap,
    Polygon,
    is_image,
    read_map,
    signed_area,
)
from kraft.scenario.scenario import Goal, Scenario, Start
from kraft.scenario.schema import (
    CAMERA_HEIGHT,
    MARKER_HEIGHT,
    Bounds,
    GoalFile,
    MapFile,
    ObstacleFile,
    ScenarioFile,
    Sensing,
    StartFile,
)  # fmt: skip
from kraft.scenario.truth import Truth
from kraft.scenario.unmapped import unmapped
from kraft.vehicles.reference import VehicleProblem, resolve_vehicle
from kraft.vehicles.true_robot import with_files


def load_scenario(name_or_path: str | Path, settings: Mapping[str, Any] | Sequence[Override] | None = None) -> Scenario:
    """Load a bundled scenario (``turns``) or a scenario file.

    Args:
        name_or_path: name or path.
        settings: values that replace those of the file, by dotted key: ``{"sensing.noise_scale": 2}``.

    Raises:
        InputError: with every problem of the file and of the settings, or if there is no such name or file.
        TypeError: if the first is neither text nor a path, or the settings are no mapping.
    """
    path = bundled.find("scenario", name_or_path)
    overrides = overrides_of(settings if settings is not None else ())
    return scenario_from(overridden(read_document(path), overrides), path.parent)


def parse_scenario(content: bytes | str, file: str = "scenario.yaml", folder: Path | None = None) -> Scenario:
    """Load a scenario from the content of a file; its paths are relative to ``folder``.

    Raises:
        InputError: with every problem of the content.
    """
    return scenario_from(parse_document(content, file), folder if folder is not None else Path.cwd())


def scenario_from(document: Document, folder: Path) -> Scenario:
    """Validate a document and build its scenario.

    Raises:
        InputError: with every problem of the document and of the maps it names.
    """
    content, problems = check(ScenarioFile, document)
    problems += _outside_bounds(document) + _low_camera(document)
    vehicle, vehicle_problems = _vehicle(document, folder)
    maps, map_problems = _maps(document, folder)
    problems += vehicle_problems + map_problems
    truth = part(Truth, _at(document.data, ("truth",))) or Truth()
    files, file_problems = with_files(truth, folder, document.source)
    problems += file_problems
    if content is None or problems:
        raise InputError(problems)
    return Scenario(
        name=content.name,
        description=" ".join(content.description.split()),
        bounds=content.bounds,
        obstacles=(
            *(_obstacle(entry, maps.get(i)) for i, entry in enumerate(content.obstacles)),
            *_unmapped(content, tuple(maps.values())),
        ),
        start=_start(content.start),
        goal=_goal(content.goal),
        vehicle=vehicle,
        planning=content.planning,
        source=document.source,
        truth=content.truth.model_copy(update=files),
        sensing=_sensing(content),
        trial=content.trial,
    )


def _sensing(content: ScenarioFile) -> Sensing:
    """Sensing with the camera above the middle of the bounds, unless its place is given."""
    if "camera" in content.sensing.model_fields_set:
        return content.sensing
    middle = (0.5 * sum(content.bounds.x), 0.5 * sum(content.bounds.y))
    return content.sensing.model_copy(update={"camera": (*middle, CAMERA_HEIGHT)})


def _outside_bounds(document: Document) -> list[Diagnostic]:
    """Start and goal outside the bounds, as far as these sections are valid themselves."""
    bounds = part(Bounds, _at(document.data, ("bounds",)))
    start = part(StartFile, _at(document.data, ("start",)))
    goal = part(GoalFile, _at(document.data, ("goal",)))
    found: list[Diagnostic] = []
    if bounds is None:
        return found
    points: list[tuple[str, float, float, KeyPath | None]] = []
    if start is not None:
        points.append(("the start", start.x, start.y, None))
    if goal is not None:
        points.append(("the goal's centre", *goal.center, ("goal", "center")))
    for what, x, y, place in points:
        if axis := bounds.outside(x, y):
            low, high = getattr(bounds, axis)
            value = x if axis == "x" else y
            problem = f"{what} is out of bounds ({axis} = {value:.12g})"
            at = place or ("start", axis)
            found.append(
                document.source.diagnostic(at, problem, f"expected {axis} in [{low:g}, {high:g}]", code=Code.GEOMETRY)
            )
    return found


def _low_camera(document: Document) -> list[Diagnostic]:
    """A camera that does not look down at the marker, if the section is valid itself."""
    sensing = part(Sensing, _at(document.data, ("sensing",), {}))
    if sensing is None or sensing.camera[2] > MARKER_HEIGHT:
        return []
    problem, expected = f"is {sensing.camera[2]:g} m high", f"expected more than the marker's {MARKER_HEIGHT:g} m"
    return [document.source.diagnostic(("sensing", "camera", 2), problem, expected, code=Code.GEOMETRY)]


def _vehicle(document: Document, folder: Path) -> tuple[str, list[Diagnostic]]:
    default = ScenarioFile.model_fields["vehicle"].default
    reference = _at(document.data, ("vehicle",), default)
    if not isinstance(reference, str):  # a wrong type is already reported
        return "", []
    try:
        return resolve_vehicle(reference, _folder(document, ("vehicle",), folder)), []
    except VehicleProblem as error:
        return "", [document.source.diagnostic("vehicle", error.problem, error.expected, code=error.code)]


def _maps(document: Document, folder: Path) -> tuple[dict[int, OccupancyMap], list[Diagnostic]]:
    """Maps of all obstacles that name one, by the index of the obstacle."""
    maps: dict[int, OccupancyMap] = {}
    problems: list[Diagnostic] = []
    entries = _at(document.data, ("obstacles",))
    for i, entry in enumerate(entries if isinstance(entries, tuple) else ()):
        settings = part(MapFile, _at(entry, ("map",)))
        if settings is None:
            continue
        path = path_from(_folder(document, ("obstacles", i, "map", "file"), folder), settings.file)
        name = _at(entry, ("name",))
        at = ("obstacles", i, "map", "file")
        try:
            if not os.path.isfile(path):
                expected = "expected the path of a map's YAML file, relative to this file"
                problem = f"there is no file {path}"
                problems.append(document.source.diagnostic(at, problem, expected, code=Code.NOT_FOUND))
            elif is_image(path):
                problem = f"{path} is an image"
                problems.append(document.source.diagnostic(at, problem, NOT_AN_IMAGE, code=Code.MISMATCH))
            else:
                found = read_map(path, height=settings.height, name=name if isinstance(name, str) else None)
                maps[i] = replace(found, states_outside=settings.outside is not None)
        except InputError as error:
            problems += error.diagnostics
    return maps, problems


def _folder(document: Document, path: KeyPath, folder: Path) -> Path:
    """Folder at which relative paths in the value at `path` begin: that of the file, or of what replaced the value."""
    place = document.source.replacement(path)
    return folder if place is None else place.folder or Path.cwd()


def _at(data: Value, path: tuple[str, ...], default: Value = None) -> Value:
    """Value of the raw data at ``path``, or ``default`` if there is no such key."""
    for key in path:
        if not isinstance(data, dict) or key not in data:
            return default
        data = data[key]
    return data


def _unmapped(content: ScenarioFile, maps: Sequence[OccupancyMap]) -> tuple[Polygon, ...]:
    """Obstacles where no map covers the bounds, if one of them says that these are occupied there."""
    occupied = [each.map.height for each in content.obstacles if each.map and each.map.outside == "occupied"]
    return unmapped(content.bounds, maps, max(occupied)) if occupied else ()


def _obstacle(entry: ObstacleFile, occupancy: OccupancyMap | None) -> Obstacle:
    if entry.box is not None:
        box = entry.box
        return Box(box.center, box.size, math.radians(box.yaw_deg), box.height, entry.name)
    if entry.circle is not None:
        return Circle(entry.circle.center, entry.circle.radius, entry.circle.height, entry.name)
    if entry.polygon is not None:
        return _polygon(entry.polygon.vertices, entry.polygon.height, entry.name)
    assert occupancy is not None, "the schema allows these four shapes alone"
    return occupancy


def _polygon(vertices: tuple[tuple[float, float], ...], height: float, name: str | None) -> Polygon:
    counter_clockwise = signed_area(np.array(vertices)) > 0
    return Polygon(vertices if counter_clockwise else vertices[::-1], height, name)


def _start(start: StartFile) -> Start:
    return Start(start.x, start.y, math.radians(start.heading_deg), start.speed)


def _goal(goal: GoalFile) -> Goal:
    if goal.heading_deg is None or goal.heading_tolerance_deg is None:
        return Goal(goal.center, goal.radius, limits=goal.limits)
    heading, tolerance = math.radians(goal.heading_deg), math.radians(goal.heading_tolerance_deg)
    return Goal(goal.center, goal.radius, heading, tolerance, goal.limits)
