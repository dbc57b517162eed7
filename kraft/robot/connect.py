"""Opening of the transport that a robot file names, at kraft's end and at the simulated robot's."""

from __future__ import annotations

import socket
from typing import Literal

from kraft.errors import Code, InputError
from kraft.robot.loopback import LOOPBACK, LoopbackClient, LoopbackServer
from kraft.robot.robot_file import Robot, Ros2, Rosbridge
from kraft.robot.transport import Transport


def open_transport(robot: Robot, end: Literal["kraft", "robot"] = "kraft") -> Transport:
    """Connect to a robot, or be the simulated one; over rosbridge and a socket the robot's end is the server.

    Raises:
        MissingDependency: if a package of the transport is missing.
        InputError: if no connection is possible, or the server's address is taken.
    """
    settings = robot.transport
    if isinstance(settings, Ros2):
        from kraft.robot.ros2 import Ros2Transport

        return Ros2Transport(settings)
    if isinstance(settings, Rosbridge):
        from kraft.robot.rosbridge import RosbridgeClient, RosbridgeServer

        return RosbridgeClient(settings) if end == "kraft" else RosbridgeServer(settings)
    if settings.socket is None:
        return LOOPBACK.node(end)
    return LoopbackClient(settings.socket) if end == "kraft" else LoopbackServer(settings.socket)


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
        known = [name for _, name in socket.if_nameindex()]
        if settings.interface is not None and settings.interface not in known:
            problem, expected = f"{settings.interface!r} is no network interface", f"expected one of {', '.join(known)}"
            raise InputError([robot.source.diagnostic("transport.interface", problem, expected, code=Code.MISMATCH)])
    elif isinstance(settings, Rosbridge):
        from kraft.robot.rosbridge import check_library

        check_library()
    elif settings.socket is None:
        problem, expected = "is loopback, which does not leave the process", "expected a socket, ros2 or rosbridge"
        raise InputError([robot.source.diagnostic("transport.kind", problem, expected, code=Code.CONFLICT)])
