"""Layouts of random worlds: obstacles of arenas as a scenario file has them, and race tracks as occupancy maps.

Lengths are in m, angles in degrees.  A track is a closed lane in the format of ROS's map_server.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Obstacle: TypeAlias = dict[str, Any]
Gap: TypeAlias = tuple[float, float]
GridCell: TypeAlias = tuple[int, int]
"""Column and row."""
Vec2: TypeAlias = tuple[float, float]

WALL: Final = 0.1
"""Thickness of outer walls and of the walls of a maze, m."""
TRIES: Final = 20_000
"""Places that are tried for posts."""


def box(center: Vec2, size: Vec2 | list[float], yaw: float = 0.0) -> Obstacle:
    """A rectangle turned by `yaw` degrees."""
    return {"box": {"center": center, "size": list(size), "yaw_deg": yaw}}


def circle(center: Vec2, radius: float) -> Obstacle:
    """A disc."""
    return {"circle": {"center": center, "radius": radius}}


def enlarged(obstacles: Sequence[Obstacle], scale: float) -> list[Obstacle]:
    """The same obstacles with all lengths times `scale`."""
    lengths = {"center", "size", "radius", "vertices"}
    return [
        {
            shape: {key: (scale * np.array(value)).tolist() if key in lengths else value for key, value in of.items()}
            for shape, of in obstacle.items()
        }
        for obstacle in obstacles
    ]


def outer_walls(width: float, length: float) -> list[Obstacle]:
    """Walls around the bounds."""
    return [
        box((-WALL / 2, length / 2), (WALL, length + 2 * WALL)),
        box((width + WALL / 2, length / 2), (WALL, length + 2 * WALL)),
        box((width / 2, -WALL / 2), (width, WALL)),
        box((width / 2, length + WALL / 2), (width, WALL)),
    ]


def divided(rng: np.random.Generator, width: float, length: float, gap: Gap) -> list[Obstacle]:
    """Two walls across with two gaps each, and obstacles of all shapes between start and goal."""
    walls = []
    for y in (0.35 * length, 0.65 * length):
        begin = 0.0
        for middle in sorted(rng.uniform(0.4, width - 0.4, 2).tolist()):
            half = 0.5 * float(rng.uniform(*gap))
            walls.append((begin, middle - half, y))
            begin = middle + half
        walls.append((begin, width, y))
    found = [box((0.5 * (a + b), y), (b - a, 0.12)) for a, b, y in walls if b - a > 0.05]
    return found + scattered(rng, width, length, (6, 10))


def rows_of_posts(rng: np.random.Generator, width: float, length: float, gap: Gap) -> list[Obstacle]:
    """Rows of posts, 0.12 to 0.24 m thick, from side to side; their centres are the gap and 0.2 m apart."""
    found, y = [], 1.2
    while y < length - 1.2:
        x = float(rng.uniform(0.1, 0.4))
        while x < width:
            place = (x, y + float(rng.uniform(-0.08, 0.08)))
            found.append(circle(place, float(rng.uniform(0.06, 0.12))))
            x += 0.2 + float(rng.uniform(*gap))
        y += float(rng.uniform(0.75, 1.0))
    return found


def scattered(rng: np.random.Generator, width: float, length: float, number: tuple[int, int]) -> list[Obstacle]:
    """Discs, turned rectangles and polygons anywhere between start and goal, least and largest number of them."""
    count = int(rng.integers(number[0], number[1] + 1))
    return [anything(rng, width, length) for _ in range(count)]


def anything(rng: np.random.Generator, width: float, length: float) -> Obstacle:
    """A disc, a turned rectangle or a polygon between start and goal."""
    center, kind = (float(rng.uniform(0.2, width - 0.2)), float(rng.uniform(1.1, length - 1.1))), rng.random()
    if kind < 0.4:
        return circle(center, float(rng.uniform(0.08, 0.3)))
    if kind < 0.8:
        return box(center, rng.uniform(0.1, 0.7, 2).tolist(), float(rng.uniform(0.0, 180.0)))
    corners = int(rng.integers(3, 6))
    turns = math.tau * (np.arange(corners) + rng.uniform(0.0, 0.4, corners)) / corners
    radii = rng.uniform(0.1, 0.4, corners)
    vertices = np.column_stack([radii * np.cos(turns), radii * np.sin(turns)]) + np.array(center)
    return {"polygon": {"vertices": vertices.tolist()}}


def clutter(rng: np.random.Generator, width: float, length: float, density: float) -> list[Obstacle]:
    """Obstacles of all shapes whose areas add up to a share of that of the floor between start and goal.

    That floor ends 1.1 m before both ends of the room.  Overlaps count twice, so less than the share is covered.
    """
    found: list[Obstacle] = []
    covered, wanted = 0.0, density * width * (length - 2.2)
    while covered < wanted:
        found.append(anything(rng, width, length))
        covered += area(found[-1])
    return found


def area(obstacle: Obstacle) -> float:
    """Area of a disc, rectangle or polygon, m^2."""
    if "circle" in obstacle:
        return math.pi * float(obstacle["circle"]["radius"]) ** 2
    if "box" in obstacle:
        return float(np.prod(obstacle["box"]["size"]))
    x, y = np.array(obstacle["polygon"]["vertices"]).T
    return 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))


def posts(
    rng: np.random.Generator, room: float, number: int, gap: float, keep_free: Sequence[Vec2], free: float
) -> list[tuple[float, float, float]]:
    """Posts (x, y, radius) in a square room around the origin.

    Between two posts, and between a post and a wall, are at least `gap` m; between a post and the points `keep_free` at
    least `free` m.
    """
    found: list[tuple[float, float, float]] = []
    half = room / 2
    for _ in range(TRIES):
        radius = float(rng.uniform(0.08, 0.3))
        x, y = rng.uniform(-half + radius + gap, half - radius - gap, 2).tolist()
        near = min(math.dist((x, y), point) for point in keep_free) - radius
        if near > free and all(math.dist((x, y), post[:2]) > radius + post[2] + gap for post in found):
            found.append((x, y, radius))
        if len(found) == number:
            break
    return found


def passages(rng: np.random.Generator, columns: int, rows: int) -> list[tuple[GridCell, GridCell]]:
    """Openings between neighbouring cells of which each cell is reached from each other one on exactly one way."""
    reached: dict[GridCell, None] = {(0, 0): None}
    way, found = [(0, 0)], []
    while way:
        column, row = way[-1]
        beside = [(column + 1, row), (column - 1, row), (column, row + 1), (column, row - 1)]
        free = [c for c in beside if 0 <= c[0] < columns and 0 <= c[1] < rows and c not in reached]
        if not free:
            way.pop()
            continue
        following = free[int(rng.integers(len(free)))]
        found.append((way[-1], following))
        reached[following] = None
        way.append(following)
    return found


def way_through(openings: Sequence[tuple[GridCell, GridCell]], goal: GridCell) -> list[GridCell]:
    """Cells from the first one to the goal, along openings of `passages`."""
    before: dict[GridCell, GridCell] = {}
    for cell, after in openings:
        before.setdefault(after, cell)  # the first one is that of `passages`; further openings would make circles
    before.pop((0, 0), None)
    way = [goal]
    while way[-1] in before:
        way.append(before[way[-1]])
    return way[::-1]


def walls_between(
    openings: Sequence[tuple[GridCell, GridCell]], columns: int, rows: int, pitch: float
) -> list[Obstacle]:
    """Walls between all neighbouring cells without an opening; walls in one line are one rectangle."""
    opened = {frozenset(pair) for pair in openings}
    found = []
    for column in range(columns - 1):
        closed = [frozenset({(column, row), (column + 1, row)}) not in opened for row in range(rows)]
        for first, last in _runs(closed):
            middle, long = pitch * (first + last) / 2, pitch * (last - first) + WALL
            found.append(box((pitch * (column + 1), middle), (WALL, long)))
    for row in range(rows - 1):
        closed = [frozenset({(column, row), (column, row + 1)}) not in opened for column in range(columns)]
        for first, last in _runs(closed):
            middle, long = pitch * (first + last) / 2, pitch * (last - first) + WALL
            found.append(box((middle, pitch * (row + 1)), (long, WALL)))
    return found


def _runs(values: Sequence[bool]) -> list[tuple[int, int]]:
    """First index and index after the last one of each run of true values."""
    change = np.flatnonzero(np.diff([False, *values, False]))
    return [(int(first), int(last)) for first, last in zip(change[::2], change[1::2], strict=True)]


RESOLUTION: Final = 0.05
"""Side of a cell of the map, m."""
SIZE: Final = (12.0, 8.0)
"""Size of the map, m."""
HALF_WIDTH: Final = 0.75
"""Half the width of the lane, m."""
LANE_WALL: Final = 0.15
"""Thickness of the walls along the lane, m."""
CURVATURE: Final = 1.0
"""Largest curvature of the centre line, 1/m."""
Points = NDArray[np.float64]


def track(rng: np.random.Generator, scale: float, name: str) -> tuple[dict[str, Any], dict[str, bytes], float]:
    """Sections of the scenario of a lap, the files of its map, and the lap's length (m).

    The start line is a wall, the goal is behind it. The layout is multiplied by `scale`; cells and walls are not.
    """
    line = centre_line(rng) * scale
    width, height = (size * scale for size in SIZE)
    length = float(np.hypot(*np.diff(line, axis=0, append=line[:1]).T).sum())
    steps = length / len(line)
    ahead, at, end = line[1] - line[-1], round(0.7 * scale / steps), round(0.9 * scale / steps)
    begin = line[at + 1] - line[at - 1]
    (start_x, start_y), (goal_x, goal_y) = line[at].tolist(), line[-end].tolist()
    start_line = {"center": _rounded(line[0].tolist()), "size": [0.1, round(2 * HALF_WIDTH * scale, 3)]}
    sections = {
        "bounds": {"x": [0.0, round(width, 3)], "y": [0.0, round(height, 3)]},
        "obstacles": [
            {"name": "track", "map": {"file": f"maps/{name}.yaml"}},
            {"name": "start line", "box": {**start_line, "yaw_deg": _heading(ahead)}},
        ],
        "start": {"x": round(start_x, 3), "y": round(start_y, 3), "heading_deg": _heading(begin)},
        "goal": {"center": _rounded([goal_x, goal_y]), "radius": round(0.4 * scale, 3)},
    }
    return sections, _map(line, scale, name), length


def _rounded(values: list[float]) -> list[float]:
    return [round(value, 3) for value in values]


def _heading(along: Points) -> float:
    return round(math.degrees(math.atan2(along[1], along[0])), 1)


def centre_line(rng: np.random.Generator) -> Points:
    """Closed centre line (720, 2) of a track: an ellipse with random waves, without a bend that is too narrow."""
    angle = np.linspace(0.0, 2.0 * math.pi, 720, endpoint=False)
    while True:
        waves = np.zeros(len(angle))
        for k in (2, 3, 4, 5):
            waves += rng.uniform(-1, 1) / k * np.cos(k * angle + rng.uniform(0, 2 * math.pi))
        line = np.column_stack([4.6 * np.cos(angle), 2.6 * np.sin(angle)]) * (1.0 + 0.16 * waves)[:, None]
        along = np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
        heading = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
        curvature = np.gradient(heading) / (0.5 * np.hypot(*along.T))
        inside = np.abs(line) < np.array(SIZE) / 2 - HALF_WIDTH - 2 * LANE_WALL
        if np.abs(curvature[5:-5]).max() < CURVATURE and inside.all() and _clear_of_itself(line):
            placed: Points = line + np.array(SIZE) / 2
            return placed


def _clear_of_itself(line: Points) -> bool:
    """Whether the lanes of two parts of the line are apart, so that a wall fits between them."""
    coarse = line[::6]
    apart = np.hypot(*(coarse[:, None] - coarse[None, :]).transpose(2, 0, 1))
    steps = np.abs(np.arange(len(coarse))[:, None] - np.arange(len(coarse))[None, :])
    length = np.hypot(*np.diff(coarse, axis=0).T).mean()
    far = np.minimum(steps, len(coarse) - steps) * length > 2.5 * (2 * HALF_WIDTH + LANE_WALL)
    return bool(apart[far].min() > 2 * HALF_WIDTH + LANE_WALL)


def _map(line: Points, scale: float, name: str) -> dict[str, bytes]:
    """Map of the walls along the lane: its image and its YAML file."""
    columns, rows = (round(size * scale / RESOLUTION) for size in SIZE)
    x, y = (np.arange(columns) + 0.5) * RESOLUTION, (np.arange(rows) + 0.5) * RESOLUTION
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    nearest = line[cKDTree(line).query(grid)[1]]
    distance = np.hypot(*(grid - nearest).transpose(2, 0, 1))
    wall = (distance >= HALF_WIDTH * scale) & (distance < HALF_WIDTH * scale + LANE_WALL)
    image = np.where(wall, 0, 254).astype(np.uint8)[::-1]  # the first row of an image is its top
    settings = (
        f"image: {name}.pgm\nresolution: {RESOLUTION}\norigin: [0.0, 0.0, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return {
        f"maps/{name}.pgm": f"P5\n{columns} {rows}\n255\n".encode() + image.tobytes(),
        f"maps/{name}.yaml": settings.encode(),
    }
