"""One trial, two trials."""

from __future__ import annotations

import pytest

from kraft.text import counted, grouped


@pytest.mark.parametrize(("number", "text"), [(0, "0 trials"), (1, "1 trial"), (2, "2 trials")])
def test_one_thing_is_no_plural(number: int, text: str) -> None:
    assert counted(number, "trial") == grouped(number, "trial") == text
    assert grouped(20_000, "edge") == "20,000 edges"
