"""DIRT as an OMPL planner.

Z. Littlefield and K. E. Bekris, Efficient and asymptotically optimal kinodynamic motion planning via
dominance-informed regions, IROS 2018; retainment, SAFETY and the best-heuristic fallback by Algorithm 1 of KRAFT.
"""

from __future__ import annotations

import math
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Real
from typing import Any, TypeAlias

import numpy as np
from ompl import base as ob
from ompl import control as oc
from ompl import util as ou

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.callback import CallbackSearch, CallbackSettings
from ompl_ext.compiled_search import CompiledSearch
from ompl_ext.configuration import Bounds, Configuration, ControlLayout, check_plane, default_configuration
from ompl_ext.kernels import kernel_types as at
from ompl_ext.parameters import DIRT_PARAMETERS, ParamSet, Value
from ompl_ext.plan import Plan, TreeView
from ompl_ext.retainment import divided_edges, remaining_edges
from ompl_ext.system import PlanarGoal
from ompl_ext.validity import SafetyValidityChecker

Search: TypeAlias = CompiledSearch | CallbackSearch
Termination: TypeAlias = Any  # a termination condition, seconds, or a function that returns true to stop
CALLBACK_BLOSSOM = 4


@dataclass(frozen=True)
class _Retained:
    parents: list[int]
    controls: Matrix
    durations: Floats

    def edges_for(self, si: oc.SpaceInformation, most: int) -> tuple[list[int], Matrix, Floats]:
        """Parents, controls and durations of edges of whole propagation steps, none longer than the longest.

        Raises:
            ValueError: they are more than `most`.
        """
        step = si.getPropagationStepSize()
        longest = si.getMaxControlDuration() * step
        rounded = np.maximum(np.floor(self.durations / step + 0.5), 1.0) * step
        if np.ceil(rounded / longest).sum() > most:
            raise ValueError(f"edges to retain: {rounded.sum():g} s are more than max_nodes, {most}, of {longest:g} s")
        return divided_edges(self.parents, self.controls, rounded, longest)


