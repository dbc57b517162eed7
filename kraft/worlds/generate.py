"""Random worlds: corridors, rooms, posts, mazes, clutter, race tracks. A kind, a seed and a vehicle give one world."""

from __future__ import annotations

import itertools
import json
import math
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError, Problems, Unreachable, out_of_range
from kraft.files import check_new_folder
from kraft.planning.compilation import ensure_compiled
from kraft.planning.feasibility import check_placement, check_reachable, footprint_hit
from kraft.planning.plan import finds_plan
from kraft.planning.workspace import start_state
from kraft.scenario import Task, parse_scenario
from kraft.text import MessageSink, counted, no_messages, suggestion
from kraft.vehicles.load import load_vehicle
from kraft.worlds import layouts
from kraft.worlds.layouts import WALL, Obstacle, track
from kraft.worlds.world import (
    SENSING,
    ScenarioContent,
    Written,
    above,
    finished,
    resolved_argument,
    write_worlds,
)
from ompl_ext.motion import motion_of
from ompl_ext.vehicle import Footprint, Vehicle

MIXED: Final = "mixed"
ATTEMPTS: Final = 500
"""Layouts that are tried until one leaves a way to the goal."""
SEARCHES: Final = 100
"""Layouts with a way to the goal in which a plan is searched, until one has a plan."""
ITERATIONS: Final = 20_000
"""Iterations of each search: those of `kraft plan` by default."""
DENSITY, DENSITY_MAX = 0.15, 0.5
"""Areas of all clutter over that of the floor between start and goal, by default and at most."""
LARGE: Final = math.hypot(0.51, 0.43)
"""Diagonal of a Jackal (m): rooms, posts and tracks suit vehicles up to this size, and grow with larger ones."""


@dataclass(frozen=True)
class Size:
    """Lengths of a vehicle that a world has to suit, m.

    Attributes:
        diagonal: diameter of the disc that covers the footprint in every heading.
        turn: radius of its tightest turn at speed, up to the outer corner of the footprint.
    """

    diagonal: float
    turn: float

    @classmethod
    def of(cls, vehicle: Vehicle) -> Size:
        """Size of a vehicle."""
        diagonal = 2.0 * vehicle.footprint.reach
        ahead, _, turning = np.abs(motion_of(vehicle).twists).T
        fast = (ahead > 0.2 * vehicle.top_speed) & (turning > 1e-3)
        radius = float((ahead[fast] / turning[fast]).min()) if fast.any() else 0.0
        return cls(diagonal, radius + 0.5 * diagonal)

    @property
    def gap(self) -> layouts.Gap:
        """Least and largest width of a passage."""
        return 1.3 * self.diagonal, 1.8 * self.diagonal

    @property
    def scale(self) -> float:
        """Factor on rooms that are made for smaller vehicles."""
        return max(1.0, self.diagonal / LARGE)


Layout = Callable[[np.random.Generator, Size, float], dict[str, Any]]
"""Sections of a scenario for a vehicle; the last argument is the density of clutter."""


def _arena(
    rng: np.random.Generator, size: Size, fill: Callable[[float, float, layouts.Gap], list[Obstacle]]
) -> dict[str, Any]:
    """An arena with outer walls; start and goal lie at its ends.

    `fill` makes the obstacles of one for smaller vehicles, of a width, a length and with gaps (m), which are enlarged.
    """
    scale = size.scale
    width, length = scale * float(rng.uniform(4.0, 5.0)), scale * float(rng.uniform(5.0, 6.0))
    end = 0.5 * scale
    start, goal = (scale * float(rng.uniform(0.6, width / scale - 0.6)) for _ in range(2))
    least, most = size.gap
    filled = fill(width / scale, length / scale, (least / scale, most / scale))
    return {
        "bounds": {"x": [0.0, width], "y": [0.0, length]},
        "obstacles": [*layouts.enlarged(filled, scale), *layouts.outer_walls(width, length)],
        "start": {"x": start, "y": end, "heading_deg": 90.0},
        "goal": {"center": [goal, length - end], "radius": 0.25 * scale},
    }


