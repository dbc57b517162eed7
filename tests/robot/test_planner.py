"""The planner of a drive: what it asks for does not depend on where it was warmed up."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from kraft.driving.method import load_method
from kraft.driving.planner_settings import Clearance, PlannerSettings
from kraft.robot.planner import Planner
from kraft.robot.protocol import DriveSpec, TaskChange
from kraft.robot.robot_file import Robot
from kraft.scenario import OccupancyMap, load_scenario
from kraft.vehicles.load import load_vehicle
from ompl_ext.obstacles import box

ROBOT: dict[str, Any] = {
    "name": "r", "transport": {"kind": "loopback"},
    "pose": {"topic": "/pose", "type": "geometry_msgs/msg/PoseStamped"}, "command": {"topic": "/drive"},
}  # fmt: skip


@pytest.mark.slow
def test_a_start_with_less_clearance_lowers_what_is_asked_for_there_alone() -> None:
    """0.1 m from the right wall, from where the vehicle leaves with the clearance that it has."""
    asked = Clearance(delta=0.12, delta_per_speed=0.0)
    settings = PlannerSettings(
        mode="replanning", cycle=0.6, lead=0.3, safety=asked, recover=True, on_board="contingency"
    )
    method = load_method("filtered-kraft").model_copy(update={"planner": settings})
    robot, task = Robot.model_validate(ROBOT, strict=False), load_scenario("turns").task()
    planner = Planner(DriveSpec(task, method, load_vehicle("mushr"), robot, 60.0))
    planner.begin((1.96, 0.0, math.pi / 2))
    assert planner._replanner is not None
    proposer, checking = planner._replanner.proposer, planner._solvers.checking
    assert proposer.recovers
    assert checking.safety.delta < 0.1
    start = task.start
    proposer.propose(1, np.array([start.x, start.y, start.heading, 0.0]), None)
    assert not proposer.recovers
    assert checking.safety.delta == 0.12


@pytest.mark.slow
def test_what_blocked_the_vehicle_stays_until_a_map_has_news_of_its_place() -> None:
    """A doorstep that the robot's sensor does not see: maps that arrive every second would lead onto it again."""
    task = load_scenario("turns").task()
    method = load_method("adaptive-kraft")
    planner = Planner(
        DriveSpec(task, method, load_vehicle("mushr-force"), Robot.model_validate(ROBOT, strict=False), 60.0)
    )
    planner.begin((task.start.x, task.start.y, task.start.heading))
    replanner, step = planner._replanner, box((1.7, 2.5), (0.2, 0.2), 0.0)
    assert replanner is not None
    occupied = np.zeros((160, 60), dtype=bool)

    def arrives(*places: tuple[slice, slice]) -> tuple[object, ...]:
        cells = occupied.copy()
        for place in places:
            cells[place] = True
        planner.change(TaskChange(None, OccupancyMap(cells, 0.05, (-0.5, -1.0, 0.0), name="map")))
        return replanner.blocked

    arrives()
    replanner._blocked = (step,)
    far, there = (slice(150, 152), slice(5, 7)), (slice(68, 73), slice(42, 47))
    assert arrives(far) == (step,)
    assert arrives(there) == ()
