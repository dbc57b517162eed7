"""What results depend on of a true robot: its dimensions, and the content of the files that it names."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from kraft.planning.plan_file import vehicle_content
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.true_robot import RobotTruth
from ompl_ext.vehicle import Vehicle


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
