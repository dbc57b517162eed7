"""What is true of the robots of an evaluation, as its manifest records it: dimensions, and the content of files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from kraft.evaluation.experiment import Cell
from kraft.planning.plan_file import vehicle_content
from kraft.vehicles.load import load_vehicle, natural_robot
from kraft.vehicles.true_robot import RobotTruth


def robots_of(cells: Iterable[Cell]) -> Mapping[tuple[str, str], dict[str, Any]]:
    """True robot of each cell by its key: that of its scenario, else that of its planning vehicle.

    It is empty where the equations of the planning vehicle are true.
    """
    cells = tuple(cells)
    scenarios = {cell.entry.name: cell.scenario.truth for cell in cells}
    vehicles = {cell.reference: cell.vehicle for cell in cells}
    stated = {name: _content(truth) for name, truth in scenarios.items() if truth.kind is not None}
    natural = {reference: _content(natural_robot(vehicle)[0]) for reference, vehicle in vehicles.items()}
    return {cell.key: stated.get(cell.entry.name, natural[cell.reference]) for cell in cells}


def _content(robot: RobotTruth) -> dict[str, Any]:
    """True robot as plain data; a file by its name and the SHA-256 of its bytes, a vehicle by its content."""
    content = robot.model_dump(mode="json", exclude_defaults=True, include=set(RobotTruth.model_fields))
    if robot.mjcf is not None:
        path = Path(robot.mjcf)
        content["mjcf"] = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    if robot.model is not None:
        vehicle = load_vehicle(robot.model)
        content["model"] = vehicle_content(vehicle, "") | {"code": vehicle.hash}
        del content["model"]["reference"]  # the content of a file matters, not its path
    return content
