"""Words for the outcome of a trial."""

from __future__ import annotations

import pytest

from kraft.trial.result import Outcome, outcome_text


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
