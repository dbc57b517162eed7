"""Outline of a true robot: the rectangle around all of it that an obstacle can touch."""

from __future__ import annotations

import math

from kraft.config.source import Source
from kraft.scenario import Scenario
from kraft.simulation.car import design_of
from kraft.simulation.robots import mjcf_robot
from kraft.simulation.true_world import TrueRobot, true_robot
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.true_robot import RobotTruth
from ompl_ext.vehicle import Footprint, Vehicle


def outline_of(scenario: Scenario, vehicle: Vehicle) -> Footprint | None:
    """Outline of the robot that is true in a scenario, about its reference point; None if no obstacle can touch it.

    Parts of a MuJoCo model that are higher than every obstacle of the scenario do not count.

    Raises:
        InputError: if the robot does not load.
    """
    highest = max((obstacle.height for obstacle in scenario.obstacles), default=math.inf)
    return _outline(true_robot(scenario, vehicle), vehicle, highest)


def stated_outline_of(robot: RobotTruth, source: Source, vehicle: Vehicle) -> Footprint | None:
    """Outline of a robot that the file of a vehicle states, among obstacles of any height.

    Raises:
        InputError: at the line of `source` that states the robot, if it does not load.
    """
    return _outline(TrueRobot(robot, source), vehicle, math.inf)


def _outline(true: TrueRobot, vehicle: Vehicle, highest: float) -> Footprint | None:
    """Outline of a true robot among obstacles up to a height (m); None if no obstacle can touch it."""
    robot = true.robot
    if robot.car is not None:
        return design_of(robot.car).outline
    if robot.mjcf is not None:
        found = mjcf_robot(robot.mjcf, vehicle.controls, robot.body, robot.actuators, robot.geoms, true.problem)
        return found.outline(highest)
    return vehicle.footprint if robot.model is None else load_vehicle(robot.model).footprint
