"""Intervals, tests and percentiles against published and exactly computed values."""

from __future__ import annotations

from math import comb

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kraft.evaluation.statistics import mcnemar, mean_interval, percentile, wilson


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662),  # Newcombe 1998, Statistics in Medicine 17, table I, method 3
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilsons_interval_is_that_of_the_literature(successes: int, trials: int, low: float, high: float) -> None:
    assert wilson(successes, trials) == pytest.approx((low, high), abs=5e-5)


def test_the_interval_of_a_mean_is_students() -> None:
    """Critical values 12.706 and 2.776 of the t distribution with 1 and 4 degrees of freedom."""
    assert mean_interval([3.0, 5.0]) == pytest.approx((4.0 - 12.706, 4.0 + 12.706), abs=1e-3)
    assert mean_interval([1.0, 2.0, 3.0, 4.0, 5.0]) == pytest.approx((3 - 2.776 / 2**0.5, 3 + 2.776 / 2**0.5), abs=1e-3)
    assert mean_interval([7.0, 7.0, 7.0]) == (7.0, 7.0)
    assert mean_interval([7.0]) is mean_interval([]) is None


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilsons_interval_holds_the_rate_and_mirrors(counts: tuple[int, int]) -> None:
    successes, trials = counts
    low, high = wilson(successes, trials)
    assert 0.0 <= low <= successes / trials <= high <= 1.0
    assert low < high
    mirrored = wilson(trials - successes, trials)
    assert (1 - mirrored[1], 1 - mirrored[0]) == pytest.approx((low, high))
    wider = wilson(successes, trials, confidence=0.99)
    assert wider[0] <= low
    assert wider[1] >= high


@pytest.mark.parametrize("counts", [(2, 1), (-1, 3), (0, -1)])
def test_impossible_counts_are_refused(counts: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=r"^k |^n "):
        wilson(*counts)


def test_no_trials_say_nothing() -> None:
    assert wilson(0, 0) == (0.0, 1.0)


def by_hand(gained: int, lost: int) -> float:
    """Two-sided exact probability of a split, with halves for both sides."""
    n, tail = gained + lost, min(gained, lost)
    return min(1.0, 2 * sum(comb(n, k) for k in range(tail + 1)) / 2**n)


@settings(deadline=None)  # scipy is loaded in it
@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=60))
def test_mcnemar_is_the_binomial_test_of_the_discordant_pairs(pairs: list[tuple[bool, bool]]) -> None:
    found = mcnemar({i: a for i, (a, _) in enumerate(pairs)}, {i: b for i, (_, b) in enumerate(pairs)})
    gained, lost = sum(a and not b for a, b in pairs), sum(b and not a for a, b in pairs)
    assert (found.gained, found.lost) == (gained, lost)
    assert found.p == pytest.approx(by_hand(gained, lost))


def test_mcnemar_has_the_known_value_of_six_to_none() -> None:
    theirs = dict.fromkeys(range(30), True)
    mine = {seed: seed >= 6 for seed in range(30)}
    found = mcnemar(mine, theirs)
    assert (found.gained, found.lost, found.p) == (0, 6, pytest.approx(0.03125))


def test_seeds_that_only_one_ran_do_not_count() -> None:
    found = mcnemar({0: True, 1: True, 5: True}, {0: False, 9: True})
    assert (found.gained, found.lost, found.p) == (1, 0, 1.0)


@given(st.lists(st.floats(0, 1e3), min_size=1), st.floats(0.01, 1.0))
def test_a_percentile_is_a_value_that_so_many_do_not_exceed(values: list[float], share: float) -> None:
    found = percentile(values, share)
    assert found in values
    assert sum(value <= found for value in values) >= share * len(values) - 1e-9
    assert sum(value < found for value in values) < share * len(values) + 1e-9


def test_nothing_has_no_percentile() -> None:
    assert percentile([], 0.5) is None
    assert percentile([3.0, 1.0, 2.0, 4.0], 0.5) == 2.0
