"""Import of worlds from files of other programs: Gazebo worlds, problems of dynobench, occupancy maps."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from kraft.config.source import Place
from kraft.errors import Code, Diagnostic, InputError, Problems
from kraft.files import check_new_folder
from kraft.scenario.geometry import read_map
from kraft.text import MessageSink, counted, no_messages, suggestion
from kraft.worlds.barn import LABEL, read_barn, worlds_in
from kraft.worlds.dynobench import read_dynobench
from kraft.worlds.world import (
    SENSING,
    Goal,
    Imported,
    ScenarioContent,
    Start,
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
    world = ScenarioContent(
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
