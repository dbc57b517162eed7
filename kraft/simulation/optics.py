"""Lens and sensor of a camera: projection with Brown's distortion, its pose, and the errors of its calibration.

OpenCV, which only rendered sensing needs, is loaded here, with the tag that picture and detector know.
"""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from kraft.errors import MissingDependency
from ompl_ext.arrays import Floats, Matrix

WIDTH, HEIGHT = 1280, 720
"""Size of a frame, px."""
FIELD_OF_VIEW: Final = math.radians(70.4)
"""Along the width of a frame; as of a Logitech C920 (78 degrees along the diagonal), a RealSense D435 has 69."""


@dataclass(frozen=True)
class Lens:
    """Intrinsic parameters: focal length and principal point in px, OpenCV's distortion k1, k2, p1, p2, k3."""

    focal: float = 0.5 * WIDTH / math.tan(0.5 * FIELD_OF_VIEW)
    centre: tuple[float, float] = (0.5 * WIDTH - 0.5, 0.5 * HEIGHT - 0.5)
    distortion: tuple[float, float, float, float, float] = (0.10, -0.18, 0.0005, -0.0005, 0.0)

    @property
    def matrix(self) -> Matrix:
        """Camera matrix (3, 3)."""
        return np.array([[self.focal, 0.0, self.centre[0]], [0.0, self.focal, self.centre[1]], [0.0, 0.0, 1.0]])

    def distorted(self, points: Matrix) -> Matrix:
        """Pixels (n, 2) of points (n, 2) in the plane at distance 1 before the camera, x right and y down."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = points.T
        squared = x * x + y * y
        radial = 1.0 + squared * (k1 + squared * (k2 + squared * k3))
        pixels = np.empty((len(points), 2))
        pixels[:, 0] = x * radial + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x)
        pixels[:, 1] = y * radial + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y
        return self.focal * pixels + self.centre

    def undistorted(self, pixels: Matrix) -> Matrix:
        """Inverse of `distorted`, by fixed-point iteration."""
        wanted = (pixels - self.centre) / self.focal
        points = wanted.copy()
        for _ in range(8):
            points += wanted - (self.distorted(points) - self.centre) / self.focal
        return points


@dataclass(frozen=True)
class View:
    """Pose of a camera: position (3,), m, and rotation (3, 3) whose columns are its right, down and forward axes."""

    position: Floats
    rotation: Matrix

    @classmethod
    def towards(cls, position: Floats, target: Floats, along: Floats) -> View:
        """Camera at `position` that looks at `target`; the width of its frame lies along the direction `along`."""
        forward = (target - position) / np.linalg.norm(target - position)
        right = along - forward * forward.dot(along)
        right /= np.linalg.norm(right)
        return cls(position, np.stack([right, np.cross(forward, right), forward], axis=1))

    def points(self, world: Matrix) -> Matrix:
        """Points (n, 3) of the world in the camera's frame."""
        inside: Matrix = (world - self.position) @ self.rotation
        return inside


@dataclass(frozen=True)
class Calibration:
    """Standard deviations of what a calibration gets wrong: lens (px, and k1 and k2), position (m), rotation (rad)."""

    focal: float = 2.0
    centre: float = 1.0
    distortion: tuple[float, float] = (0.005, 0.01)
    position: float = 0.005
    rotation: float = math.radians(0.1)

    def of(self, lens: Lens, view: View, generator: np.random.Generator) -> tuple[Lens, View]:
        """Lens and pose as a calibration finds them."""
        draws = generator.standard_normal(11)
        k1, k2, *others = lens.distortion
        found = replace(
            lens,
            focal=lens.focal + self.focal * draws[0],
            centre=(lens.centre[0] + self.centre * draws[1], lens.centre[1] + self.centre * draws[2]),
            distortion=(k1 + self.distortion[0] * draws[3], k2 + self.distortion[1] * draws[4], *others),
        )
        turned = view.rotation @ rotation_about(self.rotation * draws[8:11])
        return found, View(view.position + self.position * draws[5:8], turned)


def rotation_about(vector: Floats) -> Matrix:
    """Rotation (3, 3) about a vector by its length, rad."""
    angle = math.sqrt(vector.dot(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = (vector / angle).tolist()
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Matrix = np.eye(3) + math.sin(angle) * skew + (1.0 - math.cos(angle)) * skew @ skew
    return rotation


PURPOSE: Final = "sensing.preset rendered"
DICTIONARY: Final = "DICT_4X4_50"


def opencv() -> Any:
    """The module.

    Raises:
        MissingDependency: if it is not installed, does not load or lacks the detector of tags.
    """
    try:
        cv2 = importlib.import_module("cv2")
        cv2.aruco.ArucoDetector  # noqa: B018 - builds of OpenCV may lack it
    except (ImportError, OSError, AttributeError) as error:
        problem = f"{PURPOSE} needs OpenCV with its detector of ArUco tags ({error})"
        raise MissingDependency(f"{problem}; pip install 'kraft[vision]'") from None
    return cv2


def dictionary() -> Any:
    """Dictionary of the tag; the car has number 0."""
    aruco = opencv().aruco
    return aruco.getPredefinedDictionary(getattr(aruco, DICTIONARY))


def tag_cells() -> Matrix:
    """Cells (n, n) of the tag with its black border, 1 for white, its picture's first row first."""
    words = dictionary()
    cells: Matrix = (opencv().aruco.generateImageMarker(words, 0, words.markerSize + 2) > 127).astype(float)
    return cells
