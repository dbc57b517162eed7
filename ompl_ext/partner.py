"""Trees that other threads grow for the same query."""

from __future__ import annotations

import math

import numpy as np

from ompl_ext.arrays import Words
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.kernel_types import Lanes, Retained, Tree
from ompl_ext.kernels.tree_memory import first_nodes, reset, with_room


class Partner:
    """Tree of another thread, and the working memory to grow it; `retained` are the edges that it began with."""

    def __init__(self, memory: Tree, work: Lanes, brake: Lanes) -> None:
        self.memory = self.tree = memory
        self.work, self.brake, self.q = work, brake, np.zeros(at.Q_DIM)
        self.retained = Retained(
            np.zeros(0, np.int64), np.zeros((0, memory.edge.shape[1])), np.zeros((0, at.Q_DIM)), np.zeros(0, np.int64)
        )

    def clear(self, capacity: int, random: Words) -> None:
        """Empty the tree."""
        self.tree = first_nodes(self.memory, capacity)
        reset(self.tree, random)

    def reserve(self, nodes: int, max_nodes: int) -> None:
        """Reserve memory for so many more nodes, as far as `max_nodes` allows."""
        if len(self.tree.state) - int(self.tree.count[at.SIZE]) < nodes:
            self.memory = with_room(self.memory, nodes, max_nodes)
            self.tree = self.memory


def rank(tree: Tree) -> tuple[float, float]:
    """Cost of a tree's best plan, and the smallest cost-to-go of a plan that does not reach the goal (s)."""
    best = int(tree.count[at.BEST])
    return (float(tree.value[best, at.COST]) if best >= 0 else math.inf), float(tree.best[1])
