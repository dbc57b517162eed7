"""The simulated robot keeps to the clock: a stall of its own is neither seen in the stamps nor felt by the car."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from kraft.planning.workspace import vehicle_of_task
from kraft.robot import world as robot_world
from kraft.robot.command import CommandCodec
from kraft.robot.loopback import LoopbackBus
from kraft.robot.messages import nanoseconds_of
from kraft.robot.robot_file import load_robot
from kraft.robot.transport import Peers, Receive, Refused
from kraft.robot.world import RobotWorld, WorldResult
from kraft.scenario import load_scenario
from kraft.simulation.contacts import Collision
from kraft.simulation.true_world import TrueWorld
from kraft.trial.measures import Step
from kraft.trial.result import Outcome

STALL = 0.4
DRIVEN = 1.5


class Wire:
    """Transport that keeps what is published and lets a test send commands."""

    problem = ""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.receive: Receive | None = None

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        return None

    def publish(self, topic: str, message: Any) -> None:
        if "pose" in topic or "odom" in topic:
            self.stamps.append(nanoseconds_of(message.header.stamp))

    def subscribe(
        self, topic: str, kind: str, receive: Receive, *, latched: bool = False, reliable: bool = True,
        refused: Refused | None = None,
    ) -> None:  # fmt: skip
        self.receive = receive

    def peers(self, topic: str) -> Peers:
        return Peers(None, None)

    def close(self) -> None:
        return None


def driven(
    at_one_second: Callable[[Callable[[], None]], None],
    silent: tuple[float, float] = (0.0, 0.0),
    report: Callable[[str], None] = lambda _: None,
) -> tuple[Wire, WorldResult, list[tuple[float, float]]]:
    """A drive straight on, without commands in an interval (s).

    `at_one_second` is called once, in the thread that simulates, with what stops the car.
    """
    scenario, robot, wire = load_scenario("boxes"), load_robot("sim").model_copy(update={"clock": None}), Wire()
    vehicle = vehicle_of_task(scenario)
    codec = CommandCodec(robot, vehicle)
    world = RobotWorld(scenario, vehicle, robot, wire, 0)
    assert wire.receive is not None
    control = np.zeros(len(vehicle.controls))
    control[list(vehicle.controls).index("throttle")] = 0.5
    speeds: list[tuple[float, float]] = []
    called = False

    def send(control: np.ndarray) -> None:
        assert wire.receive is not None
        wire.receive(codec.message(0, control), time.monotonic_ns())

    def on_step(true: TrueWorld, step: Step) -> None:
        nonlocal called
        speeds.append((true.time, true.speed))
        if (true.time < 1.0 or called) and not silent[0] < true.time < silent[1]:
            send(control)
        if not called and true.time >= 1.0:
            called = True
            at_one_second(lambda: send(0.0 * control))
        if true.time >= DRIVEN:
            world.cancelled = True

    send(control)
    return wire, world.run(on_step, patience=5.0, report=report), speeds


def test_a_stalled_simulation_catches_up_and_its_poses_are_those_of_a_robot_that_did_not_stall() -> None:
    wire, result, _ = driven(lambda stop: time.sleep(STALL))
    gaps = 1e-9 * np.diff(wire.stamps)
    assert result.lag >= 0.9 * STALL
    assert result.lost == 0.0
    assert gaps.max() < 0.1  # stamped when they were sent, one would be STALL
    assert 1e-9 * (wire.stamps[-1] - wire.stamps[0]) == pytest.approx((len(wire.stamps) - 1) / 30.0, abs=0.1)


def test_a_command_that_arrives_during_a_stall_acts_at_its_arrival() -> None:
    def stall(stop: Callable[[], None]) -> None:
        time.sleep(STALL)
        stop()

    _, _, speeds = driven(stall)
    before = [speed for at, speed in speeds if 1.0 <= at <= 1.15]  # the multiplexer stops the car 0.2 s after it
    assert np.all(np.diff(before) > -0.01)


def test_the_world_tells_when_the_drive_begins_and_how_long_it_waits_without_commands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(robot_world, "SILENT", 0.5)
    told: list[str] = []
    driven(lambda stop: None, silent=(0.2, 0.9), report=told.append)
    assert told[0].endswith("the drive begins")
    assert re.search(r"^  0\.\d\d s  no command for 0\.5 s.* 59 s from now$", told[1])
    assert told[2].endswith("commands arrive again")


def test_the_world_tells_who_connects_and_leaves_before_the_drive() -> None:
    scenario, robot = load_scenario("boxes"), load_robot("sim").model_copy(update={"clock": None})
    bus = LoopbackBus()
    world = RobotWorld(scenario, vehicle_of_task(scenario), robot, bus.node("robot"), 0)
    told: list[str] = []
    client = bus.node("client")

    def report(text: str) -> None:
        told.append(text)
        if len(told) == 1:
            client.close()

    client.advertise(robot.command.topic, robot.command.type)
    world.run(patience=1.5, report=report)
    assert told == [
        "connected: waiting for the first command on /drive that moves the car",
        "nobody is connected any more: waiting for another one",
    ]


def test_a_simulation_that_cannot_keep_up_says_how_much_it_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_world, "BEHIND", 0.2)
    _, result, _ = driven(lambda stop: time.sleep(STALL))
    assert result.lost >= result.lag >= 0.9 * STALL


class Rolling:
    """World in which the car reaches the goal at once, and a wall half a second later."""

    speed = 0.7

    def __init__(self, true: TrueWorld) -> None:
        self.dt, self.controls, self.marker, self.pose = true.dt, true.controls, true.marker, true.pose
        self.movable_poses, self.steps = true.movable_poses, 0

    @property
    def time(self) -> float:
        return self.steps * self.dt

    @property
    def in_goal(self) -> bool:
        return self.time > 0.1

    @property
    def collision(self) -> Collision | None:
        return Collision(self.time, "wall", (0.0, 0.0, 0.0)) if self.time > 0.5 else None

    def step(self, number: int) -> None:
        self.steps += number

    def apply(self, control: np.ndarray) -> None:
        return None


def test_a_wall_that_is_hit_after_the_goal_is_a_collision() -> None:
    scenario, robot = load_scenario("boxes"), load_robot("sim").model_copy(update={"clock": None})
    world = RobotWorld(scenario, vehicle_of_task(scenario), robot, Wire(), 0)
    world.world = Rolling(world.world)  # type: ignore[assignment]
    world._began = True
    result = world.run(stays=True)
    assert (result.outcome, result.obstacle) == (Outcome.COLLISION, "wall")
    assert result.time == pytest.approx(0.5, abs=0.1)
