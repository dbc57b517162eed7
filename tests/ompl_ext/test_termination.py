"""Termination conditions of OMPL end the search, and nothing holds or asks them afterwards."""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Iterator

import pytest
from ompl import base as ob
from ompl import util as ou
from support.ompl_setup import arena, planned

ou.setLogLevel(ou.LOG_NONE)
STATUS = ob.PlannerStatus
CALLBACKS = pytest.mark.parametrize("callbacks", [False, True])


@pytest.fixture
def _no_collection() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@CALLBACKS
def test_a_function_with_an_interval_is_asked_by_the_thread_that_solves(callbacks: bool) -> None:
    setup = arena()
    planner = planned(setup, 0, use_callbacks=callbacks)
    threads: list[int] = []

    def asked_three_times() -> bool:
        threads.append(threading.get_ident())
        return len(threads) == 3

    assert planner.solve(asked_three_times, 0.01)
    assert threads == 3 * [threading.get_ident()]


@CALLBACKS
@pytest.mark.usefixtures("_no_collection")
def test_neither_the_condition_nor_the_search_is_held_after_it_is_dropped(callbacks: bool) -> None:
    class Condition:
        asked = 0

        def __call__(self) -> bool:
            self.asked += 1
            return self.asked > 2

    setup, condition = arena(), Condition()
    planner = planned(setup, 0, use_callbacks=callbacks)
    planner.solve(condition)
    dropped, search = weakref.ref(condition), weakref.ref(planner._search)
    del condition
    assert dropped() is None
    planner._search = None
    assert search() is None


def test_every_kind_of_termination_condition_ends_solve() -> None:
    setup = arena()
    planner = planned(setup)
    assert planner.solve(0.01) == STATUS.EXACT_SOLUTION
    assert planner.solve(ob.timedPlannerTerminationCondition(0.01)) == STATUS.EXACT_SOLUTION
    asked: list[int] = []
    assert planner.solve(lambda: bool(asked) or asked.append(1) is not None) == STATUS.EXACT_SOLUTION


def test_an_exhausted_budget_is_a_timeout_or_an_approximate_solution() -> None:
    setup = arena(goal=(3.5, 0.5))
    planner = planned(setup, 0, child_extension=False, blossom=4)
    assert planner.solve(ob.plannerAlwaysTerminatingCondition()) == STATUS.TIMEOUT
    calls = iter([False, True, True, True])
    assert planner.solve(lambda: next(calls)) == STATUS.APPROXIMATE_SOLUTION
    assert setup.getProblemDefinition().getSolutionDifference() > 0.25


@CALLBACKS
def test_a_condition_sees_the_first_path_to_the_goal_while_dirt_solves(callbacks: bool) -> None:
    setup = arena()
    definition = setup.getProblemDefinition()
    planner = planned(setup, 0, use_callbacks=callbacks)
    exact = ob.exactSolnPlannerTerminationCondition(definition)
    for _ in range(2):  # the second time without a path in the definition
        asked: list[int] = []

        def late(asked: list[int] = asked) -> bool:
            asked.append(planner.iterations)
            return len(asked) > 100_000

        assert planner.solve(ob.plannerOrTerminationCondition(exact, ob.PlannerTerminationCondition(late)))
        assert len(asked) < 100_000
        assert definition.hasExactSolution()
        assert definition.getSolutionCount() == 1
        definition.clearSolutionPaths()


@CALLBACKS
def test_better_paths_are_added_once_each(callbacks: bool) -> None:
    setup = arena()
    definition = setup.getProblemDefinition()
    planner = planned(setup, 0, use_callbacks=callbacks)
    lengths: list[float] = []  # while it solves

    def ends() -> bool:
        assert definition.getSolutionCount() <= len(lengths) + 1
        if definition.getSolutionCount() > len(lengths):
            lengths.append(definition.getSolutionPath().length())
        return len(lengths) == 3

    assert planner.solve(ends) == STATUS.EXACT_SOLUTION
    assert sorted(lengths, reverse=True) == lengths
    assert len(set(lengths)) == 3
    assert planner.solve(ob.plannerAlwaysTerminatingCondition()) == STATUS.EXACT_SOLUTION
    assert definition.getSolutionCount() == 3
