"""Import of worlds from files of other programs: Gazebo worlds, problems of dynobench, occupancy maps.

A problem of dynobench has boxes and discs, a start and a goal of one of its unicycles.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field

from kraft.config.document import Document
from kraft.config.schema import Coordinate, Length, StrictModel, check
from kraft.config.source import Place, Source
from kraft.config.yaml_reader import read_document
from kraft.errors import Code, Diagnostic, InputError, Problems
from kraft.files import check_new_folder
from kraft.scenario.geometry import read_map
from kraft.text import MessageSink, alternatives, counted, no_messages, suggestion
from kraft.worlds.barn import LABEL, read_barn, worlds_in
from kraft.worlds.world import (
    SENSING,
    Goal,
    Imported,
    Start,
    World,
    Written,
    above,
    plain_name,
    resolved_argument,
    write_worlds,
)

KINDS: Final = ("barn", "dynobench", "map")
ROBOT, CAR = "jackal", "mushr"


@dataclass(frozen=True)
class Request:
    """What to import.

    Attributes:
        kind: ``barn`` (Gazebo worlds, or folders of them), ``dynobench`` or ``map``.
        sources: files, which stay where they are.
        out: new folder for the scenarios and their suite.
        start: x, y (m) and heading (degrees); required for a map, instead of the challenge's for a Gazebo world.
        goal: x, y and radius (m), likewise.
        vehicle: vehicle of the scenarios; by default the challenge's robot, the problem's robot, or `mushr`.
        skip: leave out shapes that cannot be obstacles, instead of refusing the source.
    """

    kind: str
    sources: tuple[Path, ...]
    out: Path
    start: Start | None = None
    goal: Goal | None = None
    vehicle: str | None = None
    skip: bool = False


@dataclass(frozen=True)
class Collection:
    """Written scenarios with what was read for them, in the same order."""

    written: Written
    imported: tuple[Imported, ...]


def import_worlds(request: Request, log: MessageSink = no_messages) -> Collection:
    """Read the sources and write a scenario for each of their worlds, and a suite; all or nothing.

    Raises:
        InputError: with every problem of the arguments and of all sources.
        Unreachable: with every goal that no path leads to.
    """
    return write_imported(request, read_sources(request), log)


def read_sources(request: Request) -> list[Imported]:
    """Read the sources and write nothing.

    Raises:
        InputError: with every problem of the arguments and of all sources.
    """
    problems = Problems()
    problems.found += _argument_problems(request)
    problems.of(lambda: check_new_folder(request.out))
    if (vehicle := request.vehicle) is not None:
        request = replace(request, vehicle=problems.of(lambda: resolved_argument(vehicle)))
    found = [problems.of(partial(_read, request, path)) for path in _files(request, problems.found)]
    problems.check()
    return [each for each in found if each is not None]


def write_imported(request: Request, imported: Sequence[Imported], log: MessageSink = no_messages) -> Collection:
    """Write a scenario for each world that was read, and a suite; all or nothing; `log` as of `write_worlds`.

    Raises:
        InputError: with every problem of the worlds.
        Unreachable: with every goal that no path leads to.
    """
    worlds = [each.world for each in imported]
    of = f"{counted(len(worlds), 'world')} imported by kraft import {request.kind}"
    description = LABEL if request.kind == "barn" else of
    return Collection(write_worlds(worlds, request.out, request.out.name, description, log), tuple(imported))


def _argument_problems(request: Request) -> list[Diagnostic]:
    problems = []
    if request.kind not in KINDS:
        problems.append(
            Diagnostic(request.kind, "cannot be imported", suggestion(request.kind, KINDS), code=Code.UNKNOWN)
        )
    for name, parts in (("start", "x, y and heading"), ("goal", "x and y, and a radius if needed")):
        given = getattr(request, name) is not None
        if request.kind == "map" and not given:
            expected = f"expected {parts}, because a map has none"
            problems.append(Diagnostic(name, "is not given", expected, code=Code.MISSING, argument=True))
        if request.kind == "dynobench" and given:
            problem, expected = "is given", "expected none, because the problem states it"
            problems.append(Diagnostic(name, problem, expected, code=Code.CONFLICT, argument=True))
    if not request.sources:
        problems.append(Diagnostic("sources", "none are given", "expected at least one", code=Code.MISSING))
    return problems


def _files(request: Request, problems: list[Diagnostic]) -> Iterator[Path]:
    """Files of all sources; problems are added to `problems`."""
    for source in request.sources:
        if not os.path.lexists(source):
            expected = "expected a file, or for barn a folder of files"
            problems.append(Diagnostic(str(source), "there is no such file", expected, code=Code.NOT_FOUND))
        elif not source.is_dir():
            yield source
        elif request.kind == "barn":
            try:
                yield from worlds_in(source)
            except InputError as error:
                problems += error.diagnostics
        else:
            problems.append(Diagnostic(str(source), "is a folder", "expected a file", code=Code.UNREADABLE))


def _read(request: Request, path: Path) -> Imported | None:
    """World of a file; None if the request lacks what it needs, in which case the file is only checked."""
    if request.kind == "barn":
        return read_barn(path, request.vehicle or ROBOT, request.start, request.goal, skip=request.skip)
    if request.kind == "dynobench":
        return read_dynobench(path, request.vehicle, skip=request.skip)
    if request.kind != "map":
        return None
    if request.start is None or request.goal is None:
        read_map(path, height=0.2, name=None)
        return None
    return read_occupancy(path, request.out, request.vehicle or CAR, request.start, request.goal)


def read_occupancy(path: Path, out: Path, vehicle: str, start: Start, goal: Goal) -> Imported:
    """Read an occupancy map; the scenario in the folder `out` refers to it.

    Raises:
        InputError: with every problem of the map.
    """
    corners = np.round(read_map(path, height=0.2, name=None).corners, 6)
    (low_x, low_y), (high_x, high_y) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    bounds = {"x": [low_x, high_x], "y": [low_y, high_y]}
    file = os.path.relpath(os.path.realpath(path), os.path.realpath(out))
    world = World(
        name=plain_name(path.stem),
        remark=f"From the occupancy map {path.name}.",
        content={
            "bounds": bounds,
            "obstacles": [
                {"name": "map", "map": {"file": file, "outside": "occupied"}},
            ],
            "start": {"x": start[0], "y": start[1], "heading_deg": start[2]},
            "goal": {"center": list(goal[:2]), "radius": goal[2]},
            "vehicle": vehicle,
            "sensing": {**SENSING, "camera": above(bounds)},
        },
        places={
            "start": Place("start", argument=True),
            "goal": Place("goal", argument=True),
            "bounds": Place(str(path)),
            "obstacles": Place(str(path)),
        },
    )
    return Imported(world, Counter())


VEHICLES: Final = {
    "unicycle1_v0": "kraft.vehicles.dynobench:UNICYCLE1_V0",
    "unicycle_first_order_0": "kraft.vehicles.dynobench:UNICYCLE1_V0",
    "unicycle1_v1": "kraft.vehicles.dynobench:UNICYCLE1_V1",
    "unicycle1_v2": "kraft.vehicles.dynobench:UNICYCLE1_V2",
    "unicycle2_v0": "kraft.vehicles.dynobench:UNICYCLE2_V0",
    "unicycle_second_order_0": "kraft.vehicles.dynobench:UNICYCLE2_V0",
}
"""Vehicle of each type of robot."""
TRAILER, POINT, FLIES = "has a trailer", "has no heading", "does not drive in the plane"
OTHERS: Final = {
    "car1_v0": TRAILER,
    "car_first_order_with_1_trailers_0": TRAILER,
    "integrator1_2d_v0": POINT,
    "integrator2_2d_v0": POINT,
    "double_integrator_0": POINT,
    "quad2d_v0": FLIES,
    "quad2dpole_v0": FLIES,
    "quadrotor_v0": FLIES,
    "quadrotor_v1": FLIES,
    "quad3d_v0": FLIES,
    "acrobot_v0": FLIES,
}
"""Robots of the collection that are not one rectangle with a heading in the plane, and why."""
RADIUS, TOLERANCE_DEG, AT_GOAL = 0.02, 2.0, 0.02
"""Distances from the goal's state that count as arrived: m, degrees, m/s and rad/s."""
SHAPES: Final = ("box", "sphere")
"""Types of obstacles that are read."""


