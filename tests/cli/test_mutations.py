"""Damaged files end every command with a documented exit code and a message, never with a defect.

``KRAFT_MUTATIONS=5000`` damages that many files instead of 120.
"""

from __future__ import annotations

import os

import pytest
from support.mutations import INPUTS, outcomes

COUNT = int(os.environ.get("KRAFT_MUTATIONS", "120"))
SLOW = {"log": 10, "mapping": 4}
"""Kinds whose commands take seconds: that many times fewer files."""


@pytest.mark.parametrize("kind", [each.kind for each in INPUTS])
def test_a_damaged_file_is_never_a_defect(kind: str) -> None:
    count = max(3, COUNT // len(INPUTS) // SLOW.get(kind, 1))
    failed = [each for each in outcomes(count, seed=1, kinds=[kind]) if not each.documented]
    assert not failed, "\n\n".join(f"{each.command} {each.status}\n{each.err}\n{each.content!r}" for each in failed[:3])