def _rooms(rng: np.random.Generator, size: Size, density: float) -> dict[str, Any]:
    return _arena(rng, size, lambda width, length, gap: layouts.divided(rng, width, length, gap))


def _rows(rng: np.random.Generator, size: Size, density: float) -> dict[str, Any]:
    return _arena(rng, size, lambda width, length, gap: layouts.rows_of_posts(rng, width, length, gap))


def _clutter(rng: np.random.Generator, size: Size, density: float) -> dict[str, Any]:
    return _arena(rng, size, lambda width, length, _: layouts.clutter(rng, width, length, density))


def _posts(rng: np.random.Generator, size: Size, density: float) -> dict[str, Any]:
    """A room of 22 posts, from one corner to the other."""
    scale, room, number = size.scale, 9.0 * size.scale, 22
    half, corner = room / 2, room / 2 - 0.8 * size.scale
    found = layouts.posts(rng, room, number, 0.95 * scale, ((-corner, -corner), (corner, corner)), 1.1 * scale)
    walls = {
        "left wall": ((-half, 0.0), (WALL, room)),
        "right wall": ((half, 0.0), (WALL, room)),
        "near wall": ((0.0, -half), (room, WALL)),
        "far wall": ((0.0, half), (room, WALL)),
    }
    named = [{"name": name, **layouts.box(*placed)} for name, placed in walls.items()]
    named += [{"name": f"post {k}", **layouts.circle((x, y), radius)} for k, (x, y, radius) in enumerate(found, 1)]
    return {
        "bounds": {"x": [-half, half], "y": [-half, half]},
        "obstacles": named,
        "start": {"x": -corner, "y": -corner, "heading_deg": 45.0},
        "goal": {"center": [corner, corner], "radius": 0.3 * scale},
    }


def _cells(rng: np.random.Generator, size: Size, openings_of: Callable[[int, int], Any]) -> dict[str, Any]:
    """Cells between walls, from the first one to the last one."""
    pitch = max(float(rng.uniform(*size.gap)), 1.1 * size.turn) + WALL
    columns, rows = int(rng.integers(3, 6)), int(rng.integers(4, 7))
    openings = openings_of(columns, rows)
    first = layouts.way_through(openings, (columns - 1, rows - 1))[1]
    walls = [
        *layouts.walls_between(openings, columns, rows, pitch),
        *layouts.outer_walls(columns * pitch, rows * pitch),
    ]
    return {
        "bounds": {"x": [0.0, columns * pitch], "y": [0.0, rows * pitch]},
        "obstacles": walls,
        "start": {"x": pitch / 2, "y": pitch / 2, "heading_deg": 0.0 if first == (1, 0) else 90.0},
        "goal": {"center": [(columns - 0.5) * pitch, (rows - 0.5) * pitch], "radius": 0.3 * pitch},
    }


