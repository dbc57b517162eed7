"""Maps of a robot: received by a process of their own, checked, and taken by the controller."""

from __future__ import annotations

import math
import time
from multiprocessing import Pipe
from typing import Any

import numpy as np
import pytest

from kraft.robot.inputs import Inputs
from kraft.robot.loopback import LoopbackBus
from kraft.robot.maps import MAP, has_news_of, receive_maps
from kraft.robot.messages import GRID, POSE, from_json, header, make, pose_fields
from kraft.robot.protocol import Mailbox, MapNews
from kraft.robot.robot_file import Robot
from kraft.robot.task_inputs import TaskInputs
from kraft.scenario import OccupancyMap, load_scenario
from ompl_ext.obstacles import Polygon

TASK = load_scenario("turns").task()
CELLS = [0, 100, -1, 0, 0, 0]


def robot() -> Robot:
    return Robot.model_validate(
        {"name": "test", "transport": {"kind": "loopback"}, "pose": {"topic": "/pose", "type": POSE},
         "command": {"topic": "/drive"}, "goal": {"topic": "/goal"}, "map": {"topic": "/map"}}
    )  # fmt: skip


def grid(frame: str = "map", data: list[int] | None = None, **changed: Any) -> Any:
    (x0, _), (y0, _) = TASK.bounds.x, TASK.bounds.y
    info = {"resolution": 0.5, "width": 3, "height": 2, "origin": pose_fields(x0, y0, 0.0), **changed}
    return make(GRID, header=header(1, frame), info=info, data=CELLS if data is None else data)


def test_neither_controller_nor_guard_subscribes_to_the_map() -> None:
    """A large one would hold up all of their threads."""
    bus = LoopbackBus()
    Inputs(robot(), bus.node("guard"))
    TaskInputs(robot(), bus.node("controller"), None)
    assert not bus.receivers["/map"]
    assert bus.receivers["/pose"]
    assert [node.name for node, _ in bus.receivers["/goal"]] == ["controller"]


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (grid("odom"), "it is in the frame 'odom', expected 'map'"),
        (grid(data=[0, 0]), "its data are 2 cells"),
        (grid(width=-3, height=-2), "its data are 6 cells"),
        (grid(resolution=0.004), "expected cells of at least 0.005 m"),
        (grid(resolution=math.nan), "expected cells of at least 0.005 m"),
        (grid(origin=pose_fields(math.nan, 0.0, 0.0)), "its origin is no pose"),
        (grid(origin=pose_fields(1.7e308, 0.0, 0.0)), "cannot be used"),
    ],
)
def test_a_map_that_cannot_be_used_is_told_with_the_reason(message: Any, why: str) -> None:
    bus, told = LoopbackBus(), list[MapNews]()
    receive_maps(robot(), TASK, bus.node("maps"), told.append)
    bus.node("robot").publish("/map", message)
    (news,) = told
    assert news.map is None
    assert why in news.problem


def test_a_map_is_handed_over_once_however_often_it_is_sent() -> None:
    bus, told = LoopbackBus(), list[MapNews]()
    receive_maps(robot(), TASK, bus.node("maps"), told.append)
    for message in (grid(), grid("odom"), grid(), grid(data=[0] * 6)):
        bus.node("robot").publish("/map", message)
    assert [(news.map is None, bool(news.problem)) for news in told] == [
        (False, False), (True, True), (True, False), (False, False),
    ]  # fmt: skip
    assert told[0].map is not None
    np.testing.assert_array_equal(told[0].map.occupied, [[False, True, True], [False, False, False]])


def test_the_controller_takes_a_new_map_and_knows_when_the_last_one_cannot_be_used() -> None:
    ours, theirs = Pipe()
    tasks = TaskInputs(robot(), LoopbackBus().node("kraft"), Mailbox(ours, "the maps"))
    bus = LoopbackBus()
    receive_maps(robot(), TASK, bus.node("maps"), theirs.send)

    def until(trouble: bool) -> None:
        end = time.monotonic() + 5.0
        while (tasks.awaits_map or bool(tasks.trouble) != trouble) and time.monotonic() < end:
            time.sleep(0.001)

    assert tasks.map_check("/map").state == "warning"
    bus.node("robot").publish("/map", grid())
    until(False)
    assert tasks.map_check("/map").state == "ok"
    assert tasks.take_map() is not None
    assert tasks.take_map() is None
    bus.node("robot").publish("/map", grid("odom"))
    until(True)
    assert "the map of 3 x 2 cells of 0.5 m cannot be used" in tasks.trouble
    bus.node("robot").publish("/map", grid())
    until(False)
    assert not tasks.trouble
    theirs.close()
    until(True)
    assert tasks.trouble == "the process that receives maps has ended"


def floor(*occupied: tuple[float, float], yaw: float = 0.0) -> OccupancyMap:
    """A floor of 4 m x 4 m around the origin, with occupied cells of 5 cm at the places (m)."""
    c, s = math.cos(yaw), math.sin(yaw)
    found = np.zeros((80, 80), dtype=bool)
    for place in occupied:
        column, row = np.floor((np.array([[c, s], [-s, c]]) @ place + 2.0) / 0.05).astype(int)
        found[row, column] = True
    return OccupancyMap(found, 0.05, (-2.0 * (c - s), -2.0 * (s + c), yaw), name=MAP)


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_a_map_has_news_of_a_place_only_where_it_differs_there(yaw: float) -> None:
    doorstep = Polygon(((0.4, -0.1), (0.6, -0.1), (0.6, 0.1), (0.4, 0.1)))
    box = [(x, y) for x in np.arange(0.4, 0.6, 0.02) for y in np.arange(-0.1, 0.1, 0.02)]
    empty, elsewhere, seen = floor(yaw=yaw), floor((-1.0, 1.0), (1.0, 0.5), yaw=yaw), floor(*box, yaw=yaw)
    assert not has_news_of(doorstep, empty, floor())
    assert not has_news_of(doorstep, empty, elsewhere)
    assert not has_news_of(doorstep, empty, floor((0.5, 0.1), yaw=yaw)), "one cell comes and goes"
    assert has_news_of(doorstep, empty, seen)
    assert has_news_of(doorstep, seen, elsewhere)
    assert has_news_of(doorstep, None, empty)


def test_lists_of_numbers_in_json_are_arrays_and_other_things_are_refused() -> None:
    found = from_json({"info": {"width": 2, "height": 1}, "data": [0, -1]}, GRID)
    assert found.data.dtype == np.int8
    np.testing.assert_array_equal(found.data, [0, -1])
    covariance = [None, *[0.5] * 35]
    pose = from_json({"pose": {"covariance": covariance}}, "geometry_msgs/msg/PoseWithCovarianceStamped")
    np.testing.assert_array_equal(pose.pose.covariance, [math.nan, *[0.5] * 35])
    for wrong in ([300], [None], ["x"], 5, None):
        with pytest.raises(ValueError, match=r"."):
            from_json({"data": wrong}, GRID)
