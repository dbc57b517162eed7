"""Correlation of steering and curvature over delays, which a short log does not have all of."""

from __future__ import annotations

import numpy as np
import pytest

from kraft.sysid.checks import _best_correlation


@pytest.mark.parametrize("samples", [1, 2, 3, 10, 11, 12])
def test_a_log_shorter_than_the_longest_delay_has_a_correlation(samples: int) -> None:
    steering = np.arange(samples, dtype=float)
    moving = np.ones(samples, dtype=bool)
    assert _best_correlation(steering, 2.0 * steering, moving) == pytest.approx(1.0 if samples > 1 else 0.0)
    assert _best_correlation(steering, steering, np.zeros(samples, dtype=bool)) == 0.0