class DIRT(ob.Planner):
    """Dominance-Informed Region Trees for any control `SpaceInformation`.

    With a `SafetyValidityChecker` and a `PlanarGoal` (see `ompl_ext.system`) the whole search is compiled; with any
    other checker, propagator and goal it uses their callbacks.  `params()` lists the parameters.

    Args:
        si: space information.
        configuration: map of a state to the plane of the regions (callbacks only; default by the kind of space).
        bounds: bounds of that plane, ((low, high), (low, high)).
        parameters: initial values, as by `params()[name] = value`.

    Raises:
        TypeError: `si` is not a space information of controls.
        ValueError: the bounds are not finite with low < high, or a parameter is out of its bounds.
    """

    def __init__(
        self,
        si: oc.SpaceInformation,
        configuration: Configuration | None = None,
        bounds: Bounds | None = None,
        **parameters: Value,
    ) -> None:
        if not isinstance(si, oc.SpaceInformation):
            raise TypeError(f"si: expected an ompl.control.SpaceInformation, not {type(si).__name__}")
        super().__init__(si, "DIRT")
        if (configuration is None) != (bounds is None):
            raise ValueError("configuration and bounds: expected both or none")
        if bounds is not None:
            check_plane(bounds)
        self._params = ParamSet(DIRT_PARAMETERS)
        for name, value in parameters.items():
            self._params[name] = value
        self._configuration, self._bounds = configuration, bounds
        self._search: Search | None = None
        self._search_key: tuple[object, ...] = ()
        self._query: tuple[object, ...] = ()
        self._cleared = False
        self._added = math.inf  # cost of the best path to the goal that was added to the problem definition (s)
        self._retained: _Retained | None = None
        self._clears = 0
        self._in_use = threading.Lock()  # held by a call that changes the search
        # OMPL's wrapper passes PlannerData by copy, which OMPL forbids: an override in the class would abort the
        # process.  One call of the base makes the wrapper cache "not overridden"; Python callers use the attribute.
        ob.Planner.getPlannerData(self, ob.PlannerData(si))
        me = weakref.ref(self)
        self.getPlannerData = lambda data: _fill_planner_data(me(), data)

    def params(self) -> ParamSet:
        """Parameters in OMPL's style; they take effect before `setup()` or the first `solve`, and after `clear()`."""
        return self._params

    def retain(self, path: oc.PathControl, elapsed: float = 0.0) -> None:
        """Begin the next query with the remainder of `path` after `elapsed` s, propagated from the new start.

        The property `retained` tells after `solve` how many edges were kept.

        Raises:
            TypeError: `path` is no path with controls.
            ValueError: `elapsed` or a duration of the path is negative or not finite.
        """
        if not isinstance(path, oc.PathControl):
            expected = "expected an ompl.control.PathControl, such as setup.getSolutionPath()"
            raise TypeError(f"DIRT: retain() got a {type(path).__name__}; {expected}")
        if not 0.0 <= elapsed < math.inf:
            raise ValueError(f"elapsed is {elapsed}; expected the seconds since the start of the path, 0 or more")
        layout = ControlLayout(self.getSpaceInformation().getControlSpace())
        rows = [layout.read(path.getControl(k)) for k in range(path.getControlCount())]
        controls = np.array(rows).reshape(-1, layout.dimension)
        durations = np.array(path.getControlDurations(), dtype=float)
        if not (np.isfinite(durations).all() and (durations >= 0.0).all()):
            raise ValueError(f"durations of the path: {durations.tolist()}; expected finite seconds, 0 or more")
        self._retained = _Retained(*remaining_edges(controls, durations, elapsed))

    def retain_tree(self, tree: TreeView) -> None:
        """Begin the next query with the edges of an earlier tree below its first start, from the new start.

        Raises:
            TypeError: `tree` is no tree.
            ValueError: its edges have another number of controls.
        """
        if not isinstance(tree, TreeView):
            expected = "expected what tree() of a planner returns"
            raise TypeError(f"DIRT: retain_tree() got a {type(tree).__name__}; {expected}")
        own, given = ControlLayout(self.getSpaceInformation().getControlSpace()).dimension, tree.controls.shape[1]
        if given != own:
            raise ValueError(f"DIRT: retain_tree() got a tree with {given} controls an edge; expected {own}")
        parents, controls, durations = tree.edges_of_first_root()
        self._retained = _Retained(parents, controls, durations)

    def solve(
        self,
        ptc: Termination = None,
        checkInterval: float = 0.0,
        *,
        solveTime: float | None = None,
        terminationConditionFn: Callable[[], bool] | None = None,
    ) -> ob.PlannerStatus:
        """Grow the tree until the condition holds; a repeated call continues.

        A better path to the goal is added to the problem definition when it is found: conditions may look for it.  The
        arguments are those of OMPL's `solve`: seconds, a function with an optional interval, or a termination
        condition.

        Raises:
            TypeError: the condition is neither a number nor a function.
            RuntimeError: there is no problem definition, or this planner is in use by another thread or a caller.
        """
        limit = next((each for each in (ptc, solveTime, terminationConditionFn) if each is not None), 1.0)
        if not (isinstance(limit, Real) or callable(limit)):
            expected = "expected seconds, a function or a termination condition"
            raise TypeError(f"DIRT: solve() got a {type(limit).__name__}; {expected}")
        with self._used_by("solve"):
            return self._solve(limit, checkInterval)

    def _solve(self, limit: Termination, interval: float) -> ob.PlannerStatus:
        status = ob.PlannerStatus
        definition = self.getProblemDefinition()
        if definition is None:
            raise RuntimeError("DIRT: the problem definition is not set")
        goal = definition.getGoal()
        if definition.getStartStateCount() == 0:
            ou.OMPL_ERROR("DIRT: there are no start states")
            return status(status.INVALID_START)
        if goal is None:
            ou.OMPL_ERROR("DIRT: there is no goal")
            return status(status.INVALID_GOAL)
        self._prepare(definition)
        assert self._search is not None
        if not self._add_starts(self._search):
            if isinstance(self._search, CallbackSearch):
                self._search.warn_of_undefined_states()
            ou.OMPL_ERROR("DIRT: none of the start states is valid")
            return status(status.INVALID_START)
        if self._search.infeasible():
            ou.OMPL_ERROR("DIRT: no path for the footprint leads from the start to the goal")
            return status(status.INFEASIBLE)
        if self._retained is not None:
            retained, self._retained = self._retained, None
            self._search.retain(*retained.edges_for(self.getSpaceInformation(), int(self._params["max_nodes"])))
        self._grow(self._search, definition, _condition(limit, interval))  # made here: the maps are not the search
        if isinstance(self._search, CallbackSearch):
            self._search.warn_of_undefined_states()
        return self._report(self._search, definition, goal)

    def clear(self) -> None:
        """Empty the tree; the next query uses the next seed."""
        with self._used_by("clear"):
            if self._search is not None:
                self._search.clear()
                self._cleared = True
        ob.Planner.clear(self)  # a virtual function: OMPL calls this method once more

    def setup(self) -> None:
        """Read the space information's settings; with a goal, also compute the maps of the search."""
        ob.Planner.setup(self)
        definition = self.getProblemDefinition()
        if definition is not None and definition.getGoal() is not None:
            with self._used_by("setup"):
                self._prepare(definition)

    def tree(self) -> TreeView:
        """Copy of the tree with controls and durations, which OMPL's `PlannerData` cannot carry in Python."""
        if self._search is None:
            raise RuntimeError("DIRT: there is no tree before solve()")
        return self._search.view()

    def plan(self) -> Plan | None:
        """Best plan with its contingency (compiled search only)."""
        if not isinstance(self._search, CompiledSearch):
            raise RuntimeError("DIRT: plan() exists for the compiled search only; use the problem definition's path")
        return self._search.dirt.plan()

    @property
    def compiled(self) -> bool:
        """Whether the search is compiled rather than over callbacks; known after `solve`."""
        return isinstance(self._search, CompiledSearch)

    @property
    def edges(self) -> int:
        """Edges propagated and checked since the last `clear`."""
        return self._search.count(at.EDGES) if self._search is not None else 0

    @property
    def retained(self) -> int:
        """Edges of an earlier plan or tree with which the tree began; known after `solve`."""
        return self._search.count(at.RETAINED) if self._search is not None else 0

    @property
    def iterations(self) -> int:
        """Visits since the last `clear`."""
        return self._search.count(at.ITERATIONS) if self._search is not None else 0

    @contextmanager
    def _used_by(self, call: str) -> Iterator[None]:
        """Context in which no other call may change the search: it would change under a kernel that runs on it."""
        if not self._in_use.acquire(blocking=False):
            raise RuntimeError(
                f"DIRT: {call}() was called while another call of this planner runs, by a callback or another thread; "
                "expected one call at a time"
            )
        try:
            yield
        finally:
            self._in_use.release()

    def _add_starts(self, search: Search) -> bool:
        inputs = self.getPlannerInputStates()
        while (state := inputs.nextStart()) is not None:
            search.add_root(state)
        return search.count(at.SIZE) > 0

    def _prepare(self, definition: ob.ProblemDefinition) -> None:
        """Make the search for a problem definition with a goal, or restart the existing one after `clear()`.

        With another definition, another goal, or another threshold of it, the query is another one: it begins at the
        starts again.  Maps are computed again only for another goal or threshold.
        """
        si, goal = self.getSpaceInformation(), definition.getGoal()
        if not si.isSetup():  # as OMPL's planners do: it chooses the step and the durations that are not set
            si.setup()
        durations = si.getPropagationStepSize(), si.getMinControlDuration(), si.getMaxControlDuration()
        target = goal, goal.getThreshold() if isinstance(goal, ob.GoalRegion) else 0.0
        key = (target, si.getStateValidityChecker(), durations, *self._params.getParams().items())
        query = definition, target
        if self._search is not None and not self._cleared:
            if query == self._query:
                return
            self.getPlannerInputStates().restart()
        if self._cleared:
            self._clears += 1
        self._cleared, self._query, self._added = False, query, math.inf
        if definition.hasOptimizationObjective():
            ou.OMPL_WARN("DIRT: it minimises the duration; the optimization objective of the problem is not used")
        if isinstance(self._search, CompiledSearch) and key == self._search_key:
            self._search.restart(int(self._params["seed"]) + self._clears)
        else:
            self._search, self._search_key = self._make_search(goal), key

    def _make_search(self, goal: ob.Goal) -> Search:
        si, checker = self.getSpaceInformation(), self.getSpaceInformation().getStateValidityChecker()
        seed = int(self._params["seed"]) + self._clears
        compiled = isinstance(checker, SafetyValidityChecker) and isinstance(goal, PlanarGoal)
        if compiled and not self._params["use_callbacks"]:
            return CompiledSearch(si, checker, goal, self._params, seed)
        if isinstance(checker, SafetyValidityChecker) and not self._params["use_callbacks"]:
            ou.OMPL_WARN(f"DIRT: the goal is a {type(goal).__name__}, not a PlanarGoal: running over callbacks")
        if self._configuration is None or self._bounds is None:
            configuration, bounds = default_configuration(si.getStateSpace())
            check_plane(bounds)
        else:
            configuration, bounds = self._configuration, self._bounds
        safety = getattr(checker, "safety", None)
        _warn_of_settings_without_effect(self._params, safety is not None)
        return CallbackSearch(
            si,
            goal,
            configuration,
            bounds,
            _callback_settings(self._params),
            safety,
            seed,
        )

    def _grow(self, search: Search, definition: ob.ProblemDefinition, ends: Callable[[], bool]) -> None:
        """Grow the tree, and add each better path to the goal to the problem definition before `ends` is asked."""
        if not definition.hasExactSolution():  # its owner has cleared it
            self._added = math.inf

        def stop() -> bool:
            self._add_better_path(search, definition)
            return ends()

        search.grow(stop)
        self._add_better_path(search, definition)

    def _add_better_path(self, search: Search, definition: ob.ProblemDefinition) -> None:
        """Add the best path to the goal to the problem definition, if it is better than the last one."""
        if search.cost < self._added:
            path, _ = search.best_path()
            definition.addSolutionPath(path, False, 0.0, self.getName())
            self._added = search.cost

    def _report(self, search: Search, definition: ob.ProblemDefinition, goal: ob.Goal) -> ob.PlannerStatus:
        """Status; a path that does not reach the goal is added to the problem definition here."""
        node, exact = search.best()
        if node < 0:
            return ob.PlannerStatus(ob.PlannerStatus.TIMEOUT)
        if not exact:
            path, _ = search.best_path()
            assert path is not None, "there is a node"
            end = path.getState(path.getStateCount() - 1)
            difference = float(goal.distanceGoal(end)) if hasattr(goal, "distanceGoal") else -1.0
            definition.addSolutionPath(path, True, difference, self.getName())
        return ob.PlannerStatus(True, not exact)