class ObstacleFile(StrictModel):
    """An obstacle; `size` of a sphere is its radius."""

    type: str
    """box or sphere"""
    center: tuple[Coordinate, Coordinate]
    """[x, y], m"""
    size: tuple[Length, Length] | tuple[Length] | Length
    """[length, width] of a box, or the radius of a sphere, m"""


class EnvironmentFile(StrictModel):
    """Bounds of the position, and obstacles."""

    min: tuple[Coordinate, Coordinate]
    """lowest x and y, m"""
    max: tuple[Coordinate, Coordinate]
    """highest x and y, m"""
    obstacles: tuple[ObstacleFile, ...] = ()
    """the obstacles {type, center, size}"""


class RobotFile(StrictModel):
    """A robot with the states in which it starts and ends."""

    type: str
    """name of its model"""
    start: Annotated[tuple[Coordinate, ...], Field(min_length=3)]
    """x, y, theta and the rest of the state"""
    goal: Annotated[tuple[Coordinate, ...], Field(min_length=3)]
    """x, y, theta and the rest of the state at the end"""


class ProblemFile(StrictModel):
    """A problem of dynobench."""

    name: str = ""
    """name of the problem"""
    environment: EnvironmentFile
    """{min, max, obstacles}"""
    robots: Annotated[tuple[RobotFile, ...], Field(min_length=1)]
    """the robots {type, start, goal}"""


