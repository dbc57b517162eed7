"""Errors of a camera along drives of a car and of cars that stand, whatever the camera is."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.scenario import Scenario, load_scenario
from kraft.scenario.scenario import Start
from kraft.simulation.camera import Camera
from kraft.simulation.world import World
from ompl_ext.arrays import Floats, Matrix

RATE: Final = 30.0
ROUTE: Final = ((1.0, 0.3), (1.6, 1.5), (1.0, 2.5), (0.4, 3.5), (1.0, 5.0))
"""Way of a car through `turns`."""
X, Y = (0.0, 2.0), (-0.7, 5.7)
"""Where cars drive and stand, m."""
MakeCamera = Callable[[Scenario, int], Camera]


@dataclass(frozen=True)
class Errors:
    """Errors of the frames of one drive, or of a car that stands; n frames at 30 Hz.

    Attributes:
        error: (n, 3), along and across the line of sight (m) and heading (rad); nan where the tag was not detected.
        distance: (n,) to the camera, m.
        place: (n, 2) true position, m.
        seconds: processor time of a frame.
    """

    error: Matrix
    distance: Floats
    place: Matrix
    seconds: float


def free_scene() -> Scenario:
    """`turns` without obstacles: the camera and the size of the paper's scenes."""
    return dataclasses.replace(load_scenario("turns"), obstacles=())


def drive(number: int, seconds: float, make: MakeCamera) -> Errors:
    """Every second drive follows the way through `turns`, the others go to random points; speeds are random."""
    generator = np.random.default_rng([number, 1])
    scene = free_scene()
    points = [np.array(p) + generator.normal(0.0, 0.1, 2) for p in ROUTE]
    start = Start(1.0, -0.5, 0.5 * math.pi)
    if number % 2:
        points = [np.array([generator.uniform(0.3, 1.7), generator.uniform(0.2, 4.8)]) for _ in range(20)]
        start = Start(generator.uniform(0.3, 1.7), generator.uniform(0.5, 4.5), generator.uniform(-3.1, 3.1))
    throttle = generator.uniform(0.6, 1.0)

    def command(pose: Floats) -> tuple[float, float] | None:
        while points and math.dist(points[0], pose[:2]) < 0.35:
            points.pop(0)
        if not points:
            return None
        ahead = math.remainder(math.atan2(*(points[0] - pose[:2])[::-1]) - pose[2], math.tau)
        return throttle, min(max(1.2 * ahead, -0.38), 0.38)

    return _frames(scene, start, number, round(seconds * RATE), make, command)


def stand(number: int, seconds: float, make: MakeCamera) -> Errors:
    """A car that stands at a random pose."""
    generator = np.random.default_rng([number, 2])
    start = Start(generator.uniform(*X), generator.uniform(*Y), generator.uniform(-math.pi, math.pi))
    return _frames(free_scene(), start, number, round(seconds * RATE), make, lambda pose: (0.0, 0.0))


def _frames(
    scene: Scenario, start: Start, seed: int, count: int, make: MakeCamera,
    command: Callable[[Floats], tuple[float, float] | None],
) -> Errors:  # fmt: skip
    world, camera = World(scene), make(scene, seed)
    world.reset(start)
    world.step(250)  # the suspension comes to rest
    begun, spent = world.steps, 0.0
    errors, places, distances = np.full((count, 3), math.nan), np.empty((count, 2)), np.empty(count)
    eye = np.array(scene.sensing.camera)
    for k in range(count):
        world.step(max(round(k / RATE / world.dt) + begun - world.steps, 0))
        pose, marker = world.pose, world.marker
        before = time.process_time()
        seen = camera.expose(world.time, *marker)
        spent += time.process_time() - before
        places[k], distances[k] = pose[:2], np.linalg.norm(marker[0] - eye)
        if seen is not None:
            sight = math.atan2(pose[1] - eye[1], pose[0] - eye[0])
            c, s, dx, dy = math.cos(sight), math.sin(sight), seen.x - pose[0], seen.y - pose[1]
            errors[k] = c * dx + s * dy, c * dy - s * dx, math.remainder(seen.theta - pose[2], math.tau)
        given = command(pose)
        if given is None:
            count = k + 1
            break
        world.apply(given)
    return Errors(errors[:count], distances[:count], places[:count], spent / count)
