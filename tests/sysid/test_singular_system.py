"""Parameters that the logs do not determine are a negative result, not a defect."""

from __future__ import annotations

import numpy as np
import pytest

from kraft.errors import NegativeResult
from kraft.sysid.optimiser import RhoFactors, bounded_step


def test_a_singular_system_is_a_negative_result() -> None:
    nothing = RhoFactors(np.zeros((1, 2, 2)), np.zeros((1, 2)), np.zeros(2), np.zeros(2))
    wide = np.ones(2)
    with pytest.raises(NegativeResult):
        bounded_step(nothing, 1.0, -wide, wide, np.ones(2, dtype=bool))
