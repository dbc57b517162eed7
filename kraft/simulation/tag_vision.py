"""The pose of a car from a camera's frame: OpenCV's ArUco detector and its pose of a single tag."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kraft.simulation.camera import HALF_MARKER
from kraft.simulation.car import MARKER_HEIGHT
from kraft.simulation.imager import CORNERS
from kraft.simulation.optics import WIDTH, Lens, View, dictionary, opencv
from ompl_ext.arrays import Floats, Matrix


class TagVision:
    """Detects the tag and computes the pose of the car below it."""

    def __init__(self, lens: Lens, view: View, side: float = 2.0 * HALF_MARKER) -> None:
        """Lens and pose of the camera, and side of the tag (m), are those that the calibration found.

        Raises:
            MissingDependency: if OpenCV is missing.
        """
        self._cv2, self._view = opencv(), view
        self._matrix, self._distortion = lens.matrix, np.array(lens.distortion)
        self._corners = CORNERS * (side / (2.0 * HALF_MARKER))
        aruco = self._cv2.aruco
        self._dictionary, self._settings = dictionary(), aruco.DetectorParameters()
        self._settings.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        # the edge of the paper is close to the tag's: with OpenCV's 0.125 a quarter of the tags is not detected
        self._settings.minMarkerDistanceRate = 0.05
        self._perimeter = self._settings.minMarkerPerimeterRate * WIDTH

    def pose(self, frame: Any, first: Floats) -> tuple[float, float, float] | None:
        """Pose (x, y, theta) of the car from the part of a frame that begins at column and row `first`; None without.

        The reference point of the car is the marker's height below the tag, along the tag's own normal: the static
        transform of a ROS system from the tag's frame to the car's.
        """
        corners = self.corners(frame)
        tag = None if corners is None else self.tag(corners + first)
        if tag is None:
            return None
        position, rotation = tag
        x, y, _ = (position - MARKER_HEIGHT * rotation[:, 2]).tolist()
        return x, y, math.atan2(rotation[1, 0], rotation[0, 0])

    def corners(self, frame: Any) -> Matrix | None:
        """Corners (4, 2) of the tag in a frame or a part of one, px; None if it is not detected."""
        if min(frame.shape) < 8:
            return None
        self._settings.minMarkerPerimeterRate = self._perimeter / max(frame.shape)  # as in the whole frame
        detector = self._cv2.aruco.ArucoDetector(self._dictionary, self._settings)
        found, numbers, _ = detector.detectMarkers(frame)
        for corners, number in zip(found, [] if numbers is None else numbers.ravel(), strict=True):
            if number == 0:
                return np.asarray(corners, float).reshape(4, 2)
        return None

    def tag(self, corners: Matrix) -> tuple[Floats, Matrix] | None:
        """Position (3,), m, and rotation (3, 3) of the tag in the world from its corners (4, 2), px.

        Two poses fit the picture of a tag nearly equally well; OpenCV returns the better fit, at times the wrong pose.
        """
        solved, turn, place = self._cv2.solvePnP(
            self._corners, corners, self._matrix, self._distortion, flags=self._cv2.SOLVEPNP_IPPE_SQUARE
        )
        if not solved or not np.isfinite(turn).all():
            return None
        rotation: Matrix = self._view.rotation @ self._cv2.Rodrigues(turn)[0]
        return self._view.position + self._view.rotation @ place.ravel(), rotation
