"""Camera that measures the pose of the marker in rendered frames."""

from __future__ import annotations

import functools
import math
from typing import Any, Final

import numpy as np

from kraft.driving.messages import Observation
from kraft.errors import Code, InputError
from kraft.scenario import Bounds, Scenario
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.simulation.camera import HALF_MARKER
from kraft.simulation.floor_frame import FloorFrame, yaw_rotation
from kraft.simulation.imager import (
    CORNERS,
    HEIGHT,
    WIDTH,
    Calibration,
    Imager,
    Imaging,
    Lens,
    View,
    dictionary,
    opencv,
    tag_corners,
)
from ompl_ext.arrays import Floats, Matrix

SMALLEST: Final = 12.0
"""Smallest side of the tag in the frame with which a scenario is accepted, px."""
HEADINGS: Final = 24
"""Headings of the tag in frames of the calibration."""


class RenderedCamera:
    """Takes frames of the tag and computes the car's pose from each; the robot gets nothing else.

    The camera stands at the scenario's `sensing.camera`, aimed at the middle of its bounds, the width of the frame
    along their longer side.  Its calibration is not exact; its errors are drawn once per trial.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        """Set up the camera of one trial.

        Raises:
            MissingDependency: if OpenCV or OpenGL is missing.
        """
        generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 0xCA3E7B])))
        lens, view = Lens(), view_of(scenario.sensing.camera, scenario.bounds)
        self.latency = scenario.sensing.latency
        self._imager = Imager(lens, view, Imaging(), generator)
        side = calibrated_side(scenario.sensing.camera, scenario.bounds.x, scenario.bounds.y)
        self._vision = TagVision(*Calibration().of(lens, view, generator), side)

    def expose(self, time: float, position: Floats, rotation: Matrix) -> Observation | None:
        """Observation from a frame at `time` (s, ascending), None if the marker is not detected.

        `position` (3,) m and `rotation` (3, 3) of the marker are true, in the world's frame with z vertical; the
        marker's x axis points forward.
        """
        frame = self._imager.frame(time, position, rotation)
        pose = None if frame is None else self._vision.pose(*frame)
        if pose is None:
            return None
        x, y, theta = pose
        return Observation(time=time, arrival=time + self.latency, x=x, y=y, theta=theta)


def check_sees(scenario: Scenario, frame: FloorFrame) -> None:
    """Check that the tag of a car at the start is in the frame, and large enough there to be detected.

    Nothing is rendered: an evaluation checks all of its scenarios before the first trial.

    Raises:
        InputError: at `sensing.camera`.
    """
    start, camera = scenario.start, scenario.sensing.camera
    position, rotation = np.array([start.x, start.y, MARKER_HEIGHT]), frame.rotation @ yaw_rotation(start.heading)
    corners = tag_corners(Lens(), view_of(camera, scenario.bounds), frame.to_world(position), rotation)
    if corners is None or not ((corners > 4.0) & (corners < (WIDTH - 5.0, HEIGHT - 5.0))).all():
        problem = "does not see the marker at the start"
        expected = "expected a place from which it is in view: 70 x 43 degrees about the centre of the bounds"
    elif (side := float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min())) < SMALLEST:
        problem = f"sees the marker at the start with a side of {side:.1f} px, too small to be detected"
        expected = f"expected at least {SMALLEST:g} px, from a place nearer to it or more above it"
    else:
        return
    raise InputError([scenario.source.diagnostic("sensing.camera", problem, expected, code=Code.GEOMETRY)])


def view_of(camera: tuple[float, float, float], bounds: Bounds) -> View:
    """Pose of a camera that is aimed at the middle of the bounds, the width of its frame along their longer side."""
    wide = bounds.x[1] - bounds.x[0] > bounds.y[1] - bounds.y[0]
    return View.towards(np.array(camera), _middle(bounds.x, bounds.y), np.array([float(wide), float(not wide), 0.0]))


@functools.lru_cache(maxsize=16)
def calibrated_side(camera: tuple[float, float, float], x: tuple[float, float], y: tuple[float, float]) -> float:
    """Side of the tag (m) with which vision finds the right mean distance of a tag in the middle of the bounds.

    Corners of blurred tags are found too far inside, by nearly half a pixel, so that with its true side a tag would
    appear 3 % too far away.  A user corrects the side until the measured height is right.
    """
    lens, view = Lens(), view_of(camera, Bounds(x=x, y=y))
    imager, vision = Imager(lens, view, Imaging(), np.random.default_rng(0)), TagVision(lens, view)
    position = _middle(x, y) + np.array([0.0, 0.0, MARKER_HEIGHT])
    distances = []
    for k in range(HEADINGS):
        frame = imager.frame(0.0, position, yaw_rotation(k / HEADINGS * math.tau))
        corners = None if frame is None else vision.corners(frame[0])
        tag = None if corners is None or frame is None else vision.tag(corners + frame[1])
        if tag is not None:
            distances.append(float(np.linalg.norm(tag[0] - view.position)))
    true = float(np.linalg.norm(position - view.position))
    return 2.0 * HALF_MARKER * (true / float(np.median(distances)) if distances else 1.0)


def _middle(x: tuple[float, float], y: tuple[float, float]) -> Floats:
    """Middle of the bounds on the floor."""
    return np.array([0.5 * sum(x), 0.5 * sum(y), 0.0])


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
