"""Search by the name of the planner: kraft's DIRT, or one of OMPL's planners through callbacks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from kraft.errors import Code, InputError, out_of_range
from kraft.scenario.planners import PLANNERS
from kraft.scenario.planning import Planning
from kraft.text import suggestion
from ompl_ext.arrays import Floats
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.plan import Plan
from ompl_ext.query_tree import MAX_THREADS, Progress
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

RETAINING: Final = ("dirt", "sst")
"""Planners that can begin with the edges of an earlier plan."""
UNUSED: Final = {"dirt": (), "sst": ("child_extension",)}
"""Settings of a scenario that a planner does not have, by its name; those of OMPL's own ones are `UNUSED_BY_OMPL`."""
UNUSED_BY_OMPL: Final = ("blossom", "goal_bias", "child_extension", "pruning")


@dataclass(frozen=True)
class Previous:
    """Earlier plan: planning starts in the state that it predicts after `elapsed` s, and retains its remaining edges.

    `origin` is the file of the plan, for messages and for the plan file.  `names` are those of the components of the
    state and of the controls of the plan's vehicle, if they are known.
    """

    plan: Plan
    elapsed: float = 0.0
    origin: str = "<built in code>"
    names: tuple[tuple[str, ...], tuple[str, ...]] | None = None

    @property
    def state(self) -> Floats:
        """State that the plan predicts after `elapsed` s, shape (nx,)."""
        plan = self.plan
        return interpolated_rows(self.elapsed, plan.times, plan.trajectory)

    def check(self, vehicle: Vehicle) -> None:
        """Check that the plan belongs to `vehicle` and lasts longer than `elapsed`.

        Raises:
            InputError: if it is not.
        """
        plan = self.plan
        if len(plan.durations) == 0:
            raise InputError.of(
                self.origin, "the plan has no edges: it began in the goal", "expected a plan that moves"
            )
        sizes, required = (
            (plan.trajectory.shape[1], plan.controls.shape[1]),
            (len(vehicle.state), len(vehicle.controls)),
        )
        if sizes != required:
            problem = f"the plan has {sizes[0]} state components and {sizes[1]} controls"
            expected = f"expected a plan of {vehicle.name}, which has {required[0]} and {required[1]}"
            raise InputError.of(self.origin, problem, expected, Code.MISMATCH)
        own = vehicle.state, tuple(vehicle.controls)
        if self.names is not None and self.names != own:
            (state, controls), (own_state, own_controls) = (map(", ".join, names) for names in (self.names, own))
            problem = f"the plan is of a vehicle with the state {state} and the controls {controls}"
            expected = f"expected a plan of {vehicle.name}, with {own_state} and {own_controls}"
            raise InputError.of(self.origin, problem, expected, Code.MISMATCH)
        if not 0.0 <= self.elapsed < plan.cost:
            problem = f"the plan is over after {plan.cost:.6g} s, before {self.elapsed:.6g} s"
            raise InputError.of(self.origin, problem, f"expected from 0 to less than {plan.cost:.6g} s")


@dataclass(frozen=True)
class Budget:
    """Budget of a search: a number of iterations, which is repeatable, or wall-clock time in s.

    Raises:
        InputError: if neither is given.
    """

    iterations: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        """Check that there is a budget."""
        if self.iterations is None and self.seconds is None:
            raise InputError.of_argument("budget", "is empty", "expected iterations or seconds", Code.MISSING)


@dataclass(frozen=True)
class SearchResult:
    """Plan of a search before verification, and its progress.

    `promises_safety` is whether the planner guarantees SAFETY and the clearance delta; OMPL's own planners do not.
    """

    plan: Plan | None
    progress: Progress
    promises_safety: bool = True


OnProgress = Callable[[Progress], None]
"""Receives what a search has done so far, many times a second; it does not change the search."""


@dataclass(frozen=True)
class SearchRequest:
    """Search from a state (nx,) with a budget and a seed, which may begin with a previous plan.

    `on_progress` is called if it is given, but not by OMPL's own planners.
    """

    state: Floats
    budget: Budget
    seed: int
    previous: Previous | None = None
    on_progress: OnProgress | None = None


