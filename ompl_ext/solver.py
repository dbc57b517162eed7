"""DIRT for a compiled vehicle: one solver holds the memory for many queries."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from operator import index

import numpy as np

from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.following import PathFollower
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.dirt import EXPLORATION_INSERTIONS
from ompl_ext.kernels.tree_memory import CAPACITY, MAX_NODES, path_to, prune
from ompl_ext.obstacles import Workspace
from ompl_ext.plan import Plan
from ompl_ext.polish import Guess, Polish, guess_of, guess_to_goal, weights_of
from ompl_ext.poses import pose_of
from ompl_ext.problem import pose_cost_to_go_of
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.query_tree import Progress, QueryTree
from ompl_ext.retainment import edges_to_retain
from ompl_ext.vehicle import Vehicle

FIRST_CHUNK = 64  # iterations between readings of the clock until the first plan, at which they end early
LONGEST_CHUNK = 0.002  # time between readings of the clock once a plan is found (s)
PRUNE_EVERY = 4096  # iterations between prunings of the tree of one thread
FIRST_ROUND = 16  # iterations of each thread before the first exchange of the best cost; doubled from one to the next
LONGEST_ROUND = 1024  # most iterations of each thread between two exchanges of the best cost
ROUNDS_TO_PRUNING = 4  # exchanges between prunings of the trees of several threads: PRUNE_EVERY of the longest rounds
POLISH_FIRST, POLISH_AGAIN = 256, 4  # iterations before the first optimisation, and the factor from one to the next
POLISH_EVERY = 512  # iterations between optimisations for goals with a heading
POLISH_GAIN = 0.005  # time by which the tree's best plan must be shorter than the one optimised last (s)
PATHS, PATHS_AGAIN = 4, 2  # paths of poses tried before the search, without and with edges of an earlier plan
CONVERGES = 0.01  # share of the cost that an optimisation must save to be repeated for its own result
WARM_UP_QUERIES, WARM_UP_ITERATIONS = 16, 32  # number of queries before the first one, and iterations of each
GOLDEN = 0.618  # golden section: step in x of the starts of these queries, as a share of the workspace's width
GUESS_URGENCY = 0.1  # weight of the time in the optimisation of a path of poses, which has to become feasible first
_warmed_up: set[tuple[int, str, bool]] = set()  # kernels, which a process keeps, and what is searched with them


@dataclass(frozen=True)
class _Polished:
    """Local optimisation of the query so far.

    `searched` is the cost of the tree's plan that was optimised last, `cost` that of the best result, of which
    `controls` and `durations` are the edges from the root until they are in the tree; `seconds` is how long the last
    one took.  `guessed` is whether a path of poses was optimised.
    """

    attempts: int = 0
    guessed: bool = False
    searched: float = math.inf
    cost: float = math.inf
    controls: Matrix | None = None
    durations: Floats | None = None
    seconds: float = 0.0


class DirtSolver(QueryTree):
    """Algorithm 1 for one vehicle in one workspace towards one goal.

    Use: `start`, then `retain` if there is an earlier plan, then `grow` any number of times, and `plan` at any time.
    The constructor computes the clearance field and the cost-to-go; the first query allocates the tree's memory.
    Without a goal the solver is an `EdgeChecker`.

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
        super().__init__(vehicle, workspace, goal, safety, settings, capacity, max_nodes, threads)
        self._first = vehicle, goal  # those of the cost-to-go of poses, whatever is estimated or set later
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None
        self._rounds = 0
        self._polish: Polish | None = None  # made when it is needed: it may have to be compiled
        self._follower: PathFollower | None = None  # made with the first path
        self._polished = _Polished()
        self._polish_due = self._first_polish()  # iterations of each tree before the next attempt
        self._warm_up()

    def _warm_up(self) -> None:
        """Plan for a moment from places all over the workspace, so that the first query is as fast as later ones.

        In a new process, kernels are loaded when they are first used; later solvers for the same ones find them there.
        """
        what = id(self._kernels), self.settings.planner, self.safety.enabled
        if what in _warmed_up:
            return
        _warmed_up.add(what)
        state, places = np.zeros(len(self.vehicle.state)), [self.vehicle.index(name) for name in ("x", "y")]
        low, high = np.array(self.workspace.bounds).T
        for k in range(WARM_UP_QUERIES):
            state[places] = low + (high - low) * [GOLDEN * k % 1.0, (k + 0.5) / WARM_UP_QUERIES]
            self.start(state)
            if self.goal is not None and not self._follows_path:
                self.grow(WARM_UP_ITERATIONS, stop=lambda: bool(self._progress.history))
        if self.safety.enabled:
            self.contingency(state)
        self.clear()

    def clear(self, seed: int = 0) -> None:
        """Empty the tree; memory allocated since is kept for later queries."""
        super().clear(seed)
        self._rounds = 0
        self._polished, self._polish_due = _Polished(), self._first_polish()

    def retain(self, plan: Plan, elapsed: float = 0.0, *, optimised: bool = False) -> int:
        """Add the remainder of an earlier plan, as `QueryTree.retain`.

        A plan that was `optimised` is optimised again only after the search has improved it.
        """
        added = super().retain(plan, elapsed)
        self._count_as_optimised(optimised)
        return added

    def retain_edges(
        self,
        parents: Sequence[int] | Ints,
        controls: Matrix,
        durations: Floats,
        targets: Matrix | None = None,
        *,
        continued: bool = False,
        optimised: bool = False,
    ) -> int:
        """Add edges of an earlier tree, as `QueryTree.retain_edges`; `optimised` as for `retain`."""
        added = super().retain_edges(parents, controls, durations, targets, continued=continued)
        self._count_as_optimised(optimised)
        return added

    def _count_as_optimised(self, optimised: bool) -> None:
        if optimised and self._tree.count[at.BEST] >= 0:
            self._polished = replace(self._polished, attempts=1, searched=float(self._tree.best[0]))

    def grow(
        self,
        iterations: int | None = None,
        seconds: float | None = None,
        stop: Callable[[], bool] | None = None,
        *,
        timed: bool = True,
    ) -> Progress:
        """Grow the tree until a budget is used up or `stop()` is true, and return the progress since `start`.

        With `iterations` the result depends on the seed and the number of threads alone, not on the clock.  If that is
        the only budget and the times of better solutions are not asked for (not `timed`), few calls of the kernel do.

        Raises:
            ValueError: there is no budget or no goal, or the seconds are NaN.
            TypeError: the iterations are no whole number.
        """
        if iterations is None and seconds is None and stop is None:
            raise ValueError("grow needs a budget: iterations, seconds, or stop")
        if seconds is not None and math.isnan(seconds):
            raise ValueError("seconds is NaN; expected a number of seconds")
        iterations = None if iterations is None else index(iterations)  # with half an iteration left it would not end
        if self.goal is None:
            raise ValueError("a tree grows towards a goal, and there is none")
        if self._wants_polish and self._polish is None and self._reaches_polish(iterations):
            self._polish = Polish(self.vehicle, self._problem)
        if self._follows_path:
            self._add_path()
        if self._pool is not None:
            return self._grow_together(self._pool, iterations, seconds, stop)
        left = iterations if iterations is not None else 2**62
        base, began = self._progress.seconds, time.perf_counter()
        at_once = iterations is not None and seconds is None and stop is None and not timed
        chunk, elapsed = iterations if at_once and iterations is not None else FIRST_CHUNK, 0.0
        while left > 0 and (seconds is None or elapsed < seconds) and not (stop is not None and stop()):
            count = min(chunk, left, PRUNE_EVERY - int(self._tree.count[at.ITERATIONS]) % PRUNE_EVERY)
            if self._polish is not None:
                count = min(count, max(self._polish_due - int(self._tree.count[at.ITERATIONS]), 1))
            if iterations is None:
                self._trees[0].reserve(count * self._insertions)
            elapsed_before, before = elapsed, int(self._tree.count[at.ITERATIONS])
            self._trees[0].grow(self._problem, count, until_plan=not at_once)
            done = int(self._tree.count[at.ITERATIONS]) - before
            left -= done
            elapsed = self._after_growing(base, began, seconds)
            if self._tree.count[at.FULL] or self._prunes_now():
                prune(self._tree)
                if not self._trees[0].has_room(fixed=iterations is not None):
                    break  # the remaining nodes are needed, and there is no memory for better ones
            if self._progress.history and not at_once:
                chunk = _next_chunk(done, elapsed - elapsed_before, None if seconds is None else seconds - elapsed)
        self._insert_polished()
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
        base, began, elapsed, trees = self._progress.seconds, time.perf_counter(), 0.0, len(self._trees)
        while left > 0 and (seconds is None or elapsed < seconds) and not (stop is not None and stop()):
            longest = min(FIRST_ROUND << min(self._rounds, 10), LONGEST_ROUND)
            shares = [min(longest, left // trees + (k < left % trees)) for k in range(trees)]
            if iterations is None:
                for each in self._trees:
                    each.reserve(longest * self._insertions)
            running = [
                pool.submit(each.grow, self._problem, share)
                for each, share in zip(self._trees[1:], shares[1:], strict=True)
            ]
            self._trees[0].grow(self._problem, shares[0])
            for future in running:
                future.result()
            left -= sum(shares)
            self._rounds += 1
            self._take_best()
            elapsed = self._after_growing(base, began, seconds)
            due = self.settings.pruning and self._rounds % ROUNDS_TO_PRUNING == 0
            full = [each for each in self._trees if due or each.tree.count[at.FULL]]
            for each in full:
                prune(each.tree)
            if not all(each.has_room(fixed=iterations is not None) for each in full):
                break
        self._insert_polished()
        return self._progress

    @property
    def _insertions(self) -> int:
        """Largest number of nodes that an iteration adds."""
        if self.settings.planner == "sst":
            return self.settings.blossom
        return max(EXPLORATION_INSERTIONS, self.settings.insertions)

    @property
    def _follows_path(self) -> bool:
        """Whether the path of poses to a goal with a heading is to be added: once, unless there is a plan already."""
        count, option = self._tree.count, self._problem.option
        wanted = self._has_heading and option[at.POSE_HEADINGS] > 0
        wanted &= self.settings.quantum == 0.0 and self.settings.planner == "dirt"
        return bool(wanted and count[at.ITERATIONS] == 0 and count[at.SIZE] > 0 and count[at.BEST] < 0)

    def _add_path(self) -> None:
        """Add edges along paths of poses from the root, as far as they are free and safe, until one is in the goal.

        Where the first one is not, local optimisation may begin with it: that disregards accelerations at first.  Paths
        share their narrowest place, so if none can be followed, clear ones are tried, unless an earlier plan leads on.
        """
        vehicle, goal = self._first
        assert goal is not None
        began, root = time.perf_counter(), self._tree.state[0].copy()
        follower = self._path_follower(vehicle)
        has_earlier_plan = self._tree.count[at.RETAINED] > 0
        for clear in (False,) if has_earlier_plan else (False, True):
            if self._tree.count[at.BEST] >= 0:
                break
            found = pose_cost_to_go_of(vehicle, self.workspace, goal, self.settings, clear=clear)
            for path in found.paths_from(*pose_of(root, self.vehicle), PATHS_AGAIN if has_earlier_plan else PATHS):
                if self._tree.count[at.BEST] >= 0 or len(path.times) == 0:
                    break
                controls, durations = follower.edges_along(path, root)
                self._add_edges(controls, durations)
                if self._tree.count[at.BEST] < 0 and self._polish is not None and not self._polished.guessed:
                    self._optimise_guess()
        self._update_progress(self._progress.seconds + time.perf_counter() - began)

    def _optimise_guess(self) -> None:
        """Add the plan that local optimisation makes of the path of poses from the root, if it finds one."""
        vehicle, goal = self._first
        assert goal is not None
        guess = guess_to_goal(vehicle, self.workspace, goal, self.settings, self._tree.state[0].copy())
        self._polished = replace(self._polished, guessed=True)
        if guess is not None:
            self._improve(guess, [], GUESS_URGENCY)
            self._insert_polished()

    def _add_edges(self, controls: Matrix, durations: Floats) -> None:
        """Add edges one after the other from the root, with all checks; they do not count as retained."""
        edges = edges_to_retain(list(range(-1, len(durations) - 1)), controls, durations)
        retained = int(self._tree.count[at.RETAINED])
        self._trees[0].add(self._problem, edges)
        self._tree.count[at.RETAINED] = retained

    def _path_follower(self, vehicle: Vehicle) -> PathFollower:
        """Follower of paths for the current parameters; it is kept, since it simulates motions of the vehicle."""
        if self._follower is None or not self._follower.has_parameters(self._problem.parameters):
            self._follower = PathFollower(vehicle, self._problem.parameters, self._are_free, self.pose_slack)
        return self._follower

    def _are_free(self, state: Floats, controls: Matrix, durations: Floats, begin: float) -> bool:
        """Whether edges with controls (n, nu) and durations (n,), from a state at `begin` s, are free and safe."""
        cycle = self.safety.cycle
        for control, duration in zip(controls, durations, strict=True):
            samples, slack = self.edge(state, control, duration, begin)
            crosses = self.safety.enabled and begin < cycle <= begin + duration
            if slack < 0.0 or (crosses and self._first_safe_manoeuvre(begin, cycle) is None):
                return False
            state, begin = samples[-1], begin + duration
        return True

    def _take_best(self) -> None:
        """Put the tree with the best plan first, and make its cost the bound of all trees."""
        best = min(range(len(self._trees)), key=lambda k: self._trees[k].rank)
        self._trees[0], self._trees[best] = self._trees[best], self._trees[0]
        for each in self._trees[1:]:
            each.tree.best[0] = min(self._tree.best[0], each.tree.best[0])

    @property
    def _least_cost(self) -> float:
        return min(super()._least_cost, self._polished.cost)

    @property
    def _wants_polish(self) -> bool:
        """Whether plans are improved by local optimisation; by default they are if the goal has a heading.

        Where durations are multiples of a step, they are improved only if the settings say so.
        """
        wanted = self.settings.polish if self.settings.planner == "dirt" else False
        return self._has_heading and self.settings.quantum == 0.0 if wanted is None else wanted

    def _reaches_polish(self, iterations: int | None) -> bool:
        """Whether a budget of iterations lasts until the next optimisation."""
        return iterations is None or self._progress.iterations + iterations >= self._polish_due * len(self._trees)

    @property
    def _has_heading(self) -> bool:
        """Whether the goal has a heading, which the vehicle can have."""
        return self.goal is not None and self.goal.has_heading and self.vehicle.index("theta") >= 0

    def _first_polish(self) -> int:
        return POLISH_EVERY if self._has_heading else POLISH_FIRST

    def _polishes_now(self, left: float | None) -> bool:
        """Whether to improve the plan: at fixed iterations, if it is another one than last time and time is left."""
        if self._polish is None or self._progress.iterations < self._polish_due * len(self._trees):
            return False
        self._polish_due = self._polish_due + POLISH_EVERY if self._has_heading else self._polish_due * POLISH_AGAIN
        if self._polished.attempts > 0 and self._tree.best[0] >= self._polished.searched - POLISH_GAIN:
            return False
        return left is None or left > self._polished.seconds

    def _after_growing(self, base: float, began: float, seconds: float | None) -> float:
        """Update the progress and improve the plan if that is due; the time since the reading `began` of the clock, s.

        `base` is the time of the query at that reading, `seconds` the budget since then.
        """
        elapsed = time.perf_counter() - began
        self._update_progress(base + elapsed)
        if self._polishes_now(None if seconds is None else seconds - elapsed):
            self._add_polished(base - began)
            elapsed = time.perf_counter() - began
        return elapsed

    def _add_polished(self, offset: float) -> None:
        """Improve the best plan or, if the goal has a heading and there is none, one along the cost-to-go of poses.

        Without a heading the result is kept apart from the tree until the end of `grow`: the search goes on as without
        it, and finds other ways round the obstacles, which may be better when they are optimised in their turn.

        `offset` is the time of the query at a reading of the clock minus that reading, s.
        """
        assert self.goal is not None
        began, attempts = time.perf_counter(), self._polished.attempts
        if not self._polished.guessed and self._has_heading and self._tree.count[at.BEST] < 0:
            self._optimise_guess()
            self._update_progress(offset + time.perf_counter())
        searched = float(self._tree.best[0])
        if self._tree.count[at.BEST] >= 0:
            self._improve_plan()
            if self._has_heading:
                self._insert_polished()
                best = float(self._tree.best[0])
                searched = searched if best < (1.0 - CONVERGES) * searched else best
        seconds = time.perf_counter() - began
        self._polished = replace(self._polished, attempts=attempts + 1, searched=searched, seconds=seconds)
        self._update_progress(offset + time.perf_counter())

    def _improve_plan(self) -> None:
        """Improve the best plan of the tree; if SAFETY refuses that, the part of it after the cycle's end."""
        tree = self._tree
        path = path_to(tree, int(tree.count[at.BEST]))
        if len(path) == 1 or path[0] != 0:
            return  # the query begins in the goal, or at a further root: optimised plans are added from the first one
        heads = [0]
        if self.safety.enabled:
            heads += [k for k in range(1, len(path) - 1) if tree.value[path[k], at.COST] >= self.safety.cycle][:1]
        for head in heads:
            nu = len(self.vehicle.controls)
            controls, durations = tree.edge[path[head + 1 :], :nu], tree.edge[path[head + 1 :], nu]
            guess = guess_of(
                self.vehicle, *self._trajectory(tree.state[path[head]], controls, durations), controls, durations
            )
            if self._improve(guess, path[1 : head + 1], 1.0):
                return

    def _improve(self, guess: Guess, head: list[int], urgency: float) -> bool:
        """Improve a guess that begins after the nodes `head`; whether that is the best plan, which is kept then."""
        assert self._polish is not None
        assert self.goal is not None
        tree, nu = self._tree, len(self.vehicle.controls)
        begin = float(tree.value[head[-1], at.COST]) if head else 0.0
        for smoothness in weights_of(self.goal).smoothnesses:
            found = self._polish.improve(guess, self.goal, begin, urgency, smoothness) if guess.time > 0.0 else None
            if found is None:
                return False
            durations = np.concatenate([tree.edge[head, nu], found.durations])
            cost = float(np.cumsum(durations)[-1])
            if cost < self._least_cost:
                controls = np.concatenate([tree.edge[head, :nu], found.controls])
                self._polished = replace(self._polished, cost=cost, controls=controls, durations=durations)
                return True
            if cost < float(tree.best[0]):
                return False
        return False

    def _insert_polished(self) -> None:
        """Add the optimised plan to the tree, if it is there not yet, with all checks of an earlier plan's edges."""
        controls, durations = self._polished.controls, self._polished.durations
        if controls is None or durations is None:
            return
        self._add_edges(controls, durations)
        self._polished = replace(self._polished, controls=None, durations=None, cost=float(self._tree.best[0]))

    def _prunes_now(self) -> bool:
        """Whether to prune: at fixed iterations, so that readings of the clock do not matter."""
        return self.settings.pruning and self._tree.count[at.ITERATIONS] % PRUNE_EVERY == 0


def _next_chunk(count: int, seconds: float, remaining: float | None) -> int:
    """Iterations until the next reading of the clock: about LONGEST_CHUNK s, fewer near the end of the budget."""
    target = LONGEST_CHUNK if remaining is None else min(LONGEST_CHUNK, max(remaining, 0.0))
    return max(1, min(2 * count, int(count * target / max(seconds, 1e-9))))
