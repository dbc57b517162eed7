"""Termination conditions of OMPL end the search, and nothing holds or asks them afterwards."""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Iterator

import pytest
from ompl import util as ou
from support.ompl_setup import arena

from ompl_ext.planner import DIRT

ou.setLogLevel(ou.LOG_NONE)
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
    planner = DIRT(setup.getSpaceInformation(), use_callbacks=callbacks)
    setup.setPlanner(planner)
    setup.setup()
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
    planner = DIRT(setup.getSpaceInformation(), use_callbacks=callbacks)
    setup.setPlanner(planner)
    setup.setup()
    planner.solve(condition)
    dropped, search = weakref.ref(condition), weakref.ref(planner._search)
    del condition
    assert dropped() is None
    planner._search = None
    assert search() is None
