"""Correlations: of steering and curvature over delays, and of parameters between logs."""

from __future__ import annotations

import numpy as np
import pytest

from kraft.sysid.checks import _best_correlation, lasting_correlations
from kraft.sysid.optimiser import ParameterUncertainty


@pytest.mark.parametrize("samples", [1, 2, 3, 10, 11, 12])
def test_a_log_shorter_than_the_longest_delay_has_a_correlation(samples: int) -> None:
    steering = np.arange(samples, dtype=float)
    moving = np.ones(samples, dtype=bool)
    assert _best_correlation(steering, 2.0 * steering, moving) == pytest.approx(1.0 if samples > 1 else 0.0)
    assert _best_correlation(steering, steering, np.zeros(samples, dtype=bool)) == 0.0


@pytest.mark.parametrize(
    ("shifts", "lasts"),
    [
        ([(0.01, 0.0), (-0.01, 0.0), (0.0, 0.01), (0.0, -0.01), (0.0, 0.0), (3.0, -2.0)], False),
        ([(0.3, -0.2), (-0.9, 0.6), (0.6, -0.4), (0.0, 0.01), (-0.3, 0.2), (3.0, -2.0)], True),
    ],
    ids=["one log differs", "all logs along one line"],
)
def test_parameters_that_one_log_alone_moves_together_are_distinguishable(
    shifts: list[tuple[float, float]], lasts: bool
) -> None:
    moved = np.array(shifts)
    covariance = np.cov(moved, rowvar=False)
    assert covariance[0, 1] ** 2 > 0.95**2 * covariance[0, 0] * covariance[1, 1]
    uncertainty = ParameterUncertainty("sandwich", np.eye(2), covariance, 2.0, moved, np.zeros(2, bool))
    assert (abs(lasting_correlations(uncertainty)[0, 1]) > 0.95) == lasts