def read_dynobench(path: Path, vehicle: str | None, *, skip: bool = False) -> Imported:
    """Read a problem of one robot in the plane.

    Args:
        path: YAML file.
        vehicle: vehicle of the scenario; None for the one that the robot is.
        skip: leave out obstacles of other types than boxes and spheres.

    Raises:
        InputError: with every problem of the file.
    """
    content, document = _read_problem(path)
    source, robot = document.source, content.robots[0]
    problems = [] if skip else _other_shapes(content, document)
    if len(content.robots) > 1:
        problem = f"there are {counted(len(content.robots), 'robot')}"
        problems.append(source.diagnostic(("robots", 1), problem, "expected one", code=Code.VALUE))
    if robot.type in OTHERS or (vehicle is None and robot.type not in VEHICLES):
        problem = f"the robot {robot.type} {OTHERS.get(robot.type, 'is not known')}"
        given = "" if robot.type in OTHERS else ", or that a vehicle is given"
        expected = f"expected {alternatives(VEHICLES)}{given}"
        problems.append(source.diagnostic(("robots", 0, "type"), problem, expected, code=Code.UNKNOWN))
    if robot.type in VEHICLES and len(robot.start) > 4 and robot.start[4] != 0.0:
        problem = f"is {robot.start[4]:g}: the robot turns at the start"
        expected = "expected 0 rad/s, since scenarios begin with position, heading and speed"
        problems.append(source.diagnostic(("robots", 0, "start", 4), problem, expected, code=Code.VALUE))
    obstacles = _obstacles(content.environment, source, problems)
    if problems:
        raise InputError(problems)
    low, high = content.environment.min, content.environment.max
    bounds = {"x": [low[0], high[0]], "y": [low[1], high[1]]}
    skipped = Counter(each.type for each in content.environment.obstacles if each.type not in SHAPES)
    world = World(
        name=plain_name(content.name or path.stem),
        remark=f"From {path.name}, a problem of dynobench.",
        content={
            "bounds": bounds,
            "obstacles": obstacles,
            "start": _start(robot),
            "goal": _goal(robot, own=vehicle is None),
            "vehicle": vehicle or VEHICLES[robot.type],
            "sensing": {**SENSING, "camera": above(bounds)},
        },
        places=_places(document),
    )
    return Imported(world, skipped)


