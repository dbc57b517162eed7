"""Turns to the wrong side are found after one curve; a lag, noise, slip and missing poses are not taken for them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kraft.robot.response import Response

PERIOD = 1.0 / 30.0


def driven(rates: np.ndarray, seen: np.ndarray, noise: float = 0.0, gaps: tuple[int, ...] = ()) -> Response:
    """After commanded and seen turning rates (rad/s) by tick; poses in `gaps` are missing."""
    response, random = Response(), np.random.default_rng(0)
    headings = np.cumsum(seen) * PERIOD + noise * random.standard_normal(len(seen))
    for k, rate in enumerate(rates):
        response.commanded(float(rate) * PERIOD)
        if k not in gaps:
            response.observed(k * PERIOD, (0.0, 0.0, math.remainder(float(headings[k]), math.tau)))
    return response


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_turn_to_the_other_side_is_found_after_forty_degrees(side: float) -> None:
    rates = np.full(60, side)
    assert "wrong way round" in driven(rates[:24], -rates[:24], noise=0.03).trouble
    assert driven(rates[:18], -rates[:18], noise=0.03).trouble == ""
    assert (
        f"turn by {-40 * side:+.0f} degrees where the commands lead to {40 * side:+.0f}"
        in driven(rates, -rates).trouble
    )


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0, 2.0])
def test_a_vehicle_that_slips_or_is_held_or_turns_more_is_not_found(share: float) -> None:
    rates = np.full(300, 1.0)
    assert driven(rates, share * rates, noise=0.06).trouble == ""


@pytest.mark.parametrize("period", [20, 40, 80])
def test_a_slalom_with_a_lag_is_not_found(period: int) -> None:
    rates = np.sin(2.0 * math.pi * np.arange(600) / period) + 0.3
    lagging = np.concatenate([np.zeros(9), rates])[: len(rates)]
    assert driven(rates, lagging, noise=0.06).trouble == ""


def test_a_gap_in_the_poses_begins_the_comparison_again() -> None:
    rates = np.full(30, 1.0)
    assert driven(rates, -rates, gaps=tuple(range(5, 25))).trouble == ""
