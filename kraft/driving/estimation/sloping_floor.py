"""Poses that a camera measures on the assumption of a level floor, when the floor slopes.

Such a camera reports where its line of sight to the marker meets the plane in which the marker would move on a level
floor.  On a sloping one that is too far from the camera where the floor is higher, and too near where it is lower.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from ompl_ext.arrays import Floats, Matrix

HALF_LENGTH: Final = 0.1
"""Half the distance between two points that show a heading, m."""
DIFFERENCE: Final = 1e-4
"""Step of the numeric derivatives, SI."""
FLOOR_SIZE: Final = 2
"""Number of components of a floor: rise per metre of floor along x and along y."""


@dataclass(frozen=True)
class LevelCamera:
    """Camera at `position` (x, y, z) m that takes the floor as level, and the marker as `marker_height` m above it.

    `start` is the x, y (m) where the floor is at the height that the camera takes it to be at.
    """

    position: tuple[float, float, float]
    marker_height: float
    start: tuple[float, float]

    def linearised(self, pose: Floats, floor: Floats) -> tuple[Floats, Matrix]:
        """Measured pose (3,), and its Jacobian (3, 5) with respect to the pose and the floor."""
        steps = DIFFERENCE * np.vstack([np.zeros(5), np.eye(5), -np.eye(5)])
        seen = self._observed(pose + steps[:, :3], floor + steps[:, 3:])
        return seen[0], (seen[1:6] - seen[6:]).T / (2.0 * DIFFERENCE)

    def on_floor(self, poses: Matrix, floor: Floats) -> Matrix:
        """Poses (n, 3) on a floor (2,), given those (n, 3) that were measured."""
        return _mapped(poses, partial(self._place_on_floor, floor=floor))

    def _observed(self, poses: Matrix, floors: Matrix) -> Matrix:
        """Measured poses (n, 3) of poses (n, 3) on a floor (2,) each."""
        return _mapped(poses, partial(self._observed_place, floors=floors))

    def _observed_place(self, places: Matrix, floors: Matrix) -> Matrix:
        """Measured places (n, 2) of the marker for places (n, 2) of the vehicle, on a floor (2,) each."""
        x, y, z = self.position
        slope, away = floors, places - self.start
        level = np.sqrt(np.maximum(1.0 - (slope * slope).sum(axis=1), 0.0))  # cosine of the angle of the slope
        rise = (slope * away).sum(axis=1)
        marker = self.start + away - (rise / (1.0 + level) + self.marker_height)[:, None] * slope
        height = rise + self.marker_height * level
        stretch = (z - self.marker_height) / np.maximum(z - height, 0.1 * z)
        seen: Matrix = (x, y) + stretch[:, None] * (marker - (x, y))
        return seen

    def _place_on_floor(self, seen: Matrix, floor: Floats) -> Matrix:
        """Inverse of `_observed_place` for one floor: where the line of sight meets the plane of the marker."""
        x, y, z = self.position
        slope, level = floor, math.sqrt(max(1.0 - float(floor @ floor), 0.0))
        # The marker is at `camera` + share (seen - camera), at the height z - share (z - marker_height).
        direction = seen - (x, y)
        away = np.array([x, y]) - self.start + self.marker_height * slope
        above = z - self.marker_height * level - slope @ away / level
        share = above / (z - self.marker_height + direction @ slope / level)
        marker = (x, y) + share[:, None] * direction - self.start + self.marker_height * slope
        rise = marker @ slope / level
        place: Matrix = self.start + marker + (rise / (1.0 + level))[:, None] * slope
        return place


def _mapped(poses: Matrix, place: Callable[[Matrix], Matrix]) -> Matrix:
    """Poses (n, 3) of which `place` maps the two points that show the heading; it stays within half a turn."""
    along = HALF_LENGTH * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    front, rear = place(poses[:, :2] + along), place(poses[:, :2] - along)
    turned = np.arctan2(*(front - rear).T[::-1]) - poses[:, 2]
    turned -= math.tau * np.round(turned / math.tau)
    return np.column_stack([0.5 * (front + rear), poses[:, 2] + turned])
