"""Random scenes: obstacles of every kind, start, goal, vehicle, settings; scene number k is always the same."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from benchmarks.exact import Body, Disc, Rectangle, Solid, Star
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats
from ompl_ext.obstacles import Circle, Obstacle, Polygon, Workspace, box
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.vehicle import Footprint, Vehicle

VEHICLES = ("mushr", "benchmark", "unicycle2")
SEED = 20_240
TRIES = 200  # to place a start or a goal
ROOM = 0.02  # beyond what is asked for that a start has (m)


@dataclass(frozen=True)
class RandomScene:
    """A query, and its obstacles once more as the independent check wants them."""

    number: int
    vehicle: Vehicle
    workspace: Workspace
    solids: tuple[Solid, ...]
    start: Floats
    goal: Goal
    safety: Safety
    settings: Settings
    iterations: int


def random_scene(number: int) -> RandomScene:
    """Scene `number`."""
    rng = np.random.default_rng([SEED, number])
    vehicle = random_vehicle(rng)
    width, height = rng.uniform(2.5, 6.0, 2)
    bounds = ((0.0, float(width)), (0.0, float(height)))
    solids = (*(random_solid(rng, bounds) for _ in range(rng.integers(2, 11))), *walls(bounds))
    safety = random_safety(rng)
    body = Body(solids, vehicle.footprint)
    start = random_start(rng, vehicle, bounds, body, safety)
    goal = random_goal(rng, bounds, solids, start)
    workspace = Workspace(bounds, tuple(obstacle_of(solid) for solid in solids))
    return RandomScene(
        number, vehicle, workspace, solids, start, goal, safety, random_settings(rng), int(rng.integers(300, 5000))
    )


@cache
def vehicle_named(name: str) -> Vehicle:
    """A bundled vehicle, loaded once per process."""
    return load_vehicle(name)


def random_vehicle(rng: np.random.Generator) -> Vehicle:
    """One of the vehicles; some have their body frame at the rear."""
    vehicle = vehicle_named(str(rng.choice(VEHICLES)))
    if rng.random() < 0.25:
        shape = vehicle.footprint
        return replace(vehicle, footprint=Footprint(shape.length, shape.width, float(rng.uniform(0.02, 0.14))))
    return vehicle


def random_safety(rng: np.random.Generator) -> Safety:
    """Half of the scenes ask for delta(v) = 0.05 + 0.25 |v|, most others for contingencies without a margin."""
    kind, period = rng.random(), float(rng.uniform(0.5, 1.5))
    if kind < 0.5:
        return Safety(cycle=period, delta=0.05, delta_per_speed=0.25)
    return Safety(cycle=period) if kind < 0.9 else Safety(enabled=False, cycle=0.0)


def random_settings(rng: np.random.Generator) -> Settings:
    """Settings that change what an edge is and how many are tried."""
    quantum = 0.05 if rng.random() < 0.25 else 0.0
    return Settings(blossom=int(rng.choice([4, 16, 32])), pruning=bool(rng.random() < 0.25), quantum=quantum)


def random_solid(rng: np.random.Generator, bounds: tuple[tuple[float, float], tuple[float, float]]) -> Solid:
    """A turned rectangle, a disc or a star-shaped polygon, convex or not, anywhere in the bounds."""
    center = (float(rng.uniform(*bounds[0])), float(rng.uniform(*bounds[1])))
    kind = rng.random()
    if kind < 0.5:
        size = (float(rng.uniform(0.1, 1.2)), float(rng.uniform(0.05, 0.8)))
        return Rectangle(center, size, float(rng.uniform(-math.pi, math.pi)))
    if kind < 0.75:
        return Disc(center, float(rng.uniform(0.05, 0.45)))
    corners = int(rng.integers(3, 9))
    turns = 2 * math.pi * (np.arange(corners) + rng.uniform(0.0, 0.4, corners)) / corners  # less than pi apart
    radii = rng.uniform(0.1, 0.6, corners)
    return Star(center, np.column_stack([radii * np.cos(turns), radii * np.sin(turns)]) + np.array(center))


def walls(bounds: tuple[tuple[float, float], tuple[float, float]]) -> tuple[Rectangle, ...]:
    """Four walls around the bounds."""
    (_, width), (_, height) = bounds
    thick = 0.2
    return (
        Rectangle((-thick / 2, height / 2), (thick, height + 2 * thick), 0.0),
        Rectangle((width + thick / 2, height / 2), (thick, height + 2 * thick), 0.0),
        Rectangle((width / 2, -thick / 2), (width, thick), 0.0),
        Rectangle((width / 2, height + thick / 2), (width, thick), 0.0),
    )


def random_start(
    rng: np.random.Generator,
    vehicle: Vehicle,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    body: Body,
    safety: Safety,
) -> Floats:
    """A free state (nx,), at rest or, in three of ten scenes, moving; the last try stays, free or not."""
    state = np.zeros(len(vehicle.state))
    speed = float(rng.uniform(0.0, vehicle.top_speed)) if rng.random() < 0.3 else 0.0
    for _ in range(TRIES):
        x, y, theta = rng.uniform(*bounds[0]), rng.uniform(*bounds[1]), rng.uniform(-math.pi, math.pi)
        state[:4] = x, y, theta, speed
        if body.distance(x, y, theta) > safety.delta + safety.delta_per_speed * speed + ROOM:
            break
    return state


def random_goal(
    rng: np.random.Generator,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    solids: tuple[Solid, ...],
    start: Floats,
) -> Goal:
    """A goal whose centre is free and, if that can be, farther than 1.5 m from the start; some ask for a heading."""
    point = Body(solids, Footprint(0.05, 0.05))
    radius = float(rng.uniform(0.15, 0.4))
    center = (0.0, 0.0)
    for _ in range(TRIES):
        center = (float(rng.uniform(*bounds[0])), float(rng.uniform(*bounds[1])))
        if math.dist(center, start[:2]) > 1.5 and point.distance(*center, 0.0) > 0.15:
            break
    if rng.random() < 0.2:
        return Goal(center, radius, float(rng.uniform(-math.pi, math.pi)), 0.8)
    return Goal(center, radius)


def obstacle_of(solid: Solid) -> Obstacle:
    """The obstacle as the planner takes it."""
    match solid:
        case Rectangle():
            return box(solid.center, solid.size, solid.yaw)
        case Disc():
            return Circle(np.array(solid.center), solid.radius)
        case Star():
            return Polygon(solid.corners)
