"""Another problem definition, goal or threshold is another query for the OMPL planner."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ompl import base as ob
from ompl import util as ou
from support.ompl_setup import arena, solved

from kraft.vehicles.unicycle2 import UNICYCLE2
from ompl_ext.compiled_search import CompiledSearch
from ompl_ext.obstacles import Workspace, box
from ompl_ext.planner import DIRT
from ompl_ext.query import Goal
from ompl_ext.system import PlanarGoal, simple_setup

ou.setLogLevel(ou.LOG_NONE)


@pytest.mark.parametrize("callbacks", [False, True])
def test_another_problem_definition_with_the_same_goal_begins_at_its_start(callbacks: bool) -> None:
    setup = arena()
    planner, si = solved(setup, use_callbacks=callbacks), setup.getSpaceInformation()
    maps = planner._search.dirt if isinstance(planner._search, CompiledSearch) else None
    start, definition = si.allocState(), ob.ProblemDefinition(si)
    for k, value in enumerate((0.4, 0.3, -1.5, 0.0)):
        start[k] = value
    definition.addStartState(start)
    definition.setGoal(setup.getGoal())
    planner.setProblemDefinition(definition)
    visits = iter(range(200))
    assert planner.solve(lambda: next(visits, None) is None)
    assert np.count_nonzero(planner.tree().parents < 0) == 1
    first = definition.getSolutionPath().getState(0)
    assert [first[k] for k in range(4)] == [0.4, 0.3, -1.5, 0.0]
    if isinstance(planner._search, CompiledSearch):
        assert planner._search.dirt is maps
    edges = planner.edges
    planner.solve(ob.plannerAlwaysTerminatingCondition())
    assert planner.edges == edges  # the same query goes on


@pytest.mark.parametrize("callbacks", [False, True])
def test_another_goal_begins_another_query_without_clear(callbacks: bool) -> None:
    workspace = Workspace(((0.0, 5.0), (0.0, 5.0)), (box((2.5, 2.0), (1.0, 3.0)),))
    setup = simple_setup(UNICYCLE2, workspace, start=np.array([0.5, 0.5, 0, 0, 0]), goal=Goal((4.5, 0.5), 0.4))
    si = setup.getSpaceInformation()
    setup.setPlanner(DIRT(si, use_callbacks=callbacks))
    for goal in (Goal((4.5, 0.5), 0.4), Goal((0.5, 4.5), 0.4)):
        setup.getProblemDefinition().clearSolutionPaths()
        region = PlanarGoal(si, UNICYCLE2, goal)
        setup.setGoal(region)
        assert setup.solve(2.0)
        path = setup.getSolutionPath()
        first, last = path.getState(0), path.getState(path.getStateCount() - 1)
        assert (first[0], first[1]) == (0.5, 0.5)
        assert setup.haveExactSolutionPath() == bool(region.isSatisfied(last))
        assert math.dist((last[0], last[1]), goal.center) < 1.5


def test_the_threshold_of_a_goal_and_a_new_propagation_step_hold() -> None:
    workspace = Workspace(((0.0, 5.0), (0.0, 5.0)))
    setup = simple_setup(UNICYCLE2, workspace, start=np.array([0.5, 0.5, 0, 0, 0]), goal=Goal((4.0, 0.5), 0.4))
    si, goal = setup.getSpaceInformation(), setup.getGoal()
    planner = DIRT(si)
    setup.setPlanner(planner)
    assert setup.solve(0.3)
    goal.setThreshold(0.05)
    setup.getProblemDefinition().clearSolutionPaths()
    assert setup.solve(0.5)
    path = setup.getSolutionPath()
    assert setup.haveExactSolutionPath() == bool(goal.isSatisfied(path.getState(path.getStateCount() - 1)))
    si.setPropagationStepSize(0.2)
    si.setMinMaxControlDuration(1, 3)
    setup.clear()
    assert setup.solve(0.3)
    path = setup.getSolutionPath()
    durations = [path.getControlDuration(k) for k in range(path.getControlCount())]
    assert all(0.0 < duration <= 0.6 + 1e-9 for duration in durations)
    assert path.check()
