"""Floor's frame, the frame of maps and plans, relative to the world's frame, in which gravity is vertical."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import mujoco
import numpy as np

from kraft.scenario import Scenario
from kraft.scenario.truth import SpeedBump, Tilt
from ompl_ext.arrays import Floats, Matrix


def quaternion(rotation: Matrix) -> Any:
    """Unit quaternion (w, x, y, z) of a rotation (3, 3)."""
    result = np.empty(4)
    mujoco.mju_mat2Quat(result, rotation.ravel())
    return result


def yaw_rotation(yaw: float) -> Matrix:
    """Rotation (3, 3) about the vertical (rad)."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_quaternion(yaw: float) -> list[float]:
    """Unit quaternion (w, x, y, z) of a rotation about the vertical (rad)."""
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


TURNED_OVER: Final = math.radians(60.0)
"""Angle between the normal of the floor and that of a robot from which on it does not come back onto its wheels."""


@dataclass(frozen=True, eq=False)
class FloorFrame:
    """`rotation` (3, 3) and `origin` (3,), m, of the floor's frame in the world's; the same frames without a tilt."""

    rotation: Matrix
    origin: Floats

    @classmethod
    def of(cls, tilt: Tilt | None) -> FloorFrame:
        """Tilt the floor about the origin of the map, which stays at height 0."""
        if tilt is None:
            return cls(np.eye(3), np.zeros(3))
        return cls(_tilt_rotation(tilt.slope, tilt.uphill), np.zeros(3))

    @classmethod
    def rising(cls, slope: Floats, point: Floats) -> FloorFrame:
        """Floor that rises by `slope` (2,), at most 1, per metre along its x and y about its `point` (3,), m."""
        rotation = _tilt_rotation(math.asin(float(np.linalg.norm(slope))), math.atan2(slope[1], slope[0]))
        return cls(rotation, point - rotation @ point)

    @cached_property
    def _rows(self) -> list[list[float]]:
        rows: list[list[float]] = self.rotation.tolist()
        return rows

    @property
    def normal(self) -> Floats:
        """The floor's normal in the world's frame, (3,)."""
        upwards: Floats = self.rotation[:, 2]
        return upwards

    def has_turned_over(self, rotation: Matrix) -> bool:
        """Whether a robot with this rotation (3, 3) in the world's frame lies on its side or its roof."""
        return float(self.normal @ rotation[:, 2]) < math.cos(TURNED_OVER)

    def to_world(self, point: Floats) -> Floats:
        """A point (3,) of the floor's frame in the world's, m."""
        seen: Floats = self.origin + self.rotation @ point
        return seen

    def to_floor(self, point: Floats) -> Floats:
        """A point (3,) of the world's frame in the floor's, m."""
        seen: Floats = self.rotation.T @ (point - self.origin)
        return seen

    def along_floor(self, vector: Floats) -> tuple[float, float]:
        """Components along the floor's x and y axes of a vector (3,) of the world's frame.

        Computed with plain numbers, which is faster than a matrix product: each tick of the controller calls it, with
        the processor's caches full of the physics.
        """
        (xx, xy, _), (yx, yy, _), (zx, zy, _) = self._rows
        x, y, z = vector.tolist()
        return xx * x + yx * y + zx * z, xy * x + yy * y + zy * z


def _tilt_rotation(angle: float, uphill: float) -> Matrix:
    """Rotation that lifts the direction `uphill` (rad from +x) by `angle` (rad), (3, 3)."""
    axis = np.array([math.sin(uphill), -math.cos(uphill), 0.0])
    cross = np.array([[0.0, 0.0, axis[1]], [0.0, 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    # Rodrigues' formula
    rotation: Matrix = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    return rotation


@dataclass(frozen=True, eq=False)
class Surface:
    """Height of the ground; points are in the floor's frame (m) unless stated otherwise."""

    frame: FloorFrame
    bumps: tuple[SpeedBump, ...] = ()

    @classmethod
    def of(cls, scenario: Scenario, frame: FloorFrame) -> Surface:
        """Ground of a scenario's world whose floor has the pose `frame`."""
        return cls(frame, scenario.truth.speed_bumps)

    def heights(self, points: Matrix) -> Floats:
        """Height (n,) of the ground above the floor at points (n, 2)."""
        heights = np.zeros(len(points))
        for bump in self.bumps:
            heights = np.maximum(heights, _ridge(bump, points))
        return heights

    def raised(self, points: Matrix, rise: float) -> Matrix:
        """Points (n, 2) as (n, 3), `rise` above the ground."""
        return np.column_stack([points, self.heights(points) + rise])

    def to_world(self, points: Matrix) -> Matrix:
        """Points (n, 3) in the world's frame."""
        seen: Matrix = points @ self.frame.rotation.T + self.frame.origin
        return seen


def _ridge(bump: SpeedBump, points: Matrix) -> Floats:
    """Height (n,) of one bump, a slice of a lying cylinder; 0 beside it."""
    c, s = np.cos(bump.yaw), np.sin(bump.yaw)
    offset = (points - bump.center) @ np.array([[c, -s], [s, c]])
    lengthwise = bump.size[0] >= bump.size[1]
    across, along = (offset[:, 1], offset[:, 0]) if lengthwise else (offset[:, 0], offset[:, 1])
    half, length = min(bump.size) / 2, max(bump.size)
    height = min(bump.height, half)
    radius = (half**2 + height**2) / (2 * height)
    rise = np.sqrt(np.maximum(radius**2 - across**2, 0.0)) + height - radius
    on_it: Floats = np.where(np.abs(along) <= length / 2, np.maximum(rise, 0.0), 0.0)
    return on_it
