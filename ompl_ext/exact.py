"""Exact clearance with FCL: verifies every plan, and is the reference for tests of the clearance field."""

from __future__ import annotations

import math
import threading
from functools import lru_cache

import fcl
import numpy as np

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels.broad_phase import body_of, lower_bounds, nearest_pieces
from ompl_ext.kernels.distance import shapes
from ompl_ext.obstacles import Circle, Polygon, Workspace
from ompl_ext.triangulate import triangles
from ompl_ext.vehicle import Footprint

DISTANCE, CONTACT = fcl.DistanceRequest(), fcl.CollisionRequest()
HEIGHT = 30.0  # of prisms around the plane z = 0; with low prisms FCL's iteration fails where bodies are far apart


SPREAD = 1e-3  # m, above the error of FCL's distances to round shapes: pieces this much farther cannot be nearest


class _Memory(threading.local):
    """FCL's body, which queries move, and working memory of the broad phase; every thread has them for itself."""

    def __init__(self, footprint: Footprint, pieces: int) -> None:
        self.solid = fcl.CollisionObject(fcl.Box(footprint.length, footprint.width, HEIGHT), fcl.Transform())
        self.numbers, self.gap = np.empty((3, pieces), np.int32), np.empty(pieces)
        self.numbers[2] = np.arange(pieces)


class ExactClearance:
    """Exact distance between a footprint and the obstacles of a workspace.

    A broad phase bounds the distance to every convex piece of the obstacles from below; FCL is asked of the pieces that
    can be nearest.  The result is that of FCL over all pieces.
    """

    def __init__(self, workspace: Workspace, footprint: Footprint) -> None:
        self._pieces = _pieces(workspace)
        self._offset, self._body = footprint.offset, body_of(footprint)
        self._count = len(self._pieces.arrays.radius)
        self._memory = _Memory(footprint, self._count)

    def distance(self, x: float, y: float, theta: float = 0.0) -> float:
        """Distance (m) from the footprint at a pose to the nearest obstacle: 0 in contact, inf without obstacles."""
        solid, near = self._near(x, y, theta)
        if self._touches(solid, near):
            return 0.0
        least = math.inf
        for bound, piece in near:
            if bound >= least + SPREAD:
                break
            data = fcl.DistanceResult()
            least = min(least, fcl.distance(self._pieces.solid(piece), solid, DISTANCE, data))
        return max(0.0, float(least))  # FCL's distance is -1 for solids that just touch, and its contact test false

    def collides(self, x: float, y: float, theta: float = 0.0) -> bool:
        """Whether the footprint at a pose touches an obstacle."""
        return self._touches(*self._near(x, y, theta))

    def distances(self, poses: Matrix) -> Floats:
        """`distance` for each row x, y, theta of `poses`."""
        return np.array([self.distance(*pose) for pose in poses])

    def lower_bounds(self, poses: Matrix) -> Floats:
        """Lower bound (n,) of `distance` at poses (n, 3), m, without FCL; nothing touches where it exceeds `SPREAD`."""
        bounds = np.full(len(poses), math.inf)
        if self._count:
            poses, memory = np.ascontiguousarray(poses, dtype=float), self._memory
            lower_bounds(self._pieces.arrays, poses, self._body, memory.numbers, memory.gap, bounds)
        return bounds

    def least_distance(self, poses: Matrix) -> float:
        """Smallest `distance` at poses (n, 3), m: FCL is asked of those where it can be."""
        bounds, least = self.lower_bounds(poses), math.inf
        for k in np.argsort(bounds, kind="stable"):
            if bounds[k] >= least + SPREAD:
                break
            least = min(least, self.distance(*poses[k]))
        return least

    def first_contact(self, poses: Matrix) -> int | None:
        """Number of the first pose (n, 3) whose `distance` is 0, None without one: FCL is asked where it can be."""
        possible = np.flatnonzero(self.lower_bounds(poses) <= SPREAD)
        return next((k for k in possible.tolist() if self.distance(*poses[k]) <= 0.0), None)

    def _near(self, x: float, y: float, theta: float) -> tuple[fcl.CollisionObject, list[tuple[float, int]]]:
        """FCL's body at a pose, and bound and number of the pieces that may be nearest to it."""
        c, s = math.cos(theta), math.sin(theta)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        position = np.array([x + c * self._offset, y + s * self._offset, 0.0])
        memory = self._memory
        solid, numbers, gap = memory.solid, memory.numbers, memory.gap
        solid.setTransform(fcl.Transform(rotation, position))
        if not self._count:
            return solid, []
        pose = np.array([[x, y, theta]], dtype=float)
        count = nearest_pieces(self._pieces.arrays, pose, self._body, numbers, gap)
        return solid, sorted(zip(gap[:count].tolist(), numbers[0, :count].tolist(), strict=True))

    def _touches(self, solid: fcl.CollisionObject, near: list[tuple[float, int]]) -> bool:
        for bound, piece in near:
            if bound > SPREAD:
                break
            if fcl.collide(solid, self._pieces.solid(piece), CONTACT, fcl.CollisionResult()):
                return True
        return False


class _Pieces:
    """Convex pieces of all obstacles: as arrays, and as FCL's solids, each made when it is first needed."""

    def __init__(self, pieces: list[Polygon | Circle]) -> None:
        self.arrays, self._pieces = shapes(pieces), pieces
        self._solids: list[fcl.CollisionObject | None] = [None] * len(pieces)

    def solid(self, number: int) -> fcl.CollisionObject:
        """Upright solid of a piece."""
        solid = self._solids[number]
        if solid is None:
            solid = self._solids[number] = _solid(self._pieces[number])
        return solid


@lru_cache(8)  # the replanner and the measures of every trial use the same one
def _pieces(workspace: Workspace) -> _Pieces:
    """Convex pieces of all obstacles, which queries do not change."""
    pieces: list[Polygon | Circle] = []
    for obstacle in workspace.obstacles:
        if isinstance(obstacle, Circle):
            pieces.append(obstacle)
        elif isinstance(obstacle, Polygon):
            pieces += [Polygon(corners) for corners in triangles(obstacle.vertices)]
        else:
            pieces += obstacle.boxes()
    return _Pieces(pieces)


def _solid(piece: Polygon | Circle) -> fcl.CollisionObject:
    """Solid around the plane z = 0 with a piece as its cross-section."""
    if isinstance(piece, Circle):
        # A sphere around z = 0: its nearest point to an upright prism lies in that plane, and FCL is exact for it.
        return fcl.CollisionObject(fcl.Sphere(piece.radius), fcl.Transform(np.array([*piece.center, 0.0])))
    return _prism(piece.vertices)  # of a map's boxes too: FCL fails for two fcl.Box side by side


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
