"""Compilation of the planner for this machine and a vehicle, once, before any measured planning time."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from ompl_ext.interrupts import interrupts_between_passes
from ompl_ext.jit import cache_folder, cache_root
from ompl_ext.kernels.clearance import clearance_field
from ompl_ext.kernels.costtogo import cost_to_go
from ompl_ext.kernels.posetogo import compile_pose_cost_to_go
from ompl_ext.kernels.riccati import compile_solver
from ompl_ext.kernels.specialise import is_cached, kernels
from ompl_ext.obstacles import Workspace, box
from ompl_ext.query import Goal
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

POLL: Final = 0.05  # s, longest delay of an interrupt


def ensure_compiled(vehicle: Vehicle, report: Callable[[str], None]) -> None:
    """Compile every kernel that planning for `vehicle` needs, unless it is cached; `report` gets progress messages."""
    if is_cached(vehicle):
        return
    report(f"compiling the planner and the model of {vehicle.name} for this machine: once, about 20 s ...")
    began = time.perf_counter()
    _exercise(vehicle)
    report(f"compiled in {time.perf_counter() - began:.0f} s; kept in {cache_root()}")


def ensure_maps_compiled(report: Callable[[str], None]) -> None:
    """Compile the kernels for maps, which are the same for every vehicle, unless they are cached."""
    if _maps_marker().exists():
        return
    report("compiling the maps' kernels for this machine: once, about 6 s ...")
    with interrupts_between_passes():
        compile_maps()


def _exercise(vehicle: Vehicle) -> None:
    """Plan a few iterations in a small world, because kernels compile at their first call."""
    with interrupts_between_passes() as check:
        with _maps_meanwhile() as maps:
            kernels(vehicle)
            while maps is not None and maps.poll() is None:
                check()
                time.sleep(POLL)
        side = 4 * vehicle.footprint.reach
        world = Workspace(((0.0, side), (0.0, side)), (box((side, side), (0.1, 0.1)),))
        dirt = DirtSolver(vehicle, world, Goal((side / 2, side / 2), side / 4), capacity=1000)
        state = np.zeros(len(vehicle.state))
        state[[vehicle.index("x"), vehicle.index("y")]] = side / 2
        dirt.start(state)
        dirt.grow(iterations=10)
        dirt.plan()


@contextmanager
def _maps_meanwhile() -> Iterator[subprocess.Popen[bytes] | None]:
    """Compile the kernels for maps, unless they are cached, in a process that ends with the block at the latest.

    It is silent and in a process group of its own, which no Ctrl-C reaches.  If it fails, these kernels compile in
    this process, which reports the error.
    """
    if _maps_marker().exists():
        yield None
        return
    command = [sys.executable, "-c", f"from {__name__} import compile_maps; compile_maps()"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    silent = subprocess.DEVNULL
    with subprocess.Popen(
        command, env=environment, stdin=silent, stdout=silent, stderr=silent, process_group=0
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def compile_maps() -> None:
    """Compile the kernels of the clearance field, the cost-to-go and local optimisation."""
    field = clearance_field(Workspace(((0.0, 1.0), (0.0, 1.0)), (box((1.0, 1.0), (0.1, 0.1)),)), 0.1)
    seconds = cost_to_go(field, 0.1, (0.5, 0.5), 0.2, 1.0).seconds
    compile_pose_cost_to_go(field.values, seconds)
    compile_solver()
    _maps_marker().touch()


def _maps_marker() -> Path:
    return cache_folder() / "maps"
