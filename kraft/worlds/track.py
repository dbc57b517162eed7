"""Random race tracks: a closed lane as an occupancy map in the format of ROS's map_server."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

RESOLUTION: Final = 0.05
"""Side of a cell of the map, m."""
SIZE: Final = (12.0, 8.0)
"""Size of the map, m."""
HALF_WIDTH: Final = 0.75
"""Half the width of the lane, m."""
WALL: Final = 0.15
"""Thickness of the walls along the lane, m."""
CURVATURE: Final = 1.0
"""Largest curvature of the centre line, 1/m."""
Points = NDArray[np.float64]


def track(rng: np.random.Generator, scale: float, name: str) -> tuple[dict[str, Any], dict[str, bytes], float]:
    """Sections of the scenario of a lap, the files of its map, and the lap's length (m).

    The start line is a wall, the goal is behind it. All lengths are multiplied by `scale`.
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
        inside = np.abs(line) < np.array(SIZE) / 2 - HALF_WIDTH - 2 * WALL
        if np.abs(curvature[5:-5]).max() < CURVATURE and inside.all() and _clear_of_itself(line):
            placed: Points = line + np.array(SIZE) / 2
            return placed


def _clear_of_itself(line: Points) -> bool:
    """Whether the lanes of two parts of the line are apart, so that a wall fits between them."""
    coarse = line[::6]
    apart = np.hypot(*(coarse[:, None] - coarse[None, :]).transpose(2, 0, 1))
    steps = np.abs(np.arange(len(coarse))[:, None] - np.arange(len(coarse))[None, :])
    length = np.hypot(*np.diff(coarse, axis=0).T).mean()
    far = np.minimum(steps, len(coarse) - steps) * length > 2.5 * (2 * HALF_WIDTH + WALL)
    return bool(apart[far].min() > 2 * HALF_WIDTH + WALL)


def _map(line: Points, scale: float, name: str) -> dict[str, bytes]:
    """Map of the walls along the lane: its image and its YAML file."""
    columns, rows = (round(size * scale / RESOLUTION) for size in SIZE)
    x, y = (np.arange(columns) + 0.5) * RESOLUTION, (np.arange(rows) + 0.5) * RESOLUTION
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    nearest = line[cKDTree(line).query(grid)[1]]
    distance = np.hypot(*(grid - nearest).transpose(2, 0, 1))
    wall = (distance >= HALF_WIDTH * scale) & (distance < HALF_WIDTH * scale + WALL)
    image = np.where(wall, 0, 254).astype(np.uint8)[::-1]  # the first row of an image is its top
    settings = (
        f"image: {name}.pgm\nresolution: {RESOLUTION}\norigin: [0.0, 0.0, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return {
        f"maps/{name}.pgm": f"P5\n{columns} {rows}\n255\n".encode() + image.tobytes(),
        f"maps/{name}.yaml": settings.encode(),
    }
