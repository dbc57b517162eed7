"""The controller of a drive and the brake guard that drives beside it."""

from __future__ import annotations

import time
from multiprocessing import Pipe
from typing import Any, Final

import numpy as np

from kraft.driving.messages import Commitment, Reference, ReferenceKind
from kraft.driving.method import load_method
from kraft.robot.control import ControlLoop
from kraft.robot.drive_tables import DriveTables
from kraft.robot.health import Health
from kraft.robot.inputs import Inputs
from kraft.robot.loopback import LoopbackBus
from kraft.robot.protocol import BeginOrder, DriveSpec, Guarded, Mailbox
from kraft.robot.robot_file import Robot
from kraft.robot.task_inputs import TaskInputs
from kraft.robot.tracker import Tracker
from kraft.scenario import load_scenario
from kraft.vehicles.load import load_vehicle

ROBOT: Final[dict[str, Any]] = {
    "name": "r", "transport": {"kind": "loopback"},
    "pose": {"topic": "/pose", "type": "geometry_msgs/msg/PoseStamped"}, "command": {"topic": "/drive"},
}  # fmt: skip


def test_a_command_of_the_guard_that_is_newer_than_the_tick_counts_from_the_tick() -> None:
    """The guard may send one between the beginning of a tick and the look at its messages."""
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
    theirs.send(Guarded(1.3, np.array([0.5, 0.1])))
    until = time.monotonic() + 5.0
    while (found := control._take_guarded(1.2)) == 0 and time.monotonic() < until:
        time.sleep(0.001)
    assert found == 1
    assert tracker.last_sent == 1.2
    tracker.commanded(1.2, np.zeros(2))
