"""Worlds without obstacles, and driving in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kraft.scenario import parse_scenario
from kraft.simulation import World

OPEN = """
name: open
bounds: {{x: [-50, 50], y: [-50, 50]}}
start: {{x: 0, y: 0, heading_deg: {heading}, speed: {speed}}}
goal: {{center: [40, 0], radius: 1}}
obstacles: [{obstacles}]
truth: {{{truth}}}
"""


def open_world(truth: str = "", speed: float = 0.0, heading: float = 0.0, obstacles: str = "") -> World:
    """A wide floor; the car starts at the origin, heading in degrees."""
    return World(parse_scenario(OPEN.format(truth=truth, speed=speed, heading=heading, obstacles=obstacles)))


def drive(
    world: World, throttle: float, steering: float, seconds: float, every: int = 5
) -> dict[str, NDArray[np.float64]]:
    """Hold a command; time, x, y, theta and speed every so many steps."""
    world.apply((throttle, steering))
    rows = []
    for _ in range(round(seconds / world.dt / every)):
        world.step(every)
        rows.append((world.time, *world.pose, world.speed))
    return dict(zip(("t", "x", "y", "theta", "v"), np.array(rows).T, strict=True))
