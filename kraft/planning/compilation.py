"""Compilation of the planner for this machine and a vehicle, once, before any measured planning time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, TypeAlias

import numpy as np

from kraft.elapsed import elapsed_time
from kraft.planning.feasibility import needs_motions
from kraft.planning.shared_kernels import (
    CONTROL,
    FILTER,
    MAPS,
    PLANNER,
    POSES,
    SHARED,
    Meanwhile,
    Progress,
    is_compiled,
    processes_for,
)
from kraft.scenario import Goal, Task
from kraft.text import MessageSink
from ompl_ext.interrupts import interrupts_between_passes
from ompl_ext.kernel_cache import where_kept
from ompl_ext.kernels.costtogo import descend, smooth
from ompl_ext.kernels.fine_field import raise_to_fine
from ompl_ext.kernels.specialise import (
    are_steps_cached,
    is_cached,
    is_model_cached,
    is_module_cached,
    is_polish_cached,
    model_step,
    optional_module,
    polish_kernels,
    polish_solver,
    step_kernels,
)
from ompl_ext.obstacles import Workspace, box
from ompl_ext.query import Goal as GoalRegion
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

OPTIONAL: Final = {"rollouts": "the rollouts", "sst": "the planner sst"}
Parts: TypeAlias = dict[tuple[str, str], Callable[[], object]]
"""Functions that compile a part each, by its name and the hash of its vehicle: two vehicles may have one name."""


@dataclass
class Missing:
    """What is not compiled: kernels that vehicles share, by their names in `SHARED`, and parts of each vehicle."""

    shared: tuple[str, ...] = ()
    before: Parts = field(default_factory=dict)
    """parts that need none of those: compiled at the same time"""
    after: Parts = field(default_factory=dict)
    """parts that need them"""

    def need(self, *names: str) -> None:
        """Add shared kernels, unless they are compiled."""
        wanted = {*self.shared, *(name for name in names if not is_compiled(name))}
        self.shared = tuple(name for name in SHARED if name in wanted)

    @property
    def titles(self) -> list[str]:
        """What the parts are called in messages."""
        return [*(SHARED[name].title for name in self.shared), *(name for name, _ in (*self.before, *self.after))]


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
    missing = Missing()
    for each in needs:
        _add_missing(missing, each)
    _compile(missing, report)


def ensure_checks_compiled(task: Task, vehicle: Vehicle, report: MessageSink) -> None:
    """Compile what `check_placement` and `check_reachable` need: the kernels of maps, and for few tasks the model.

    What is cached is not compiled again; `report` gets progress messages.
    """
    missing = Missing()
    missing.need(MAPS)
    if needs_motions(task) and not is_model_cached(vehicle):
        missing.before[_model_of(vehicle)] = partial(model_step, vehicle)
    _compile(missing, report)


def _compile(missing: Missing, report: MessageSink) -> None:
    """Compile what is missing; `report` gets what is compiled, for how long, and each part that is done."""
    titles = missing.titles
    if not titles:
        return
    # no closer estimate: what else the machine does makes it three times as long
    once = "for this machine, once: up to a minute, or some minutes if the machine is busy"
    what = f"{len(titles)} parts {once}: {'; '.join(titles)}" if len(titles) > 1 else f"{titles[0]} {once}"
    report(f"compiling {what} ...")
    progress = Progress(len(titles), report)
    processes = processes_for(len(missing.shared), with_others=bool(missing.before))
    with interrupts_between_passes() as check, elapsed_time(report, lambda: progress.present):
        with Meanwhile(missing.shared, progress, processes) as meanwhile:
            _compile_parts(missing.before, progress)
            meanwhile.finish(check)
        _compile_parts(missing.after, progress)
    report(f"compiled in {progress.seconds:.0f} s; kept in {where_kept()}")


def _compile_parts(parts: Parts, progress: Progress) -> None:
    for (name, _), compile_part in parts.items():
        with progress.part(name):
            compile_part()


def _add_missing(missing: Missing, needs: Needs) -> None:
    """Add which parts that are needed are not cached."""
    vehicle, code = needs.vehicle, needs.vehicle.hash
    missing.need(PLANNER, MAPS, CONTROL, *([POSES] if needs.poses else []), *([FILTER] if needs.steps else []))
    before, after = missing.before, missing.after
    if not is_cached(vehicle):
        if not is_model_cached(vehicle):
            before[_model_of(vehicle)] = partial(model_step, vehicle)
        after[f"the checks for {vehicle.name}", code] = partial(_exercise, vehicle)
    if needs.steps and not are_steps_cached(vehicle):
        before[f"the steps of the model of {vehicle.name}", code] = partial(step_kernels, vehicle)
    if needs.steps and not _is_identification_cached():
        before["the identification", ""] = partial(_compile_identification, vehicle)
    if needs.polish and not is_polish_cached(vehicle):
        if PLANNER in missing.shared:  # the rest needs it
            before[f"the solver of the local optimisation for {vehicle.name}", code] = partial(polish_solver, vehicle)
        after[f"the local optimisation for {vehicle.name}", code] = partial(polish_kernels, vehicle)
    for name in needs.modules:
        if not is_module_cached(vehicle, name):
            after[f"{OPTIONAL[name]} for {vehicle.name}", code] = partial(optional_module, vehicle, name)


def _model_of(vehicle: Vehicle) -> tuple[str, str]:
    return f"the model of {vehicle.name}", vehicle.hash


def _is_identification_cached() -> bool:
    from kraft.sysid.elimination import is_cached  # needed by few commands, and slow to load

    return is_cached()


def _compile_identification(vehicle: Vehicle) -> None:
    from kraft.sysid.factor_graph import compile_identification

    compile_identification(vehicle)


def _exercise(vehicle: Vehicle) -> None:
    """Plan a few iterations in a small world, because kernels compile at their first call."""
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