def _read_problem(path: Path) -> tuple[ProblemFile, Document]:
    """Read a problem.

    Raises:
        InputError: with every problem of the file; with a single one if it is a file of another kind.
    """
    document = read_document(path)
    if isinstance(document.data, dict) and not {"environment", "robots"} & document.data.keys():
        expected = "expected a file with the keys environment and robots"
        raise InputError.of(str(path), "is no problem of dynobench", expected, Code.MISMATCH)
    content, problems = check(ProblemFile, document)
    if content is None:
        raise InputError(problems)
    return content, document


def _places(document: Document) -> dict[str, Place]:
    """Places of the values of a scenario's keys."""
    source = document.source
    found = {
        "bounds": ("environment",),
        "obstacles": ("environment", "obstacles"),
        "start": ("robots", 0, "start"),
        "goal": ("robots", 0, "goal"),
    }
    return {key: Place(source.file, source.where(path)) for key, path in found.items()}


def _other_shapes(content: ProblemFile, document: Document) -> list[Diagnostic]:
    """One problem for each type of obstacle that is not read, at the first one."""
    types = [each.type for each in content.environment.obstacles]
    expected = f"expected {alternatives(SHAPES)}, or `skip` to leave out all others"
    return [
        document.source.diagnostic(
            ("environment", "obstacles", types.index(kind), "type"),
            f"{types.count(kind)} x {kind} cannot be an obstacle",
            expected,
            code=Code.UNKNOWN,
        )
        for kind in dict.fromkeys(types)
        if kind not in SHAPES
    ]


def _obstacles(environment: EnvironmentFile, source: Source, problems: list[Diagnostic]) -> list[dict[str, Any]]:
    """Obstacles of the types that are read, as a scenario file has them; problems are added to `problems`."""
    found: list[dict[str, Any]] = []
    for k, each in enumerate(environment.obstacles):
        size = each.size if isinstance(each.size, tuple) else (each.size,)
        if each.type in SHAPES and len(size) != (2 if each.type == "box" else 1):
            expected = "expected [length, width]" if each.type == "box" else "expected a radius"
            at = ("environment", "obstacles", k, "size")
            problems.append(source.diagnostic(at, f"is not the size of a {each.type}", expected))
        elif each.type == "box":
            found.append({"name": f"box {k}", "box": {"center": list(each.center), "size": list(size)}})
        elif each.type == "sphere":
            found.append({"name": f"sphere {k}", "circle": {"center": list(each.center), "radius": size[0]}})
    return found


def _start(robot: RobotFile) -> dict[str, float]:
    x, y, theta, *rest = robot.start
    speed = rest[0] if rest and robot.type in VEHICLES else 0.0  # what else other robots have is not known
    return {"x": x, "y": y, "heading_deg": _degrees(theta), "speed": speed}


def _goal(robot: RobotFile, *, own: bool) -> dict[str, Any]:
    """Goal; it limits the speeds only for the robot's `own` model, whose state has the problem's components."""
    x, y, theta, *rest = robot.goal
    goal = {
        "center": [x, y],
        "radius": RADIUS,
        "heading_deg": _degrees(theta),
        "heading_tolerance_deg": TOLERANCE_DEG,
    }
    if own and rest:
        goal["limits"] = {
            name: [value - AT_GOAL, value + AT_GOAL] for name, value in zip(("v", "omega"), rest, strict=False)
        }
    return goal


def _degrees(theta: float) -> float:
    return round(math.degrees(math.remainder(theta, math.tau)), 9)
