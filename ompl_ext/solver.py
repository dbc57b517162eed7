"""DIRT for a compiled vehicle: one solver holds the memory for many queries."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ompl_ext.arrays import Bools, Floats, Ints, Matrix
from ompl_ext.exact import ExactClearance
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.costtogo import UNREACHABLE
from ompl_ext.kernels.dirt import EXPLORATION_INSERTIONS
from ompl_ext.kernels.fine_field import raise_to_fine
from ompl_ext.kernels.kernel_types import LANE_WIDTH, Problem
from ompl_ext.kernels.rng import generator
from ompl_ext.kernels.specialise import kernels
from ompl_ext.kernels.tree_memory import (  # fmt: skip
    CAPACITY,
    MAX_NODES,
    add_root,
    first_nodes,
    new_tree,
    path_to,
    prune,
    reset,
    with_room,
)
from ompl_ext.obstacles import Workspace
from ompl_ext.partner import Partner, rank
from ompl_ext.plan import Contingency, Plan, TreeView, tree_view
from ompl_ext.polish import INTERVAL, SOFT, Guess, Polish, guess_along, resampled
from ompl_ext.query import (
    Goal,
    Safety,
    Settings,
    edges_to_retain,
    make_lanes,
    make_problem,
    pose_cost_to_go_of,
    remaining_edges,
    settings_for,
)
from ompl_ext.retainment import RetainableEdges, retainable_edges
from ompl_ext.vehicle import Vehicle

FIRST_CHUNK = 16  # iterations between readings of the clock until a solution is found
PRUNE_EVERY = 4096  # iterations
MAX_THREADS = 64
LONGEST_ROUND = 1024  # iterations of each thread between two exchanges of the best cost
ROUNDS_TO_PRUNING = 4
PARTNER_SEEDS = 2**32  # difference between the seeds of the trees of one query
LONGEST_CHUNK = 0.002  # seconds between readings of the clock afterwards


POLISH_EVERY = 512  # iterations
POLISH_GAIN = 0.005  # s by which the best plan must be better than the last time
CLEARANCES = (0.7, 1.5, 3.0)  # cells of the clearance field that optimised plans aim for, in turn
REPEATED_STIFFNESS = 1e3  # of the model, for a plan that obeys it already
PATIENCE = 0.1  # weight of the time for a first guess: at first it has to become feasible


@dataclass(frozen=True)
class _Polished:
    """Plans that were optimised so far: how many, the cost of the best and the time that the last one took (s)."""

    attempts: int = 0
    cost: float = math.inf
    seconds: float = 0.0


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


class DirtSolver:
    """Algorithm 1 for one vehicle in one workspace towards one goal.

    Use: `start`, then `retain` if there is an earlier plan, then `grow` any number of times, and `plan` at any time.
    The constructor computes the clearance field and the cost-to-go, and allocates the tree's memory.  Without a goal
    the solver only checks: `edge`, `contingency`, `exact`.

    A budget of iterations uses memory for `capacity` nodes; for any other budget the memory is doubled when needed, up
    to `max_nodes`.  When the memory is full, the tree is pruned; if then less than a tenth is free, the search ends.

    With several `threads` each grows a tree of its own, in the same workspace and with a seed of its own; the trees
    exchange the best cost at fixed iterations.  A budget of iterations is for all of them together.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        workspace: Workspace,
        goal: Goal | None,
        safety: Safety | None = None,
        settings: Settings | None = None,
        capacity: int = CAPACITY,
        max_nodes: int = MAX_NODES,
        threads: int = 1,
    ) -> None:
        if not 1 <= threads <= MAX_THREADS:
            raise ValueError(f"threads is {threads}, not 1 to {MAX_THREADS}")
        self.vehicle, self.workspace, self.goal = vehicle, workspace, goal
        self.safety, self.settings = safety or Safety(), settings or Settings()
        self._kernels = kernels(vehicle)
        self._problem = make_problem(vehicle, workspace, goal, self.safety, self.settings)
        problem = self._problem
        self._maps = problem.field, problem.tile, problem.squares, problem.discs, problem.scalar
        nx, nu, inputs = (
            len(vehicle.state),
            len(vehicle.controls),
            len(vehicle.inputs) or len(vehicle.controls),
        )
        self._capacity, self._max_nodes = capacity, max(capacity, max_nodes)
        self._memory = new_tree(capacity, nx, nu, workspace.bounds)
        self._tree = self._memory
        steps, brake_steps = int(problem.option[at.STEPS]), int(problem.option[at.BRAKE_STEPS])
        self._work, self._brake = make_lanes(nx, nu, inputs, steps), make_lanes(nx, nu, inputs, brake_steps)
        self._q = np.zeros(at.Q_DIM)
        self._partners = [
            Partner(
                new_tree(capacity, nx, nu, workspace.bounds),
                make_lanes(nx, nu, inputs, steps),
                make_lanes(nx, nu, inputs, brake_steps),
            )
            for _ in range(threads - 1)
        ]
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None
        self._rounds = 0
        self._no_edges = edges_to_retain([], np.zeros((0, nu)), np.zeros(0))
        self._retained_nodes = self._no_edges.node
        self._progress = Progress()
        self._polish = self._make_polish()
        self._polished = _Polished()

    @property
    def problem(self) -> Problem:
        """Arrays that the kernels read."""
        return self._problem

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
    def progress(self) -> Progress:
        """Progress of the query since `start`."""
        return self._progress

    def start(self, state: Floats, seed: int = 0) -> float:
        """Begin a query at `state` (nx,), m, rad, m/s.  Returns its spare clearance (m), negative if it may collide.

        A state without clearance becomes the root too, but no edge leaves it.
        """
        self.clear(seed)
        return self.add_root(state)

    def clear(self, seed: int = 0) -> None:
        """Empty the tree; memory allocated since is kept for later queries."""
        self._tree = first_nodes(self._memory, self._capacity)
        reset(self._tree, generator(seed))
        for number, partner in enumerate(self._partners, 1):
            partner.clear(self._capacity, generator(seed + number * PARTNER_SEEDS))
        self._rounds = 0
        self._progress, self._polished = Progress(), _Polished()

    def add_root(self, state: Floats) -> float:
        """Add a start state; returns its spare clearance as `start` does.

        One in the goal is a plan only if it has a contingency, like every end of a plan.
        """
        slack = self._propagate(np.asarray(state, dtype=float), np.zeros(len(self.vehicle.controls)), 0.0)
        if self._work.at_goal[0] == 1 and self.safety.enabled and self.contingency(self._work.source) is None:
            self._work.at_goal[0] = 0
        for tree in (self._tree, *(partner.tree for partner in self._partners)):
            add_root(tree, self._work)
        return slack

    def retain(self, plan: Plan, elapsed: float = 0.0) -> int:
        """Add the rest of an earlier plan after `elapsed` s, propagated from the new root; returns the edges added.

        The edge in progress is kept in part.  An edge that collides or is not safe is omitted, with all after it.
        """
        return self.retain_edges(*remaining_edges(plan.controls, plan.durations, elapsed))

    def retain_edges(
        self, parents: Sequence[int] | Ints, controls: Matrix, durations: Floats, targets: Matrix | None = None
    ) -> int:
        """Add edges of an earlier tree, parents before children, -1 for the root; returns the number added.

        The first n edges are corrected to end at `targets` (n, Q_DIM), if there are any.
        """
        before = int(self._tree.count[at.RETAINED])
        self._reserve(len(parents))
        began = time.perf_counter()
        retained = edges_to_retain(parents, controls, durations, targets)
        self._run_kernel(retained, 0)
        self._retained_nodes = retained.node
        for partner in self._partners:
            partner.reserve(len(parents), self._max_nodes)
            partner.retained = edges_to_retain(parents, controls, durations, targets)
            self._run_partner(partner, partner.retained, 0)
        self._update_progress(self._progress.seconds + time.perf_counter() - began)
        return int(self._tree.count[at.RETAINED]) - before

    @property
    def retained_nodes(self) -> Ints:
        """Node of each edge of the last call of `retain` or `retain_edges`; -1 if the edge was not added."""
        return self._retained_nodes

    def retainable_edges(self, plan: Plan, elapsed: float, limit: int) -> RetainableEdges:
        """Rest of a plan of this query after `elapsed` s, and up to `limit` edges of the tree that begin on it."""
        states, vehicle = plan.states[1:], self.vehicle
        x, y = states[:, vehicle.index("x")], states[:, vehicle.index("y")]
        heading = states[:, vehicle.index("theta")] if "theta" in vehicle.state else np.zeros(len(states))
        weight = self.settings.heading_weight
        targets = np.column_stack([x, y, weight * np.cos(heading), weight * np.sin(heading)])
        return retainable_edges(self._tree, plan, targets, elapsed, limit)

    def grow(
        self,
        iterations: int | None = None,
        seconds: float | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> Progress:
        """Grow the tree until a budget is used up or `stop()` is true, and return the progress since `start`.

        With `iterations` the result depends on the seed and the number of threads alone, not on the clock.

        Raises:
            ValueError: there is no budget or no goal.
        """
        if iterations is None and seconds is None and stop is None:
            raise ValueError("grow needs a budget: iterations, seconds, or stop")
        if self.goal is None:
            raise ValueError("a tree grows towards a goal, and there is none")
        if self._pool is not None:
            return self._grow_together(self._pool, iterations, seconds, stop)
        left = iterations if iterations is not None else 2**62
        base, began = self._progress.seconds, time.perf_counter()
        chunk, elapsed = FIRST_CHUNK, 0.0
        while left > 0 and (seconds is None or elapsed < seconds) and not (stop is not None and stop()):
            count = min(chunk, left, PRUNE_EVERY - int(self._tree.count[at.ITERATIONS]) % PRUNE_EVERY)
            if self._polish is not None:
                count = min(count, POLISH_EVERY - int(self._tree.count[at.ITERATIONS]) % POLISH_EVERY)
            if iterations is None:
                self._reserve(count * max(EXPLORATION_INSERTIONS, self.settings.insertions))
            elapsed_before, before = elapsed, int(self._tree.count[at.ITERATIONS])
            self._run_kernel(self._no_edges, count)
            left -= int(self._tree.count[at.ITERATIONS]) - before
            elapsed = time.perf_counter() - began
            self._update_progress(base + elapsed)
            if self._polishes_now(None if seconds is None else seconds - elapsed):
                self._add_polished(base - began)
                elapsed = time.perf_counter() - began
                self._update_progress(base + elapsed)
            if self._tree.count[at.FULL] or self._prunes_now():
                prune(self._tree)
                memory = len(self._tree.state)
                is_last = iterations is not None or memory == self._max_nodes
                if is_last and memory - self._tree.count[at.SIZE] < memory // 10:
                    break  # the remaining nodes are needed, and there is no memory for better ones
            if self._progress.history:
                chunk = _next_chunk(count, elapsed - elapsed_before, None if seconds is None else seconds - elapsed)
        return self._progress

    def _grow_together(
        self,
        pool: ThreadPoolExecutor,
        iterations: int | None,
        seconds: float | None,
        stop: Callable[[], bool] | None,
    ) -> Progress:
        """Grow one tree per thread, in rounds of equal numbers of iterations; see `grow`.

        After each round all trees get the lowest cost, beyond which nothing is added, and the tree with that plan
        becomes the solver's own.
        """
        left = iterations if iterations is not None else 2**62
        base, began, elapsed, trees = self._progress.seconds, time.perf_counter(), 0.0, 1 + len(self._partners)
        insertions = max(EXPLORATION_INSERTIONS, self.settings.insertions)
        while left > 0 and (seconds is None or elapsed < seconds) and not (stop is not None and stop()):
            longest = min(FIRST_CHUNK << min(self._rounds, 10), LONGEST_ROUND)
            shares = [min(longest, left // trees + (k < left % trees)) for k in range(trees)]
            if iterations is None:
                self._reserve(longest * insertions)
                for partner in self._partners:
                    partner.reserve(longest * insertions, self._max_nodes)
            running = [
                pool.submit(self._run_partner, partner, self._no_edges, share)
                for partner, share in zip(self._partners, shares[1:], strict=True)
            ]
            self._run_kernel(self._no_edges, shares[0])
            for each in running:
                each.result()
            left -= sum(shares)
            self._rounds += 1
            self._take_best()
            elapsed = time.perf_counter() - began
            self._update_progress(base + elapsed)
            rooms = [self._has_room(tree, iterations is not None) for tree in self._trees()]  # prunes each
            if not all(rooms):
                break
        return self._progress

    def _take_best(self) -> None:
        """Make the tree with the best plan the solver's own, and its cost the bound of all trees."""
        costs = [rank(tree) for tree in self._trees()]
        best = costs.index(min(costs))
        if best > 0:
            partner = self._partners[best - 1]
            self._memory, partner.memory = partner.memory, self._memory
            self._tree, partner.tree = partner.tree, self._tree
            nodes, self._retained_nodes = self._retained_nodes, partner.retained.node
            partner.retained = partner.retained._replace(node=nodes)
        for partner in self._partners:
            partner.tree.best[0] = min(self._tree.best[0], partner.tree.best[0])

    def _trees(self) -> list[at.Tree]:
        return [self._tree, *(partner.tree for partner in self._partners)]

    def _has_room(self, tree: at.Tree, fixed: bool) -> bool:
        """Prune a tree if it is full or due; whether it has room for more nodes, or can get memory unless `fixed`."""
        due = self.settings.pruning and self._rounds % ROUNDS_TO_PRUNING == 0
        if not (tree.count[at.FULL] or due):
            return True
        prune(tree)
        memory = len(tree.state)
        is_last = fixed or memory == self._max_nodes
        return not is_last or memory - int(tree.count[at.SIZE]) >= memory // 10

    def _run_partner(self, partner: Partner, retained: at.Retained, iterations: int) -> None:
        self._kernels.grow(partner.tree, self._problem, partner.work, partner.brake, partner.q, retained, iterations)

    def _make_polish(self) -> Polish | None:
        """Local optimisation, if the settings ask for it and durations are free."""
        wanted = self.settings.polish
        if self.goal is None or self.settings.quantum > 0.0 or self.vehicle.index("theta") < 0:
            return None
        if wanted is None:
            wanted = self.goal.has_heading
        return Polish(self.vehicle, self._problem, self.goal, self.safety) if wanted else None

    def _polishes_now(self, left: float | None) -> bool:
        """Whether to improve the plan: at fixed iterations, if it is another one than last time and time is left."""
        if self._polish is None or self._tree.count[at.ITERATIONS] % POLISH_EVERY != 0:
            return False
        if self._polished.attempts > 0 and self._tree.best[0] >= self._polished.cost - POLISH_GAIN:
            return False
        return left is None or left > self._polished.seconds

    def _add_polished(self, offset: float) -> None:
        """Improve the best plan, and at first one along the cost-to-go of poses, and add them to the tree.

        `offset` is the time of the query at a reading of the clock minus that reading, s.
        """
        began = time.perf_counter()
        if self._polished.attempts == 0:
            self._add_improved(self._guided_guess(), PATIENCE)
            self._update_progress(offset + time.perf_counter())
        if self._tree.count[at.BEST] >= 0:
            self._add_improved(self._guess_of_plan(), 1.0)
        cost = float(self._tree.best[0])
        self._polished = _Polished(self._polished.attempts + 1, cost, time.perf_counter() - began)

    def _guided_guess(self) -> Guess | None:
        """Guess along the path of poses from the root."""
        assert self.goal is not None
        cell = settings_for(self.settings, self.vehicle, self.goal).cell
        found = pose_cost_to_go_of(self.vehicle, self.workspace, self.goal, cell)
        root = self._tree.state[0].copy()
        path = found.path_from(*(float(root[self.vehicle.index(name)]) for name in ("x", "y", "theta")))
        return guess_along(path, self.vehicle, root) if path is not None and len(path.times) > 1 else None

    def _guess_of_plan(self) -> Guess:
        """Guess of the best plan."""
        nu, path = len(self.vehicle.controls), path_to(self._tree, int(self._tree.count[at.BEST]))
        controls, durations = self._tree.edge[path[1:], :nu], self._tree.edge[path[1:], nu]
        times, trajectory = self._trajectory(self._tree.state[path[0]], controls, durations)
        ends = np.cumsum(durations)
        held = np.minimum(np.searchsorted(ends, 0.5 * (times[:-1] + times[1:])), len(ends) - 1)
        return resampled(Guess(trajectory, controls[held], np.diff(times)), INTERVAL)

    def _add_improved(self, guess: Guess | None, urgency: float) -> None:
        """Improve a guess and add it as edges from the root, with more and more clearance until all of it passes."""
        assert self._polish is not None
        assert self.goal is not None
        if guess is None or guess.time == 0.0:
            return
        self._polish.goal, self._polish.safety, self._polish.urgency = self.goal, self.safety, urgency
        cell, stiffness = 1.0 / float(self._problem.scalar[at.GRID_INVERSE]), SOFT
        for factor in CLEARANCES:
            guess = self._polish.improve(guess, factor * cell, stiffness)
            edges = edges_to_retain(list(range(-1, len(guess.durations) - 1)), guess.controls, guess.durations)
            retained = int(self._tree.count[at.RETAINED])
            self._reserve(len(guess.durations))
            self._run_kernel(edges, 0)
            self._tree.count[at.RETAINED] = retained
            if edges.node[-1] >= 0 and self._tree.link[edges.node[-1], at.AT_GOAL] == 1:
                return
            stiffness = REPEATED_STIFFNESS

    def _reserve(self, nodes: int) -> None:
        """Reserve memory for so many more nodes, as far as `max_nodes` allows."""
        if len(self._tree.state) - int(self._tree.count[at.SIZE]) < nodes:
            self._memory = with_room(self._memory, nodes, self._max_nodes)
            self._tree = self._memory

    def _prunes_now(self) -> bool:
        """Whether to prune: at fixed iterations, so that readings of the clock do not matter."""
        return self.settings.pruning and self._tree.count[at.ITERATIONS] % PRUNE_EVERY == 0

    def best_node(self) -> tuple[int, bool]:
        """Last node of the best plan, -1 without a plan, and whether it is in the goal."""
        if self._tree.count[at.BEST] >= 0:
            return int(self._tree.count[at.BEST]), True
        return int(self._tree.count[at.CLOSEST]), False

    @property
    def best_cost(self) -> float:
        """Cost of the best plan plus the cost-to-go from its end (s); infinite without a plan."""
        node, reaches_goal = self.best_node()
        if node < 0:
            return math.inf
        cost, to_go = self._tree.value[node, [at.COST, at.TOGO]]
        return float(cost) if reaches_goal else float(cost + to_go)

    def plan(self) -> Plan | None:
        """Best plan so far, or the plan that ends closest to the goal if none reaches it, or None.

        With SAFETY enabled every plan has a contingency.
        """
        node, reaches_goal = self.best_node()
        if node < 0 or (self._tree.link[node, at.PARENT] < 0 and not reaches_goal):
            return None
        return self.plan_to(node)

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

    def contingency(self, state: Floats, after: float = 0.0) -> Contingency | None:
        """SAFETY (Alg. 2) of a state: a manoeuvre that is safe until standstill, or None; times begin at `after` s."""
        self._brake.source[:] = state
        return self._first_safe_manoeuvre(math.inf, after)

    def manoeuvres(self, state: Floats) -> list[Matrix]:
        """States (m, nx) of each contingency manoeuvre from a state until standstill, at most up to the horizon.

        A state follows every `safety.step` s; nothing is checked.
        """
        self._brake.source[:] = state
        self._kernels.brake(self._problem, self._work, self._brake, math.inf)
        trajectory = self._brake.trajectory.reshape(-1, len(self.vehicle.state), LANE_WIDTH)
        rest, found = list(self.vehicle.rest_indices), []
        for number in range(len(self.vehicle.manoeuvres)):
            resting = np.all(np.abs(trajectory[:, rest, number]) <= self.safety.rest_speed, axis=1)
            samples = int(np.argmax(resting)) + 1 if resting.any() else len(trajectory)
            found.append(trajectory[:samples, :, number].copy())
        return found

    def tree(self) -> TreeView:
        """Copy of the tree."""
        return tree_view(self._tree, self._tree.state[: self._tree.count[at.SIZE]].copy())

    def edge(
        self, state: Floats, control: Floats, duration: float, start_time: float = math.inf
    ) -> tuple[Matrix, float]:
        """Trajectory (steps + 1, nx) of one edge and its spare clearance (m), negative if it may collide.

        The edge begins at `start_time` s; before the end of the cycle it must also keep delta(v).
        """
        slack = self._propagate(np.asarray(state, dtype=float), control, duration, start_time)
        steps, nx = int(self._work.steps[0]), len(self.vehicle.state)
        return self._work.trajectory.reshape(-1, nx, LANE_WIDTH)[: steps + 1, :, 0].copy(), slack

    def set_delta(self, delta: float) -> None:
        """Set the clearance at rest, `delta` m, within the first cycle and along contingencies."""
        self.safety = replace(self.safety, delta=delta)
        self._problem.scalar[at.DELTA] = delta

    def set_bound(self, delta: float, per_speed: float, per_time: float, horizon: float) -> None:
        """Set the clearance delta(t, v) within the first cycle and along contingencies, see `Safety`."""
        self.safety = replace(
            self.safety, delta=delta, delta_per_speed=per_speed, delta_per_time=per_time, delta_horizon=horizon
        )
        self._problem.scalar[[at.DELTA, at.DELTA_PER_SPEED]] = delta, per_speed
        self._problem.scalar[[at.DELTA_PER_TIME, at.DELTA_HORIZON]] = per_time, horizon

    def set_parameters(self, values: Floats) -> None:
        """Set the parameters of the vehicle (np,), in its order; the cost-to-go stays that of the first ones."""
        names = self.vehicle.parameters
        self.vehicle = replace(self.vehicle, parameters=dict(zip(names, map(float, values), strict=True)))
        self._problem.parameters[: len(names)] = values

    def set_goal_radius(self, radius: float) -> None:
        """Set the radius of the goal region, m; the cost-to-go stays that of the initial radius."""
        if self.goal is None:
            raise ValueError("there is no goal to aim for")
        self.goal = replace(self.goal, radius=radius)
        self._problem.scalar[at.GOAL_RADIUS] = radius

    def pose_slack(self, x: float, y: float, theta: float) -> float:
        """Lower bound of the footprint's clearance at a pose within the workspace (m)."""
        return self._kernels.pose(*self._maps, x, y, theta)

    def clearances(self, poses: Matrix) -> Floats:
        """Lower bound (n,) of the footprint's clearance at poses (n, 3), m; as `pose_slack`, but tight everywhere."""
        field, _, _, discs, scalar = self._maps
        distance = np.full(len(poses), math.inf)
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        for ahead, aside, radius in discs:
            row = (poses[:, 1] + ahead * s + aside * c - scalar[at.GRID_Y]) * scalar[at.GRID_INVERSE]
            column = (poses[:, 0] + ahead * c - aside * s - scalar[at.GRID_X]) * scalar[at.GRID_INVERSE]
            inside = np.clip(row, 0, field.shape[0] - 1).astype(int), np.clip(column, 0, field.shape[1] - 1).astype(int)
            value = field[inside].astype(float)
            if scalar[at.FINE_INVERSE] > 0.0:
                x, y = poses[:, 0] + ahead * c - aside * s, poses[:, 1] + ahead * s + aside * c
                raise_to_fine(self._problem, x, y, value)
            distance = np.minimum(distance, value - radius)
        return distance

    def least_distance(self, poses: Matrix) -> float:
        """Smallest exact distance of the footprint at poses (n, 3) to an obstacle (m), asked of as few as possible."""
        return self.exact.least_distance(poses)

    def fine(self, states: Matrix, controls: Matrix, durations: Floats, samples: int) -> Floats:
        """States (n, samples + 1, nx) at equal intervals along n motions, unchecked.

        Motion k begins in `states[k]` (nx,) and holds `controls[k]` (nu,) for `durations[k]` s.
        """
        found = np.empty((len(states), samples + 1, len(self.vehicle.state)))
        found[:, 0] = states
        self._kernels.roll_out(found, np.ascontiguousarray(controls), self._problem.parameters, durations / samples)
        return found

    def goal_nodes(self) -> Ints:
        """Nodes in the goal region (n,), the one with the lowest cost first."""
        size = int(self._tree.count[at.SIZE])
        nodes = np.flatnonzero(self._tree.link[:size, at.AT_GOAL] == 1)
        return nodes[np.argsort(self._tree.value[nodes, at.COST], kind="stable")]

    def is_occupied(self, points: Matrix) -> Bools:
        """Whether each of the points (n, 2) is in an obstacle or less than a cell of the clearance field from one."""
        scalar, field = self._problem.scalar, self._problem.field
        columns, rows = ((points - scalar[[at.GRID_X, at.GRID_Y]]) * scalar[at.GRID_INVERSE]).astype(int).T
        value = field[rows.clip(0, field.shape[0] - 1), columns.clip(0, field.shape[1] - 1)].astype(float)
        if scalar[at.FINE_INVERSE] > 0.0:
            raise_to_fine(self._problem, points[:, 0].copy(), points[:, 1].copy(), value)
        inside: Bools = value <= 0.0
        return inside

    @cached_property
    def exact(self) -> ExactClearance:
        """Exact clearance of the vehicle's footprint in the workspace."""
        return ExactClearance(self.workspace, self.vehicle.footprint)

    def _propagate(self, state: Floats, control: Floats, duration: float, start_time: float = math.inf) -> float:
        work, problem = self._work, self._problem
        work.source[:] = state
        for k, value in enumerate(control):
            work.control[k * LANE_WIDTH] = value
        work.duration[0], work.steps[0] = duration, problem.option[at.STEPS]
        if self.settings.quantum > 0.0 and duration > 0.0:
            work.steps[0] = max(1, round(duration / self.settings.quantum))
        if not 1 <= work.steps[0] <= problem.option[at.STEPS]:
            raise ValueError(f"an edge of {duration} s is longer than the longest of {self.settings.longest} s")
        self._kernels.edge(problem, work, start_time)
        return float(work.slack[0])

    def _trajectory(self, root: Floats, controls: Matrix, durations: Floats) -> tuple[Floats, Matrix]:
        times, states, state, clock = [np.zeros(1)], [root[None, :].copy()], root, 0.0
        for control, duration in zip(controls, durations, strict=True):
            samples, _ = self.edge(state, control, duration)
            times.append(clock + duration * np.arange(1, len(samples)) / (len(samples) - 1))
            states.append(samples[1:])
            state, clock = samples[-1], clock + duration
        return np.concatenate(times), np.vstack(states)

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

    def _first_safe_manoeuvre(self, edge_begins: float, brakes_at: float) -> Contingency | None:
        """SAFETY where the edge in lane 0 crosses the end of the cycle, or of `source` if `edge_begins` is infinite."""
        number = self._kernels.brake(self._problem, self._work, self._brake, edge_begins)
        if number < 0:
            return None
        samples, nx = int(self._brake.steps[number]) + 1, len(self.vehicle.state)
        states = self._brake.trajectory.reshape(-1, nx, LANE_WIDTH)[:samples, :, number].copy()
        times: Floats = brakes_at + self.safety.step * np.arange(samples, dtype=float)
        return Contingency(self.vehicle.manoeuvres[number], times, states, float(self._brake.slack[number]))

    def _run_kernel(self, retained: at.Retained, iterations: int) -> None:
        self._kernels.grow(self._tree, self._problem, self._work, self._brake, self._q, retained, iterations)

    def _update_progress(self, seconds: float) -> None:
        """Update the progress after a call of the kernel."""
        count, cost, history = self._tree.count, float(self._tree.best[0]), self._progress.history
        if count[at.BEST] >= 0 and (not history or cost < history[-1][1]):
            history = (*history, (seconds, cost))
        first = int(count[at.FIRST_ITERATION]) if count[at.BEST] >= 0 else None
        total = sum((tree.count for tree in self._trees()[1:]), start=count)
        self._progress = Progress(
            seconds=seconds,
            iterations=int(total[at.ITERATIONS]),
            edges=int(total[at.EDGES]),
            nodes=int(total[at.SIZE]),
            unsafe=int(total[at.UNSAFE]),
            retained=int(count[at.RETAINED]),
            first_iteration=first,
            history=history,
        )


def _next_chunk(count: int, seconds: float, remaining: float | None) -> int:
    """Iterations until the next reading of the clock: about LONGEST_CHUNK s, fewer near the end of the budget."""
    target = LONGEST_CHUNK if remaining is None else min(LONGEST_CHUNK, max(remaining, 0.0))
    return max(1, min(2 * count, int(count * target / max(seconds, 1e-9))))
