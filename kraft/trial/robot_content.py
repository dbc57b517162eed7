"""What results depend on of a vehicle and of its true robot, with the content of the files that these name."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

from kraft.planning.plan_file import vehicle_content
from kraft.provenance import plain, plain_hash
from kraft.vehicles.load import load_vehicle, natural_robot
from kraft.vehicles.true_robot import RobotTruth
from ompl_ext.vehicle import Vehicle

ESTIMATION: Final = ("ranges", "gravity_share", "delay", "errors_by_speed")
"""What of a vehicle only estimators use."""
FILES: Final = "files"
"""Key of the files that an MJCF file refers to."""
FOLDERS: Final = ("meshdir", "texturedir", "assetdir")
"""Settings of MuJoCo's compiler with the folders of such files."""


def robot_content(robot: RobotTruth) -> dict[str, Any]:
    """True robot as plain data, also in the section `truth` of a scenario; empty where it is the planning vehicle.

    A file is stated by its name and the SHA-256 of its bytes, as those that it refers to; a vehicle by its content.
    """
    content = robot.model_dump(mode="json", exclude_defaults=True, include=set(RobotTruth.model_fields))
    if robot.mjcf is not None:
        path = Path(robot.mjcf)
        content["mjcf"] = {"file": path.name, **_hashed(path)}
        if files := dict(_referred(path)):
            content["mjcf"][FILES] = {name: _hashed(file) for name, file in sorted(files.items())}
    if robot.model is not None:
        content["model"] = model_content(load_vehicle(robot.model))
    return content


def _hashed(path: Path) -> dict[str, str]:
    return {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def _referred(path: Path) -> Iterator[tuple[str, Path]]:
    """Files that an MJCF file refers to, as meshes and parts of the model, with their paths from its folder."""
    waiting, seen, named, folders = [path], {path}, set[str](), {""}
    while waiting:
        try:
            elements = list(ElementTree.parse(waiting.pop()).iter())
        except ElementTree.ParseError:  # MuJoCo says what is wrong when it loads the file
            continue
        values = [(key, value) for each in elements for key, value in each.attrib.items()]
        folders |= {value for key, value in values if key in FOLDERS}
        named |= {value for key, value in values if key.startswith("file")}
        parts = {path.parent / value for key, value in values if key == "file" and value.endswith((".xml", ".mjcf"))}
        found = {part for part in parts - seen if part.is_file()}
        waiting += found
        seen |= found
    places = {(Path(folder) / name).as_posix() for name in named for folder in folders}
    yield from ((place, path.parent / place) for place in places if (path.parent / place).is_file())


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
