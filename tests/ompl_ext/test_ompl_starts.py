"""Starts of the OMPL planner: several ones, in collision, in the goal, turned far, and more than there is room for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ompl import base as ob
from ompl import util as ou
from support.kernels import NO_SAFETY
from support.ompl_setup import START, arena, planned, solved

from kraft.vehicles.unicycle2 import UNICYCLE2
from ompl_ext.obstacles import Workspace, box
from ompl_ext.plan import TreeView
from ompl_ext.planner import DIRT
from ompl_ext.query import Goal
from ompl_ext.solver import DirtSolver
from ompl_ext.system import SimpleSetup

ou.setLogLevel(ou.LOG_NONE)
STATUS = ob.PlannerStatus


def test_starts_in_collision_are_an_invalid_start() -> None:
    setup = arena(start=np.array([2.0, 1.0, 0.0, 0.0]))
    setup.setPlanner(DIRT(setup.getSpaceInformation()))
    assert setup.solve(0.01) == STATUS.INVALID_START


def test_no_start_at_all_is_an_invalid_start_and_no_goal_an_invalid_goal() -> None:
    setup = arena()
    si = setup.getSpaceInformation()
    bare = SimpleSetup(si, setup.propagator)
    planner = DIRT(si)
    planner.setProblemDefinition(bare.getProblemDefinition())
    assert planner.solve(0.01) == STATUS.INVALID_START
    state = si.allocState()
    for k, value in enumerate(START):
        state[k] = float(value)
    bare.setStartState(state)
    assert planner.solve(0.01) == STATUS.INVALID_GOAL


def test_several_starts_all_become_roots() -> None:
    setup = arena()
    state = setup.getSpaceInformation().allocState()
    for k, value in enumerate((3.5, 2.9, math.pi / 2, 0.0)):
        state[k] = value
    setup.addStartState(state)
    planner = planned(setup)
    assert np.count_nonzero(planner.tree().parents < 0) == 2
    assert setup.getSolutionPath().getState(0)[0] == 3.5  # the nearer start


@pytest.mark.parametrize("callbacks", [False, True])
def test_a_start_may_have_turned_further_than_headings_are_sampled(callbacks: bool) -> None:
    setup = arena(start=np.array([0.5, 0.5, 2.5 * math.pi, 0.0]))
    solved(setup, use_callbacks=callbacks)
    assert setup.haveExactSolutionPath()
    assert setup.getSolutionPath().getState(0)[2] == 2.5 * math.pi


@pytest.mark.parametrize("callbacks", [False, True])
def test_a_further_start_finds_room_or_is_refused(callbacks: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ompl_ext.callback.CAPACITY" if callbacks else "ompl_ext.compiled_search.CAPACITY", 10)

    def with_starts(count: int) -> int:
        setup = arena()
        state = setup.getSpaceInformation().allocState()
        for k, value in enumerate(START):
            state[k] = value
        for _ in range(count - 1):
            setup.addStartState(state)
        return len(planned(setup, 1, use_callbacks=callbacks, max_nodes=100).tree().parents)

    assert with_starts(99) >= 99
    with pytest.raises(MemoryError, match="no room for another start"):
        with_starts(101)


def test_of_a_tree_with_several_starts_the_first_ones_is_retained() -> None:
    nodes = TreeView(
        states=np.zeros((6, 4)),
        parents=np.array([-1, -1, 0, 1, 2, 3]),
        controls=np.arange(12.0).reshape(6, 2),
        durations=np.arange(6.0),
        costs=np.zeros(6),
        costs_to_go=np.zeros(6),
    )
    parents, controls, durations = nodes.edges_of_first_root()
    assert parents == [-1, 0]
    assert durations.tolist() == [2.0, 4.0]
    assert controls.tolist() == [[4.0, 5.0], [8.0, 9.0]]


def test_a_start_that_collides_in_the_goal_is_no_plan() -> None:
    workspace = Workspace(((0.0, 3.0), (0.0, 3.0)), (box((1.0, 1.0), (0.5, 0.5)),))
    dirt = DirtSolver(UNICYCLE2, workspace, Goal((1.0, 1.0), 0.3), NO_SAFETY)
    assert dirt.start(np.array([1.0, 1.0, 0.0, 0.0, 0.0])) < 0.0
    dirt.grow(100)
    assert dirt.plan() is None
