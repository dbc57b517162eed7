"""A small arena for OMPL's programs, and DIRT in it."""

from __future__ import annotations

import math
import time

import numpy as np

from kraft.vehicles.benchmark import BENCHMARK
from ompl_ext.obstacles import Workspace, box
from ompl_ext.planner import DIRT
from ompl_ext.query import Goal
from ompl_ext.system import SimpleSetup, simple_setup

BOUNDS = ((0.0, 4.0), (0.0, 4.0))


START = np.array([0.5, 0.5, math.pi / 2, 0.0])


def arena(*obstacles: object, goal: tuple[float, float] = (3.5, 3.5), start: np.ndarray = START) -> SimpleSetup:
    wall = box((2.0, 1.0), (0.2, 2.0))
    return simple_setup(BENCHMARK, Workspace(BOUNDS, (wall, *obstacles)), start, Goal(goal, 0.25))  # type: ignore[arg-type]


def planned(setup: SimpleSetup, iterations: int = 2000, **parameters: object) -> DIRT:
    """A planner after at least so many iterations (the clock is looked at now and then), however slow the machine."""
    planner = DIRT(setup.getSpaceInformation(), **parameters)  # type: ignore[arg-type]
    setup.setPlanner(planner)
    setup.setup()
    began = time.monotonic()
    while planner.iterations < iterations:
        assert time.monotonic() < began + 60.0
        setup.solve(0.01)
    return planner


def solved(setup: SimpleSetup, **parameters: object) -> DIRT:
    """A planner that has just found its first solution: a tenth of a second or, over callbacks, a few."""
    began, planner = time.monotonic(), planned(setup, 1, **parameters)
    while not setup.haveExactSolutionPath():
        assert time.monotonic() < began + 60.0
        setup.solve(0.02)
    return planner
