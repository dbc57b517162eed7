"""Kernels that are the same for every vehicle, and processes that compile them while others are compiled.

numba compiles in one thread of a process at a time.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np

from kraft.text import MessageSink
from ompl_ext.arrays import Matrix32
from ompl_ext.cores import usable_cores
from ompl_ext.exact import ExactClearance
from ompl_ext.kernel_cache import cache_folder, is_marked, mark
from ompl_ext.kernels.clearance import ClearanceField, cover, fields
from ompl_ext.kernels.costtogo import cost_to_go
from ompl_ext.kernels.half_planes import half_planes
from ompl_ext.kernels.held_signals import hat_means
from ompl_ext.kernels.moments import moments
from ompl_ext.kernels.nearest_points import nearest_points
from ompl_ext.kernels.paths import paths
from ompl_ext.kernels.pose_fusion import pose_fusion
from ompl_ext.kernels.posetogo import compile_pose_cost_to_go
from ompl_ext.kernels.search import search
from ompl_ext.kernels.stopping import stop_controls
from ompl_ext.kernels.tracking import tracking
from ompl_ext.obstacles import OccupancyGrid, Workspace, box
from ompl_ext.vehicle import Footprint

POLL: Final = 0.05
"""Longest delay of an interrupt while processes compile, s."""
MOST_PROCESSES: Final = 3
"""Processes beside this one, each of which needs about 0.3 GB of memory: there is not enough work for more."""


@dataclass(frozen=True)
class SharedKernels:
    """Kernels that are compiled together: what they are called in messages, and the function that compiles them."""

    title: str
    compile: Callable[[], object]


def compile_maps() -> None:
    """Compile the kernels of the clearance fields, the costs-to-go, exact clearances and half-planes of free space."""
    field, world, body = _small_map()
    for most_in_order in (field.values.size, 0):
        cost_to_go(field, 0.1, (0.5, 0.5), 0.2, 1.0, most_in_order=most_in_order)
    exact = ExactClearance(world, body)
    exact.distance(0.5, 0.1)
    exact.lower_bounds(np.zeros((1, 3)))
    half_planes()


def _small_map() -> tuple[ClearanceField, Workspace, Footprint]:
    """Clearance field of a map of a few cells and a box, for a footprint."""
    body = Footprint(0.2, 0.2)
    cells = OccupancyGrid(np.eye(4, dtype=bool), 0.1, (0.0, 0.0, 0.0))
    world = Workspace(((0.0, 1.0), (0.0, 1.0)), (cells, box((1.0, 1.0), (0.1, 0.1))))
    field, _ = fields(world, body, float(cover(body).discs[:, 2].min()), 0.05)
    return field, world, body


def _compile_poses() -> None:
    values: Matrix32 = np.ones((4, 4), np.float32)  # what a map would have
    compile_pose_cost_to_go(values, values)


def _compile_control() -> None:
    for module in (tracking, paths, nearest_points, stop_controls):
        module()


def _compile_filter() -> None:
    for module in (hat_means, moments, pose_fusion):
        module()


PLANNER: Final = "planner"
MAPS: Final = "maps"
POSES: Final = "poses"
FILTER: Final = "filter"
CONTROL: Final = "control"
SHARED: Final = {
    PLANNER: SharedKernels("the planner", search),
    MAPS: SharedKernels("the maps", compile_maps),
    POSES: SharedKernels("the cost-to-go of poses", _compile_poses),
    FILTER: SharedKernels("the pose filter", _compile_filter),
    CONTROL: SharedKernels("the controllers", _compile_control),
}
"""Those that take longest first."""


def is_compiled(name: str) -> bool:
    """Whether the kernels of this name in `SHARED` are loaded instead of compiled."""
    return is_marked(_marker(name))


def compile_shared(name: str) -> None:
    """Compile the kernels of this name in `SHARED`, or load them from the cache."""
    SHARED[name].compile()
    mark(_marker(name))


def _marker(name: str) -> Path:
    """File that says that kernels are compiled."""
    return cache_folder() / name


class Progress:
    """What is compiled at present, and reports of what has been; several threads compile."""

    def __init__(self, total: int, report: MessageSink) -> None:
        self._total, self._report, self._began = total, report, time.perf_counter()
        self._lock = threading.Lock()
        self._present, self._count = list[str](), 0

    @property
    def seconds(self) -> float:
        """Time since the beginning, s."""
        return time.perf_counter() - self._began

    @property
    def present(self) -> str:
        """What is compiled at present."""
        with self._lock:
            return "compiling " + "; ".join(self._present)

    @contextmanager
    def part(self, title: str) -> Iterator[None]:
        """Context in which a part is compiled, which is reported at its end, unless it is the only one."""
        with self._lock:
            self._present.append(title)
        try:
            yield
        finally:
            with self._lock:
                self._present.remove(title)
        with self._lock:
            self._count += 1
            if self._total > 1:
                self._report(f"  {self.seconds:.0f} s: compiled {title} ({self._count} of {self._total})")


class ProcessFailedError(Exception):
    """A process that compiles has ended before it was done."""


class Meanwhile:
    """Compiles shared kernels in other processes until the context ends, which it does when `finish` has returned.

    The processes are silent and in process groups of their own, which no Ctrl-C reaches.  What one of them cannot
    compile is compiled in this process, which raises the error.
    """

    def __init__(self, names: Sequence[str], progress: Progress, processes: int) -> None:
        self._left, self._failed, self._progress = deque(names), list[str](), progress
        self._running, self._ended, self._lock = set[subprocess.Popen[bytes]](), False, threading.Lock()
        self._threads = [threading.Thread(target=self._serve, daemon=True) for _ in range(processes)]

    def __enter__(self) -> Self:
        """Begin."""
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End what has not ended."""
        with self._lock:
            self._ended = True
            for process in self._running:
                process.kill()
        for thread in self._threads:
            thread.join()

    def finish(self, check: Callable[[], None]) -> None:
        """Compile what no process has begun, and wait for the processes; `check` is called often meanwhile."""
        while (name := self._take()) is not None:
            self._compile_here(name)
        while any(thread.is_alive() for thread in self._threads):
            check()
            time.sleep(POLL)
        for name in self._failed:
            self._compile_here(name)

    def _take(self) -> str | None:
        """Next part that nobody has begun, None if there is none."""
        with self._lock:
            return self._left.popleft() if self._left else None

    def _compile_here(self, name: str) -> None:
        with self._progress.part(SHARED[name].title):
            compile_shared(name)

    def _serve(self) -> None:
        """Have one part after the other compiled by a process each (main function of a thread)."""
        while (name := self._take()) is not None:
            try:
                with self._progress.part(SHARED[name].title):
                    self._run(name)
            except (OSError, ProcessFailedError):
                self._failed.append(name)

    def _run(self, name: str) -> None:
        with self._lock:
            if self._ended:
                raise ProcessFailedError
            process = _compiling(name)
            self._running.add(process)
        code = process.wait()
        with self._lock:
            self._running.remove(process)
        if code != 0:
            raise ProcessFailedError


def processes_for(shared: int, with_others: bool) -> int:
    """Processes that compile so many shared parts, of which this one takes its share: at once without other parts."""
    return max(0, min(usable_cores() - 1, MOST_PROCESSES, shared if with_others else shared - 1))


def _compiling(name: str) -> subprocess.Popen[bytes]:
    # -P: files of the working directory do not take the place of installed packages
    command = [sys.executable, "-P", "-c", f"from {__name__} import compile_shared; compile_shared({name!r})"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    silent = subprocess.DEVNULL
    return subprocess.Popen(command, env=environment, stdin=silent, stdout=silent, stderr=silent, process_group=0)
