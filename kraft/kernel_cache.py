"""Compile the planner for this machine and a vehicle: once, before the clock of any plan runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from multiprocessing import get_context

import numpy as np

from ompl_ext.clearance import clearance_field
from ompl_ext.costtogo import cost_to_go
from ompl_ext.jit import cache_root
from ompl_ext.obstacles import Workspace, box
from ompl_ext.query import Goal
from ompl_ext.solver import Dirt
from ompl_ext.specialise import is_cached, kernels
from ompl_ext.vehicle import Vehicle


def ensure_compiled(vehicle: Vehicle, say: Callable[[str], None]) -> None:
    """Compile everything that planning for `vehicle` needs, unless it was; `say` is told before and after."""
    if is_cached(vehicle):
        return
    say(f"compiling the planner and the {vehicle.name} model for this machine: once, about 20 s ...")
    began = time.perf_counter()
    _exercise(vehicle)
    say(f"compiled in {time.perf_counter() - began:.0f} s; kept in {cache_root()}")


def _exercise(vehicle: Vehicle) -> None:
    """Plan a few iterations in a small world: kernels compile when they are first called.

    The maps' kernels, the same for every vehicle, compile meanwhile in a process of their own.  Should that fail, they
    compile here after all, and say why they cannot.
    """
    maps = get_context("spawn").Process(target=_compile_maps)
    maps.start()
    kernels(vehicle)
    maps.join()
    side = 4 * vehicle.footprint.reach
    world = Workspace(((0.0, side), (0.0, side)), (box((side, side), (0.1, 0.1)),))
    dirt = Dirt(vehicle, world, Goal((side / 2, side / 2), side / 4), capacity=1000)
    state = np.zeros(len(vehicle.state))
    state[[vehicle.index("x"), vehicle.index("y")]] = side / 2
    dirt.start(state)
    dirt.grow(iterations=10)
    dirt.plan()


def _compile_maps() -> None:
    field = clearance_field(Workspace(((0.0, 1.0), (0.0, 1.0)), (box((1.0, 1.0), (0.1, 0.1)),)), 0.1)
    cost_to_go(field, 0.1, (0.5, 0.5), 0.2, 1.0)
