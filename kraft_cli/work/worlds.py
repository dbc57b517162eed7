"""Options of `kraft import`, and the JSON objects of `kraft import` and `kraft generate`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from kraft.errors import Code, InputError, Problems
from kraft.planning.workspace import vehicle_of_task
from kraft.scenario import load_scenario
from kraft.text import MessageSink
from kraft.trial.planning_vehicle import other_robot
from kraft.worlds.imports import Collection, Request, read_sources, write_imported
from kraft.worlds.world import Written

RADIUS: Final = 0.25
"""Radius of a goal that is given without one, m."""


@dataclass(frozen=True)
class ImportRequest:
    """Options of `kraft import` as written."""

    kind: str
    sources: tuple[Path, ...]
    out: Path
    start: str | None = None
    goal: str | None = None
    vehicle: str | None = None
    skip: bool = False


def run_import(request: ImportRequest, log: MessageSink) -> Collection:
    """Read the sources, and write scenarios and a suite; `log` gets the progress.

    Raises:
        InputError: with every problem of the options and of the sources.
        Unreachable: with every goal that no path leads to.
    """
    problems = Problems()
    begin, end = request.start, request.goal
    # where a text cannot be read, any numbers do for reading the sources: they are not written then
    start = None if begin is None else problems.of(lambda: numbers_of("start", begin, "X,Y,HEADING")) or (0.0, 0.0, 0.0)
    goal = None if end is None else problems.of(lambda: goal_of(end)) or (0.0, 0.0, RADIUS)
    resolved = Request(request.kind, request.sources, request.out, start, goal, request.vehicle, request.skip)
    imported = problems.of(lambda: read_sources(resolved))
    problems.check()
    assert imported is not None, "every problem was raised"
    return write_imported(resolved, imported, log)


def numbers_of(name: str, text: str, form: str) -> tuple[float, float, float]:
    """Three numbers of an option that is to be given as `form`.

    Raises:
        InputError: if the text is not three finite numbers.
    """
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3 or not all(map(math.isfinite, values)):
        expected = f"expected {form}: finite numbers"
        raise InputError.of_argument(name, f"is {text!r}", expected, Code.TYPE)
    first, second, third = values
    return first, second, third


def goal_of(text: str) -> tuple[float, float, float]:
    """Centre and radius (m) of a goal, with a radius if none is given.

    Raises:
        InputError: if the text is not two or three finite numbers.
    """
    whole = f"{text},{RADIUS}" if text.count(",") == 1 else text
    return numbers_of("goal", whole, "X,Y[,RADIUS]")


def imported_json(kind: str, found: Collection, warnings: Sequence[str]) -> dict[str, Any]:
    """Content of the ``kraft.import/1`` object, without its schema."""
    scenarios = [
        {
            "name": each.world.name,
            "file": str(path),
            "obstacles": len(each.world.content["obstacles"]),
            "skipped": dict(each.skipped),
            "score": each.world.content.get("trial", {}).get("score"),
        }
        for each, path in zip(found.imported, found.written.scenarios, strict=True)
    ]
    return {
        "kind": kind,
        "folder": str(found.written.folder),
        "suite": str(found.written.suite),
        "scenarios": scenarios,
        "warnings": list(warnings),
    }


def robot_warnings(written: Written, vehicle: str | None) -> list[str]:
    """What to say of the robot that is true in worlds that were written for a vehicle; one text or none.

    The worlds state no robot, so that the first one stands for all; without `vehicle` all have a bundled one.
    A robot that does not load is a warning too: planning in the worlds is possible.
    """
    if vehicle is None:
        return []
    scenario = load_scenario(written.scenarios[0])
    try:
        text = other_robot(scenario, vehicle_of_task(scenario.task()))
    except InputError as error:
        text = "; ".join(map(str, error.diagnostics))
    return [text] if text else []


def generated_json(kind: str, seed: int, written: Written, warnings: Sequence[str]) -> dict[str, Any]:
    """Content of the ``kraft.generate/1`` object, without its schema."""
    scenarios = [{"name": path.stem, "file": str(path)} for path in written.scenarios]
    return {
        "kind": kind,
        "seed": seed,
        "folder": str(written.folder),
        "suite": str(written.suite),
        "scenarios": scenarios,
        "warnings": list(warnings),
    }
