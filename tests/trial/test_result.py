"""Words for the outcome of a trial."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support import fake_trials

from kraft.errors import Code, InputError
from kraft.trial.result import Outcome, TrialSpec, outcome_text


@pytest.mark.parametrize(
    ("outcome", "obstacle", "time", "text"),
    [
        (Outcome.SUCCESS, None, 12.345, "success after 12.35 s"),
        (Outcome.COLLISION, "first box", 3.0, "collision with first box after 3.00 s"),
        (Outcome.TIMEOUT, None, 60.0, "timeout after 60.00 s"),
        (Outcome.COLLISION, "first box", None, "collision with first box"),
        ("failed", None, None, "failed"),
    ],
)
def test_an_outcome_has_one_phrase(outcome: str, obstacle: str | None, time: float | None, text: str) -> None:
    assert outcome_text(outcome, obstacle, time) == text


def test_a_trial_that_cannot_begin_is_refused_when_it_is_loaded() -> None:
    with pytest.raises(InputError) as inside:
        TrialSpec.load("turns", settings={"start.x": -0.25, "start.y": 2.5})
    assert [each.code for each in inside.value.diagnostics] == [Code.GEOMETRY]
    with pytest.raises(InputError) as seed:
        TrialSpec.load("turns", seed=-1)
    assert [each.code for each in seed.value.diagnostics] == [Code.VALUE]


def test_a_contingency_that_the_trial_ends_before_is_decided_but_not_counted() -> None:
    cycles = tuple(fake_trials.cycle(k, kind) for k, kind in enumerate(("plan", "contingency", "contingency")))
    result = replace(fake_trials.quick(TrialSpec.load("turns")), cycles=cycles)
    for end, begun, contingencies in ((1.9, 2, 1), (2.0, 3, 2)):
        ended = replace(result, time=end)
        assert (len(ended.begun), ended.contingencies) == (begun, contingencies)
        assert len(ended.cycles) == 3
