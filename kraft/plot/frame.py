"""Frame of the map on the page, trajectories of poses, and the footprint along them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kraft.planning.workspace import poses_of
from kraft.scenario import Bounds
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Footprint, Vehicle

TALL = 1.2  # a scene higher than this many widths is turned by a quarter, so that it fills the page's width
MARGIN = 0.02  # of the longer side, so that walls on the bounds are visible


@dataclass(frozen=True)
class Frame:
    """The visible part of the world, m, and whether the page shows it turned clockwise by a quarter.

    Page coordinates are metres too: (x, y), or (y, -x) when turned.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    turned: bool

    @classmethod
    def around(cls, bounds: Bounds) -> Frame:
        """Frame of the bounds with a margin; never flatter than 1 : 8, so that there is room for labels."""
        width, height = (high - low for low, high in (bounds.x, bounds.y))
        longest = max(width, height)
        spans = []
        for (low, high), size in ((bounds.x, width), (bounds.y, height)):
            margin = max(MARGIN * longest, (longest / 8 - size) / 2)
            spans.append((low - margin, high + margin))
        return cls(spans[0], spans[1], height > TALL * width)

    @property
    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Horizontal and vertical limits of the page, m."""
        return (self.y, (-self.x[1], -self.x[0])) if self.turned else (self.x, self.y)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height on the page, m."""
        (left, right), (low, high) = self.limits
        return right - left, high - low

    def points(self, world: Floats) -> Floats:
        """Page coordinates of points in the world, both of shape (..., 2), m."""
        return np.stack([world[..., 1], -world[..., 0]], axis=-1) if self.turned else world

    def heading(self, theta: float) -> float:
        """Direction on the page, rad, of a heading in the world."""
        return theta - math.pi / 2 if self.turned else theta


@dataclass(frozen=True)
class PoseTrajectory:
    """Poses (m, 3), x, y in m and theta in rad, at increasing `times` (m,) in s."""

    times: Floats
    poses: Matrix

    @classmethod
    def of(cls, times: Floats, states: Matrix, vehicle: Vehicle) -> PoseTrajectory:
        """The poses of states (m, nx); a vehicle without theta never turns."""
        poses = poses_of(states, vehicle)
        poses[:, 2] = np.unwrap(poses[:, 2])
        return cls(times, poses)

    @property
    def end(self) -> float:
        """Time of the last pose, s."""
        return float(self.times[-1])

    def at(self, times: Floats) -> Matrix:
        """Poses (k, 3) at `times` (k,), s, by linear interpolation."""
        return np.column_stack([np.interp(times, self.times, column) for column in self.poses.T])

    def between(self, begin: float, end: float) -> Matrix:
        """Poses from `begin` to `end`, s, including the interpolated poses at both."""
        inside = self.times[(self.times > begin) & (self.times < end)]
        return self.at(np.concatenate([[begin], inside, [end]]))

    @property
    def length(self) -> float:
        """Distance travelled, m."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())


def outlines(footprint: Footprint, poses: Matrix) -> Floats:
    """The footprint at each pose (k, 3): corners in the world, shape (k, 4, 2), m."""
    return _placed(footprint.corners(), poses)


def arrowheads(footprint: Footprint, poses: Matrix) -> Floats:
    """Mark at the front of each footprint that shows the heading: shape (k, 3, 2), m."""
    front, half = footprint.offset + footprint.length / 2, footprint.width / 2
    tip, back = front - 0.08 * footprint.length, front - 0.25 * footprint.length
    return _placed(np.array([[back, 0.5 * half], [tip, 0.0], [back, -0.5 * half]]), poses)


def _placed(points: Floats, poses: Matrix) -> Floats:
    """Points (n, 2) of the body frame in the world, at each pose (k, 3): shape (k, n, 2)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    placed: Floats = np.einsum("kij,nj->kni", turn, points) + poses[:, None, :2]
    return placed
