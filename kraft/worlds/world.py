"""A world that becomes a scenario file: its check, and writing many of them with a suite."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from kraft.config.overrides import value_text
from kraft.config.source import Place
from kraft.errors import Code, Diagnostic, InputError, Unreachable
from kraft.files import check_new_folder, new_folder
from kraft.planning.compilation import ensure_checks_compiled
from kraft.planning.feasibility import check_placement, check_reachable
from kraft.planning.workspace import start_state, vehicle_of_task
from kraft.scenario import Trial, parse_scenario
from kraft.text import MessageSink, no_messages
from kraft.vehicles.reference import VehicleProblem, relative_vehicle, resolve_vehicle

SUITE: Final = "suite.yaml"
SENSING: Final = {"preset": "planar", "rate_hz": 50}
DIGITS: Final = 12
"""Of the numbers in a scenario file."""
HEIGHT: Final = 6.0
"""Height of the camera, m."""
LEAST_TIMES: Final = 3.0
"""Limit of time for drives over a long way, in least times to the goal."""
LIMIT_MAX: Final = 86_400
"""Longest limit of time in a scenario file, s."""
Start = tuple[float, float, float]
"""x, y (m) and heading (degrees)."""
Goal = tuple[float, float, float]
"""x, y and radius, m."""


@dataclass(frozen=True)
class ScenarioContent:
    """Content of a scenario file.

    Attributes:
        name: name of the scenario and of its file.
        remark: where it comes from, for the first lines of the file.
        content: keys of the scenario in the order in which they are written, without `name`.
        files: further files, by their path relative to the scenario's.
        places: where the values of top-level keys were given, for problems of the start and the goal.
    """

    name: str
    remark: str
    content: Mapping[str, Any]
    files: Mapping[str, bytes] = field(default_factory=dict)
    places: Mapping[str, Place] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """Content of the scenario file."""
        lines = [f"# {line}".rstrip() for line in self.remark.splitlines()]
        lines.append(f"name: {value_text(self.name)}")
        for key, value in self.content.items():
            if key == "obstacles":
                lines.append("obstacles:" if value else "obstacles: []")
                lines += [f"  - {value_text(obstacle, DIGITS)}" for obstacle in value]
            else:
                lines.append(f"{key}: {value_text(value, DIGITS)}")
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Imported:
    """World of a file of another program, the shapes that were left out, and why a BARN layout has no score.

    `missing` is empty if it has a score, and for a world of another kind.
    """

    world: ScenarioContent
    skipped: Counter[str]
    missing: str = ""


@dataclass(frozen=True)
class Written:
    """Folder with scenario files and their suite."""

    folder: Path
    scenarios: tuple[Path, ...]

    @property
    def suite(self) -> Path:
        """File of the suite."""
        return self.folder / SUITE


def above(bounds: Mapping[str, Sequence[float]]) -> list[float]:
    """Place of a camera above the middle of the bounds, m."""
    (x0, x1), (y0, y1) = bounds["x"], bounds["y"]
    return [round((x0 + x1) / 2, 3), round((y0 + y1) / 2, 3), HEIGHT]


def resolved_argument(vehicle: str) -> str:
    """Reference of a vehicle that holds in any folder; a path is relative to the working directory.

    Raises:
        InputError: if there is no such vehicle.
    """
    try:
        return resolve_vehicle(vehicle, Path.cwd())
    except VehicleProblem as error:
        raise InputError.of_argument("vehicle", error.problem, error.expected, error.code) from None


def plain_name(text: str) -> str:
    """Text as the name of a scenario: letters, digits, - and _."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text).strip("-_")[:100] or "world"


def finished(number: int, count: int, name: str) -> str:
    """Message after world `number` of `count` worlds, counted from 1."""
    return f"world {number} of {count}: {name}"


