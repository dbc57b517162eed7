"""Compiled search with the interface that `DIRT` uses; `CallbackSearch` is the one over callbacks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from ompl import base as ob
from ompl import control as oc

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.specialise import polish_kernels
from ompl_ext.kernels.tree_memory import CAPACITY, path_to
from ompl_ext.parameters import ParamSet
from ompl_ext.plan import TreeView
from ompl_ext.query import Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.system import PlanarGoal
from ompl_ext.validity import SafetyValidityChecker

BLOSSOM = 32


class CompiledSearch:
    """Adapter of a `DirtSolver` for `DIRT`."""

    def __init__(
        self,
        si: oc.SpaceInformation,
        checker: SafetyValidityChecker,
        goal: PlanarGoal,
        params: ParamSet,
        seed: int,
    ) -> None:
        self._si, self._seed, self._roots = si, seed, 0
        step, cycle = si.getPropagationStepSize(), float(params["cycle"])
        safety = replace(checker.safety_settings, enabled=cycle > 0, cycle=cycle)
        if cycle == 0:  # without SAFETY no edge has to keep its clearance, not even the first one
            safety = replace(safety, delta=0.0, delta_per_speed=0.0, delta_per_time=0.0)
        settings = Settings(
            blossom=int(params["blossom"]) or BLOSSOM,
            child_extension=bool(params["child_extension"]),
            pruning=bool(params["pruning"]),
            polish=bool(params["polish"]) or None,
            goal_bias=float(params["goal_bias"]),
            beyond=float(params["control_bound_bias"]),
            resolution=float(params["resolution"]),
            shortest=si.getMinControlDuration() * step,
            longest=si.getMaxControlDuration() * step,
            quantum=step,
        )
        max_nodes = int(params["max_nodes"])
        capacity = min(CAPACITY, max_nodes)
        threads = int(params["threads"])
        if settings.polish:
            polish_kernels(checker.vehicle)  # compiled here, before any planning time is measured
        region = replace(goal.goal, radius=goal.getThreshold())
        self.dirt = DirtSolver(
            checker.vehicle,
            checker.workspace,
            region,
            safety,
            settings,
            capacity,
            max_nodes,
            threads,
        )
        self.dirt.clear()  # allocates the memory, before any planning time is measured

    def clear(self) -> None:
        """Empty the tree; maps and memory stay."""
        self._roots = 0
        self.dirt.clear()

    def restart(self, seed: int) -> None:
        """Empty the tree and set the seed of the next query."""
        self._seed = seed
        self.clear()

    def add_root(self, state: ob.State) -> None:
        """Add a start state."""
        values = np.array([state[k] for k in range(len(self.dirt.vehicle.state))])
        if self._roots == 0:
            self.dirt.start(values, self._seed)
        else:
            self.dirt.add_root(values)
        self._roots += 1

    def infeasible(self) -> bool:
        """Whether no path leads to the goal."""
        return self.dirt.unreachable

    def retain(self, parents: list[int], controls: Matrix, durations: Floats) -> int:
        """Add the edges of an earlier plan or tree that are free, safe and within the bounds; returns their number."""
        return self.dirt.retain_edges(parents, controls, durations)

    def grow(self, stop: Callable[[], bool]) -> None:
        """Grow the tree until `stop()` is true."""
        self.dirt.grow(stop=stop)

    def count(self, which: int) -> int:
        """Entry of `ompl_ext.kernels.kernel_types.Tree.count`; iterations and edges are those of all threads."""
        progress = {at.ITERATIONS: self.dirt.progress.iterations, at.EDGES: self.dirt.progress.edges}
        return progress[which] if which in progress else int(self.dirt.tree_arrays.count[which])

    @property
    def cost(self) -> float:
        """Cost of the best path to the goal (s), infinite without one."""
        return float(self.dirt.tree_arrays.best[0])

    def best(self) -> tuple[int, bool]:
        """Last node of the best plan, -1 without a plan, and whether it is in the goal."""
        return self.dirt.best_node()

    def state_of(self, node: int) -> ob.State:
        """OMPL state of a node."""
        state = self._si.allocState()
        _write(self.dirt.tree_arrays.state[node], state)
        return state

    def view(self) -> TreeView:
        """Copy of the tree."""
        return self.dirt.tree()

    def best_path(self) -> tuple[oc.PathControl | None, bool]:
        """Path of the best plan, None without a plan, and whether it reaches the goal."""
        node, exact = self.best()
        if node < 0:
            return None, False
        tree, nodes = self.dirt.tree_arrays, path_to(self.dirt.tree_arrays, node)
        path, state, control = oc.PathControl(self._si), self._si.allocState(), self._si.allocControl()
        for before, after in pairwise(nodes):
            _write(tree.state[before], state)
            _write(tree.edge[after, :-1], control)
            path.append(state, control, float(tree.edge[after, -1]))
        _write(tree.state[node], state)
        path.append(state)
        return path, exact


def _write(values: Floats, target: ob.State | oc.Control) -> None:
    for k, value in enumerate(values):
        target[k] = float(value)
