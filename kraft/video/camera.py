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
        self._time = -math.inf
        self._heading = self._rate = 0.0
        self._elevation = LOWEST

    def aim(self, world: World) -> Aim:
        """Where it is now; to be asked in the order of time."""
        x, y, theta = map(float, world.pose)
        self._follow(world.time, theta, self._clear(world, x, y))
        along = np.array([math.cos(self._heading), math.sin(self._heading), 0.0])
        target = np.array([x, y, 0.08]) + AHEAD * along
        offset = DISTANCE * (math.sin(self._elevation) * np.array([0, 0, 1.0]) - math.cos(self._elevation) * along)
        rotation = world.frame.rotation
        position = world.frame.to_world(target + offset)
        return Aim(position, *_levelled(rotation @ -offset), math.tan(FIELD_OF_VIEW / 2), True)

    def _follow(self, time: float, heading: float, elevation: float) -> None:
        """Second-order, critically damped; the first time it is there at once."""
        dt = time - self._time
        self._time = time
        if not math.isfinite(dt):
            self._heading, self._elevation = heading, elevation
            return
        pull = 2.0 / SETTLING
        ahead = math.remainder(heading - self._heading, math.tau)
        error, decay = -ahead, math.exp(-pull * dt)
        slope = self._rate + pull * error
        self._heading = self._heading + ahead + (error + slope * dt) * decay
        self._rate = (self._rate - pull * slope * dt) * decay
        self._elevation += (elevation - self._elevation) * (1.0 - math.exp(-pull * dt))

    def _clear(self, world: World, x: float, y: float) -> float:
        """The lowest elevation from which nothing hides the roof."""
        roof = world.frame.to_world(np.array([x, y, ROOF]))
        back = np.array([-math.cos(self._heading), -math.sin(self._heading), 0.0])
        hit = np.zeros(1, np.int32)
        for elevation in np.arange(LOWEST, HIGHEST, STEP):
            towards = math.cos(elevation) * back + math.sin(elevation) * np.array([0.0, 0.0, 1.0])
            sight = world.frame.rotation @ towards
            distance = mujoco.mj_ray(world.model, world.data, roof, sight, SOLID, True, -1, hit)
            if distance < 0.0 or distance > DISTANCE:
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
