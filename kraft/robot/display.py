"""Messages for people: the map, the scene, plan and contingency, the planner's tree, the footprint."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from kraft.driving.messages import Cycle, Reference, ReferenceKind
from kraft.robot.messages import GRID, MARKERS, header, make, path, polygon, pose_fields, stamp
from kraft.scenario import Box, Circle, Obstacle, OccupancyMap, Task
from ompl_ext.arrays import Bools, Floats
from ompl_ext.plan import TreeView
from ompl_ext.poses import poses_of
from ompl_ext.vehicle import Vehicle

CELL: Final = 0.05
"""Side of a cell of the map, m; larger if the map would have more than CELLS_MAX cells."""
CELLS_MAX: Final = 4_000_000
"""Largest number of cells of the map."""
TREE_EDGES: Final = 1500
"""Largest number of edges of the tree that are sent."""
_CUBE, _CYLINDER, _LINES, _TEXT = 1, 3, 5, 9
"""Types of markers (visualization_msgs/Marker)."""
_GREY: Final = (0.35, 0.35, 0.4, 1.0)
_GREEN: Final = (0.1, 0.6, 0.3, 0.5)
_DARK: Final = (0.2, 0.2, 0.25, 0.4)
_WHITE: Final = (1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Frames:
    """Names of the frames of the map and of the vehicle's body."""

    map: str = "map"
    body: str = "base_link"


def occupancy_grid(task: Task, time: int, frame: str) -> Any:
    """OccupancyGrid of the obstacles within the bounds: cells that an obstacle touches are occupied."""
    (x0, x1), (y0, y1) = task.bounds.x, task.bounds.y
    cell = max(CELL, math.sqrt((x1 - x0) * (y1 - y0) / CELLS_MAX))
    columns, rows = max(1, math.ceil((x1 - x0) / cell)), max(1, math.ceil((y1 - y0) / cell))
    xs: Floats = x0 + cell * (np.arange(columns, dtype=float) + 0.5)
    ys: Floats = y0 + cell * (np.arange(rows, dtype=float) + 0.5)
    occupied = np.zeros((rows, columns), bool)
    for obstacle in task.obstacles:
        occupied |= _touched(obstacle, xs, ys, cell)
    info = {
        "map_load_time": stamp(time),
        "resolution": cell, "width": columns, "height": rows, "origin": pose_fields(x0, y0, 0.0),
    }  # fmt: skip
    return make(GRID, header=header(time, frame), info=info, data=np.where(occupied, 100, 0).astype(np.int8).ravel())


