"""The camera as its user knows it: where it is, how a sloping floor and the place of a marker change what it measures.

A camera that assumes a level floor reports where its line of sight to the marker meets the plane in which the marker
would move on a level floor.  On a sloping one that is too far from the camera where the floor is higher, and too near
where it is lower.  The pose of a single tag is uncertain along the line of sight, and much less across it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.driving.messages import Observation
from ompl_ext.arrays import Cube, Floats, Matrix
from ompl_ext.kernels.pose_fusion import INPUTS, pose_fusion

LEAST_ACROSS: Final = 0.25
"""Size of the errors across the line of sight, at least, as a share of that straight below the camera."""
BELOW: Final = 1e-9
"""Distance from the point below the camera within which a marker counts as straight below it, m."""


@dataclass(frozen=True)
class PowerLaw:
    """Size of an error as a power law of the distance d to the camera: `at_5m` (d / 5 m)^`power` exp(`slant` phi).

    phi (rad) is the angle between the line of sight and the vertical.
    """

    at_5m: float
    power: float = 0.0
    slant: float = 0.0

    @classmethod
    def through(cls, at_3m: float, at_5m: float) -> PowerLaw:
        """Power law through the values at 3 m and at 5 m, whatever phi."""
        return cls(at_5m, math.log(at_5m / at_3m) / math.log(5.0 / 3.0))

    def at(self, distance: float, phi: float = 0.0) -> float:
        """Size at a distance (m) and an angle (rad), in the unit it was given in."""
        return self.at_5m * math.pow(distance / 5.0, self.power) * math.exp(self.slant * phi)

    def at_each(self, distances: Floats, phis: Floats) -> Floats:
        """The same at distances and angles (n,)."""
        sizes: Floats = self.at_5m * (distances / 5.0) ** self.power * np.exp(self.slant * phis)
        return sizes


@dataclass(frozen=True)
class PoseErrors:
    """Errors of a measured pose by the place of the marker.

    `along` and `across` the camera's line of sight on the floor, and of the `heading`: as multiples of what the errors
    are straight below a camera in 5 m.  `mean` (m) is the mean error, away from the camera.
    """

    along: PowerLaw
    across: PowerLaw
    heading: PowerLaw
    mean: PowerLaw


SINGLE_TAG: Final = PoseErrors(
    along=PowerLaw(1.0, 2.0, 1.1),
    across=PowerLaw(1.0, 1.3, -4.7),
    heading=PowerLaw(1.0, 2.1, 1.9),
    mean=PowerLaw(0.0116, 2.8, 1.65),
)
"""Those of a tag of 15 cm whose height is not known, from rendered frames (python -m benchmarks sensing)."""


@dataclass(frozen=True)
class CameraModel:
    """Camera at `position` (x, y, z) m, and a marker that moves `marker_height` m above the floor.

    Attributes:
        position: of the camera, m.
        marker_height: of the marker above the floor, m.
        level_at: x, y (m) where the floor is at the height that the camera takes it to be at, if it takes the floor as
            level; None if it measures heights itself.
        errors: of the poses by the place of the marker; None if they are the same everywhere.
    """

    position: tuple[float, float, float]
    marker_height: float
    level_at: tuple[float, float] | None = None
    errors: PoseErrors | None = None

    @property
    def values(self) -> Floats:
        """(6,) that compiled code reads, see `ompl_ext.kernels.pose_fusion`; none if the camera measures heights."""
        if self.level_at is None:
            return np.zeros(0)
        return np.array([*self.position, self.marker_height, *self.level_at], dtype=np.float64)

    def seen(self, poses: Matrix, floor: Floats) -> Matrix:
        """Measured poses (n, 3) of poses (n, 3) on a floor (2,)."""
        seen = np.empty_like(poses)
        pose_fusion().see(self.values, poses, np.concatenate([np.zeros(3), floor]), seen)
        return seen

    def linearised(self, poses: Matrix, floor: Floats) -> tuple[Matrix, Cube]:
        """Measured poses (n, 3), and their Jacobians (n, 3, 5) with respect to the poses (n, 3) and the floor (2,)."""
        seen, jacobians = np.empty_like(poses), np.empty((*poses.shape, INPUTS))
        inputs, work = np.concatenate([np.zeros(3), floor]), np.empty((2, INPUTS))
        pose_fusion().linearise(self.values, poses, inputs, seen, jacobians, work)
        return seen, jacobians

    def without_mean(self, pose: Observation) -> Observation:
        """A measured pose without the mean error."""
        if self.errors is None:
            return pose
        from_x, from_y, height = pose.x - self.position[0], pose.y - self.position[1], self._above
        away = math.hypot(from_x, from_y)
        if away < BELOW:
            return pose
        share = self.errors.mean.at(math.hypot(away, height), math.atan2(away, height)) / away
        return Observation(pose.time, pose.arrival, pose.x - share * from_x, pose.y - share * from_y, pose.theta)

    def spread(self, x: float, y: float) -> Matrix:
        """Errors (3, 3) of a pose at a place (m), by those along and across the line of sight and of the heading.

        As multiples of those straight below a camera in 5 m; the unit matrix if errors are the same everywhere.
        """
        if self.errors is None:
            return np.eye(3)
        from_x, from_y = x - self.position[0], y - self.position[1]
        away = float(np.hypot(from_x, from_y))
        along_x, along_y = (1.0, 0.0) if away < BELOW else (from_x / away, from_y / away)
        (along,), (across,), (heading,) = (sizes.tolist() for sizes in self._sizes(self.errors, np.array([away])))
        return np.array(
            [[along * along_x, -across * along_y, 0.0], [along * along_y, across * along_x, 0.0], [0.0, 0.0, heading]]
        )

    def frames(self, places: Matrix) -> Floats | None:
        """Inverses (n, 3, 3) of `spread` at places (n, 2): they take errors to those straight below the camera.

        None if errors are the same everywhere.
        """
        if self.errors is None:
            return None
        from_camera = places - self.position[:2]
        away = np.hypot(*from_camera.T)
        below = away < BELOW
        directions = np.where(below[:, None], (1.0, 0.0), from_camera / np.where(below, 1.0, away)[:, None])
        along, across, heading = self._sizes(self.errors, away)
        frames = np.zeros((len(places), 3, 3))
        frames[:, 0, :2] = directions / along[:, None]
        frames[:, 1, 0], frames[:, 1, 1] = -directions[:, 1] / across, directions[:, 0] / across
        frames[:, 2, 2] = 1.0 / heading
        return frames

    def _sizes(self, errors: PoseErrors, away: Floats) -> tuple[Floats, Floats, Floats]:
        """Sizes (n,) of errors along the line of sight, across it and of the heading, `away` (n,) m from the camera.

        That is the distance on the floor.
        """
        sight = np.hypot(away, self._above), np.arctan2(away, self._above)
        across = np.maximum(LEAST_ACROSS, errors.across.at_each(*sight))
        return errors.along.at_each(*sight), across, errors.heading.at_each(*sight)

    @property
    def _above(self) -> float:
        """Height of the camera above the marker, m."""
        return self.position[2] - self.marker_height
