"""Where the pictures are taken from: behind the car, and from above."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from kraft.scenario import Bounds
from kraft.simulation.world import World
from ompl_ext.arrays import Floats

FIELD_OF_VIEW: Final = math.radians(45.0)
DISTANCE: Final = 2.1
"""Between the camera and what it looks at, m."""
AHEAD: Final = 0.5
"""How far in front of the car it looks, m."""
LOWEST, HIGHEST, STEP = math.radians(36.0), math.radians(80.0), math.radians(3.0)
"""Elevation of the camera above the floor: as low as nothing stands between it and the car."""
SETTLING: Final = 0.35
"""Time in which the camera follows a turn, s."""
ROOF: Final = 0.26
SOLID: Final = np.array([1, 1, 0, 0, 0, 0], np.uint8)
"""Groups of geoms that can hide the car."""


@dataclass(frozen=True)
class Aim:
    """A camera in the world's frame; `half` is half the picture's height: a tangent, or metres without perspective."""

    position: Floats
    forward: Floats
    up: Floats
    half: float
    perspective: bool

    def apply(self, scene: Any, near: float, far: float) -> None:
        """Make it the camera of a scene that sees from `near` to `far` m."""
        top = self.half * near if self.perspective else self.half
        for camera in scene.camera:
            camera.pos, camera.forward, camera.up = self.position, self.forward, self.up
            camera.frustum_near, camera.frustum_far = near, far
            camera.frustum_bottom, camera.frustum_top = -top, top
            camera.frustum_center = camera.frustum_width = 0.0
            camera.orthographic = int(not self.perspective)


class ChaseCamera:
    """Behind and above the car; turns smoothly, and rises where an obstacle would hide the car."""

    def __init__(self) -> None:
        self._time, self._dt = -math.inf, math.inf
        self._heading = self._rate = 0.0
        self._elevation = LOWEST

    def aim(self, world: World) -> Aim:
        """Where it is now; to be asked in the order of time."""
        x, y, theta = map(float, world.pose)
        self._turn(world.time, theta)
        self._rise(self._clear(world, x, y))
        target, offset = self._place(x, y, self._elevation)
        position = world.frame.to_world(target + offset)
        return Aim(position, *_levelled(world.frame.rotation @ -offset), math.tan(FIELD_OF_VIEW / 2), True)

    def _place(self, x: float, y: float, elevation: float) -> tuple[Floats, Floats]:
        """What it looks at, and where it is from there, in the floor's frame, m."""
        along, up = np.array([math.cos(self._heading), math.sin(self._heading), 0.0]), np.array([0.0, 0.0, 1.0])
        offset = DISTANCE * (math.sin(elevation) * up - math.cos(elevation) * along)
        return np.array([x, y, 0.08]) + AHEAD * along, offset

    def _turn(self, time: float, heading: float) -> None:
        """Follow the heading like a critically damped spring; the first time it is there at once."""
        self._dt, self._time = time - self._time, time
        if not math.isfinite(self._dt):
            self._heading = heading
            return
        pull = 2.0 / SETTLING
        ahead = math.remainder(heading - self._heading, math.tau)
        slope, decay = self._rate - pull * ahead, math.exp(-pull * self._dt)
        self._heading += ahead + (slope * self._dt - ahead) * decay
        self._rate = (self._rate - pull * slope * self._dt) * decay

    def _rise(self, elevation: float) -> None:
        """Rise at once, so that nothing gets between; come down slowly."""
        share = 1.0 - math.exp(-self._dt / SETTLING)
        self._elevation = max(elevation, self._elevation + (elevation - self._elevation) * share)

    def _clear(self, world: World, x: float, y: float) -> float:
        """The lowest elevation from which nothing hides the roof."""
        roof = np.array([x, y, ROOF])
        start, hit = world.frame.to_world(roof), np.zeros(1, np.int32)
        for elevation in np.arange(LOWEST, HIGHEST, STEP):
            target, offset = self._place(x, y, float(elevation))
            sight = world.frame.rotation @ (target + offset - roof)
            distance = mujoco.mj_ray(world.model, world.data, start, sight, SOLID, True, -1, hit)
            if distance < 0.0 or distance > 1.0:  # in lengths of the sight
                return float(elevation)
        return HIGHEST


def _levelled(sight: Floats) -> tuple[Floats, Floats]:
    """Unit vectors forward and up of a camera that looks along `sight` and keeps the horizon level."""
    forward = sight / np.linalg.norm(sight)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return forward, np.cross(right, forward)


def map_aim(world: World, bounds: Bounds, aspect: float) -> Aim:
    """From above, square to the floor, without perspective; `aspect` is the picture's width over its height.

    +y points up in the picture, or +x if the scene is wider than high.
    """
    size = np.array([bounds.x[1] - bounds.x[0], bounds.y[1] - bounds.y[0]])
    wide = size[0] > size[1]
    across, along = size[::-1] if wide else size
    half = 0.5 * max(along, across / aspect) + 0.12
    rotation = world.frame.rotation
    centre = world.frame.to_world(np.array([sum(bounds.x) / 2, sum(bounds.y) / 2, 0.0]))
    up = rotation[:, 0] if wide else rotation[:, 1]
    return Aim(centre + 10.0 * rotation[:, 2], -rotation[:, 2], up, half, False)
