"""Outline of a true robot: the rectangle around all of it that an obstacle can touch."""

from __future__ import annotations

import math

from kraft.config.source import Source
from kraft.simulation.car import design_of
from kraft.simulation.robots import mjcf_robot
from kraft.simulation.true_world import TrueRobot
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.true_robot import RobotTruth
from ompl_ext.vehicle import Footprint, Vehicle


def outline_of(robot: RobotTruth, source: Source, vehicle: Vehicle, highest: float = math.inf) -> Footprint | None:
    """Outline of the true robot that `source` states, about its reference point; None if no obstacle can touch it.

    Parts of a MuJoCo model that are higher than the `highest` obstacle (m) do not count.

    Raises:
        InputError: at the line of `source` that states the robot, if it does not load.
    """
    if robot.car is not None:
        return design_of(robot.car).outline
    if robot.mjcf is not None:
        problem = TrueRobot(robot, source).problem
        found = mjcf_robot(robot.mjcf, vehicle.controls, robot.body, robot.actuators, robot.geoms, problem)
        return found.outline(highest)
    return vehicle.footprint if robot.model is None else load_vehicle(robot.model).footprint
