"""Exact clearance with FCL: verifies every plan, and is the reference for tests of the clearance field."""

from __future__ import annotations

import math
from functools import lru_cache

import fcl
import numpy as np

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.obstacles import Circle, OccupancyGrid, Polygon, Workspace
from ompl_ext.triangulate import triangles
from ompl_ext.vehicle import Footprint

HEIGHT = 30.0  # of prisms around the plane z = 0; with low prisms FCL's iteration fails where bodies are far apart


class ExactClearance:
    """Exact distance between a footprint and the obstacles of a workspace."""

    def __init__(self, workspace: Workspace, footprint: Footprint) -> None:
        self._obstacles, self._manager = _scene(workspace)
        self._offset = footprint.offset
        self._body = fcl.CollisionObject(fcl.Box(footprint.length, footprint.width, HEIGHT), fcl.Transform())

    def distance(self, x: float, y: float, theta: float = 0.0) -> float:
        """Distance (m) from the footprint at a pose to the nearest obstacle: 0 in contact, inf without obstacles."""
        if not self._obstacles:
            return math.inf
        if self.collides(x, y, theta):
            return 0.0
        data = fcl.DistanceData()
        self._manager.distance(self._body, data, fcl.defaultDistanceCallback)
        return float(data.result.min_distance)

    def collides(self, x: float, y: float, theta: float = 0.0) -> bool:
        """Whether the footprint at a pose touches an obstacle."""
        c, s = math.cos(theta), math.sin(theta)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        position = np.array([x + c * self._offset, y + s * self._offset, 0.0])
        self._body.setTransform(fcl.Transform(rotation, position))
        contact = fcl.CollisionData()
        self._manager.collide(self._body, contact, fcl.defaultCollisionCallback)
        return bool(contact.result.is_collision)

    def distances(self, poses: Matrix) -> Floats:
        """`distance` for each row x, y, theta of `poses`."""
        return np.array([self.distance(*pose) for pose in poses])


@lru_cache(8)  # the replanner and the measures of every trial use the same one
def _scene(workspace: Workspace) -> tuple[list[fcl.CollisionObject], fcl.DynamicAABBTreeCollisionManager]:
    """Prisms of all obstacles, and a manager of them, which queries do not change."""
    prisms = [part for obstacle in workspace.obstacles for part in _prisms(obstacle)]
    manager = fcl.DynamicAABBTreeCollisionManager()
    manager.registerObjects(prisms)
    manager.setup()
    return prisms, manager


def _prisms(obstacle: Polygon | Circle | OccupancyGrid) -> list[fcl.CollisionObject]:
    """Convex prisms that compose an obstacle."""
    if isinstance(obstacle, Circle):
        # A sphere around z = 0: its nearest point to an upright prism lies in that plane, and FCL is exact for it.
        place = fcl.Transform(np.array([*obstacle.center, 0.0]))
        return [fcl.CollisionObject(fcl.Sphere(obstacle.radius), place)]
    if isinstance(obstacle, Polygon):
        return [_prism(corners) for corners in triangles(obstacle.vertices)]
    x, y, yaw = obstacle.origin
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, -s], [s, c]])
    prisms = []
    for row, column, rows, columns in obstacle.rectangles():  # not fcl.Box: FCL fails for two boxes side by side
        cells = np.array([[column, row], [column + columns, row], [column + columns, row + rows], [column, row + rows]])
        prisms.append(_prism(cells * obstacle.resolution @ turn.T + np.array([x, y])))
    return prisms


def _prism(corners: Matrix) -> fcl.CollisionObject:
    """Prism over a convex polygon with counter-clockwise corners."""
    n = len(corners)
    low = np.column_stack([corners, np.full(n, -HEIGHT / 2)])
    high = np.column_stack([corners, np.full(n, HEIGHT / 2)])
    faces = [n, *range(n - 1, -1, -1), n, *range(n, 2 * n)]
    for k in range(n):
        after = (k + 1) % n
        faces += [4, k, after, n + after, n + k]
    return fcl.CollisionObject(fcl.Convex(np.vstack([low, high]), n + 2, np.array(faces)), fcl.Transform())
