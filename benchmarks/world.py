"""How fast the simulated world is, looking for a collision after every physics step included."""

from __future__ import annotations

import time

from benchmarks.effort import Effort
from benchmarks.report import Report, Row, Target, row
from kraft.config import bundled
from kraft.scenario import load_scenario
from kraft.simulation import World

LONGEST = 10.0  # of a drive (s)
CONTROL = 10  # physics steps between commands
STEERING = (-0.12, -0.06, 0.0, 0.06, 0.12)
TARGET = 120.0
TARGETS = {
    "bump": 100.0,
    "slip": 100.0,
    "movable": 50.0,
}  # contacts that take longer: ellipsoid on cylinder or box, boxes


def run(effort: Effort) -> Report:
    """Measure every bundled scene."""
    rows = [entry for name in bundled.names("scenario") for entry in measure(name, effort)]
    notes = [
        "Drives at full throttle from the start to the first collision, over and over, steering differently.",
        "Bumps, slippery floor and boxes are met on the way. Processor time of one core; a physics step is 2 ms.",
    ]
    return Report("world", rows, notes=notes)


def measure(name: str, effort: Effort) -> list[Row]:
    """Real-time factor of one scene, and what it takes to make and to reset its world."""
    scene = load_scenario(name)
    builds, resets = [], []
    for _ in range(effort.repeats):
        began = time.perf_counter()
        world = World(scene)
        built = time.perf_counter()
        world.reset()
        builds.append(1000 * (built - began))
        resets.append(1e6 * (time.perf_counter() - built))
    factors = [factor(world, effort.seconds) for _ in range(effort.repeats)]
    return [
        row(f"{name}: faster than real time", "times", factors, Target(TARGETS.get(name, TARGET), most=False)),
        row(f"{name}: physics steps", "1/s", [f / world.dt for f in factors], more=True),
        row(f"{name}: new world", "ms", builds),
        row(f"{name}: reset", "us", resets),
    ]


def factor(world: World, seconds: float) -> float:
    """Simulated time over the processor's time of drives that take about so many seconds."""
    simulated, drives, began = 0.0, 0, time.process_time()
    while time.process_time() - began < seconds:
        world.reset()
        world.apply((1.0, STEERING[drives % len(STEERING)]))
        while world.collision is None and world.time < LONGEST:
            world.step(CONTROL)
        simulated += world.time
        drives += 1
    return simulated / (time.process_time() - began)