Search = Callable[[DirtSolver, SearchRequest], SearchResult]
"""Search of a solver that has the query and was started in the state of the request."""


def search_named(planner: str) -> Search:
    """Search of a planner.

    Raises:
        InputError: if there is no planner of this name.
    """
    if planner not in _SEARCHES:
        raise InputError.of_argument("planner", f"is {planner!r}", suggestion(planner, _SEARCHES), Code.NOT_FOUND)
    return _SEARCHES[planner]


def settings_without_effect(planning: Planning) -> str:
    """What to say of settings other than the defaults that the planner does not have; else empty."""
    planner, default = planning.planner, Planning()
    unused = UNUSED.get(planner, UNUSED_BY_OMPL)
    found = [f"planning.{name}" for name in unused if getattr(planning, name) != getattr(default, name)]
    if not found:
        return ""
    verb = "has" if len(found) == 1 else "have"
    return f"{', '.join(found)} {verb} no effect with the planner {planner}; expected the planner dirt"


def check_threads(planner: str, threads: int) -> None:
    """Check that a planner can use so many threads.

    Raises:
        InputError: if it cannot.
    """
    if problems := out_of_range("threads", threads, 1, MAX_THREADS):
        raise InputError(problems)
    if threads > 1 and planner != "dirt":
        problem = f"is {threads} with the planner {planner!r}, which uses one thread"
        raise InputError.of_argument("threads", problem, "expected 1, or the planner 'dirt'", Code.CONFLICT)


def check_seed(seed: int) -> None:
    """Check that a number is a seed.

    Raises:
        InputError: if it is negative or no whole number.
    """
    if problems := out_of_range("seed", seed, 0):
        raise InputError(problems)


def check_previous(planner: str, previous: Previous | None, vehicle: Vehicle) -> None:
    """Check that a planner can begin with a previous plan, if there is one, and that this is a plan of `vehicle`.

    Raises:
        InputError: if it cannot, or the plan is not, or is over before it is to be continued.
    """
    if previous is None:
        return
    if planner not in RETAINING:
        problem = f"is {planner!r}, which cannot keep an earlier plan"
        raise InputError.of_argument("planner", problem, "expected 'dirt' or 'sst'", Code.CONFLICT)
    previous.check(vehicle)


def _tree_search(dirt: DirtSolver, request: SearchRequest) -> SearchResult:
    previous, budget, on_progress = request.previous, request.budget, request.on_progress
    stop = None
    if on_progress is not None:

        def stop() -> bool:
            on_progress(dirt.progress)
            return False  # it goes on

    if previous is not None:
        dirt.retain(previous.plan, previous.elapsed)
    progress = dirt.grow(iterations=budget.iterations, seconds=budget.seconds, stop=stop)
    return SearchResult(dirt.plan(), progress)


def _ompl_search(name: str) -> Search:
    def search(dirt: DirtSolver, request: SearchRequest) -> SearchResult:
        from ompl_ext.peers import plan_with_ompl

        assert request.previous is None, "otherwise it was refused"
        assert dirt.goal is not None, "a task has a goal"
        result = plan_with_ompl(
            name, dirt.vehicle, dirt.workspace, request.state, dirt.goal, safety=dirt.safety, settings=dirt.settings,
            iterations=request.budget.iterations, seconds=request.budget.seconds, seed=request.seed,
        )  # fmt: skip
        solved = result.plan is not None and result.plan.reaches_goal
        history = ((result.seconds, result.plan.cost),) if result.plan is not None and solved else ()
        progress = Progress(result.seconds, result.iterations, nodes=result.nodes, history=history)
        return SearchResult(result.plan, progress, promises_safety=False)

    return search


_SEARCHES: Final[dict[str, Search]] = {
    name: _tree_search if name in RETAINING else _ompl_search(name) for name in PLANNERS
}
