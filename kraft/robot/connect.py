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


def check_transport(robot: Robot) -> None:
    """Check that a drive, whose controller has a process of its own, can use the transport of a robot.

    Raises:
        MissingDependency: if a package of the transport is missing.
        InputError: if messages cannot leave the process.
    """
    settings = robot.transport
    if isinstance(settings, Ros2):
        from kraft.robot.ros2 import domain_number

        domain_number(settings)
    elif isinstance(settings, Rosbridge):
        from kraft.robot.rosbridge import check_library

        check_library()
    else:
        problem, expected = "is loopback, which does not leave the process", "expected ros2 or rosbridge"
        raise InputError([robot.source.diagnostic("transport.kind", problem, expected, code=Code.CONFLICT)])


def open_robot(robot: Robot) -> Transport:
    """Transport of a simulated robot, to which `open_transport` connects in another process.

    Raises:
        MissingDependency: if a package of the transport is missing.
        InputError: if the port is taken.
    """
    settings = robot.transport
    if isinstance(settings, Ros2):
        from kraft.robot.ros2 import Ros2Transport

        return Ros2Transport(settings)
    if isinstance(settings, Rosbridge):
        from kraft.robot.rosbridge import RosbridgeServer

        return RosbridgeServer(settings)
    return LOOPBACK.node("robot")