def write_worlds(
    worlds: Sequence[ScenarioContent], out: Path, suite: str, description: str, log: MessageSink = no_messages
) -> Written:
    """Check all worlds and write them and their suite into the new folder `out`, all or nothing.

    `log` gets a message before kernels are compiled, and one for each world that was checked.

    Raises:
        InputError: with every problem of the worlds, or if the folder exists or cannot be written.
        Unreachable: with every goal that no path leads to, if there is no other problem.
    """
    check_new_folder(out)
    _check_names(worlds)
    worlds = [_in_folder(world, out) for world in worlds]
    with new_folder(out) as folder:
        for world in worlds:
            for name, content in {**world.files, f"{world.name}.yaml": world.text.encode()}.items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(content)
        for world, least in zip(worlds, _check_all(worlds, out, folder, log), strict=True):
            (folder / f"{world.name}.yaml").write_bytes(_with_time(world, least).text.encode())
        entries = [f"  - {value_text({'name': each.name, 'scenario': f'{each.name}.yaml'})}" for each in worlds]
        heading = [f"name: {value_text(plain_name(suite))}", f"description: {value_text(description)}", "entries:"]
        (folder / SUITE).write_text("\n".join([*heading, *entries]) + "\n", encoding="utf-8")
    return Written(out, tuple(out / f"{world.name}.yaml" for world in worlds))


def _in_folder(world: ScenarioContent, folder: Path) -> ScenarioContent:
    """World whose vehicle, if it is a file, is found from a folder."""
    if "vehicle" not in world.content:
        return world
    return replace(world, content={**world.content, "vehicle": relative_vehicle(world.content["vehicle"], folder)})


def _check_names(worlds: Sequence[ScenarioContent]) -> None:
    names = [world.name for world in worlds]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice or "suite" in names:
        problem = f"{', '.join(twice or ['suite'])}: several files would have this name"
        raise InputError.of("sources", problem, "expected sources with different names", Code.DUPLICATE)


def _with_time(world: ScenarioContent, least: float) -> ScenarioContent:
    """World with limits of time for a way of at least so many seconds, if it has none and the usual one is short."""
    limit = float(min(math.ceil(LEAST_TIMES * least), LIMIT_MAX))
    if "trial" in world.content or limit <= Trial().timeout:
        return world
    return replace(world, content={**world.content, "trial": {"timeout": limit, "oneshot_timeout": limit}})


def _check_all(worlds: Sequence[ScenarioContent], out: Path, folder: Path, log: MessageSink) -> list[float]:
    """Least time (s) to the goal of each world."""
    times: list[float] = []
    problems: list[Diagnostic] = []
    enclosed: list[Diagnostic] = []
    for number, world in enumerate(worlds, 1):
        try:
            times.append(check(world, out, folder, log))
        except InputError as error:
            problems += error.diagnostics
        except Unreachable as error:
            enclosed += error.diagnostics
        else:
            log(finished(number, len(worlds), world.name))
    if problems:
        raise InputError(problems + enclosed)
    if enclosed:
        raise Unreachable(enclosed)
    return times


def check(world: ScenarioContent, out: Path, folder: Path, log: MessageSink = no_messages) -> float:
    """Check that a world is a valid scenario with a free start and a goal that its vehicle may reach.

    Args:
        world: the world.
        out: folder that messages name.
        folder: folder in which its files are.
        log: gets a message before kernels are compiled.

    Returns:
        Least time to the goal: of the shortest path at top speed, s.

    Raises:
        InputError: with every problem, where the source has the value.
        Unreachable: at the goal, if no path leads to it.
    """
    try:
        scenario = parse_scenario(world.text, str(out / f"{world.name}.yaml"), folder)
        vehicle = vehicle_of_task(scenario)
        ensure_checks_compiled(scenario, vehicle, log)
        check_placement(scenario, vehicle, start_state(scenario, vehicle))
        return check_reachable(scenario, vehicle)
    except InputError as error:
        raise InputError(_at_source(world, each) for each in error.diagnostics) from error
    except Unreachable as error:
        raise Unreachable(_at_source(world, each) for each in error.diagnostics) from error


def _at_source(world: ScenarioContent, found: Diagnostic) -> Diagnostic:
    """Problem at the place of its value in the source, if that is known; an argument is one value, without keys."""
    key = re.split(r"[.\[]", found.path)[0]
    place = world.places.get(key)
    if place is None:
        return found
    return place.diagnostic("" if place.argument else found.path, found.problem, found.expected, found.code)
