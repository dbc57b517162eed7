"""A drive that knows another scenario than the robot simulates is refused; what only the simulation knows is not compared."""

from __future__ import annotations

from typing import Any

import pytest

from kraft.robot.announcement import KIND, TOPIC, Announced, announce
from kraft.robot.loopback import LoopbackBus
from kraft.robot.messages import make
from kraft.robot.protocol import Check
from kraft.scenario import Scenario, load_scenario
from kraft.vehicles.load import load_vehicle


def compared(
    there: Scenario, here: Scenario, *, simulated: str = "mushr", model: str = "mushr", has_map: bool = False
) -> list[Check]:
    bus = LoopbackBus()
    announce(bus.node("robot"), there.task(), load_vehicle(simulated))
    announced = Announced(bus.node("kraft"))
    return announced.checks(here.task(), load_vehicle(model), is_simulated=True, has_map=has_map)


def boxes(**settings: Any) -> Scenario:
    return load_scenario("boxes", {key.replace("__", "."): value for key, value in settings.items()})


@pytest.mark.parametrize(
    ("there", "words"),
    [
        (load_scenario("turns"), ("simulates turns", "in boxes", "only the drive has first box", "does not know")),
        (boxes(goal__center=[1.5, 1.6]), ("goal: center [1.5, 1.6] there",)),
        (boxes(bounds__x=[-0.4, 2.4]), ("bounds: x [-0.4, 2.4] there",)),
    ],
)
def test_another_scenario_is_a_problem_that_says_what_differs(there: Scenario, words: tuple[str, ...]) -> None:
    (check,) = compared(there, boxes())
    assert (check.name, check.state) == ("scenario", "problem")
    for each in words:
        assert each in check.detail


def test_what_only_the_simulation_knows_is_not_compared() -> None:
    (check,) = compared(boxes(sensing__noise_scale=2.0, trial__timeout=30.0), boxes())
    assert (check.name, check.state, check.detail) == ("scenario", "ok", "the robot simulates boxes")


def test_obstacles_that_the_drive_has_from_the_map_of_the_robot_are_a_warning() -> None:
    (check,) = compared(boxes(), boxes(obstacles=[]), has_map=True)
    assert (check.state, "only its map tells the drive of left wall" in check.detail) == ("warning", True)
    (check,) = compared(boxes(), boxes(obstacles=[]))
    assert check.state == "problem"


def test_an_announcement_that_lacks_a_part_counts_as_none() -> None:
    bus = LoopbackBus()
    announced, robot = Announced(bus.node("kraft")), bus.node("robot")
    robot.advertise(TOPIC, KIND, latched=True)
    robot.publish(TOPIC, make(KIND, data='{"schema": "kraft.announcement/1", "name": "boxes"}'))
    (check,) = announced.checks(boxes().task(), load_vehicle("mushr"), is_simulated=True, has_map=False)
    assert (check.state, "does not announce its scenario" in check.detail) == ("warning", True)


def test_a_larger_vehicle_than_the_model_is_a_warning() -> None:
    _, check = compared(boxes(), boxes(), simulated="f1tenth")
    assert (check.name, check.state) == ("vehicle", "warning")
    assert "f1tenth of 0." in check.detail


def test_a_robot_that_announces_nothing_is_not_compared() -> None:
    bus = LoopbackBus()
    announced = Announced(bus.node("kraft"))
    node = bus.node("robot")
    node.advertise(TOPIC, KIND)
    for text in ("no JSON", "[1]", '{"schema": "other"}'):
        node.publish(TOPIC, make(KIND, data=text))
    task, vehicle = boxes().task(), load_vehicle("mushr")
    assert announced.checks(task, vehicle, is_simulated=False, has_map=False) == []
    (check,) = announced.checks(task, vehicle, is_simulated=True, has_map=False)
    assert check.state == "warning"
