"""Ground surface for drawings: the tilted floor with its bumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kraft.scenario import Scenario
from kraft.scenario.truth import SpeedBump
from kraft.simulation.floor_frame import FloorFrame
from ompl_ext.arrays import Floats, Matrix


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
