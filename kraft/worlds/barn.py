"""Worlds of the BARN challenge, and other Gazebo worlds with the same or another start and goal."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Final
from zipfile import BadZipFile

import numpy as np

from kraft.config.source import Place, Position
from kraft.errors import Code, Diagnostic, InputError
from kraft.worlds.sdf import Shapes, read_sdf
from kraft.worlds.world import SENSING, Goal, Imported, ScenarioContent, Start, above, plain_name

START: Final[Start] = (-2.25, 3.0, 90.0)
GOAL: Final[Goal] = (-2.25, 13.0, 1.0)
TIMEOUT: Final = 100.0
SPEED: Final = 2.0
"""Top speed of the challenge's robot, m/s; the optimal time is that of the shortest path at this speed."""
CELL: Final = 0.15
"""Side of a cell of the shortest paths that come with the worlds, m."""
CORNER: Final = (-4.575, 5.075)
"""Position of cell (0, 0), m."""
LABEL: Final = "BARN layouts, known map"
ROOM: Final = 1.5
"""Free space around obstacles, start and goal within the bounds, m."""
SUFFIXES: Final = (".world", ".sdf", ".world.gz", ".sdf.gz")


def worlds_in(folder: Path) -> list[Path]:
    """Files of the worlds in a folder, in the order of their numbers.

    Raises:
        InputError: if there are none.
    """
    found = [path for path in folder.iterdir() if path.name.endswith(SUFFIXES)]
    if not found:
        expected = f"expected files *{', *'.join(SUFFIXES)}"
        raise InputError.of(str(folder), "has no worlds", expected, Code.NOT_FOUND)
    return sorted(found, key=lambda path: [int(word) if word.isdecimal() else word for word in _words(path.name)])


def _words(name: str) -> list[str]:
    return re.split(r"(\d+)", name)


def read_barn(path: Path, vehicle: str, start: Start | None, goal: Goal | None, *, skip: bool = False) -> Imported:
    """Read a Gazebo world.

    Args:
        path: SDF file, perhaps compressed by gzip.
        vehicle: vehicle of the scenario.
        start: start; that of the challenge if None.
        goal: goal; that of the challenge if None. With another start or goal there is no score.
        skip: leave out shapes that cannot be obstacles.

    Raises:
        InputError: with every problem of the file and of the file with its shortest path.
    """
    shapes = read_sdf(path, skip=skip)
    (x, y, heading), (goal_x, goal_y, radius) = start or START, goal or GOAL
    bounds = _bounds(shapes, ((x, y), (goal_x, goal_y)))
    trial: dict[str, object] = {"timeout": TIMEOUT, "oneshot_timeout": TIMEOUT}
    missing = "" if start is None and goal is None else "start or goal are not those of the challenge"
    if not missing:
        optimal, missing = _optimal_time(path)
        if optimal is not None:
            trial["score"] = {"label": LABEL, "optimal_time": round(optimal, 6)}
    here = Place(str(path), Position(shapes.line, shapes.column))
    name = path.name.removesuffix(".gz").rpartition(".")[0]
    world = ScenarioContent(
        name=plain_name(re.sub(r"^world_(?=\d+$)", "barn-", name)),
        remark=f"From {path.name}: {len(shapes.obstacles)} obstacles of a Gazebo world.",
        content={
            "bounds": bounds,
            "obstacles": list(shapes.obstacles),
            "start": {"x": x, "y": y, "heading_deg": heading},
            "goal": {"center": [goal_x, goal_y], "radius": radius},
            "vehicle": vehicle,
            "sensing": {**SENSING, "camera": above(bounds)},
            "trial": trial,
        },
        places={
            "bounds": here,
            "sensing": here,
            "obstacles": here,
            "start": here if start is None else Place("start", argument=True),
            "goal": here if goal is None else Place("goal", argument=True),
        },
    )
    return Imported(world, shapes.skipped, missing)


def _bounds(shapes: Shapes, points: tuple[tuple[float, float], ...]) -> dict[str, list[float]]:
    """Bounds around obstacles and points, so that a robot can drive around all of them."""
    low_x, high_x, low_y, high_y = shapes.extent if shapes.obstacles else (math.inf, -math.inf, math.inf, -math.inf)
    xs, ys = zip(*points, strict=True)
    return {
        "x": [round(min(low_x, *xs) - ROOM, 3), round(max(high_x, *xs) + ROOM, 3)],
        "y": [round(min(low_y, *ys) - ROOM, 3), round(max(high_y, *ys) + ROOM, 3)],
    }


def _optimal_time(path: Path) -> tuple[float | None, str]:
    """Time of the shortest path at top speed (s), or what is missing for it."""
    number = re.fullmatch(r".*?(\d+)\.(?:world|sdf)(?:\.gz)?", path.name)
    if number is None:
        return None, "its name has no number"
    name = f"path_{number[1]}.npy"
    folders = (path.parent, path.parent / "path_files", path.parent.parent / "path_files")
    found = next((folder / name for folder in folders if (folder / name).is_file()), None)
    if found is None:
        return None, f"{name} is neither beside it nor in path_files"
    points = np.array([START[:2], *(_cells(found) * CELL + CORNER), GOAL[:2]])
    return float(np.hypot(*np.diff(points, axis=0).T).sum()) / SPEED, ""


def _cells(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Cells of a shortest path, shape (n, 2).

    Raises:
        InputError: if the file has no such array.
    """
    expected = "expected an array of n cells with two numbers each"
    try:
        with path.open("rb") as file:
            cells = np.load(file, allow_pickle=False)
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise InputError.of(str(path), problem, expected, Code.UNREADABLE) from None
    except (ValueError, EOFError, BadZipFile):  # numpy's text advises to load what it does not know as code
        raise InputError.of(str(path), "is no complete file of numpy", expected, Code.SYNTAX) from None
    usable = getattr(cells, "ndim", 0) == 2 and cells.shape[1] == 2 and cells.dtype.kind in "iuf"
    if not usable or not np.isfinite(cells).all():
        raise InputError([Diagnostic(str(path), "is no path", expected, code=Code.TYPE)])
    return np.asarray(cells, dtype=np.float64)
