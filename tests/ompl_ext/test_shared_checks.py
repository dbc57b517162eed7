"""The propagator and the validity checker of one space answer several threads as they answer one."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from ompl import base as ob
from support.ompl_setup import arena

from kraft.vehicles.benchmark import BENCHMARK
from ompl_ext.kernels import specialise
from ompl_ext.obstacles import Circle, box
from ompl_ext.system import SimpleSetup

THREADS, STATES, ROUNDS = 4, 100, 6
Answer = Callable[[ob.State], object]


@pytest.fixture
def _threads_alternate_often() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


def scene() -> tuple[SimpleSetup, list[ob.State]]:
    setup = arena(box((3.0, 2.6), (1.5, 0.1)), Circle(np.array([0.8, 2.2]), 0.3))
    random, states = np.random.default_rng(0), []
    for _ in range(STATES):
        state = setup.getSpaceInformation().allocState()
        for k, value in enumerate((*random.uniform(0.2, 3.8, 2), random.uniform(-3, 3), random.uniform(0, 0.6))):
            state[k] = float(value)
        states.append(state)
    return setup, states


def propagation(setup: SimpleSetup) -> Answer:
    si, control = setup.getSpaceInformation(), setup.getSpaceInformation().allocControl()
    control[0], control[1] = 0.5, 0.2

    def answer(state: ob.State) -> object:
        result = si.allocState()
        setup.propagator(state, control, 0.05, result)
        return [result[k] for k in range(4)]

    return answer


def validity(setup: SimpleSetup) -> Answer:
    checker = setup.getStateValidityChecker()
    return lambda state: (checker.isValid(state), checker.clearance(state))


def contingency(setup: SimpleSetup) -> Answer:
    checker = setup.getStateValidityChecker()

    def answer(state: ob.State) -> object:
        found = checker.safety(state)
        return found and (found.manoeuvre, found.slack, found.states.tobytes())

    return answer


def edge_and_bounds(setup: SimpleSetup) -> Answer:
    solver = setup.getStateValidityChecker()._solver

    def answer(state: ob.State) -> object:
        trajectory, slack = solver.edge(np.array([state[k] for k in range(4)]), np.array([0.5, 0.2]), 0.5)
        return trajectory.tobytes(), slack, solver.exact.lower_bounds(trajectory[:, :3]).tobytes()

    return answer


@pytest.mark.usefixtures("_threads_alternate_often")
@pytest.mark.parametrize("answer_of", [propagation, validity, contingency, edge_and_bounds])
def test_several_threads_get_the_answers_of_one(answer_of: Callable[[SimpleSetup], Answer]) -> None:
    setup, states = scene()
    answer = answer_of(setup)
    alone = [answer(state) for state in states]

    def wrong(seed: int) -> int:
        order = np.random.default_rng(seed).permuted(np.tile(np.arange(STATES), ROUNDS))
        return sum(answer(states[k]) != alone[k] for k in order)

    with ThreadPoolExecutor(THREADS) as pool:
        assert list(pool.map(wrong, range(THREADS))) == THREADS * [0]


def test_a_thread_does_not_see_for_which_vehicle_another_one_compiles() -> None:
    specialise._being_compiled.vehicles.append(BENCHMARK)
    try:
        assert specialise.vehicle_being_compiled() is BENCHMARK
        with ThreadPoolExecutor(1) as pool, pytest.raises(ImportError, match="once per vehicle"):
            pool.submit(specialise.vehicle_being_compiled).result()
    finally:
        specialise._being_compiled.vehicles.pop()
