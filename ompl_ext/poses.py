"""Poses of a vehicle's states, and how far two of them are apart."""

from __future__ import annotations

import math

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle


def heading_of(state: Floats, vehicle: Vehicle) -> float:
    """Heading of a state, rad; 0 for a vehicle that does not turn."""
    index = vehicle.index("theta")
    return float(state[index]) if index >= 0 else 0.0


def pose_of(state: Floats, vehicle: Vehicle) -> tuple[float, float, float]:
    """Position (m) and heading (rad) of a state; heading 0 for a vehicle that does not turn."""
    return float(state[vehicle.index("x")]), float(state[vehicle.index("y")]), heading_of(state, vehicle)


def poses_of(states: Matrix, vehicle: Vehicle) -> Matrix:
    """Poses (n, 3), x, y (m) and heading (rad), of states (n, nx); heading 0 for a vehicle that does not turn."""
    x, y, theta = (vehicle.index(name) for name in ("x", "y", "theta"))
    poses: Matrix = states.take([x, y, theta], axis=1)
    if theta < 0:
        poses[:, 2] = 0.0
    return poses


def displacement(state: Floats, other: Floats, vehicle: Vehicle) -> float:
    """Upper bound of the distance between any point of the vehicle in one state and the same point in another, m."""
    (x, y, theta), (x0, y0, theta0) = pose_of(state, vehicle), pose_of(other, vehicle)
    turned = abs(math.remainder(theta - theta0, math.tau))
    return math.hypot(x - x0, y - y0) + vehicle.footprint.reach * turned
