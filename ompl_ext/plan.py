"""Results of the planner: plan, contingency, copy of the tree."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.kernel_types import Tree
from ompl_ext.times import SAME_TIME


@dataclass(frozen=True)
class Contingency:
    """Braking manoeuvre that is safe at the end of the plan's first cycle.

    `times` (m,) count from the plan's start; `states` (m, nx) end at standstill.  `slack` is a lower bound
    of the clearance minus delta(v) along it (m).
    """

    manoeuvre: str
    times: Floats = field(repr=False)
    states: Matrix = field(repr=False)
    slack: float


@dataclass(frozen=True)
class Plan:
    """Piecewise constant controls and their predicted trajectory.

    `controls` (n, nu) are held for `durations` (n,) s; `states` (n + 1, nx) are those where they change.
    `trajectory` (m, nx) at `times` (m,) has every integration step.  `cost` is the duration; `cost_to_go` is the
    heuristic at the end, 0 inside the goal region.
    """

    states: Matrix = field(repr=False)
    controls: Matrix = field(repr=False)
    durations: Floats = field(repr=False)
    times: Floats = field(repr=False)
    trajectory: Matrix = field(repr=False)
    cost: float
    cost_to_go: float
    reaches_goal: bool
    contingency: Contingency | None

    @property
    def total_cost(self) -> float:
        """Cost of the plan and cost-to-go from its end, s."""
        return self.cost + self.cost_to_go

    def head(self, until: float) -> Plan:
        """The plan up to the end of the edge that is held at `until` s, with the cost of the whole one."""
        ends = np.cumsum(self.durations)
        edges = min(len(ends), int(np.searchsorted(ends, until - SAME_TIME)) + 1)
        samples = int(np.searchsorted(self.times, ends[edges - 1] + SAME_TIME)) if len(ends) else 1
        return replace(
            self,
            states=self.states[: edges + 1],
            controls=self.controls[:edges],
            durations=self.durations[:edges],
            times=self.times[:samples],
            trajectory=self.trajectory[:samples],
        )


@dataclass(frozen=True)
class TreeView:
    """Copy of the tree: `states` (n, nx), `parents` (n,) with -1 for the root, and the edge to each node.

    `controls` (n, nu) and `durations` (n,) of the root are zero; `costs` and `costs_to_go` (n,) in s.
    """

    states: Matrix = field(repr=False)
    parents: Ints = field(repr=False)
    controls: Matrix = field(repr=False)
    durations: Floats = field(repr=False)
    costs: Floats = field(repr=False)
    costs_to_go: Floats

    def edges_of_first_root(self) -> tuple[list[int], Matrix, Floats]:
        """Parents (-1 for the root), controls (m, nu) and durations (m,) of the edges below the first root."""
        root = np.arange(len(self.parents))
        for node, parent in enumerate(self.parents.tolist()):
            if parent >= 0:
                root[node] = root[parent]
        kept = np.flatnonzero(root == 0)[1:]
        number = np.full(len(root), -1)
        number[kept] = np.arange(len(kept))
        return number[self.parents[kept]].tolist(), self.controls[kept], self.durations[kept]


def tree_view(tree: Tree, states: Matrix) -> TreeView:
    """Copy the tree's arrays, with `states` (n, nx) for the nodes."""
    size = int(tree.count[at.SIZE])
    return TreeView(
        states=states,
        parents=tree.link[:size, at.PARENT].astype(np.int64),
        controls=tree.edge[:size, :-1].copy(),
        durations=tree.edge[:size, -1].copy(),
        costs=tree.value[:size, at.COST].copy(),
        costs_to_go=tree.value[:size, at.TOGO].copy(),
    )
