"""Each problem definition is a query of its own for the OMPL planner."""

from __future__ import annotations

import numpy as np
import pytest
from ompl import base as ob
from ompl import util as ou
from support.ompl_setup import arena, solved

from ompl_ext.compiled_search import CompiledSearch

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
