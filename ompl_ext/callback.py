"""DIRT over OMPL's callbacks: the source of `ompl_ext.dirt`, for any control space.

States stay OMPL's own; the tree's arrays hold their numbers in a list.  What needs no callback runs compiled.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from ompl import base as ob
from ompl import control as oc

from ompl_ext import dirt
from ompl_ext import kernel_types as at
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.configuration import Bounds, Configuration, ControlLayout, goal_configuration, state_reader
from ompl_ext.kernel_types import LANE_WIDTH, Lanes, Problem
from ompl_ext.plan import Contingency, TreeView, tree_view
from ompl_ext.query import edges_to_retain, make_lanes
from ompl_ext.rng import generator
from ompl_ext.tree_memory import add_root, new_tree, path_to, prune, reset


@dataclass(frozen=True)
class CallbackSettings:
    """Settings of DIRT for a space of callbacks; `cycle` 0 asks no SAFETY, `top_speed` 0 learns it."""

    blossom: int
    child_extension: bool
    goal_bias: float
    beyond: float
    resolution: float
    capacity: int
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
        self._edge_control = si.allocControl()
        self._states: list[ob.State] = []
        self._distance: list[float] = []  # of each state from the goal, in the goal's measure
        self._is_region = isinstance(goal, ob.GoalRegion)  # whose distance alone decides
        self._step = si.getPropagationStepSize()
        self._rate = settings.top_speed
        self._problem = self._make_problem(bounds)
        longest = int(self._problem.option[at.STEPS])
        self._tree = new_tree(settings.capacity, 1, self._control.dimension, bounds)
        self._work = make_lanes(1, self._control.dimension, 1, longest)
        self._brake = make_lanes(1, self._control.dimension, 1, 1)
        self._q = np.zeros(at.Q_DIM)
        self._lane_state = [self._new_state() for _ in range(settings.blossom)]
        self._scratch = si.allocState()
        self._start = self._scratch
        self._seen = 0
        reset(self._tree, generator(seed))

    def _make_problem(self, bounds: Bounds) -> Problem:
        settings, shortest, longest = (
            self._settings,
            self._si.getMinControlDuration(),
            self._si.getMaxControlDuration(),
        )
        scalar, option = np.zeros(at.SCALARS), np.zeros(at.OPTIONS, np.int64)
        scalar[[at.SHORTEST, at.LONGEST, at.QUANTUM]] = (
            shortest * self._step,
            longest * self._step,
            self._step,
        )
        scalar[[at.RESOLUTION, at.CYCLE]] = settings.resolution, settings.cycle
        scalar[[at.X_LOW, at.X_HIGH, at.Y_LOW, at.Y_HIGH]] = *bounds[0], *bounds[1]
        scalar[at.BEYOND] = settings.beyond
        option[[at.STEPS, at.BLOSSOM, at.INSERTIONS]] = longest, settings.blossom, 1
        option[[at.CHILD_EXTENSION, at.ASK_SAFETY]] = settings.child_extension, self._safety is not None
        target = goal_configuration(self._goal, self._configuration)
        if target is not None:
            scalar[at.GOAL_BIAS] = settings.goal_bias
            scalar[[at.GOAL_X, at.GOAL_Y]] = target
        nothing = np.zeros((1, 1), np.float32)
        return Problem(
            np.zeros(1), self._control.bounds, np.zeros((1, 2)), np.zeros(1), nothing, nothing, scalar, option
        )

    def count(self, which: int) -> int:
        """A number of `ompl_ext.kernel_types.Tree.count`."""
        return int(self._tree.count[which])

    def infeasible(self) -> bool:
        """Nothing is known of the way to the goal."""
        return False

    def state_of(self, node: int) -> ob.State:
        """OMPL's state of a node."""
        return self._states[int(self._tree.state[node, 0])]

    def view(self) -> TreeView:
        """A copy of the tree."""
        read, size = state_reader(self._si.getStateSpace()), self.count(at.SIZE)
        states = np.array([read(self.state_of(node)) for node in range(size)])
        return tree_view(self._tree, states)

    def add_root(self, state: ob.State) -> None:
        """A state to begin at."""
        place = self._new_state()
        self._si.copyState(self._states[place], state)
        self._work.source[0] = place
        self._distance[place] = self._goal_distance(self._states[place])
        self._describe(0, place)
        add_root(self._tree, self._work)

    def retain(self, parents: list[int], controls: Matrix, durations: Floats) -> int:
        """Add edges of an earlier plan or tree that are valid and safe from the root; returns how many."""
        kept = edges_to_retain(parents, controls, durations)
        before = int(self._tree.count[at.SIZE])
        dirt.retain.py_func(  # type: ignore[attr-defined]
            self._tree, self._problem, self._work, self._brake, kept, self._propagate, self._check, self._safe
        )
        return int(self._tree.count[at.SIZE]) - before

    def grow(self, stop: Callable[[], bool]) -> None:
        """Visit nodes until `stop()` is true or memory is used up."""
        while not stop():
            dirt.visit.py_func(  # type: ignore[attr-defined]
                self._tree,
                self._problem,
                self._work,
                self._brake,
                self._q,
                self._propagate,
                self._check,
                self._safe,
            )
            if self._tree.count[at.FULL] or (self._settings.pruning and self.count(at.ITERATIONS) % 1024 == 0):
                prune(self._tree, self._settings.resolution)
                self._seen = int(self._tree.count[at.SIZE])
                if self._tree.count[at.SIZE] > 0.9 * len(self._tree.state):
                    return

    def best(self) -> tuple[int, bool]:
        """The node to end the plan at, -1 if there is none, and whether it is in the goal."""
        if self._tree.count[at.BEST] >= 0:
            return int(self._tree.count[at.BEST]), True
        return int(self._tree.count[at.CLOSEST]), False

    def best_path(self) -> tuple[oc.PathControl | None, bool]:
        """The path of the best plan, None if there is none, and whether it reaches the goal."""
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

    # The three functions that `ompl_ext.dirt` is given.

    def _propagate(self, source: Floats, lanes: int, problem: Problem, work: Lanes) -> None:
        self._replace_taken_states()
        start_place = int(source[0])
        self._start = self._states[start_place]
        last = int(problem.option[at.STEPS]) * LANE_WIDTH
        rows = work.control.reshape(-1, LANE_WIDTH)[:, :lanes].T.tolist()
        for lane, steps in enumerate(work.steps[:lanes].tolist()):
            self._control.write(rows[lane], self._edge_control)
            place = self._lane_state[lane]
            done = self._si.propagateWhileValid(self._start, self._edge_control, steps, self._states[place])
            work.slack[lane], work.togo[lane] = -1.0, math.inf
            if done == steps:
                work.slack[lane] = 0.0
                self._distance[place] = self._goal_distance(self._states[place])
                if self._settings.top_speed == 0.0:
                    gained = self._distance[start_place] - self._distance[place]
                    self._rate = max(self._rate, gained / float(work.duration[lane]))
                self._describe(lane, place)
                work.trajectory[last + lane] = place

    def _check(self, lane: int, start_time: float, problem: Problem, work: Lanes) -> float:
        return float(work.slack[lane])

    def _safe(self, lane: int, start_time: float, problem: Problem, work: Lanes, brake: Lanes) -> int:
        """SAFETY where an edge leaves the cycle: propagate up to there once more and ask the checker."""
        assert self._safety is not None
        self._control.write(work.control[lane::LANE_WIDTH].tolist(), self._edge_control)
        steps = min(math.ceil((self._settings.cycle - start_time) / self._step - 1e-9), int(work.steps[lane]))
        self._si.propagate(self._start, self._edge_control, steps, self._scratch)
        return 0 if self._safety(self._scratch) is not None else -1

    def _describe(self, lane: int, place: int) -> None:
        """Configuration, cost-to-go and goal of a state, as the end of a lane."""
        state, work = self._states[place], self._work
        work.end[lane], work.end[LANE_WIDTH + lane] = self._configuration(state)
        work.togo[lane] = max(0.0, self._distance[place]) / self._rate if self._rate > 0.0 else 0.0
        inside = self._distance[place] < 0.0 if self._is_region else self._goal.isSatisfied(state)
        work.at_goal[lane] = 1 if inside else 0

    def _goal_distance(self, state: ob.State) -> float:
        """Distance from the goal's threshold, negative inside."""
        if not hasattr(self._goal, "distanceGoal"):
            return 0.0  # a goal that only says yes or no
        threshold = self._goal.getThreshold() if hasattr(self._goal, "getThreshold") else 0.0
        return float(self._goal.distanceGoal(state)) - threshold

    def _new_state(self) -> int:
        self._states.append(self._si.allocState())
        self._distance.append(0.0)
        return len(self._states) - 1

    def _replace_taken_states(self) -> None:
        """Give a lane whose state has become a node's a new one."""
        size = int(self._tree.count[at.SIZE])
        for node in range(self._seen, size):
            place = int(self._tree.state[node, 0])
            if place in self._lane_state:
                self._lane_state[self._lane_state.index(place)] = self._new_state()
        self._seen = size
