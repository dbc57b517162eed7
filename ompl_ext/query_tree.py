"""Tree of a query: its roots, edges of earlier plans and trees, and the plans in it."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import index

import numpy as np

from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.checker import EdgeChecker
from ompl_ext.growing_tree import GrowingTree
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.costtogo import UNREACHABLE
from ompl_ext.kernels.rng import generator
from ompl_ext.kernels.tree_memory import best_node, path_to
from ompl_ext.obstacles import Workspace
from ompl_ext.plan import Contingency, Plan, TreeView, tree_view
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.retainment import RetainableEdges, edges_to_retain, remaining_edges, retainable_edges
from ompl_ext.vehicle import Vehicle

MAX_THREADS = 64
THREAD_SEEDS = 2**32  # difference between the seeds of the trees of one query


@dataclass(frozen=True)
class Progress:
    """Progress of a query.  `history` has (seconds, cost) of each better solution, at readings of the clock."""

    seconds: float = 0.0
    iterations: int = 0
    edges: int = 0
    nodes: int = 0
    unsafe: int = 0
    retained: int = 0
    first_iteration: int | None = None
    history: tuple[tuple[float, float], ...] = ()

    @property
    def first_solution(self) -> tuple[float, float] | None:
        """Time until the first solution (s) and its cost (s), None without a solution."""
        return self.history[0] if self.history else None


class QueryTree(EdgeChecker):
    """Trees of a query for one vehicle in one workspace: one for each thread, of which the first has the best plan."""

    def __init__(
        self,
        vehicle: Vehicle,
        workspace: Workspace,
        goal: Goal | None,
        safety: Safety | None,
        settings: Settings | None,
        capacity: int,
        max_nodes: int,
        threads: int,
    ) -> None:
        if not 1 <= threads <= MAX_THREADS:
            raise ValueError(f"threads is {threads}, not 1 to {MAX_THREADS}")
        super().__init__(vehicle, workspace, goal, safety, settings)
        self._threads, self._capacity, self._max_nodes = threads, capacity, max(capacity, max_nodes)
        self._progress = Progress()

    @cached_property
    def _trees(self) -> list[GrowingTree]:
        """Trees, with memory from the first query on: a solver that only checks edges needs none."""
        return [
            GrowingTree(
                self.vehicle, self._problem, self.workspace.bounds, self.settings, self._capacity, self._max_nodes
            )
            for _ in range(self._threads)
        ]

    @property
    def _tree(self) -> at.Tree:
        return self._trees[0].tree

    @property
    def tree_arrays(self) -> at.Tree:
        """Arrays of the tree, not copied; valid until the next call that starts a query or adds nodes."""
        return self._tree

    @property
    def unreachable(self) -> bool:
        """Whether no path of the inscribed disc leads from any root to the goal; then no plan exists."""
        roots = self._tree.link[: self._tree.count[at.SIZE], at.PARENT] < 0
        togo: Floats = self._tree.value[: self._tree.count[at.SIZE], at.TOGO][roots]
        return bool(np.all(togo >= UNREACHABLE))

    @property
    def root_cost_to_go(self) -> float:
        """Cost-to-go of the first root, s."""
        return float(self._tree.value[0, at.TOGO])

    @property
    def progress(self) -> Progress:
        """Progress of the query since `start`."""
        return self._progress

    def start(self, state: Floats, seed: int = 0) -> float:
        """Begin a query at `state` (nx,), m, rad, m/s.  Returns its slack (m), negative if it may collide.

        A state without clearance becomes the root too, but no edge leaves it.
        """
        self.clear(seed)
        return self.add_root(state)

    def clear(self, seed: int = 0) -> None:
        """Empty the tree; memory allocated since is kept for later queries."""
        seed = index(seed)  # a number of numpy would overflow
        for number, each in enumerate(self._trees):
            each.clear(generator(seed + number * THREAD_SEEDS))
        self._progress = Progress()

    def add_root(self, state: Floats) -> float:
        """Add a start state; returns its slack as `start` does.

        One in the goal is a plan only if it keeps delta(v), and has a contingency like every end of a plan.

        Raises:
            MemoryError: if the tree is full and its memory cannot grow.
            ValueError: the state has another number of components.
        """
        names = self.vehicle.state
        if np.shape(state) != (len(names),):
            raise ValueError(f"the state has {np.size(state)} values; expected {len(names)}: {', '.join(names)}")
        state, still, work = np.asarray(state, dtype=float), np.zeros(len(self.vehicle.controls)), self.work
        slack = self._propagate(state, still, 0.0)
        if work.at_goal[0] == 1:
            unsafe = self.safety.enabled and self.contingency(state) is None
            if unsafe or self._propagate(state, still, 0.0, 0.0) < 0.0:
                work.at_goal[0] = 0
        for each in self._trees:
            each.add_root(work)
        return slack

    def retain(self, plan: Plan, elapsed: float = 0.0) -> int:
        """Add the remainder of an earlier plan after `elapsed` s, from the new root; returns the number of edges added.

        The edge in progress is kept in part.  An edge that collides, is not safe, or has a control beyond the vehicle's
        bounds is omitted, with all after it.

        Raises:
            ValueError: `elapsed` is negative or not finite, or the plan has another number of controls.
        """
        if not 0.0 <= elapsed < math.inf:
            raise ValueError(f"elapsed is {elapsed}; expected finite seconds, 0 or more")
        return self.retain_edges(*remaining_edges(plan.controls, plan.durations, elapsed, self.settings.longest))

    def retain_edges(
        self,
        parents: Sequence[int] | Ints,
        controls: Matrix,
        durations: Floats,
        targets: Matrix | None = None,
        *,
        continued: bool = False,
    ) -> int:
        """Add edges of an earlier tree, parents before children, -1 for the root; returns the number added.

        An edge that cannot be added (see `retain`) is omitted, with all that begin where it ends.  The first n edges
        are corrected to end at `targets` (n, Q_DIM), if there are any.  If they are `continued`, the first ones are
        those of the last call, which are not added again.

        Raises:
            ValueError: the edges have another number of controls.
        """
        before = int(self._tree.count[at.RETAINED])
        began = time.perf_counter()
        for each in self._trees:
            known = each.retained.node if continued else None
            each.retained = edges_to_retain(parents, controls, durations, targets, known, self._problem.controls)
            each.add(self._problem, each.retained)
        self._update_progress(self._progress.seconds + time.perf_counter() - began)
        return int(self._tree.count[at.RETAINED]) - before

    @property
    def retained_nodes(self) -> Ints:
        """Node of each edge of the last call of `retain` or `retain_edges`; -1 if the edge was not added."""
        return self._trees[0].retained.node

    def retainable_edges(self, plan: Plan, elapsed: float, limit: int) -> RetainableEdges:
        """Remainder of a plan of this query after `elapsed` s, and up to `limit` edges of the tree that begin on it."""
        states, vehicle = plan.states[1:], self.vehicle
        x, y = states[:, vehicle.index("x")], states[:, vehicle.index("y")]
        heading = states[:, vehicle.index("theta")] if "theta" in vehicle.state else np.zeros(len(states))
        weight = self.settings.heading_weight
        targets = np.column_stack([x, y, weight * np.cos(heading), weight * np.sin(heading)])
        return retainable_edges(self._tree, plan, targets, elapsed, limit)

    def best_node(self) -> tuple[int, bool]:
        """Last node of the best plan, -1 without a plan, and whether it is in the goal."""
        return best_node(self._tree)

    @property
    def _least_cost(self) -> float:
        """Cost of the best plan to the goal that is known (s), infinite without one."""
        return float(self._tree.best[0])

    @property
    def best_cost(self) -> float:
        """Cost of the best plan plus the cost-to-go from its end (s); infinite without a plan."""
        node, reaches_goal = self.best_node()
        if node < 0:
            return math.inf
        value = self._tree.value
        return float(value[node, at.COST] if reaches_goal else value[node, at.COST] + value[node, at.TOGO])

    def plan(self, known: Plan | None = None) -> Plan | None:
        """Best plan so far, or the plan that ends closest to the goal if none reaches it, or None.

        With SAFETY enabled every plan has a contingency.  It is `known`, a plan of this query, if that is still the
        best one.
        """
        node, reaches_goal = self.best_node()
        if node < 0 or (self._tree.link[node, at.PARENT] < 0 and not reaches_goal):
            return None
        return known if known is not None and self._is_plan_to(node, known) else self.plan_to(node)

    def plan_to(self, node: int) -> Plan:
        """Plan that ends at a node of the tree, without a contingency if the node is not one where a plan may end."""
        tree, reaches_goal = self._tree, bool(self._tree.link[node, at.AT_GOAL])
        path = path_to(tree, node)
        nu = len(self.vehicle.controls)
        controls, durations = tree.edge[path[1:], :nu].copy(), tree.edge[path[1:], nu].copy()
        times, trajectory = self._trajectory(tree.state[path[0]], controls, durations)
        return Plan(
            states=tree.state[path].copy(),
            controls=controls,
            durations=durations,
            times=times,
            trajectory=trajectory,
            cost=float(tree.value[node, at.COST]),
            cost_to_go=0.0 if reaches_goal else float(tree.value[node, at.TOGO]),
            reaches_goal=reaches_goal,
            contingency=self._contingency_of(tree.state[path], controls, durations) if self.safety.enabled else None,
        )

    def _is_plan_to(self, node: int, plan: Plan) -> bool:
        """Whether a plan of this query is the one that ends at a node."""
        path, edge = path_to(self._tree, node), self._tree.edge
        if len(path) != len(plan.states) or not np.array_equal(self._tree.state[path[0]], plan.states[0]):
            return False
        nu, edges = len(self.vehicle.controls), edge[path[1:]]
        return np.array_equal(edges[:, :nu], plan.controls) and np.array_equal(edges[:, nu], plan.durations)

    def tree(self) -> TreeView:
        """Copy of the tree."""
        return tree_view(self._tree, self._tree.state[: self._tree.count[at.SIZE]].copy())

    def set_goal_region(self, radius: float, tolerance: float | None = None) -> None:
        """Set the radius of the goal region (m) and, if it has a heading, the tolerance of that (rad).

        Cost-to-go and treatment of edges that pass through the region stay those of the initial one: a vehicle that
        aims for a smaller region within its goal is to drive on, and edges that end where they touch it are shorter.
        """
        if self.goal is None:
            raise ValueError("there is no goal to aim for")
        self.goal = replace(self.goal, radius=radius)
        self._problem.scalar[at.GOAL_RADIUS] = radius
        if tolerance is not None and self.goal.has_heading:
            self.goal = replace(self.goal, tolerance=tolerance)
            self._problem.scalar[at.GOAL_TOLERANCE] = math.cos(tolerance)

    def goal_nodes(self) -> Ints:
        """Nodes in the goal region (n,), the one with the lowest cost first."""
        size = int(self._tree.count[at.SIZE])
        nodes = np.flatnonzero(self._tree.link[:size, at.AT_GOAL] == 1)
        return nodes[np.argsort(self._tree.value[nodes, at.COST], kind="stable")]

    def _trajectory(self, root: Floats, controls: Matrix, durations: Floats) -> tuple[Floats, Matrix]:
        steps = np.array([self.steps_of(duration) for duration in durations.tolist()], np.int64)
        count = int(steps.sum()) + 1
        times, states = np.zeros(count), np.empty((count, len(root)))
        states[0] = root
        edges = np.column_stack([controls, durations])
        self._search.path(self._problem, self.work, edges, steps, times, states)
        return times, states

    def _contingency_of(self, states: Matrix, controls: Matrix, durations: Floats) -> Contingency | None:
        """Contingency at the end of the cycle, or at the end of the plan if that is earlier."""
        if len(durations) == 0:  # the start is in the goal
            return self.contingency(states[0])
        ends = np.cumsum(durations)
        leaves = min(self.safety.cycle, float(ends[-1]))
        k = int(np.searchsorted(ends, leaves - 1e-12))
        begins = float(ends[k] - durations[k])
        self._propagate(states[k], controls[k], float(durations[k]))
        return self._first_safe_manoeuvre(begins, leaves)

    def _update_progress(self, seconds: float) -> None:
        """Update the progress after a call of the kernel."""
        count, history = self._tree.count, self._progress.history
        cost = self._least_cost
        if count[at.BEST] >= 0 and (not history or cost < history[-1][1]):
            history = (*history, (seconds, cost))
        first = int(count[at.FIRST_ITERATION]) if count[at.BEST] >= 0 else None
        total = sum((each.tree.count for each in self._trees[1:]), start=count).tolist()
        self._progress = Progress(
            seconds=seconds,
            iterations=total[at.ITERATIONS],
            edges=total[at.EDGES],
            nodes=total[at.SIZE],
            unsafe=total[at.UNSAFE],
            retained=int(count[at.RETAINED]),
            first_iteration=first,
            history=history,
        )
