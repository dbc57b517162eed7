"""Camera that measures the pose of the marker on the car's roof, assuming a flat and level floor."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from kraft.driving.messages import Observation
from kraft.errors import Code, InputError
from kraft.scenario import Sensing
from kraft.simulation.noise import PRESETS, PoseNoise
from ompl_ext.arrays import Floats, Matrix

HALF_MARKER = 0.075
"""Half the side of the marker, m."""


class Camera(Protocol):
    """Takes frames and measures the pose of the marker."""

    def expose(self, time: float, position: Floats, rotation: Matrix) -> Observation | None:
        """Observation from a frame at `time` (s, ascending), None if the marker is not detected."""


class MarkerCamera:
    """Measures the pose of a marker; the robot gets no other information about the truth.

    The measured position is the intersection of the true line of sight with the plane in which the marker moves on a
    flat, level floor.  On a tilted floor or on a bump this position is wrong.
    """

    def __init__(self, sensing: Sensing, marker_height: float, seed: int) -> None:
        """Set up the camera of one trial.

        Args:
            sensing: preset, place and rate of the camera.
            marker_height: height of the marker above a flat floor, m.
            seed: seed of the errors; the same seed and exposures give the same observations.

        Raises:
            InputError: if the camera is not above the marker.
        """
        if sensing.camera[2] <= marker_height:
            raise InputError.of(
                "sensing.camera",
                f"is {sensing.camera[2]:g} m high",
                f"expected more than the marker's {marker_height:g} m",
                Code.GEOMETRY,
            )
        assert sensing.preset != "rendered", "RenderedCamera renders"
        preset = PRESETS[sensing.preset]
        dropout = preset.dropout if sensing.dropout is None else sensing.dropout
        generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 0xCA3E7A])))
        self.camera = np.array(sensing.camera)
        self._camera_position = tuple(float(value) for value in sensing.camera)
        self.latency = sensing.latency
        self.marker_height = marker_height
        self._noise = PoseNoise(preset, dropout, sensing.noise_scale, generator, sensing.correlation_time)

    def expose(self, time: float, position: Floats, rotation: Matrix) -> Observation | None:
        """Observation from a frame at `time` (s, ascending), None if the marker is not detected.

        `position` (3,) m and `rotation` (3, 3) of the marker are true, in the world's frame with z vertical; the
        marker's x axis points forward.
        """
        x, y, z = position.tolist()
        dx, dy, dz = (HALF_MARKER * part for part in rotation[:, 0].tolist())
        centre = self._on_plane(x, y, z)
        pose = x, y, math.atan2(dy, dx)
        error = self._noise.draw(time, self._sight(x, y, z), pose)
        if centre is None or error is None:
            return None
        front, rear = self._on_plane(x + dx, y + dy, z + dz), self._on_plane(x - dx, y - dy, z - dz)
        if front is None or rear is None:
            return None
        heading = math.atan2(front[1] - rear[1], front[0] - rear[0]) + error[2]
        return Observation(
            time=time,
            arrival=time + self.latency,
            x=centre[0] + error[0],
            y=centre[1] + error[1],
            theta=math.remainder(heading, math.tau),
        )

    def _on_plane(self, px: float, py: float, pz: float) -> tuple[float, float] | None:
        """Intersection of the line of sight to a point with the assumed plane, m; None for a point above the camera."""
        x, y, z = self._camera_position
        below = z - pz
        if below <= 0.0:
            return None
        share = (z - self.marker_height) / below
        return x + share * (px - x), y + share * (py - y)

    def _sight(self, px: float, py: float, pz: float) -> tuple[float, float, float]:
        """Line of sight to a point: length (m), angle from the vertical direction on the floor (rad)."""
        x, y, z = self._camera_position
        away = math.hypot(px - x, py - y)
        return math.hypot(away, z - pz), math.atan2(away, z - pz), math.atan2(py - y, px - x)
