"""The search itself, by the planner's name: kraft's DIRT, or one of OMPL's planners over callbacks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from kraft.errors import InputError
from kraft.planners import PLANNERS
from kraft.previous import Previous
from kraft.text import suggestion
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan
from ompl_ext.solver import Dirt, Progress


@dataclass(frozen=True)
class Budget:
    """How long to plan: a number of iterations, which is repeatable, or wall-clock time in s."""

    iterations: int | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Found:
    """What a search found, as the planner claims it, and how it went.

    `strict` is whether the planner promises SAFETY and the clearance delta; OMPL's own planners know neither.
    """

    plan: Plan | None
    progress: Progress
    strict: bool = True


Search = Callable[[Dirt, Floats, Budget, int, Previous | None], Found]
"""Search from a state with a budget and a seed.  The `Dirt` holds the query and has been started at the state."""


def search_of(planner: str) -> Search:
    """The search of a planner.

    Raises:
        InputError: if there is no planner of this name.
    """
    if planner not in _SEARCHES:
        raise InputError.of(planner, "there is no planner of this name", suggestion(planner, _SEARCHES))
    return _SEARCHES[planner]


def _dirt(dirt: Dirt, state: Floats, budget: Budget, seed: int, previous: Previous | None) -> Found:
    if previous is not None:
        dirt.retain(previous.plan, previous.elapsed)
    progress = dirt.grow(iterations=budget.iterations, seconds=budget.seconds)
    return Found(dirt.plan(), progress)


def _peer(name: str) -> Search:
    def search(dirt: Dirt, state: Floats, budget: Budget, seed: int, previous: Previous | None) -> Found:
        from ompl_ext.peers import plan_with_ompl

        if previous is not None:
            raise InputError.of(name, "cannot keep an earlier plan", "expected the planner dirt with --from")
        assert dirt.goal is not None, "a task has a goal"
        result = plan_with_ompl(
            name, dirt.vehicle, dirt.workspace, state, dirt.goal, safety=dirt.safety, settings=dirt.settings,
            iterations=budget.iterations, seconds=budget.seconds, seed=seed,
        )  # fmt: skip
        solved = result.plan is not None and result.plan.reaches_goal
        history = ((result.seconds, result.plan.cost),) if result.plan is not None and solved else ()
        progress = Progress(result.seconds, result.iterations, nodes=result.nodes, history=history)
        return Found(result.plan, progress, strict=False)

    return search


_SEARCHES: Final[dict[str, Search]] = {name: _dirt if name == "dirt" else _peer(name) for name in PLANNERS}
