"""Collision and distance of a footprint, asked of FCL without any of the planner's own code."""

from __future__ import annotations

import math
from dataclasses import dataclass

import fcl
import numpy as np

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Footprint

HEIGHT = 2.0  # of all bodies (m): distances in space are then distances in the plane
UPRIGHT = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Rectangle:
    """Full `size` (m) around `center`, turned by `yaw` rad."""

    center: tuple[float, float]
    size: tuple[float, float]
    yaw: float


@dataclass(frozen=True)
class Disc:
    """`radius` m around `center`."""

    center: tuple[float, float]
    radius: float


@dataclass(frozen=True)
class Star:
    """Polygon all of which can be seen from `center`; `corners` (n, 2) counter-clockwise."""

    center: tuple[float, float]
    corners: Matrix


Solid = Rectangle | Disc | Star


class Body:
    """A footprint among solids."""

    def __init__(self, solids: tuple[Solid, ...], footprint: Footprint) -> None:
        self._solids = [part for solid in solids for part in parts(solid)]
        self._manager = fcl.DynamicAABBTreeCollisionManager()
        self._manager.registerObjects(self._solids)
        self._manager.setup()
        self._box = fcl.CollisionObject(fcl.Box(footprint.length, footprint.width, HEIGHT))
        self._offset = footprint.offset

    def collides(self, x: float, y: float, theta: float) -> bool:
        """Whether the footprint at a pose touches a solid."""
        self._move(x, y, theta)
        found = fcl.CollisionData()
        self._manager.collide(self._box, found, fcl.defaultCollisionCallback)
        return bool(found.result.is_collision)

    def distance(self, x: float, y: float, theta: float) -> float:
        """Distance (m) to the nearest solid, 0 in contact, infinite without solids."""
        if not self._solids:
            return math.inf
        if self.collides(x, y, theta):
            return 0.0
        found = fcl.DistanceData()
        self._manager.distance(self._box, found, fcl.defaultDistanceCallback)
        return float(found.result.min_distance)

    def any_collision(self, poses: Matrix) -> bool:
        """Whether the footprint touches a solid at any row x, y, theta."""
        return any(self.collides(x, y, theta) for x, y, theta in poses.tolist())

    def distances(self, poses: Matrix) -> Floats:
        """`distance` of each row x, y, theta."""
        return np.array([self.distance(x, y, theta) for x, y, theta in poses.tolist()])

    def _move(self, x: float, y: float, theta: float) -> None:
        c, s = math.cos(theta), math.sin(theta)
        self._box.setTransform(place(x + c * self._offset, y + s * self._offset, theta))


def place(x: float, y: float, yaw: float) -> fcl.Transform:
    """A pose in the plane."""
    c, s = math.cos(yaw), math.sin(yaw)
    return fcl.Transform(np.array([[c, -s, 0.0], [s, c, 0.0], UPRIGHT]), np.array([x, y, 0.0]))


def parts(solid: Solid) -> list[fcl.CollisionObject]:
    """Convex bodies that make up a solid."""
    match solid:
        case Rectangle():
            return [fcl.CollisionObject(fcl.Box(*solid.size, HEIGHT), place(*solid.center, solid.yaw))]
        case Disc():
            return [fcl.CollisionObject(fcl.Cylinder(solid.radius, HEIGHT), place(*solid.center, 0.0))]
        case Star():
            around = zip(solid.corners, np.roll(solid.corners, -1, axis=0), strict=True)
            return [wedge(np.array([solid.center, a, b])) for a, b in around]


def wedge(corners: Matrix) -> fcl.CollisionObject:
    """Prism over a triangle with counter-clockwise corners (3, 2)."""
    low, high = (np.column_stack([corners, np.full(3, z)]) for z in (-HEIGHT / 2, HEIGHT / 2))
    faces = np.array([3, 2, 1, 0, 3, 3, 4, 5, 4, 0, 1, 4, 3, 4, 1, 2, 5, 4, 4, 2, 0, 3, 5])
    return fcl.CollisionObject(fcl.Convex(np.vstack([low, high]), 5, faces))
