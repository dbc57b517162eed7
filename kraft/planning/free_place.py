"""How deep a vehicle is in what it collides with, and where near it there is room: what to say of a bad start."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, TypeAlias

from kraft.planning.workspace import planar_obstacle, workspace_of
from kraft.scenario import Task
from ompl_ext.exact import ExactClearance
from ompl_ext.obstacles import Workspace
from ompl_ext.vehicle import Footprint, Vehicle

Pose: TypeAlias = tuple[float, float, float]

DIRECTIONS: Final = 72
"""Directions that a vehicle is moved in: out of a straight wall the best is at most 0.1 % longer than the shortest."""
FIRST: Final = 0.01
"""First distance that it is moved by, m."""
GROWTH: Final = 1.1
"""Factor from each of these distances to the next, to which `FIRST` is added."""
HALVINGS: Final = 12
"""Number of halvings that find where it gets free between two of these distances."""
ROOM: Final = 0.2
"""Room around a place that is suggested, as a share of the width: the planner needs some."""


def overlap(task: Task, vehicle: Vehicle, pose: Pose, number: int) -> float | None:
    """Shortest way (m) of the vehicle at a pose out of an obstacle; None if it is longer than the bounds.

    The obstacle is taken alone, and the vehicle keeps its heading.
    """
    x, y, heading = pose
    bounds, obstacle = (task.bounds.x, task.bounds.y), planar_obstacle(task.obstacles[number])
    alone = ExactClearance(Workspace(bounds, (obstacle,)), vehicle.footprint)
    found = _nearest(lambda u, v: not alone.collides(u, v, heading), x, y, _across(task) + vehicle.footprint.reach)
    return None if found is None else math.dist(found, (x, y))


def free_place(task: Task, vehicle: Vehicle, pose: Pose) -> tuple[float, float] | None:
    """Point (m) near a pose where the vehicle with this heading has some room, in the bounds; None if there is none."""
    x, y, heading = pose
    shape, room = vehicle.footprint, 2 * ROOM * vehicle.footprint.width
    larger = Footprint(shape.length + room, shape.width + room, shape.offset)
    exact = ExactClearance(workspace_of(task, vehicle), larger)

    def free(u: float, v: float) -> bool:
        return not task.bounds.outside(u, v) and not exact.collides(u, v, heading)

    return _nearest(free, x, y, _across(task))


def beyond_bounds(task: Task, footprint: Footprint, pose: Pose) -> str:
    """How far the footprint reaches beyond sides of the bounds: ``0.1 m beyond x = 0``; empty if it is inside."""
    x, y, heading = pose
    c, s = math.cos(heading), math.sin(heading)
    ends, half = [footprint.offset + side * footprint.length / 2 for side in (-1, 1)], footprint.width / 2
    corners = [(x + c * along - s * across, y + s * along + c * across) for along in ends for across in (-half, half)]
    said = []
    for axis, (low, high), values in zip("xy", (task.bounds.x, task.bounds.y), zip(*corners, strict=True), strict=True):
        sides = ((low - min(values), low), (max(values) - high, high))
        said += [f"{amount:.2g} m beyond {axis} = {side:g}" for amount, side in sides if amount > 0.0]
    return " and ".join(said)


def fits(task: Task, footprint: Footprint) -> bool:
    """Whether the footprint is inside the bounds at any pose (Carver 1957, Rectangles in rectangles)."""
    (x0, x1), (y0, y1) = task.bounds.x, task.bounds.y
    b, a = sorted((x1 - x0, y1 - y0))
    q, p = sorted((footprint.length, footprint.width))
    if p <= a:
        return q <= b
    needed = (2 * p * q * a + (p * p - q * q) * math.sqrt(p * p + q * q - a * a)) / (p * p + q * q)
    return q <= b and needed <= b


def _across(task: Task) -> float:
    """Diagonal of the bounds, m."""
    return math.dist((task.bounds.x[0], task.bounds.y[0]), (task.bounds.x[1], task.bounds.y[1]))


def _nearest(free: Callable[[float, float], bool], x: float, y: float, most: float) -> tuple[float, float] | None:
    """Nearest free point around (x, y) that is up to `most` away, in the first ring of points that has a free one."""
    inner, outer = 0.0, FIRST
    ways = [(math.cos(turn), math.sin(turn)) for turn in (2 * math.pi * k / DIRECTIONS for k in range(DIRECTIONS))]
    while inner < most:
        found = [_edge(free, x, y, way, inner, outer) for way in ways if free(x + outer * way[0], y + outer * way[1])]
        if found:
            return min(found, key=lambda point: math.dist(point, (x, y)))
        inner, outer = outer, GROWTH * outer + FIRST
    return None


def _edge(
    free: Callable[[float, float], bool], x: float, y: float, way: tuple[float, float], inner: float, outer: float
) -> tuple[float, float]:
    """Free point on a way from (x, y), next to where it gets free between two distances, of which `outer` is free."""
    for _ in range(HALVINGS):
        middle = (inner + outer) / 2
        if free(x + middle * way[0], y + middle * way[1]):
            outer = middle
        else:
            inner = middle
    return x + outer * way[0], y + outer * way[1]