def _callback_settings(params: ParamSet) -> CallbackSettings:
    return CallbackSettings(
        blossom=int(params["blossom"]) or CALLBACK_BLOSSOM,
        child_extension=bool(params["child_extension"]),
        goal_bias=float(params["goal_bias"]),
        control_bound_bias=float(params["control_bound_bias"]),
        resolution=float(params["resolution"]),
        max_nodes=int(params["max_nodes"]),
        pruning=bool(params["pruning"]),
        cycle=float(params["cycle"]),
        top_speed=float(params["top_speed"]),
    )


def _warn_of_settings_without_effect(params: ParamSet, has_safety: bool) -> None:
    """Warn of parameters that are set and have no effect over callbacks."""
    if params["cycle"] and not has_safety:
        ou.OMPL_WARN("DIRT: the validity checker has no method safety(state): no edge is checked by SAFETY")
    for name in ("polish", "threads"):
        if params[name] != params.describe(name).default:
            ou.OMPL_WARN(f"DIRT: {name} has no effect over callbacks")


def _condition(limit: Termination, interval: float) -> Callable[[], bool]:
    """Function that returns whether to stop; it calls that of the user at most every `interval` s, in this thread."""
    if isinstance(limit, Real):
        return ob.timedPlannerTerminationCondition(float(limit))
    return _at_intervals(limit, interval) if interval > 0 else limit


