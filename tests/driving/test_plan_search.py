"""One search for a plan: what of its plan is verified, and what happens if that fails."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.replanner import replanner, start

from kraft.errors import Defect
from ompl_ext.plan import Plan
from ompl_ext.solver import DirtSolver
from ompl_ext.verification import Violation


def test_what_is_verified_is_all_that_may_be_executed(monkeypatch: pytest.MonkeyPatch) -> None:
    heads = list[Plan]()

    def violations(_: DirtSolver, head: Plan) -> tuple[Violation, ...]:
        heads.append(head)
        return ()

    monkeypatch.setattr("kraft.driving.plan_search.violations", violations)
    for mode, until in (("replanning", 1.0), ("one-shot", math.inf)):
        subject = replanner(mode=mode)
        subject.begin(start())
        plan, head = subject.proposal.plan, heads[-1]
        assert plan is not None
        assert len(plan.durations) > 2
        assert head.times[-1] == pytest.approx(head.durations.sum())
        assert head.times[-1] >= min(until, plan.cost) - 1e-9
        assert len(head.times) == len(head.trajectory)
        assert len(head.states) == len(head.durations) + 1
        np.testing.assert_array_equal(head.trajectory, plan.trajectory[: len(head.times)])
    assert {round(head.durations.sum(), 6) for head in heads} != {round(heads[0].durations.sum(), 6)}


def test_a_plan_that_fails_its_verification_is_a_defect(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kraft.driving.plan_search.violations", lambda *_: ("plan: collides",))
    with pytest.raises(Defect, match=r"cycle 0 fails verification: plan: collides"):
        replanner().begin(start())
