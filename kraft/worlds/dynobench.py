"""Problems of dynobench: boxes and discs, a start and a goal of one of its unicycles."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, Field

from kraft.config.document import Document, Value
from kraft.config.schema import Coordinate, Length, StrictModel, check
from kraft.config.source import Place, Source
from kraft.config.yaml_reader import read_document
from kraft.errors import Code, Diagnostic, InputError
from kraft.text import alternatives, counted
from kraft.worlds.world import SENSING, Imported, ScenarioContent, above, plain_name

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


def _as_list(value: object) -> object:
    return value if isinstance(value, tuple) else (value,)


class ObstacleFile(StrictModel):
    """An obstacle; `size` of a sphere is its radius, as a number or in a list."""

    type: str
    """box or sphere"""
    center: tuple[Coordinate, Coordinate]
    """[x, y], m"""
    size: Annotated[tuple[Length, ...], BeforeValidator(_as_list)]
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
    world = ScenarioContent(
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
    content, problems = check(ProblemFile, replace(document, data=_without_content_of_others(document.data)))
    if content is None:
        raise InputError(problems)
    return content, document


def _without_content_of_others(data: Value) -> Value:
    """Content of a file in which obstacles of other types have the keys of those that are read.

    What else they state, such as the file of an octomap, is not read: they are refused or left out.
    """
    environment = data.get("environment") if isinstance(data, dict) else None
    obstacles = environment.get("obstacles") if isinstance(environment, dict) else None
    if not (isinstance(data, dict) and isinstance(environment, dict) and isinstance(obstacles, tuple)):
        return data
    return {**data, "environment": {**environment, "obstacles": tuple(map(_readable, obstacles))}}


def _readable(obstacle: Value) -> Value:
    kind = obstacle.get("type") if isinstance(obstacle, dict) else None
    if not isinstance(kind, str) or kind in SHAPES:
        return obstacle
    return {"type": kind, "center": (0.0, 0.0), "size": (1.0,)}


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
        size = each.size
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
