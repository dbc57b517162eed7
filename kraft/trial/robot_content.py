"""What results depend on of a vehicle and of its true robot, with the content of the files that these name."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Final

from kraft.planning.plan_file import vehicle_content
from kraft.provenance import plain, plain_hash
from kraft.vehicles.load import load_vehicle, natural_robot
from kraft.vehicles.true_robot import RobotTruth
from ompl_ext.vehicle import Vehicle

ESTIMATION: Final = ("ranges", "gravity_share", "delay", "errors_by_speed")
"""What of a vehicle only estimators use."""


def robot_content(robot: RobotTruth) -> dict[str, Any]:
    """True robot as plain data, also in the section `truth` of a scenario; empty where it is the planning vehicle.

    A file is stated by its name and the SHA-256 of its bytes, a vehicle by its content.
    """
    content = robot.model_dump(mode="json", exclude_defaults=True, include=set(RobotTruth.model_fields))
    if robot.mjcf is not None:
        path = Path(robot.mjcf)
        content["mjcf"] = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    if robot.model is not None:
        content["model"] = model_content(load_vehicle(robot.model))
    return content


def model_content(vehicle: Vehicle) -> dict[str, Any]:
    """Equations, parameters and limits of a vehicle as plain data, without the path of its file."""
    content = vehicle_content(vehicle, "") | {"code": vehicle.hash}
    del content["reference"]
    return content


def estimation_content(vehicle: Vehicle) -> dict[str, Any]:
    """What only estimators use of a vehicle, as plain data."""
    return {name: plain(getattr(vehicle, name)) for name in ESTIMATION}


def vehicle_hash(vehicle: Vehicle) -> str:
    """SHA-256 of all that trials depend on of a planning vehicle, and of the true robot that its file states."""
    robot = robot_content(natural_robot(vehicle)[0])
    return plain_hash({**model_content(vehicle), **estimation_content(vehicle), "robot": robot})
