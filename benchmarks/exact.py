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
        discs = [[*solid.center, solid.radius] for solid in solids if isinstance(solid, Disc)]
        self._discs = np.array(discs).reshape(-1, 3)

    def collides(self, x: float, y: float, theta: float) -> bool:
        """Whether the footprint at a pose touches a solid."""
        self._move(x, y, theta)
        found = fcl.CollisionData()
        self._manager.collide(self._box, found, fcl.defaultCollisionCallback)
        return bool(found.result.is_collision)

    def distance(self, x: float, y: float, theta: float) -> float:
        """Distance (m) to the nearest solid, 0 in contact, infinite without solids."""
        return float(self.distances(np.array([[x, y, theta]]))[0])

    def any_collision(self, poses: Matrix) -> bool:
        """Whether the footprint touches a solid at any row x, y, theta."""
        return any(self.collides(x, y, theta) for x, y, theta in poses.tolist())

    def distances(self, poses: Matrix) -> Floats:
        """`distance` of each row x, y, theta."""
        touching = [self.collides(x, y, theta) for x, y, theta in poses.tolist()]
        found: Floats = np.where(touching, 0.0, self._gaps(poses))
        return found

    def _gaps(self, poses: Matrix) -> Floats:
        """Distance of the outlines (n,), of bodies that do not touch: from a corner of one to a side of the other."""
        x, y, c, s = poses[:, :1], poses[:, 1:2], np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        gaps = [np.full((len(poses), 1), math.inf)]
        if len(self._from):
            ahead, aside = self._footprint.corners().T
            corners = np.stack([x + c * ahead - s * aside, y + s * ahead + c * aside], axis=2)
            sides = to_segments(corners.reshape(-1, 2), self._from, self._to)
            gaps.append(sides.reshape(len(poses), -1))
        for points, radius in ((self._from, 0.0), (self._discs[:, :2], self._discs[:, 2])):
            dx, dy = points[:, 0] - x, points[:, 1] - y
            gaps.append(self._to_footprint(dx * c + dy * s, dy * c - dx * s) - radius)
        least: Floats = np.concatenate(gaps, axis=1).min(axis=1)
        return least

    def _to_footprint(self, ahead: Matrix, aside: Matrix) -> Matrix:
        """Distance of points in the body's frame from the rectangle."""
        shape = self._footprint
        ahead = np.abs(ahead - shape.offset) - shape.length / 2
        aside = np.abs(aside) - shape.width / 2
        gap: Matrix = np.hypot(np.maximum(ahead, 0.0), np.maximum(aside, 0.0))
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
