"""The check list finds what prevents a drive before anything moves."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import Pipe
from typing import Any

import numpy as np
import pytest

from kraft.driving.method import load_method
from kraft.robot import checklist
from kraft.robot.checklist import Checklist, _check_goal, _check_model, _check_point
from kraft.robot.inputs import Inputs
from kraft.robot.loopback import LoopbackBus, LoopbackNode
from kraft.robot.maps import receive_maps, with_map
from kraft.robot.messages import ACKERMANN, BOOL, GRID, JOY, POSE, header, make, pose_fields
from kraft.robot.protocol import Check, Checked, DriveSpec, Mailbox, NewGoal
from kraft.robot.robot_file import Robot, load_robot
from kraft.robot.task_inputs import TaskInputs
from kraft.scenario import OccupancyMap, load_scenario
from kraft.vehicles.load import load_vehicle

POSE_INPUT = {"topic": "/pose", "type": POSE}
START = (1.0, -0.5, 1.5708)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checklist, "LISTENING", 0.4)
    monkeypatch.setattr(checklist, "WAITING", 1.2)


def robot(**changed: Any) -> Robot:
    content = {"name": "r", "transport": {"kind": "loopback"}, "pose": POSE_INPUT, "command": {"topic": "/drive"}}
    return Robot.model_validate({**content, **changed})


@contextmanager
def sending(send: Callable[[LoopbackNode], None], bus: LoopbackBus) -> Iterator[LoopbackNode]:
    """A robot that sends 30 times a second and listens to commands."""
    node, stop = bus.node("robot"), threading.Event()
    node.advertise("/pose", POSE)
    node.subscribe("/drive", ACKERMANN, lambda *_: None)

    def run() -> None:
        while not stop.wait(1 / 30):
            send(node)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield node
    finally:
        stop.set()
        thread.join()


def poses(
    x: float = START[0], y: float = START[1], theta: float = START[2], frame: str = "map", off: float = 0.0
) -> Callable[[LoopbackNode], None]:
    def send(node: LoopbackNode) -> None:
        stamp = time.time_ns() + round(1e9 * off)
        node.publish("/pose", make(POSE, header=header(stamp, frame), pose=pose_fields(x, y, theta)))

    return send


def checked(send: Callable[[LoopbackNode], None], described: Robot | None = None, others: bool = False) -> Checked:
    described = described or robot()
    spec = DriveSpec(
        load_scenario("boxes").task(), load_method("adaptive-kraft"), load_vehicle("mushr"), described, timeout=60.0
    )
    bus = LoopbackBus()
    if others:
        bus.node("joystick").advertise("/drive", ACKERMANN)
    here = bus.node("kraft")
    with sending(send, bus):
        return checklist_of(described, here, spec).run(spec, lambda: False, lambda _: None)


def checklist_of(described: Robot, here: LoopbackNode, spec: DriveSpec) -> Checklist:
    """Check list as the controller has it; maps are received in this process."""
    ours, theirs = Pipe()
    if described.map is not None:
        receive_maps(described, spec.task, here, theirs.send)
    tasks = TaskInputs(described, here, None if described.map is None else Mailbox(ours, "the maps"))
    return Checklist(described, here, Inputs(described, here), tasks)


def states(found: Checked) -> dict[str, str]:
    return {check.name: check.state for check in found.checks}


def test_a_robot_that_stands_at_the_start_passes() -> None:
    found = checked(poses())
    assert found.passed, found.checks
    assert found.pose == pytest.approx(START, abs=1e-6)
    assert {"poses", "start", "clock", "commands", "dead man", "model", "priority"} == set(states(found))


@pytest.mark.parametrize(
    ("send", "name", "words"),
    [
        (lambda _: None, "poses", "silent"),
        (poses(frame="odom"), "poses", "'odom'"),
        (poses(x=float("nan")), "poses", "no numbers"),
        (poses(x=1003.0, y=-498.0), "start", "millimetres"),
        (poses(y=1.8), "start", "2.30 m"),
        (poses(theta=-1.5), "start", "deg from the start"),
        (poses(theta=START[2] + 1.5708), "start", "90 deg from the start of boxes; if it stands as the scenario says"),
        (poses(off=5.0), "clock", "-5.0"),
        (poses(off=-5.0), "clock", "5.0"),
    ],
)
def test_what_prevents_a_drive_is_found(send: Callable[[LoopbackNode], None], name: str, words: str) -> None:
    found = checked(send)
    assert not found.passed
    (problem,) = [check for check in found.checks if check.state == "problem"]
    assert problem.name == name
    assert words in problem.detail


def test_an_orientation_in_degrees_is_no_rotation() -> None:
    def send(node: LoopbackNode) -> None:
        pose = {"position": {"x": 1.0, "y": -0.5}, "orientation": {"z": 90.0}}
        node.publish("/pose", make(POSE, header=header(time.time_ns(), "map"), pose=pose))

    assert states(checked(send))["poses"] == "problem"


def test_a_robot_that_moves_is_found() -> None:
    places = iter(range(1000))

    def send(node: LoopbackNode) -> None:
        poses(y=-0.5 + 0.03 * next(places))(node)

    found = checked(send)
    assert states(found)["standstill"] == "problem"


def test_two_poses_with_large_errors_are_no_motion() -> None:
    places = itertools.chain([-0.7], itertools.repeat(-0.5, 20), [-0.3], itertools.repeat(-0.5))

    def send(node: LoopbackNode) -> None:
        poses(y=next(places))(node)

    assert "standstill" not in states(checked(send))


def test_slow_poses_and_a_missing_dead_man_are_warnings() -> None:
    found = checked(poses(), robot(pose={**POSE_INPUT, "rate_hz": 100.0}))
    assert found.passed
    assert states(found)["poses"] == states(found)["dead man"] == "warning"


def test_the_check_list_shows_the_size_that_is_kept_free() -> None:
    """A vehicle file that is identified from a bag has the footprint of another car until somebody writes the right one."""
    for is_simulated in (True, False):
        assert "0.58 m long and 0.31 m wide" in _check_model(load_vehicle("f1tenth"), is_simulated=is_simulated).detail


def test_a_tracked_point_beside_a_model_of_the_tracked_point_is_warned_of() -> None:
    """The pose of `kraft.vehicles.car`, and with it the footprint, would be moved from where the logs have it."""
    rear = robot(pose={**POSE_INPUT, "tracked_point": {"x": -0.17}})
    (warning,) = _check_point(load_vehicle("car"), rear)
    assert warning.state == "warning"
    assert "moved by 0.17 m" in warning.detail
    assert not _check_point(load_vehicle("car"), robot())
    assert not _check_point(load_vehicle("mushr"), rear)
    assert not _check_point(load_vehicle("car"), rear.model_copy(update={"simulated": True}))


def test_a_heading_that_is_turned_is_no_matter_of_units_at_the_origin() -> None:
    """There a position is the same in all of them."""
    scenario = load_scenario("boxes", {"start": {"x": 0.0, "y": 0.0, "heading_deg": 0.0}})
    spec = DriveSpec(scenario.task(), load_method("adaptive-kraft"), load_vehicle("mushr"), robot(), timeout=60.0)
    bus = LoopbackBus()
    here = bus.node("kraft")
    with sending(poses(x=0.02, y=0.01, theta=1.5708), bus):
        found = checklist_of(spec.robot, here, spec).run(spec, lambda: False, lambda _: None)
    (check,) = (each for each in found.checks if each.name == "start")
    assert check.state == "problem"
    assert "millimetres" not in check.detail
    assert "pose.tracked_point.heading_deg" in check.detail


def test_of_a_simulated_robot_neither_a_dead_man_nor_an_identified_model_is_expected() -> None:
    found = checked(poses(), robot(simulated=True))
    assert states(found)["dead man"] == "ok"
    assert [_check_model(load_vehicle("benchmark"), is_simulated=known).state for known in (True, False)] == [
        "ok",
        "warning",
    ]
    assert load_robot("sim").simulated
    assert not load_robot("f1tenth").simulated


def test_somebody_else_who_publishes_commands_is_found() -> None:
    found = checked(poses(), others=True)
    assert states(found)["commands"] == "problem"


def test_a_publisher_that_leaves_is_waited_for_with_one_line() -> None:
    spec = DriveSpec(
        load_scenario("boxes").task(), load_method("adaptive-kraft"), load_vehicle("mushr"), robot(), timeout=60.0
    )
    bus, waits = LoopbackBus(), list[Check]()
    earlier, here = bus.node("earlier drive"), bus.node("kraft")
    earlier.advertise("/drive", ACKERMANN)

    def leave_soon(check: Check) -> None:
        waits.append(check)
        threading.Timer(0.3, earlier.close).start()

    with sending(poses(), bus):
        found = checklist_of(robot(), here, spec).run(spec, lambda: False, leave_soon)
    assert found.passed, found.checks
    assert [(check.name, check.state) for check in waits] == [("commands", "waiting")]
    assert "earlier drive" in waits[0].detail


def test_commands_that_nobody_hears_are_found() -> None:
    described = robot(command={"topic": "/other"})
    assert states(checked(poses(), described))["commands"] == "problem"


@pytest.mark.parametrize(("held", "state"), [(True, "ok"), (False, "problem"), (None, "problem")])
@pytest.mark.parametrize("kind", [BOOL, JOY])
def test_the_dead_man_must_be_held(held: bool | None, state: str, kind: str) -> None:
    switch: dict[str, Any] = {"topic": "/switch", "type": kind}
    if kind == JOY:
        switch["button"] = 2

    def send(node: LoopbackNode) -> None:
        poses()(node)
        if held is not None:
            content = {"data": held} if kind == BOOL else {"buttons": [0, 0, int(held)]}
            node.publish("/switch", make(kind, **content))

    assert states(checked(send, robot(dead_man=switch)))["dead man"] == state


def test_a_dead_man_that_falls_silent_counts_as_released() -> None:
    described = robot(dead_man={"topic": "/switch", "type": BOOL, "timeout": 0.1})
    bus = LoopbackBus()
    inputs, node = Inputs(described, bus.node("kraft")), bus.node("robot")
    node.publish("/switch", make(BOOL, data=True))
    assert inputs.trouble == ""
    time.sleep(0.15)
    assert "silent" in inputs.trouble


@pytest.mark.parametrize(("frame", "state"), [("map", "ok"), ("odom", "problem"), (None, "warning")])
def test_the_map_of_the_robot_is_part_of_the_check(frame: str | None, state: str) -> None:
    def send(node: LoopbackNode) -> None:
        poses()(node)
        if frame is not None:
            info = {"resolution": 0.1, "width": 2, "height": 2, "origin": pose_fields(0, 0, 0)}
            node.publish("/map", make(GRID, header=header(1, frame), info=info, data=[0, 0, 100, -1]))

    found = checked(send, robot(map={"topic": "/map"}))
    assert states(found)["map"] == state
    assert (found.map is not None) == (state == "ok")


@pytest.mark.parametrize(
    ("x", "cells", "words"),
    [(START[0], [0, 0], None), (START[0], [0, 100], "is in collision with 'map'"), (-9.0, [0, 0], "is out of bounds")],
)
def test_a_car_that_stands_in_an_obstacle_of_its_map_or_outside_of_the_bounds_is_warned_of(
    x: float, cells: list[int], words: str | None
) -> None:
    def send(node: LoopbackNode) -> None:
        poses(x)(node)
        info = {"resolution": 0.1, "width": 2, "height": 1, "origin": pose_fields(START[0] - 0.1, START[1], 0)}
        node.publish("/map", make(GRID, header=header(1, "map"), info=info, data=cells))

    found = checked(send, robot(map={"topic": "/map"}))
    (place,) = [check for check in found.checks if check.name == "place"] or [None]
    assert (place is None) == (words is None)
    if place is not None and words is not None:
        assert place.state == "warning"
        assert words in place.detail


def test_a_goal_in_another_frame_is_not_taken_and_the_reason_is_told() -> None:
    bus, described = LoopbackBus(), robot(goal={"topic": "/goal"})
    inputs, node = TaskInputs(described, bus.node("kraft"), None), bus.node("robot")
    node.publish("/goal", make(POSE, header=header(1, "odom"), pose=pose_fields(1, 2, 0)))
    assert inputs.take_goal() is None
    expected = "expected numbers in the frame 'map'"
    assert inputs.take_goal_problem() == f"the goal (1, 2) in the frame 'odom' cannot be used: {expected}"
    assert inputs.take_goal_problem() == ""
    node.publish("/goal", make(POSE, header=header(1, "map"), pose=pose_fields(1, 2, 0)))
    assert inputs.take_goal() == NewGoal((1.0, 2.0))
    assert inputs.take_goal() is None


def test_a_goal_has_the_heading_of_its_message_if_the_robot_file_states_a_tolerance() -> None:
    bus, described = LoopbackBus(), robot(goal={"topic": "/goal", "heading_tolerance_deg": 15})
    inputs, node = TaskInputs(described, bus.node("kraft"), None), bus.node("robot")
    node.publish("/goal", make(POSE, header=header(1, "map"), pose=pose_fields(1, 2, -2.5)))
    goal = inputs.take_goal()
    assert goal is not None
    moved = goal.moved(load_scenario("boxes").goal)
    assert (moved.center, moved.heading, moved.heading_tolerance) == (
        (1.0, 2.0), pytest.approx(-2.5), pytest.approx(math.radians(15)),
    )  # fmt: skip
    lying = pose_fields(1, 2, 0) | {"orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}}
    node.publish("/goal", make(POSE, header=header(1, "map"), pose=lying))
    assert inputs.take_goal() is None
    assert "and a rotation as the orientation" in inputs.take_goal_problem()


def test_a_scenario_that_begins_elsewhere_is_the_one_to_check_against() -> None:
    spec = DriveSpec(
        load_scenario("boxes").task(), load_method("adaptive-kraft"), load_vehicle("mushr"), robot(), timeout=60.0
    )
    moved = replace(spec.task, start=replace(spec.task.start, x=2.0))
    bus = LoopbackBus()
    here = bus.node("kraft")
    with sending(poses(), bus):
        found = checklist_of(robot(), here, spec).run(replace(spec, task=moved), lambda: False, lambda _: None)
    assert states(found)["start"] == "problem"


@pytest.mark.parametrize(("value", "warns"), [(False, False), (True, True)])
def test_a_goal_in_an_obstacle_of_the_robots_map_is_warned_of(value: bool, warns: bool) -> None:
    task, vehicle = load_scenario("boxes").task(), load_vehicle("mushr")
    x, y = task.goal.center
    grid = OccupancyMap(np.full((2, 2), value), 0.1, (x - 0.1, y - 0.1, 0.0), name="map")
    checks = _check_goal(with_map(task, grid), vehicle)
    assert [(each.name, each.state) for each in checks] == ([("goal", "warning")] if warns else [])
    assert all("in collision with 'map'" in each.detail for each in checks)
