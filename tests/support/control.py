"""A controller of a drive without its planner, for tests."""

from __future__ import annotations

from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, Final

import numpy as np

from kraft.driving.messages import Commitment, Reference, ReferenceKind
from kraft.driving.method import load_method
from kraft.robot.control import ControlLoop
from kraft.robot.drive_tables import DriveTables
from kraft.robot.health import Health
from kraft.robot.inputs import Inputs
from kraft.robot.loopback import LoopbackBus
from kraft.robot.protocol import BeginOrder, DriveSpec, Mailbox
from kraft.robot.robot_file import Robot
from kraft.robot.task_inputs import TaskInputs
from kraft.robot.tracker import Tracker
from kraft.scenario import load_scenario
from kraft.vehicles.load import load_vehicle

ROBOT: Final[dict[str, Any]] = {
    "name": "r", "transport": {"kind": "loopback"},
    "pose": {"topic": "/pose", "type": "geometry_msgs/msg/PoseStamped"}, "command": {"topic": "/drive"},
}  # fmt: skip


def control_and_guard() -> tuple[ControlLoop, Tracker, Connection]:
    """A controller whose vehicle stands, what drives it, and the brake guard's end of the pipe."""
    described, bus = Robot.model_validate(ROBOT, strict=False), LoopbackBus()
    spec = DriveSpec(
        load_scenario("boxes").task(), load_method("adaptive-kraft"), load_vehicle("mushr"), described, 60.0
    )
    start = spec.task.start
    state = spec.at_rest((start.x, start.y, start.heading))
    rest = Reference(ReferenceKind.CONTINGENCY, np.array([0.0]), state[np.newaxis], np.zeros((0, 2)), np.zeros(2))
    node = bus.node("kraft")
    inputs = Inputs(described, node)
    tracker = Tracker(spec, BeginOrder(state, Commitment(rest)), node, inputs)
    (planner, _planner), (guard, theirs) = Pipe(), Pipe()
    mail = Mailbox(guard, "the brake guard")
    health = Health(described.watchdog, 30.0, spec.period)
    control = ControlLoop(
        spec, node, inputs, TaskInputs(described, node, None), Mailbox(planner, "the planner"), mail, DriveTables(None, {}),
        tracker, health,
    )  # fmt: skip
    return control, tracker, theirs
