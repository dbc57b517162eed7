"""Collision and distance of a footprint, without any of the planner's own code.

Contact is FCL's verdict.  Distances are computed in the plane: FCL's are too large for some pairs of prisms whose
sides are parallel, by decimetres.
"""

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
        self._footprint = footprint
        outlines = [outline(solid) for solid in solids if not isinstance(solid, Disc)]
        self._from = np.concatenate([*outlines, np.zeros((0, 2))])
        self._to = np.concatenate([*(np.roll(corners, -1, axis=0) for corners in outlines), np.zeros((0, 2))])
        self._discs = np.array([[*solid.center, solid.radius] for solid in solids if isinstance(solid, Disc)])

    def collides(self, x: float, y: float, theta: float) -> bool:
        """Whether the footprint at a pose touches a solid."""
        self._move(x, y, theta)
        found = fcl.CollisionData()
        self._manager.collide(self._box, found, fcl.defaultCollisionCallback)
        return bool(found.result.is_collision)

    def distance(self, x: float, y: float, theta: float) -> float:
        """Distance (m) to the nearest solid, 0 in contact, infinite without solids."""
        return 0.0 if self.collides(x, y, theta) else self._gap(x, y, theta)

    def any_collision(self, poses: Matrix) -> bool:
        """Whether the footprint touches a solid at any row x, y, theta."""
        return any(self.collides(x, y, theta) for x, y, theta in poses.tolist())

    def distances(self, poses: Matrix) -> Floats:
        """`distance` of each row x, y, theta."""
        return np.array([self.distance(x, y, theta) for x, y, theta in poses.tolist()])

    def _gap(self, x: float, y: float, theta: float) -> float:
        """Distance of the outlines, for bodies that do not touch: from a corner of the one to a side of the other."""
        turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
        gaps = [np.array([math.inf])]
        if len(self._from):
            gaps.append(to_segments(self._footprint.corners() @ turn.T + (x, y), self._from, self._to))
            gaps.append(self._to_footprint((self._from - (x, y)) @ turn))
        if len(self._discs):
            gaps.append(self._to_footprint((self._discs[:, :2] - (x, y)) @ turn) - self._discs[:, 2])
        return float(np.concatenate(gaps).min())

    def _to_footprint(self, points: Matrix) -> Floats:
        """Distance of each point (n, 2) in the body's frame from the rectangle."""
        shape = self._footprint
        ahead = np.abs(points[:, 0] - shape.offset) - shape.length / 2
        aside = np.abs(points[:, 1]) - shape.width / 2
        gap: Floats = np.hypot(np.maximum(ahead, 0.0), np.maximum(aside, 0.0))
        return gap

    def _move(self, x: float, y: float, theta: float) -> None:
        c, s = math.cos(theta), math.sin(theta)
        offset = self._footprint.offset
        self._box.setTransform(place(x + c * offset, y + s * offset, theta))


def outline(solid: Rectangle | Star) -> Matrix:
    """Corners (n, 2) in their order."""
    if isinstance(solid, Star):
        return solid.corners
    c, s = math.cos(solid.yaw), math.sin(solid.yaw)
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(solid.size) / 2
    corners: Matrix = half @ np.array([[c, s], [-s, c]]) + np.array(solid.center)
    return corners


def to_segments(points: Matrix, begin: Matrix, end: Matrix) -> Floats:
    """Distances of points (m, 2) from segments (n, 2) to (n, 2), all pairs in a row."""
    along = end - begin
    offset = points[:, None] - begin[None]
    share = np.clip((offset * along).sum(axis=2) / (along**2).sum(axis=1), 0.0, 1.0)
    away = offset - share[:, :, None] * along
    distances: Floats = np.hypot(away[:, :, 0], away[:, :, 1]).ravel()
    return distances


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
