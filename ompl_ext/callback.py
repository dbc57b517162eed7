"""DIRT over OMPL's callbacks: the algorithm of `ompl_ext.kernels.dirt` for any control space.

States are OMPL's, kept in a list; the tree's arrays hold their indices (slots).  The algorithm runs compiled and calls
back for edges and SAFETY (`ompl_ext.kernels.callback_kernel`).
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from numbers import Real
from typing import Any

import numpy as np
from ompl import base as ob
from ompl import control as oc
from ompl import util as ou

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.configuration import Bounds, Configuration, ControlLayout, goal_configuration, state_reader
from ompl_ext.kernels import callback_kernel
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.dirt import EXPLORATION_INSERTIONS
from ompl_ext.kernels.functions import FUNCTIONS
from ompl_ext.kernels.kernel_types import LANE_WIDTH, Lanes, Problem, Retained
from ompl_ext.kernels.rng import generator
from ompl_ext.kernels.tree_memory import (  # fmt: skip
    CAPACITY,
    add_root,
    best_node,
    new_tree,
    path_to,
    prune,
    reset,
    set_costs_to_go,
    with_room,
)
from ompl_ext.plan import Contingency, TreeView, tree_view
from ompl_ext.problem import make_lanes
from ompl_ext.retainment import edges_to_retain

PRUNE_EVERY = 1024  # iterations
TOP_SPEED_MARGIN = 1.01  # factor of the learned top speed over the fastest edge, so that it rises rarely


@dataclass(frozen=True)
class CallbackSettings:
    """Settings of DIRT over callbacks; `cycle` 0 disables SAFETY, with `top_speed` 0 the planner learns it."""

    blossom: int
    child_extension: bool
    goal_bias: float
    control_bound_bias: float
    resolution: float
    max_nodes: int
    pruning: bool
    cycle: float
    top_speed: float


class CallbackSearch:
    """Algorithm 1 on an OMPL `SpaceInformation`: `add_root`, then `grow`, then `path`."""

    def __init__(
        self,
        si: oc.SpaceInformation,
        goal: ob.Goal,
        configuration: Configuration,
        bounds: Bounds,
        settings: CallbackSettings,
        safety: Callable[[ob.State], Contingency | None] | None,
        seed: int,
    ) -> None:
        self._si, self._goal, self._configuration, self._settings = si, goal, configuration, settings
        self._safety = safety if settings.cycle > 0 else None
        self._control = ControlLayout(si.getControlSpace())
        self._lane_control = [si.allocControl() for _ in range(settings.blossom)]
        self._states: list[ob.State] = []
        self._free: list[int] = []  # slots of states that are neither a node's nor a lane's
        self._distance: list[float] = []  # of each state to the goal region, as the goal measures it
        # the distance alone decides, unless a class of the user's says otherwise
        self._is_region = isinstance(goal, ob.GoalRegion) and _inherits_is_satisfied(goal)
        self._goal_distance = getattr(goal, "distanceGoal", lambda state: 0.0)  # a goal without a distance
        self._threshold = 0.0
        self._step = si.getPropagationStepSize()
        self._top_speed, self._learns_top_speed = settings.top_speed, settings.top_speed == 0.0
        self._problem = self._make_problem(bounds)
        max_steps = int(self._problem.option[at.STEPS])
        capacity = min(CAPACITY, settings.max_nodes)
        self._tree = new_tree(capacity, 1, self._control.dimension, bounds)
        self._work = make_lanes(1, self._control.dimension, 1, max_steps)
        self._view: Any = Lanes._make(array.data for array in self._work)  # faster than numpy for single numbers
        self._last = max_steps * LANE_WIDTH  # index of the edges' ends in the trajectory
        self._q = np.zeros(at.Q_DIM)
        self._no_edges = edges_to_retain([], np.zeros((0, self._control.dimension)), np.zeros(0))
        self._grow = callback_kernel.grow()
        self._lane_slot = [self._new_state() for _ in range(settings.blossom)]
        self._scratch = si.allocState()
        self._start = self._scratch
        self._inserted = 0
        self._undefined = 0  # states without a configuration or a distance to the goal, which are omitted
        self._stop = np.zeros(1, np.int64)  # 1 ends a run of the kernel
        self._asks_to_stop: Callable[[], bool] = _never
        self._error: BaseException | None = None  # of a callback, in this run
        self._callbacks = _callbacks_of(self)
        reset(self._tree, generator(seed))

    def _make_problem(self, bounds: Bounds) -> Problem:
        settings = self._settings
        min_steps, max_steps = self._si.getMinControlDuration(), self._si.getMaxControlDuration()
        scalar, option = np.zeros(at.SCALARS), np.zeros(at.OPTIONS, np.int64)
        scalar[[at.SHORTEST, at.LONGEST, at.QUANTUM]] = (
            min_steps * self._step,
            max_steps * self._step,
            self._step,
        )
        scalar[[at.RESOLUTION, at.CYCLE]] = settings.resolution, settings.cycle
        scalar[[at.X_LOW, at.X_HIGH, at.Y_LOW, at.Y_HIGH]] = *bounds[0], *bounds[1]
        scalar[at.CONTROL_BOUND_BIAS] = settings.control_bound_bias
        option[[at.STEPS, at.BLOSSOM, at.INSERTIONS]] = max_steps, settings.blossom, 1
        option[[at.CHILD_EXTENSION, at.REQUIRE_SAFETY]] = settings.child_extension, self._safety is not None
        target = goal_configuration(self._goal, self._configuration)
        if target is not None:
            scalar[at.GOAL_BIAS] = settings.goal_bias
            scalar[[at.GOAL_X, at.GOAL_Y]] = target
        nothing, no_tile, no_squares = (np.zeros((1, 1), kind) for kind in (np.float32, np.int32, np.uint16))
        return Problem(
            parameters=np.zeros(1),
            controls=self._control.bounds,
            limits=np.zeros((1, 2)),
            discs=np.zeros((1, 4)),
            field=nothing,
            togo=nothing,
            tile=no_tile,
            squares=no_squares,
            pose_togo=np.zeros(1, np.float32),
            goal_limits=np.zeros((1, 3)),
            scalar=scalar,
            option=option,
            functions=np.zeros(FUNCTIONS, np.int64),
        )

    def count(self, which: int) -> int:
        """Entry of `ompl_ext.kernels.kernel_types.Tree.count`."""
        return int(self._tree.count[which])

    def infeasible(self) -> bool:
        """False: feasibility is unknown without a map."""
        return False

    def state_of(self, node: int) -> ob.State:
        """OMPL state of a node."""
        return self._states[int(self._tree.state[node, 0])]

    def view(self) -> TreeView:
        """Copy of the tree."""
        read, size = state_reader(self._si.getStateSpace()), self.count(at.SIZE)
        states = np.array([read(self.state_of(node)) for node in range(size)])
        return tree_view(self._tree, states.reshape(size, len(read(self._scratch))))

    def clear(self) -> None:
        """Empty the tree and forget a learned top speed; memory and the generator's state are kept."""
        reset(self._tree, self._tree.random)
        self._top_speed = self._settings.top_speed
        self._inserted = 0
        self._free_unused_states()

    def add_root(self, state: ob.State) -> None:
        """Add a start state; one whose configuration or distance to the goal is not a number is omitted.

        Raises:
            MemoryError: if the tree has `max_nodes` nodes.
        """
        self._reserve(1)
        slot = self._new_state()
        self._si.copyState(self._states[slot], state)
        self._work.source[0] = slot
        self._read_threshold()
        if not (self._measure(slot) and self._describe(0, slot)):
            self._free.append(slot)
            return
        if self._work.at_goal[0] == 1 and self._safety is not None and self._safety(state) is None:
            self._work.at_goal[0] = 0  # no plan may end there
        add_root(self._tree, self._work)

    def retain(self, parents: list[int], controls: Matrix, durations: Floats) -> int:
        """Add the edges of an earlier plan or tree that are valid, safe and within the bounds; returns their number."""
        before = int(self._tree.count[at.SIZE])
        self._reserve(len(parents))
        self._run(edges_to_retain(parents, controls, durations, bounds=self._control.bounds), 0, _never)
        return int(self._tree.count[at.SIZE]) - before

    def grow(self, stop: Callable[[], bool]) -> None:
        """Visit nodes until `stop()` is true or `max_nodes` are in use; an exception of a callback is raised here.

        `stop` is called in every visit, and at once when a better plan has been found.
        """
        stopped = bool(stop())
        while not stopped:
            iterations = PRUNE_EVERY - self.count(at.ITERATIONS) % PRUNE_EVERY
            self._reserve(iterations * EXPLORATION_INSERTIONS)
            self._run(self._no_edges, iterations, stop)
            if self._tree.count[at.FULL] or (self._settings.pruning and self.count(at.ITERATIONS) % PRUNE_EVERY == 0):
                self._prune()
                if self._tree.count[at.SIZE] > 0.9 * self._settings.max_nodes:
                    return
            stopped = bool(self._stop[0]) or bool(stop())

    def warn_of_undefined_states(self) -> None:
        """Warn of valid states without a configuration or a distance to the goal, which were omitted."""
        if self._undefined:
            ou.OMPL_WARN(
                f"DIRT: {self._undefined} valid states were omitted: their configuration or "
                "their distance to the goal is not a number"
            )
            self._undefined = 0

    def _prune(self) -> None:
        """Prune the tree and free the states of the removed nodes."""
        self._replace_inserted_states()  # pruning moves the nodes that it has to look at
        prune(self._tree, at.COST if self._learns_top_speed else at.F)
        self._inserted = int(self._tree.count[at.SIZE])
        self._free_unused_states()

    def _reserve(self, nodes: int) -> None:
        """Have memory for so many more nodes, as far as `max_nodes` allows."""
        self._tree = with_room(self._tree, nodes, self._settings.max_nodes)

    def _run(self, retained: Retained, iterations: int, stop: Callable[[], bool]) -> None:
        """Run the kernel.  Exceptions cannot pass compiled code: the first one ends the run and is raised after it."""
        self._stop[0] = 0
        self._read_threshold()
        self._asks_to_stop, self._error = stop, None
        work = callback_kernel.CallbackLanes(*self._work, *self._callbacks, self._stop)
        try:
            self._grow(self._tree, self._problem, work, self._q, retained, iterations)
            if self._error is not None:
                raise self._error
        finally:
            self._asks_to_stop, self._error = _never, None

    def _called_to_propagate(self, start_slot: int, lanes: int) -> None:
        """Propagate a blossom and ask whether to stop (called by the kernel)."""
        self._work.slack[:lanes] = -1.0  # invalid until propagated
        try:
            if self._error is None:
                self._propagate(start_slot, lanes)
                self._stop[0] = bool(self._asks_to_stop())
        except BaseException as error:
            self._work.slack[:lanes] = -1.0
            self._error, self._stop[0] = error, 1

    def _called_for_safety(self, lane: int, start_time: float) -> int:
        """0 if an edge passes SAFETY, else -1 (called by the kernel)."""
        try:
            return -1 if self._error is not None else self._safe(lane, start_time)
        except BaseException as error:
            self._error, self._stop[0] = error, 1
            return -1

    @property
    def cost(self) -> float:
        """Cost of the best path to the goal (s), infinite without one."""
        return float(self._tree.best[0])

    def best(self) -> tuple[int, bool]:
        """Last node of the best plan, -1 without a plan, and whether it is in the goal."""
        return best_node(self._tree)

    def best_path(self) -> tuple[oc.PathControl | None, bool]:
        """Path of the best plan, None without a plan, and whether it reaches the goal."""
        node, exact = self.best()
        if node < 0:
            return None, False
        path, control = oc.PathControl(self._si), self._si.allocControl()
        nodes = path_to(self._tree, node)
        for before, after in pairwise(nodes):
            self._control.write(self._tree.edge[after, :-1].tolist(), control)
            path.append(self.state_of(before), control, float(self._tree.edge[after, -1]))
        path.append(self.state_of(node))
        return path, exact

    # What the kernel calls for.

    def _propagate(self, start_slot: int, lanes: int) -> None:
        """Propagate a blossom, each stage for all lanes before the next: its data stay in the processor's caches."""
        self._replace_inserted_states()
        work, states, slots, controls = self._view, self._states, self._lane_slot, self._lane_control
        start, steps = states[start_slot], work.steps[:lanes].tolist()
        self._start = start
        for lane in range(lanes):
            self._control.write(work.control[lane::LANE_WIDTH].tolist(), controls[lane])
        propagate = self._si.propagateWhileValid
        done = [propagate(start, controls[lane], steps[lane], states[slots[lane]]) for lane in range(lanes)]
        valid = [lane for lane in range(lanes) if done[lane] == steps[lane] and self._measure(slots[lane])]
        if self._learns_top_speed:
            self._learn_top_speed(start_slot, valid)
        for lane in valid:
            if self._describe(lane, slots[lane]):
                work.trajectory[self._last + lane] = slots[lane]
                work.slack[lane] = 0.0

    def _safe(self, lane: int, start_time: float) -> int:
        """SAFETY where an edge crosses the end of the cycle: propagate to that time again and call the checker."""
        assert self._safety is not None
        steps = min(math.ceil((self._settings.cycle - start_time) / self._step - 1e-9), self._view.steps[lane])
        self._si.propagate(self._start, self._lane_control[lane], steps, self._scratch)
        return 0 if self._safety(self._scratch) is not None else -1

    def _measure(self, slot: int) -> bool:
        """Store a state's distance to the goal region, of any numeric type; false if it is NaN."""
        stated = self._goal_distance(self._states[slot])
        if not isinstance(stated, Real):
            kind = type(self._goal).__name__
            raise TypeError(f"{kind}.distanceGoal() returned {stated!r}; expected a number")
        self._distance[slot] = distance = float(stated) - self._threshold
        if math.isnan(distance):
            self._undefined += 1
            return False
        return True

    def _learn_top_speed(self, start_slot: int, lanes: list[int]) -> None:
        """Raise the top speed to the fastest of some edges, and lower every cost-to-go of the tree with it.

        A cost-to-go computed with an earlier, lower speed is no lower bound: nodes that can still improve the plan
        would be excluded.
        """
        work, distance, start = self._view, self._distance, self._distance[start_slot]
        speeds = [(start - distance[self._lane_slot[lane]]) / work.duration[lane] for lane in lanes]
        fastest = max(filter(math.isfinite, speeds), default=0.0)  # nothing follows from an infinite distance
        if fastest <= self._top_speed:
            return
        self._top_speed = TOP_SPEED_MARGIN * fastest
        slots = self._tree.state[: self.count(at.SIZE), 0].astype(np.int64).tolist()
        known = np.array([distance[slot] for slot in slots])
        togo = np.where(known < math.inf, np.maximum(known, 0.0), 0.0) / self._top_speed
        cycle = self._settings.cycle if self._safety is not None else 0.0
        set_costs_to_go(self._tree, togo, self._settings.resolution, cycle)

    def _describe(self, lane: int, slot: int) -> bool:
        """Write configuration, cost-to-go and goal of a state as the end of a lane; its distance is known.

        False if the configuration is not finite.  An infinite distance bounds no cost: the cost-to-go is 0.
        """
        state, work, distance = self._states[slot], self._view, self._distance[slot]
        x, y = self._configuration(state)
        if not (math.isfinite(x) and math.isfinite(y)):
            self._undefined += 1
            return False
        work.end[lane], work.end[LANE_WIDTH + lane] = x, y
        work.togo[lane] = distance / self._top_speed if 0.0 < distance < math.inf and self._top_speed > 0.0 else 0.0
        work.at_goal[lane] = distance < 0.0 if self._is_region else bool(self._goal.isSatisfied(state))
        return True

    def _read_threshold(self) -> None:
        """Read the goal's threshold, which may have changed."""
        self._threshold = self._goal.getThreshold() if hasattr(self._goal, "getThreshold") else 0.0

    def _new_state(self) -> int:
        """Slot of a state that is nobody's: a free one or, if there is none, a new one."""
        if self._free:
            return self._free.pop()
        self._states.append(self._si.allocState())
        self._distance.append(0.0)
        return len(self._states) - 1

    def _free_unused_states(self) -> None:
        """Free every state that is neither a node's nor a lane's."""
        used = np.zeros(len(self._states), bool)
        used[self._lane_slot] = True
        used[self._tree.state[: self.count(at.SIZE), 0].astype(np.int64)] = True
        self._free = np.flatnonzero(~used).tolist()

    def _replace_inserted_states(self) -> None:
        """Take another state for each lane whose state has become a node's."""
        size = int(self._tree.count[at.SIZE])
        for slot in self._tree.state[self._inserted : size, 0].tolist():
            if slot in self._lane_slot:
                self._lane_slot[self._lane_slot.index(slot)] = self._new_state()
        self._inserted = size


def _inherits_is_satisfied(goal: ob.Goal) -> bool:
    """Whether no Python class of a goal has an `isSatisfied` of its own; OMPL's are in the package `ompl`."""
    own = [kind for kind in type(goal).__mro__ if "isSatisfied" in vars(kind)]
    return own[0].__module__.split(".")[0] == "ompl"


def _never() -> bool:
    return False


def _callbacks_of(search: CallbackSearch) -> tuple[Any, Any]:
    """Functions of a search that compiled code can call.

    They hold it by a weak reference: numba's cast of a ctypes function to an address makes it refer to itself, so that
    it, and all that it holds, would stay until the next garbage collection.
    """
    me = weakref.ref(search)

    def propagate(start_slot: int, lanes: int) -> None:
        search = me()
        assert search is not None  # it runs the kernel
        search._called_to_propagate(start_slot, lanes)

    def safe(lane: int, start_time: float) -> int:
        search = me()
        assert search is not None
        return search._called_for_safety(lane, start_time)

    return callback_kernel.PROPAGATE(propagate), callback_kernel.SAFE(safe)