def _touched(obstacle: Obstacle, xs: Floats, ys: Floats, cell: float) -> Bools:
    """Cells [ny, nx] of side `cell` (m) and these centres that an obstacle touches: those within half a diagonal."""
    if isinstance(obstacle, OccupancyMap):
        return _under_map(obstacle, xs, ys, cell)
    x, y = np.meshgrid(xs, ys)
    reach = 0.5 * math.sqrt(2.0) * cell
    if isinstance(obstacle, Circle):
        near: Bools = np.hypot(x - obstacle.center[0], y - obstacle.center[1]) <= obstacle.radius + reach
        return near
    vertices = np.array(obstacle.corners if isinstance(obstacle, Box) else obstacle.vertices)
    inside, near = np.zeros(x.shape, bool), np.zeros(x.shape, bool)
    for (ax, ay), (bx, by) in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
        dx, dy = bx - ax, by - ay
        if dy != 0.0:
            inside ^= ((ay > y) != (by > y)) & (x < ax + dx * (y - ay) / dy)
        share = np.clip(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        near |= np.hypot(x - ax - share * dx, y - ay - share * dy) <= reach
    return inside | near


def _under_map(grid: OccupancyMap, xs: Floats, ys: Floats, cell: float) -> Bools:
    """Cells that the occupied ones of a map touch: its cells are cut into squares that touch up to four each."""
    x0, y0, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    touched = np.zeros((len(ys), len(xs)), bool)
    row, column = np.nonzero(grid.occupied)
    span = grid.resolution * (abs(c) + abs(s))  # of a cell along x and y
    parts = math.ceil(span / cell)
    half = (0.5 - 1e-6) * span / parts  # what ends at the border of a cell does not touch it
    for k, corner in itertools.product(range(parts * parts), itertools.product((-half, half), repeat=2)):
        u = (column + (k % parts + 0.5) / parts) * grid.resolution
        v = (row + (k // parts + 0.5) / parts) * grid.resolution
        i = np.floor((x0 + c * u - s * v + corner[0] - xs[0]) / cell + 0.5).astype(int)
        j = np.floor((y0 + s * u + c * v + corner[1] - ys[0]) / cell + 0.5).astype(int)
        inside = (i >= 0) & (i < len(xs)) & (j >= 0) & (j < len(ys))
        touched[j[inside], i[inside]] = True
    return touched


def scene_markers(task: Task, time: int, frame: str) -> Any:
    """MarkerArray of obstacles, except maps, and of the goal."""
    shapes = [shape for obstacle in task.obstacles for shape in _shape(obstacle)]
    (x, y), radius = task.goal.center, task.goal.radius
    shapes.append((_CYLINDER, (x, y, 0.0), (2 * radius, 2 * radius, 0.01), 0.01, _GREEN))
    markers = []
    for number, (kind, (x, y, yaw), size, height, colour) in enumerate(shapes):
        pose = pose_fields(x, y, yaw)
        pose["position"]["z"] = 0.5 * height
        markers.append(_marker(time, frame, "scene", number, kind, colour, pose=pose, scale=_vector(*size)))
    return make(MARKERS, markers=markers)


_Shape = tuple[int, tuple[float, float, float], tuple[float, float, float], float, tuple[float, float, float, float]]


def _shape(obstacle: Obstacle) -> Iterator[_Shape]:
    """Type, pose, size, height and colour of the markers of an obstacle; a polygon is drawn as its edges."""
    height = obstacle.height
    if isinstance(obstacle, Box):
        yield _CUBE, (*obstacle.center, obstacle.yaw), (*obstacle.size, height), height, _GREY
    elif isinstance(obstacle, Circle):
        size = 2 * obstacle.radius
        yield _CYLINDER, (*obstacle.center, 0.0), (size, size, height), height, _GREY
    elif not isinstance(obstacle, OccupancyMap):
        vertices = obstacle.vertices
        for (ax, ay), (bx, by) in zip(vertices, (*vertices[1:], vertices[0]), strict=True):
            middle, turn = (0.5 * (ax + bx), 0.5 * (ay + by)), math.atan2(by - ay, bx - ax)
            yield _CUBE, (*middle, turn), (math.hypot(bx - ax, by - ay), 0.02, height), height, _GREY


def cycle_markers(cycle: Cycle, vehicle: Vehicle, time: int, frame: str) -> Any:
    """MarkerArray of a cycle: what is committed, in words above the vehicle, and the tree if it is kept."""
    words = cycle.kind + (f": {cycle.reason}" if cycle.reason else "")
    x, y, _ = poses_of(cycle.predicted.states[:1], vehicle)[0].tolist()
    pose = pose_fields(x, y, 0.0)
    pose["position"]["z"] = 0.4
    markers = [_marker(time, frame, "state", 0, _TEXT, _WHITE, pose=pose, scale=_vector(0, 0, 0.12), text=words)]
    if cycle.tree is not None:
        markers.append(_tree(cycle.tree, vehicle, time, frame))
    return make(MARKERS, markers=markers)


def _tree(tree: TreeView, vehicle: Vehicle, time: int, frame: str) -> Any:
    """Lines from each node to its parent, of at most TREE_EDGES nodes."""
    nodes = np.flatnonzero(tree.parents >= 0)
    if len(nodes) > TREE_EDGES:
        nodes = nodes[np.linspace(0, len(nodes) - 1, TREE_EDGES).astype(int)]
    places = poses_of(tree.states, vehicle)[:, :2]
    ends = np.stack([places[tree.parents[nodes]], places[nodes]], axis=1).reshape(-1, 2)
    points = [{"x": x, "y": y, "z": 0.01} for x, y in ends.tolist()]
    return _marker(
        time,
        frame,
        "tree",
        0,
        _LINES,
        _DARK,
        pose=pose_fields(0.0, 0.0, 0.0),
        scale=_vector(0.005, 0, 0),
        points=points,
    )


def _marker(
    time: int, frame: str, name: str, number: int, kind: int, colour: tuple[float, float, float, float], **fields: Any
) -> Any:
    r, g, b, a = colour
    return {
        "header": header(time, frame), "ns": name, "id": number, "type": kind,
        "color": {"r": r, "g": g, "b": b, "a": a}, **fields,
    }  # fmt: skip


def _vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def reference_path(reference: Reference, vehicle: Vehicle, time: int, epoch: int, frame: str) -> Any:
    """Path of a reference; `epoch` (ns) is time 0 of the reference's times."""
    times = [epoch + round(1e9 * t) for t in reference.times.tolist()]
    return path(time, frame, times, poses_of(reference.states, vehicle))


def cycle_messages(cycle: Cycle, vehicle: Vehicle, time: int, epoch: int, frames: Frames) -> Iterator[tuple[str, Any]]:
    """Topics and messages of a cycle at `time` (ns): plan, contingency, footprint, markers.

    A path without poses says that there is none: in a cycle with a contingency there is no plan.
    """
    is_plan = cycle.reference.kind is ReferenceKind.PLAN
    nothing = path(time, frames.map, [], np.zeros((0, 3)))
    plan = reference_path(cycle.reference, vehicle, time, epoch, frames.map) if is_plan else nothing
    stop = cycle.contingency
    yield "plan", plan
    yield "contingency", nothing if stop is None else reference_path(stop, vehicle, time, epoch, frames.map)
    yield "footprint", polygon(time, frames.body, vehicle.footprint.corners())
    yield "markers", cycle_markers(cycle, vehicle, time, frames.map)
