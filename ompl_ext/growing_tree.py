"""One tree of a query with the memory to grow it; with several threads a query has several."""

from __future__ import annotations

import math

import numpy as np

from ompl_ext.arrays import Words
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.kernel_types import Lanes, Problem, Retained, Tree
from ompl_ext.kernels.search import search
from ompl_ext.kernels.specialise import optional_module
from ompl_ext.kernels.tree_memory import add_root, first_nodes, new_tree, reset, reset_indices, with_room
from ompl_ext.problem import lanes_of
from ompl_ext.query import Settings
from ompl_ext.retainment import edges_to_retain
from ompl_ext.vehicle import Vehicle


class GrowingTree:
    """Tree with working memory; `retained` are the edges of an earlier plan or tree that it began with."""

    def __init__(
        self,
        vehicle: Vehicle,
        problem: Problem,
        bounds: tuple[tuple[float, float], tuple[float, float]],
        settings: Settings,
        capacity: int,
        max_nodes: int,
    ) -> None:
        """Allocate memory for `capacity` nodes within `bounds`, which may grow to `max_nodes`."""
        nx, nu = len(vehicle.state), len(vehicle.controls)
        self._memory = new_tree(capacity, nx, nu, bounds)
        self.tree: Tree = self._memory
        self._capacity, self._max_nodes = capacity, max_nodes
        self.work = lanes_of(vehicle, int(problem.option[at.STEPS]))
        self.brake = lanes_of(vehicle, int(problem.option[at.BRAKE_STEPS]))
        self._q = np.zeros(at.Q_DIM)
        self._no_edges = edges_to_retain([], np.zeros((0, nu)), np.zeros(0))
        self.retained = self._no_edges
        self._sparse = _SparseTree(vehicle, bounds, settings) if settings.planner == "sst" else None

    def clear(self, random: Words) -> None:
        """Empty the tree; memory allocated since is kept."""
        reset(self._memory, random)
        has_grown = len(self._memory.state) > self._capacity
        self.tree = first_nodes(self._memory, self._capacity) if has_grown else self._memory
        if self._sparse is not None:
            self._sparse.forget()

    def reserve(self, nodes: int) -> None:
        """Reserve memory for so many more nodes, as far as the limit allows."""
        if len(self.tree.state) - int(self.tree.count[at.SIZE]) < nodes:
            self._memory = self.tree = with_room(self._memory, nodes, self._max_nodes)

    def add_root(self, work: Lanes) -> None:
        """Add the end of lane 0 as a root.

        Raises:
            MemoryError: if the tree has as many nodes as it may have.
        """
        self.reserve(1)
        add_root(self.tree, work)

    def add(self, problem: Problem, edges: Retained) -> None:
        """Add the free and safe ones of some edges."""
        self.reserve(len(edges.parent))
        self._run(problem, edges, 0, until_plan=False)

    def grow(self, problem: Problem, iterations: int, *, until_plan: bool = False) -> None:
        """Visit nodes; ends early if the memory is full, and with `until_plan` after the first plan to the goal.

        SST does not end early with a plan.
        """
        if self._sparse is not None:
            self._sparse.grow(self.tree, problem, self.work, self.brake, iterations)
            return
        self._run(problem, self._no_edges, iterations, until_plan=until_plan)

    def has_room(self, *, fixed: bool) -> bool:
        """Whether a tenth of the memory is free, or more can be had unless it is `fixed`."""
        memory = len(self.tree.state)
        is_last = fixed or memory == self._max_nodes
        return not is_last or memory - int(self.tree.count[at.SIZE]) >= memory // 10

    @property
    def rank(self) -> tuple[float, float]:
        """Cost of the best plan, and the smallest cost-to-go of a plan that does not reach the goal (s)."""
        tree, best = self.tree, int(self.tree.count[at.BEST])
        return (float(tree.value[best, at.COST]) if best >= 0 else math.inf), float(tree.best[1])

    def _run(self, problem: Problem, edges: Retained, iterations: int, *, until_plan: bool) -> None:
        search().grow(self.tree, problem, self.work, self.brake, self._q, edges, iterations, until_plan)


class _SparseTree:
    """Witnesses of SST, see `ompl_ext.kernels.sst`."""

    def __init__(
        self, vehicle: Vehicle, bounds: tuple[tuple[float, float], tuple[float, float]], settings: Settings
    ) -> None:
        self._grow = optional_module(vehicle, "sst").grow
        self._bounds, self._q = bounds, np.zeros(at.Q_DIM)
        self._radii = np.zeros(2)
        self._radii[[at.SST_SELECTION, at.SST_PRUNING]] = settings.selection_radius, settings.pruning_radius
        self._witnesses = new_tree(1, 1, 1, bounds)
        self._known = 0, 0, 0  # nodes, iterations and pruned nodes when the witnesses were up to date

    def forget(self) -> None:
        """Find the witnesses anew, as for another tree."""
        self._known = 0, 0, 0

    def grow(self, tree: Tree, problem: Problem, work: Lanes, brake: Lanes, iterations: int) -> None:
        """Visit nodes; witnesses are found anew if nodes were added or removed since."""
        count, memory = tree.count, len(tree.state)
        self._witnesses = with_room(self._witnesses, memory - int(self._witnesses.count[at.SIZE]), memory)
        if self._known != (int(count[at.SIZE]), int(count[at.ITERATIONS]), int(count[at.PRUNED])):
            reset(self._witnesses, tree.random)
            reset_indices(tree)
        self._grow(tree, self._witnesses, problem, work, brake, self._q, self._radii, iterations)
        self._known = int(count[at.SIZE]), int(count[at.ITERATIONS]), int(count[at.PRUNED])
