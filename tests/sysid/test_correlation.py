"""Correlations: of steering and curvature over delays, and of parameters between logs."""

from __future__ import annotations

import numpy as np
import pytest
from support.sysid import fake_identification

from kraft.sysid.checks import _best_correlation, lasting_correlations
from kraft.sysid.optimiser import ParameterUncertainty, RhoFactors, estimate_uncertainty


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


def test_a_parameter_that_no_log_shows_has_correlations_that_json_and_the_page_can_hold() -> None:
    """Six logs: the third parameter has an effect in none, so that all of them leave it at its prior."""
    generator = np.random.default_rng(0)
    information, gradient = np.zeros((6, 3, 3)), np.zeros((6, 3))
    for own in information:
        effects = generator.normal(size=(20, 2))
        own[:2, :2] = effects.T @ effects
    gradient[:, :2] = generator.normal(size=(6, 2))
    factors = RhoFactors(information, gradient, np.ones(3), np.zeros(3))
    free = np.ones(3, dtype=bool)
    found = estimate_uncertainty(factors, free, ~free)
    assert found.kind == "sandwich"
    assert found.std[2] == 0.0
    correlation = fake_identification((), covariance=found.covariance).correlation
    assert np.isfinite(correlation).all()
    assert correlation[0, 0] == pytest.approx(1.0)
    assert abs(correlation[0, 1]) > 0.1
