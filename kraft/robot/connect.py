"""Opening of the transport that a robot file names, at kraft's end and at the simulated robot's."""

from __future__ import annotations

from kraft.errors import Code, InputError
from kraft.robot.robot_file import Robot, Ros2, Rosbridge
from kraft.robot.transport import LOOPBACK, Transport


def open_transport(robot: Robot) -> Transport:
    """Connect to a robot.

    Raises:
        MissingDependency: if a package of the transport is missing.
        InputError: if no connection is possible.
    """
    settings = robot.transport
    if isinstance(settings, Ros2):
        from kraft.robot.ros2 import Ros2Transport

        return Ros2Transport(settings)
    if isinstance(settings, Rosbridge):
        from kraft.robot.rosbridge import RosbridgeClient

        return RosbridgeClient(settings)
    return LOOPBACK.node("kraft")


def open_robot(robot: Robot) -> Transport:
    """Transport of a simulated robot, to which `open_transport` connects in another process.

    Raises:
        MissingDependency: if a package of the transport is missing.
        InputError: if the port is taken, or if messages cannot leave the process.
    """
    settings = robot.transport
    if isinstance(settings, Ros2):
        from kraft.robot.ros2 import Ros2Transport

        return Ros2Transport(settings)
    if isinstance(settings, Rosbridge):
        from kraft.robot.rosbridge import RosbridgeServer

        return RosbridgeServer(settings)
    problem, expected = "is loopback, which does not leave the process", "expected ros2 or rosbridge"
    raise InputError([robot.source.diagnostic("transport.kind", problem, expected, code=Code.CONFLICT)])
