"""Floor plan of a scenario: what the planner knows, what only the truth contains, and the number of collisions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Final
from xml.etree.ElementTree import Element

import numpy as np

from kraft.evaluation.report.elements import Content, element, number, svg
from kraft.scenario import Box, Circle, Goal, Obstacle, OccupancyMap, Polygon, Scenario, Start, Truth
from kraft.scenario.truth import Tilt
from kraft.text import counted

LONGEST, WIDEST = 330.0, 200.0  # px
MARGIN: Final = 0.03  # of the longer side
CELLS_MAX: Final = 300  # cells of a map along its longer side; cells of finer maps are merged


def floor_plan(scenario: Scenario, hits: Mapping[str, int]) -> Element:
    """Draw a scenario with x to the right and y up.

    Args:
        scenario: the scenario.
        hits: number of collisions by obstacle; an obstacle is drawn in a deeper red the more it has.
    """
    (x0, x1), (y0, y1) = scenario.bounds.x, scenario.bounds.y
    margin = MARGIN * max(x1 - x0, y1 - y0)
    width, height = x1 - x0 + 2 * margin, y1 - y0 + 2 * margin
    scale = min(WIDEST / width, LONGEST / height)
    most = max(hits.values(), default=1)
    things: list[Content] = [
        element("rect", class_="free", x=x0, y=y0, width=x1 - x0, height=y1 - y0),
        *_truth(scenario.truth),
        *(_obstacle(obstacle, hits.get(obstacle.name or "", 0), most) for obstacle in scenario.obstacles),
        _goal(scenario.goal),
        _start(scenario.start, 0.02 * LONGEST / scale),
        _uphill(scenario.truth.tilt, ((x0 + x1) / 2, (y0 + y1) / 2), 0.12 * LONGEST / scale),
    ]
    # one unit is a metre inside this group, and y grows upwards
    place = f"scale({scale:.6g}) translate({number(margin - x0)} {number(margin + y1)}) scale(1 -1)"
    look = "floor landscape" if width > height else "floor"
    return svg(width * scale, height * scale, element("g", *things, transform=place), class_=look)


def _truth(truth: Truth) -> Iterator[Element]:
    for patch in truth.friction_patches:
        (x0, x1), (y0, y1) = patch.x, patch.y
        slippery = element("title", f"friction {patch.friction:g}")
        yield element("rect", slippery, class_="slippery", x=x0, y=y0, width=x1 - x0, height=y1 - y0)
    for bump in truth.speed_bumps:
        title = f"bump, {100 * bump.height:g} cm"
        yield _polygon(Box(bump.center, bump.size, bump.yaw).corners, "bump", title)
    for box in truth.movable_boxes:
        title = f"can be pushed, {box.mass:g} kg"
        yield _polygon(Box(box.center, box.size[:2], box.yaw).corners, "movable", title)


def _obstacle(obstacle: Obstacle, hits: int, most: int) -> Element:
    title = f"{obstacle.name or 'obstacle'}: {counted(hits, 'collision')}"
    if isinstance(obstacle, OccupancyMap):
        found = _cells(obstacle, title)
    elif isinstance(obstacle, Circle):
        (x, y), r = obstacle.center, obstacle.radius
        found = element("circle", element("title", title), class_="obstacle", cx=x, cy=y, r=r)
    else:
        vertices = obstacle.vertices if isinstance(obstacle, Polygon) else obstacle.corners
        found = _polygon(vertices, "obstacle", title)
    if hits:
        found.set("class", "obstacle hit")
        found.set("style", f"fill-opacity: {0.25 + 0.75 * hits / most:.2f}")
    return found


def _polygon(vertices: tuple[tuple[float, float], ...], look: str, title: str) -> Element:
    points = " ".join(f"{x:.4g},{y:.4g}" for x, y in vertices)
    return element("polygon", element("title", title), class_=look, points=points)


def _cells(cells: OccupancyMap, title: str) -> Element:
    """Occupied cells of a map as one path, with a rectangle for each run of cells in a row."""
    occupied, side = cells.occupied, cells.resolution
    merged = max(1, math.ceil(max(occupied.shape) / CELLS_MAX))
    if merged > 1:  # a merged cell is occupied if any of its cells is
        padded = np.pad(occupied, [(0, -size % merged) for size in occupied.shape])
        rows, columns = (size // merged for size in padded.shape)
        occupied = np.asarray(padded.reshape(rows, merged, columns, merged).any(axis=(1, 3)))
        side *= merged
    edges = np.diff(np.pad(occupied.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    begins, ends = np.argwhere(edges == 1), np.argwhere(edges == -1)
    runs = [
        f"M{column * side:.4g} {row * side:.4g}h{(end - column) * side:.4g}v{side:.4g}h{(column - end) * side:.4g}z"
        for (row, column), (_, end) in zip(begins, ends, strict=True)
    ]
    x, y, yaw = cells.origin
    place = f"translate({x:.6g} {y:.6g}) rotate({math.degrees(yaw):.6g})"
    return element("path", element("title", title), class_="obstacle cells", d="".join(runs), transform=place)


def _goal(goal: Goal) -> Element:
    x, y = goal.center
    return element("circle", element("title", "goal"), class_="goal", cx=x, cy=y, r=goal.radius)


def _start(start: Start, size: float) -> Element:
    """Arrowhead of length `size` (m) at the start, along its heading."""
    shape = f"{number(size)},0 {number(-size)},{number(0.7 * size)} {number(-size)},{number(-0.7 * size)}"
    place = f"translate({start.x:.6g} {start.y:.6g}) rotate({math.degrees(start.heading):.6g})"
    return element("polygon", element("title", "start"), class_="start", points=shape, transform=place)


def _uphill(tilt: Tilt | None, middle: tuple[float, float], length: float) -> Element | None:
    """Arrow that points uphill; None on a level floor."""
    if tilt is None:
        return None
    half, head = length / 2, length / 5
    tip = f"L{number(half)} 0"
    path = f"M{number(-half)} 0{tip}l{number(-head)} {number(head)}{tip}l{number(-head)} {number(-head)}"
    place = f"translate({middle[0]:.6g} {middle[1]:.6g}) rotate({math.degrees(tilt.uphill):.6g})"
    title = f"uphill, {math.degrees(tilt.slope):.3g} degrees"
    return element("path", element("title", title), class_="uphill", d=path, transform=place)