def _maze(rng: np.random.Generator, size: Size, density: float) -> dict[str, Any]:
    """A maze in which every cell is reached, with some openings more, so that there are several ways."""

    def openings(columns: int, rows: int) -> list[tuple[layouts.GridCell, layouts.GridCell]]:
        found = layouts.passages(rng, columns, rows)
        for _ in range(columns * rows // 6):
            column, row = int(rng.integers(columns - 1)), int(rng.integers(rows - 1))
            found.append(((column, row), (column + 1, row) if rng.random() < 0.5 else (column, row + 1)))
        return found

    return _cells(rng, size, openings)


def _corridor(rng: np.random.Generator, size: Size, density: float) -> dict[str, Any]:
    """The one way through a maze, without its dead ends."""

    def openings(columns: int, rows: int) -> list[tuple[layouts.GridCell, layouts.GridCell]]:
        way = layouts.way_through(layouts.passages(rng, columns, rows), (columns - 1, rows - 1))
        return list(itertools.pairwise(way))

    return _cells(rng, size, openings)


LAYOUTS: Final[dict[str, Layout]] = {
    "corridor": _corridor,
    "rooms": _rooms,
    "rows": _rows,
    "posts": _posts,
    "maze": _maze,
    "clutter": _clutter,
}
KINDS: Final = (*LAYOUTS, "track")
COUNT_MAX: Final = 10_000
"""Largest number of worlds of one call."""
USUAL: Final = {"posts": "jackal", "track": "f1tenth"}
"""Vehicles of the kinds that are not made for a `mushr`."""


def generate_worlds(
    kind: str,
    out: Path,
    *,
    seed: int = 0,
    count: int = 1,
    vehicle: str | None = None,
    density: float | None = None,
    log: MessageSink = no_messages,
) -> Written:
    """Write random worlds and their suite into the new folder `out`; world k has the seed `seed` + k.

    Args:
        kind: one of `KINDS`, or ``mixed`` for all of them in turn.
        out: new folder.
        seed: seed of the first world.
        count: number of worlds, at most `COUNT_MAX`.
        vehicle: vehicle of all worlds; by default a `mushr`, a `jackal` for posts and an `f1tenth` for tracks.
        density: areas of all clutter over that of the floor between start and goal; overlaps count twice.
        log: gets a message before kernels are compiled, and one for each world that has a plan.

    Raises:
        InputError: with every wrong argument: an unknown kind, a number out of range, a vehicle that does not exist, a
            folder that exists; then for a vehicle that cannot be loaded, or a density that leaves no way.
    """
    problems = Problems()
    problems.found += [*out_of_range("count", count, 1, COUNT_MAX), *out_of_range("seed", seed, 0)]
    problems.found += _layout_problems(kind, density)
    reference = None if vehicle is None else problems.of(lambda: resolved_argument(vehicle))
    problems.of(lambda: check_new_folder(out))
    problems.check()
    worlds: list[ScenarioContent] = []
    for each, number in _numbered(kind, seed, count):
        world = _first_that_counts(each, number, reference or _usual(each), density, log)
        worlds.append(_with_remark(world, each, number, vehicle, density))
        log(finished(len(worlds), count, worlds[-1].name))
    description = f"{counted(count, 'world')}: kraft generate {kind} --seed {seed} --count {count}"
    return write_worlds(worlds, out, f"{kind}-{seed}", description)


def _layout_problems(kind: str, density: float | None) -> list[Diagnostic]:
    problems = []
    if kind not in (*KINDS, MIXED):
        expected = suggestion(kind, (*KINDS, MIXED))
        problems.append(Diagnostic(kind, "is no kind of world", expected, code=Code.UNKNOWN))
    elif density is not None and kind not in ("clutter", MIXED):
        problem, expected = f"is given for {kind}", "expected it for clutter alone"
        problems.append(Diagnostic("density", problem, expected, code=Code.CONFLICT, argument=True))
    if density is not None and not 0.0 < density <= DENSITY_MAX:
        expected = f"expected a share above 0 and up to {DENSITY_MAX:g}"
        problems.append(Diagnostic("density", f"is {density:g}", expected, argument=True))
    return problems


def _numbered(kind: str, seed: int, count: int) -> Iterator[tuple[str, int]]:
    """Kind and seed of each world; of mixed ones the seed alone decides the kind."""
    for number in range(seed, seed + count):
        yield (KINDS[number % len(KINDS)] if kind == MIXED else kind), number


def generate(
    kind: str, seed: int, vehicle: str | None = None, density: float | None = None, log: MessageSink = no_messages
) -> ScenarioContent:
    """Make the world of a kind and a seed: the first layout of the seed that counts.

    Its start is free, a path leads to its goal on which the footprint is free in every heading, and the planner finds a
    plan for the vehicle within `ITERATIONS` iterations.  `log` gets a message before kernels are compiled.

    Raises:
        InputError: if the vehicle cannot be loaded, or after many attempts no layout counts.
    """
    reference = resolved_argument(vehicle) if vehicle else _usual(kind)
    return _with_remark(_first_that_counts(kind, seed, reference, density, log), kind, seed, vehicle, density)


def _usual(kind: str) -> str:
    """Vehicle of the worlds of a kind if none is given."""
    return USUAL.get(kind, "mushr")


def _with_remark(
    world: ScenarioContent, kind: str, seed: int, vehicle: str | None, density: float | None
) -> ScenarioContent:
    """A world with the command that repeats it; `vehicle` is as it was given."""
    return replace(world, remark=f"Written by {_command(kind, seed, vehicle, density)}{world.remark}.")


def _first_that_counts(
    kind: str, seed: int, reference: str, density: float | None, log: MessageSink
) -> ScenarioContent:
    """See `generate`; `reference` is the vehicle with its absolute path."""
    loaded = load_vehicle(reference)
    ensure_compiled(loaded, log)
    size = Size.of(loaded)
    wide = replace(loaded, footprint=Footprint(size.diagonal, size.diagonal))
    name, searches = f"{kind}-{seed:03d}", 0
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([seed, attempt] if attempt else seed)
        world = _world(kind, name, rng, size, reference, density or DENSITY)
        task = _task_with_way(world, loaded, wide)
        if task is None:
            continue
        searches += 1
        if finds_plan(task, loaded, ITERATIONS):
            return world
        if searches == SEARCHES:
            break
    problem = f"{name}: none of {counted(attempt + 1, 'layout')} leaves {loaded.name} a way to the goal"
    if searches:
        problem += f" with a plan that is found in {counted(ITERATIONS, 'iteration')}"
    raise InputError.of_argument("density" if kind == "clutter" else "vehicle", problem, "expected a smaller one")


def _command(kind: str, seed: int, vehicle: str | None, density: float | None) -> str:
    """Command that repeats a world.

    A vehicle is named as it was given, except that an absolute path is left out: it holds on one machine alone.
    """
    words = ["kraft", "generate", kind, "--seed", str(seed)]
    if vehicle:
        words += ["--vehicle", Path(vehicle).name if Path(vehicle).is_absolute() else vehicle]
    if density and kind == "clutter":
        words += ["--density", f"{density:g}"]
    return shlex.join(words)


def _world(kind: str, name: str, rng: np.random.Generator, size: Size, vehicle: str, density: float) -> ScenarioContent:
    files: dict[str, bytes] = {}
    remark = ""
    if kind == "track":
        sections, files, length = track(rng, size.scale, name)
        remark = f": a lap of {length:.1f} m"
    else:
        sections = _rounded(LAYOUTS[kind](rng, size, density))
    camera = {"sensing": {**SENSING, "camera": above(sections["bounds"])}}
    return ScenarioContent(name, remark, {**sections, "vehicle": vehicle, **camera}, files)


def _rounded(value: Any) -> Any:
    """The same values with lengths to 1 mm and angles to 0.001 degrees."""
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(each) for each in value]
    return round(value, 3) if isinstance(value, float) else value


def _task_with_way(world: ScenarioContent, vehicle: Vehicle, wide: Vehicle) -> Task | None:
    """Task of a world; None unless the start is free and the disc around the footprint gets from it to the goal."""
    with TemporaryDirectory() as folder:
        for name, content in world.files.items():
            (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(folder) / name).write_bytes(content)
        text = json.dumps({"name": world.name, **world.content})
        try:
            task = parse_scenario(text, world.name, Path(folder)).task()
            start = task.start
            if footprint_hit(task, vehicle, (start.x, start.y, start.heading)):  # quicker than to say what is wrong
                return None
            check_placement(task, vehicle, start_state(task, vehicle))
            check_reachable(task, wide)
        except (InputError, Unreachable):
            return None
    return task
