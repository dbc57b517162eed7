"""Compilation of the planner for this machine and a vehicle, once, before any measured planning time."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np

from kraft.elapsed import elapsed_time
from kraft.planning.feasibility import needs_motions
from kraft.scenario import Goal, Task
from kraft.text import MessageSink
from ompl_ext.arrays import Matrix32
from ompl_ext.exact import ExactClearance
from ompl_ext.interrupts import interrupts_between_passes
from ompl_ext.kernel_cache import cache_folder, is_marked, mark, where_kept
from ompl_ext.kernels.clearance import ClearanceField, cover, fields
from ompl_ext.kernels.costtogo import cost_to_go, descend, smooth
from ompl_ext.kernels.fine_field import raise_to_fine
from ompl_ext.kernels.half_planes import half_planes
from ompl_ext.kernels.held_signals import hat_means
from ompl_ext.kernels.moments import moments
from ompl_ext.kernels.nearest_points import nearest_points
from ompl_ext.kernels.paths import paths
from ompl_ext.kernels.pose_fusion import pose_fusion
from ompl_ext.kernels.posetogo import compile_pose_cost_to_go
from ompl_ext.kernels.specialise import (
    are_steps_cached,
    is_cached,
    is_model_cached,
    is_module_cached,
    is_polish_cached,
    kernels,
    model_step,
    optional_module,
    polish_kernels,
    step_kernels,
)
from ompl_ext.kernels.stopping import stop_controls
from ompl_ext.kernels.tracking import tracking
from ompl_ext.obstacles import OccupancyGrid, Workspace, box
from ompl_ext.query import Goal as GoalRegion
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Footprint, Vehicle

POLL: Final = 0.05
"""Longest delay of an interrupt, s."""
MAPS: Final = "maps"
MAPS_PART: Final = "the maps' kernels"
POSES: Final = "poses"
SEARCH: Final = "search"
"""Files that mark what is compiled."""
OPTIONAL: Final = {"rollouts": "the rollouts", "sst": "the planner sst"}
Parts: TypeAlias = dict[tuple[str, str], Callable[[], object]]
"""Functions that compile a part each, by its name and the hash of its vehicle: two vehicles may have one name."""


@dataclass(frozen=True)
class Needs:
    """What is needed of a vehicle: its planner, and what `ensure_compiled` names.

    The needs of several methods, or of a method and a goal, are joined with ``|``.
    """

    vehicle: Vehicle
    steps: bool = False
    polish: bool = False
    modules: tuple[str, ...] = ()
    poses: bool = False

    @classmethod
    def of_goal(cls, vehicle: Vehicle, goal: Goal) -> Needs:
        """What any planner needs of a goal: with a heading, the cost-to-go of poses and the local optimisation."""
        has_heading = goal.heading is not None
        return cls(vehicle, polish=has_heading, poses=has_heading)

    def __or__(self, other: Needs) -> Needs:
        """What is needed of the same vehicle by one or the other."""
        assert self.vehicle is other.vehicle, "the needs are of one vehicle"
        modules = tuple(dict.fromkeys([*self.modules, *other.modules]))
        return Needs(
            self.vehicle, self.steps or other.steps, self.polish or other.polish, modules, self.poses or other.poses
        )


def ensure_compiled(
    vehicle: Vehicle,
    report: MessageSink,
    *,
    steps: bool = False,
    polish: bool = False,
    modules: Sequence[str] = (),
    poses: bool = False,
) -> None:
    """Compile every kernel that planning for `vehicle` needs, unless it is cached; `report` gets progress messages.

    With `steps`, compile what identification and the LQR need too, the steps of the model and the elimination of the
    graph: they would compile while the vehicle drives.  With `polish`, compile the local optimisation of plans; with
    `poses`, the cost-to-go of poses.  `modules` names kernels that few methods use, see `optional_module`.
    """
    ensure_all_compiled([Needs(vehicle, steps, polish, tuple(modules), poses)], report)


def ensure_all_compiled(needs: Iterable[Needs], report: MessageSink) -> None:
    """Compile what is needed of several vehicles and is not cached, which is reported as one compilation."""
    parts: Parts = {}
    with_planner = not is_marked(_marker(SEARCH))  # it is compiled with the first vehicle that is not cached
    for each in needs:
        parts.update(_missing(each, with_planner))
        with_planner = with_planner and is_cached(each.vehicle)
    _compile(parts, report)


def ensure_checks_compiled(task: Task, vehicle: Vehicle, report: MessageSink) -> None:
    """Compile what `check_placement` and `check_reachable` need: the kernels of maps, and for few tasks the model.

    What is cached is not compiled again; `report` gets progress messages.
    """
    parts: Parts = {}
    if not is_marked(_marker(MAPS)):
        parts[MAPS_PART, ""] = compile_maps
    if needs_motions(task) and not is_model_cached(vehicle):
        parts[f"the model of {vehicle.name}", vehicle.hash] = partial(model_step, vehicle)
    _compile(parts, report)


def _compile(parts: Parts, report: MessageSink) -> None:
    """Compile parts; `report` gets what is compiled, for how long, and each part that is done."""
    if not parts:
        return
    # no closer estimate: what else the machine does makes it three times as long
    once = "for this machine, once: up to a minute, or some minutes if the machine is busy"
    names, several = [name for name, _ in parts], len(parts) > 1
    what = f"{len(parts)} parts {once}: {'; '.join(names)}" if several else f"{names[0]} {once}"
    report(f"compiling {what} ...")
    began = time.perf_counter()
    for number, ((name, _), compile_part) in enumerate(parts.items(), 1):
        took, part = time.perf_counter() - began, f"{name} ({number} of {len(parts)})" if several else name
        with interrupts_between_passes(), elapsed_time(report, f"compiling {part}", before=took):
            compile_part()
        if several:
            report(f"  {time.perf_counter() - began:.0f} s: compiled {part}")
    report(f"compiled in {time.perf_counter() - began:.0f} s; kept in {where_kept()}")


def _missing(needs: Needs, with_planner: bool) -> Parts:
    """Which parts that are needed are not cached.

    `with_planner` is whether the planner itself is compiled with the vehicle's model.
    """
    vehicle, code = needs.vehicle, needs.vehicle.hash
    parts: Parts = {}
    if not is_cached(vehicle):
        planner = "the planner and " if with_planner else ""
        parts[f"{planner}the model of {vehicle.name}", code] = partial(_exercise, vehicle)
    elif not is_marked(_marker(MAPS)):  # otherwise compiled with the planner
        parts[MAPS_PART, ""] = compile_maps
    if needs.steps and not are_steps_cached(vehicle):
        parts[f"the steps of the model of {vehicle.name}", code] = partial(step_kernels, vehicle)
    if needs.steps and not _is_identification_cached():
        parts["the identification and the pose filter", ""] = partial(_compile_identification, vehicle)
    if needs.polish and not is_polish_cached(vehicle):
        parts[f"the local optimisation for {vehicle.name}", code] = partial(polish_kernels, vehicle)
    for name in needs.modules:
        if not is_module_cached(vehicle, name):
            parts[f"{OPTIONAL[name]} for {vehicle.name}", code] = partial(optional_module, vehicle, name)
    if needs.poses and not is_marked(_marker(POSES)):
        parts["the cost-to-go of poses", ""] = compile_poses
    return parts


def _is_identification_cached() -> bool:
    from kraft.sysid.elimination import is_cached  # needed by few commands, and slow to load

    return is_cached()


def _compile_identification(vehicle: Vehicle) -> None:
    from kraft.sysid.factor_graph import compile_identification

    compile_identification(vehicle)
    hat_means()
    moments()
    pose_fusion()


def _exercise(vehicle: Vehicle) -> None:
    """Plan a few iterations in a small world, because kernels compile at their first call."""
    with interrupts_between_passes() as check:
        with _maps_meanwhile() as maps:
            kernels(vehicle)
            tracking()
            paths()
            nearest_points()
            stop_controls()
            while maps is not None and maps.poll() is None:
                check()
                time.sleep(POLL)
        side = 4 * vehicle.footprint.reach
        world = Workspace(((0.0, side), (0.0, side)), (box((side, side), (0.1, 0.1)),))
        dirt = DirtSolver(vehicle, world, GoalRegion((side / 2, side / 2), side / 4), capacity=1000)
        state = np.zeros(len(vehicle.state))
        state[[vehicle.index("x"), vehicle.index("y")]] = side / 2
        dirt.start(state)
        dirt.grow(iterations=10)
        dirt.retainable_edges(dirt.plan_to(0), 0.0, 10)
        place, value = np.zeros((1, 2)), np.zeros(1)
        descend(dirt.problem, place, 0.0, place)
        smooth(place, 0, place)
        raise_to_fine(dirt.problem, value, value, value)
        mark(_marker(SEARCH))


@contextmanager
def _maps_meanwhile() -> Iterator[subprocess.Popen[bytes] | None]:
    """Compile the kernels for maps, unless they are cached, in a process that ends with the block at the latest.

    It is silent and in a process group of its own, which no Ctrl-C reaches.  If it fails, these kernels compile in
    this process, which reports the error.
    """
    if is_marked(_marker(MAPS)):
        yield None
        return
    # -P: files of the working directory do not take the place of installed packages
    command = [sys.executable, "-P", "-c", f"from {__name__} import compile_maps; compile_maps()"]
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
    """Compile the kernels of the clearance fields, the costs-to-go, exact clearances and half-planes of free space."""
    field, world, body = _small_map()
    for most_in_order in (field.values.size, 0):
        _seconds_to_goal(field, most_in_order)
    exact = ExactClearance(world, body)
    exact.distance(0.5, 0.1)
    exact.lower_bounds(np.zeros((1, 3)))
    half_planes()
    mark(_marker(MAPS))


def compile_poses() -> None:
    """Compile the kernels of the cost-to-go of poses, which are those of every vehicle."""
    field, _, _ = _small_map()
    compile_pose_cost_to_go(field.values, _seconds_to_goal(field, 0))
    mark(_marker(POSES))


def _small_map() -> tuple[ClearanceField, Workspace, Footprint]:
    """Clearance field of a map of a few cells and a box, for a footprint."""
    body = Footprint(0.2, 0.2)
    cells = OccupancyGrid(np.eye(4, dtype=bool), 0.1, (0.0, 0.0, 0.0))
    world = Workspace(((0.0, 1.0), (0.0, 1.0)), (cells, box((1.0, 1.0), (0.1, 0.1))))
    field, _ = fields(world, body, float(cover(body).discs[:, 2].min()), 0.05)
    return field, world, body


def _seconds_to_goal(field: ClearanceField, most_in_order: int) -> Matrix32:
    return cost_to_go(field, 0.1, (0.5, 0.5), 0.2, 1.0, most_in_order=most_in_order).seconds


def _marker(name: str) -> Path:
    return cache_folder() / name
