"""The process that receives a robot's maps, so that a large one holds up no process that sends commands.

To read a map of millions of cells takes seconds, in which no other thread of a process runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any, Final

import numpy as np

from kraft.errors import KraftError
from kraft.robot.connect import open_transport
from kraft.robot.messages import GRID, yaw_of
from kraft.robot.priority import leave_signals_to_planner, name_this_process
from kraft.robot.protocol import DriveSpec, Mailbox, MapLink, MapNews
from kraft.robot.robot_file import Robot
from kraft.robot.transport import Transport
from kraft.scenario import OccupancyMap, Task
from ompl_ext.obstacles import Polygon

MAP: Final = "map"
"""Name of the obstacle that is the robot's map."""
OCCUPIED: Final = 50
"""Occupancy in percent from which on a cell of a map is occupied; unknown cells are occupied too."""
RESOLUTION_MIN: Final = 0.005
"""Least side of a cell of a map, m."""
AROUND: Final = 1.0
"""Distance from the bounds up to which a map of the robot is used, m."""
BETWEEN: Final = 0.03
"""Distance between two points at which two maps are compared, m."""
NEWS: Final = 0.15
"""Share of them that differs where a map has news; cells at the border of an obstacle come and go."""
LOOK: Final = 0.2
"""Time between two looks at whether the robot is connected, s."""


def run_maps(spec: DriveSpec, connection: Connection, others: Sequence[Connection]) -> None:
    """Main function of the process, until the controller has ended; `others` are ends that it does not need."""
    for each in others:
        each.close()
    leave_signals_to_planner()
    name_this_process("kraft map")
    mailbox = Mailbox(connection, "the controller")
    try:
        transport = open_transport(spec.robot)
    except KraftError as error:
        mailbox.send(MapLink(str(error))).wait(LOOK)
        return
    try:
        receive_maps(spec.robot, spec.task, transport, mailbox.send)
        reported = ""
        while not mailbox.closed:
            mailbox.wait(LOOK)  # nothing but the end of the controller
            if transport.problem != reported:
                reported = transport.problem
                mailbox.send(MapLink(reported))
    finally:
        transport.close()


def receive_maps(robot: Robot, task: Task, transport: Transport, tell: Callable[[MapNews], Any]) -> None:
    """Subscribe to the maps of a robot; `tell` is called with each of them, from a thread of the transport."""
    assert robot.map is not None, "only then there are maps"
    newest: list[OccupancyMap] = []

    def take(message: Any, _: int) -> None:
        info, frame = message.info, message.header.frame_id.lstrip("/")
        size = f"{info.width} x {info.height} cells of {info.resolution:g} m"
        try:
            if frame != robot.pose.frame:
                raise ValueError(f"it is in the frame {frame!r}, expected {robot.pose.frame!r}")
            found = near_bounds(occupancy_map(message), task)
        except (ValueError, OverflowError) as error:
            tell(MapNews(None, size, f"the map of {size} cannot be used: {error}"))
            return
        is_new = newest != [found]
        newest[:] = [found]
        tell(MapNews(found if is_new else None, size))

    def refuse(why: str) -> None:
        assert robot.map is not None, "it is subscribed because of it"
        tell(MapNews(None, "", f"a message on {robot.map.topic} cannot be used as a map: it {why}"))

    transport.subscribe(robot.map.topic, GRID, take, latched=True, refused=refuse)


def with_map(task: Task, grid: OccupancyMap | None) -> Task:
    """Task with a new map instead of the last one of the same name; the same task without a map."""
    if grid is None:
        return task
    kept = tuple(each for each in task.obstacles if each.name != grid.name)
    return replace(task, obstacles=(*kept, near_bounds(grid, task)))


def map_of(task: Task) -> OccupancyMap | None:
    """The robot's map of a task with one, see `with_map`."""
    maps = (each for each in task.obstacles if isinstance(each, OccupancyMap) and each.name == MAP)
    return next(maps, None)


def near_bounds(grid: OccupancyMap, task: Task) -> OccupancyMap:
    """Part of a map that is used, up to AROUND outside the bounds of a task: it may be that of a building."""
    (x0, x1), (y0, y1) = task.bounds.x, task.bounds.y
    return grid.cropped((x0 - AROUND, x1 + AROUND), (y0 - AROUND, y1 + AROUND))


def has_news_of(obstacle: Polygon, before: OccupancyMap | None, now: OccupancyMap) -> bool:
    """Whether a map tells something else than the last one about the place of an obstacle, or is the first one."""
    if before is None:
        return True
    low, high = np.min(obstacle.vertices, axis=0), np.max(obstacle.vertices, axis=0)
    x, y = (np.arange(a, b + BETWEEN, BETWEEN) for a, b in zip(low, high, strict=True))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    differs = before.occupied_at(points) != now.occupied_at(points)
    return bool(differs.mean() > NEWS)


def occupancy_map(message: Any) -> OccupancyMap:
    """Obstacle from an OccupancyGrid, unknown cells occupied.

    Raises:
        ValueError: with the reason if it cannot be used.
    """
    info = message.info
    origin = info.origin.position.x, info.origin.position.y, yaw_of(info.origin.orientation)
    cells = np.asarray(message.data, dtype=np.int8)
    if min(info.width, info.height) < 1 or cells.shape != (info.width * info.height,):
        raise ValueError(f"its data are {cells.size} cells")
    if not info.resolution >= RESOLUTION_MIN:  # NaN is none either
        raise ValueError(f"expected cells of at least {RESOLUTION_MIN:g} m")
    if not np.isfinite([*origin, info.resolution]).all():
        raise ValueError("its origin is no pose: ({:g}, {:g}) m, {:g} rad".format(*origin))
    occupied = (cells >= OCCUPIED) | (cells < 0)
    grid = occupied.reshape(int(info.height), int(info.width))
    grid.setflags(write=False)
    return OccupancyMap(grid, float(info.resolution), origin, name=MAP)
