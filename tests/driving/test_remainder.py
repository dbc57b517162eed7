"""What is retained of a plan whose edges last longer than those of the tree, as those of plans of minutes do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.kernels import BENCHMARK, DEFAULT, GOAL, NO_SAFETY, TURNS, planned, turns

from kraft.driving.messages import PlanLoss
from kraft.driving.remainder import Remainder, retain, retained_plan
from ompl_ext.solver import DirtSolver


@pytest.mark.parametrize("elapsed_edges", [0, 2])
def test_a_plan_with_longer_edges_than_those_of_the_tree_is_retained_to_its_end(elapsed_edges: int) -> None:
    plan = planned(turns())
    assert plan.reaches_goal
    settings = replace(DEFAULT, shortest=0.05, longest=0.125)
    assert plan.durations.max() > settings.longest
    dirt = DirtSolver(BENCHMARK, TURNS, GOAL, NO_SAFETY, settings)
    root, elapsed = plan.states[elapsed_edges], float(plan.durations[:elapsed_edges].sum())
    dirt.start(root, 1)
    remainder = Remainder(plan, elapsed)
    assert retain(dirt, root, remainder) is PlanLoss.NONE
    found = retained_plan(dirt, remainder)
    assert found is not None
    assert found.reaches_goal
    assert len(found.durations) > len(plan.durations) - elapsed_edges
    np.testing.assert_allclose(found.states[-1], plan.states[-1], atol=1e-3)
    assert found.cost == pytest.approx(plan.cost - elapsed, abs=1e-6)
