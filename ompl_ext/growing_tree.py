"""One tree of a query with the memory to grow it; with several threads a query has several."""

from __future__ import annotations

import math

import numpy as np

from ompl_ext.arrays import Words
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.kernel_types import Problem, Retained, Tree
from ompl_ext.kernels.specialise import VehicleKernels
from ompl_ext.kernels.tree_memory import first_nodes, new_tree, reset, with_room
from ompl_ext.query import edges_to_retain, make_lanes
from ompl_ext.vehicle import Vehicle


class GrowingTree:
    """Tree with working memory; `retained` are the edges of an earlier plan or tree that it began with."""

    def __init__(
        self,
        vehicle: Vehicle,
        problem: Problem,
        bounds: tuple[tuple[float, float], tuple[float, float]],
        capacity: int,
        max_nodes: int,
    ) -> None:
        """Allocate memory for `capacity` nodes within `bounds`, which may grow to `max_nodes`."""
        nx, nu = len(vehicle.state), len(vehicle.controls)
        inputs = len(vehicle.inputs) or nu
        self._memory = new_tree(capacity, nx, nu, bounds)
        self.tree: Tree = self._memory
        self._capacity, self._max_nodes = capacity, max_nodes
        self.work = make_lanes(nx, nu, inputs, int(problem.option[at.STEPS]))
        self.brake = make_lanes(nx, nu, inputs, int(problem.option[at.BRAKE_STEPS]))
        self._q = np.zeros(at.Q_DIM)
        self._no_edges = edges_to_retain([], np.zeros((0, nu)), np.zeros(0))
        self.retained = self._no_edges

    def clear(self, random: Words) -> None:
        """Empty the tree; memory allocated since is kept."""
        self.tree = first_nodes(self._memory, self._capacity)
        reset(self.tree, random)

    def reserve(self, nodes: int) -> None:
        """Reserve memory for so many more nodes, as far as the limit allows."""
        if len(self.tree.state) - int(self.tree.count[at.SIZE]) < nodes:
            self._memory = self.tree = with_room(self._memory, nodes, self._max_nodes)

    def add(self, kernels: VehicleKernels, problem: Problem, edges: Retained) -> None:
        """Add the free and safe ones of some edges."""
        self.reserve(len(edges.parent))
        self._run(kernels, problem, edges, 0)

    def grow(self, kernels: VehicleKernels, problem: Problem, iterations: int) -> None:
        """Visit nodes; ends early if the memory is full."""
        self._run(kernels, problem, self._no_edges, iterations)

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

    def _run(self, kernels: VehicleKernels, problem: Problem, edges: Retained, iterations: int) -> None:
        kernels.grow(self.tree, problem, self.work, self.brake, self._q, edges, iterations)