def _at_intervals(function: Callable[[], bool], interval: float) -> Callable[[], bool]:
    """Function that calls another one at most every `interval` s, the first time after that, until it returns true.

    OMPL's own class for this calls it in a thread, which its destructor waits for with Python's global lock held: the
    process may hang, or be aborted where it ends first.
    """
    due, stopped = time.monotonic() + interval, False

    def stop() -> bool:
        nonlocal due, stopped
        now = time.monotonic()
        if not stopped and now >= due:
            due, stopped = now + interval, bool(function())
        return stopped

    return stop


def _fill_planner_data(planner: DIRT | None, data: ob.PlannerData) -> None:
    """Add the tree to planner data: a vertex's tag is the node's index in `tree()`, an edge's weight its duration."""
    if planner is None or planner._search is None:
        return
    view, search = planner._search.view(), planner._search
    states, first = [search.state_of(node) for node in range(len(view.parents))], data.numVertices()
    for node, parent in enumerate(view.parents.tolist()):
        vertex = ob.PlannerDataVertex(states[node], node)
        if parent < 0:
            data.addStartVertex(vertex)
        else:
            data.addVertex(vertex)
            data.addEdge(first + parent, first + node, ob.PlannerDataEdge(), ob.Cost(float(view.durations[node])))
    best, exact = search.best()
    if exact:
        data.addGoalVertex(ob.PlannerDataVertex(states[best], best))
    data.decoupleFromPlanner()
