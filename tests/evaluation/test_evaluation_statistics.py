"""Intervals, tests and percentiles against published and exactly computed values."""

from __future__ import annotations

from itertools import product
from math import comb, log, prod

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kraft.evaluation.statistics import (
    fisher_p,
    grouped_share_interval,
    holm,
    least_sign_flip_p,
    mcnemar,
    mean_difference_interval,
    mean_difference_p,
    mean_interval,
    newcombe,
    paired_difference,
    percentile,
    ratio_interval,
    sign_flip_p,
    wilson,
)


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
    of_more = wilson(10 * successes, 10 * trials)
    assert of_more[1] - of_more[0] < high - low


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


@given(st.tuples(st.integers(0, 12), st.integers(0, 9)))
def test_the_test_of_two_rates_is_the_sum_of_the_splits_that_are_no_likelier(successes: tuple[int, int]) -> None:
    (a, b), n, m = successes, 12, 9
    chances = [comb(n, k) * comb(m, a + b - k) / comb(n + m, a + b) for k in range(a + b + 1)]
    assert fisher_p((a, n), (b, m)) == pytest.approx(sum(p for p in chances if p <= chances[a] * (1 + 1e-9)))


def test_rates_that_wilsons_interval_holds_apart_may_be_equal() -> None:
    """29 of 30 excludes a rate of 23 of 30 that is known exactly, but not one that 30 trials show."""
    assert wilson(29, 30)[0] > 23 / 30
    assert fisher_p((29, 30), (23, 30)) == pytest.approx(0.0523, abs=1e-4)


def test_holms_adjustment_is_that_of_the_literature() -> None:
    """Holm 1979: the smallest of n p-values times n, the next one times n - 1, none below the one before it."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.6]) == [1.0, 1.0]
    assert holm([]) == []


@given(st.lists(st.floats(0, 1e3), min_size=1), st.floats(0.01, 1.0))
def test_a_percentile_is_a_value_that_so_many_do_not_exceed(values: list[float], share: float) -> None:
    found = percentile(values, share)
    assert found in values
    assert sum(value <= found for value in values) >= share * len(values) - 1e-9
    assert sum(value < found for value in values) < share * len(values) + 1e-9


def test_nothing_has_no_percentile() -> None:
    assert percentile([], 0.5) is None
    assert percentile([3.0, 1.0, 2.0, 4.0], 0.5) == 2.0


@pytest.mark.parametrize("shares", [(0.7, 0.2, 0.05, 0.05), (0.3, 0.3, 0.1, 0.3), (0.9, 0.04, 0.02, 0.04)])
def test_the_interval_of_paired_shares_holds_the_true_difference_as_often_as_it_says(
    shares: tuple[float, float, float, float],
) -> None:
    """Exact coverage over all outcomes of 12 pairs."""
    n, covered = 12, 0.0
    for both in range(n + 1):
        for gained in range(n + 1 - both):
            for lost in range(n + 1 - both - gained):
                counts = (both, gained, lost, n - both - gained - lost)
                low, high = newcombe(*counts)
                ways = comb(n, both) * comb(n - both, gained) * comb(n - both - gained, lost)
                if low <= shares[1] - shares[2] <= high:
                    covered += ways * prod(share**count for share, count in zip(shares, counts, strict=True))
    assert 0.93 <= covered <= 1.0


@given(st.tuples(*[st.integers(0, 40)] * 4).filter(any))
def test_the_interval_of_paired_shares_mirrors_and_holds_its_own_value(counts: tuple[int, int, int, int]) -> None:
    both, gained, lost, neither = counts
    low, high = newcombe(*counts)
    assert newcombe(both, lost, gained, neither) == pytest.approx((-high, -low))
    assert -1.0 - 1e-9 <= low <= (gained - lost) / sum(counts) + 1e-9
    assert (gained - lost) / sum(counts) - 1e-9 <= high <= 1.0 + 1e-9
    assert low < high


def test_pairs_that_agree_narrow_the_interval_of_their_difference() -> None:
    together, apart = newcombe(20, 5, 0, 15), newcombe(10, 15, 10, 5)
    assert together[1] - together[0] < 0.7 * (apart[1] - apart[0])


@given(st.lists(st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=60))
def test_groups_of_one_pair_have_the_p_of_the_mcnemar_test(found: list[tuple[bool, bool]]) -> None:
    gained, lost = sum(a and not b for a, b in found), sum(b and not a for a, b in found)
    assert sign_flip_p([int(a) - int(b) for a, b in found]) == pytest.approx(by_hand(gained, lost))


def test_the_p_of_groups_is_the_share_of_the_signs_with_a_sum_as_large() -> None:
    changes = [3, -1, 4, 2, 0, 5]
    sums = [
        sum(sign * change for sign, change in zip(signs, changes, strict=True)) for signs in product((1, -1), repeat=6)
    ]
    expected = sum(abs(each) >= sum(changes) for each in sums) / len(sums)
    assert sign_flip_p(changes) == sign_flip_p([-change for change in changes]) == pytest.approx(expected)
    assert sign_flip_p([]) == sign_flip_p([0, 0]) == 1.0
    assert sign_flip_p([30] * 6) == pytest.approx(2 / 2**6)
    for number in range(8):
        assert sign_flip_p([30] * number) == pytest.approx(least_sign_flip_p(number))


def test_trials_of_a_group_count_as_alike() -> None:
    """Ten successes more, all in one group of ten, against ten spread over all groups."""
    groups = [k // 10 for k in range(100)]
    together = paired_difference([k < 10 for k in range(100)], [False] * 100, groups)
    spread = paired_difference([k % 10 == k // 10 % 3 for k in range(100)], [k == 37 for k in range(100)], groups)
    assert (together.pairs, together.counts, together.gained, together.lost) == (100, (10, 0), 10, 0)
    assert (together.difference, together.p, together.shown) == (0.1, 1.0, 0)
    assert together.interval[0] <= 0.0
    assert together.interval[1] - together.interval[0] > 2 * (spread.interval[1] - spread.interval[0])
    assert spread.shown == 1
    assert paired_difference([k < 10 for k in range(100)], [False] * 100, groups) == together
    three = paired_difference([k % 10 < 5 and k < 30 for k in range(300)], [False] * 300, [k // 10 for k in range(300)])
    assert (three.p, three.shown) == (0.25, 0), "with three of 30 groups signs of chance are as good"


def test_a_difference_is_as_wide_as_that_of_its_groups_where_these_are_equal() -> None:
    groups = [k // 10 for k in range(40)]
    equal = paired_difference([True] * 40, [True] * 40, groups)
    assert equal.interval == pytest.approx(newcombe(4, 0, 0, 0))
    assert (equal.p, equal.shown) == (1.0, 0)
    always = paired_difference([True] * 40, [k % 10 < 5 for k in range(40)], groups)
    assert always.interval == pytest.approx(newcombe(2, 2, 0, 0))
    for wrong in (([], [], []), ([True], [True, False], [0]), ([True], [True], [0, 1])):
        with pytest.raises(ValueError, match="pairs"):
            paired_difference(*wrong)


def test_the_interval_of_a_share_is_that_of_its_groups() -> None:
    alike, different = (
        grouped_share_interval([6, 0, 0, 6, 0, 0], [6] * 6),
        grouped_share_interval([2] * 5 + [1], [6] * 6),
    )
    assert alike[0] < 1 / 3 < alike[1]
    assert alike[1] - alike[0] > 2 * (different[1] - different[0])
    assert alike == grouped_share_interval([6, 0, 0, 6, 0, 0], [6] * 6)
    assert grouped_share_interval([0] * 27, [6] * 27) == pytest.approx(wilson(0, 27))
    assert grouped_share_interval([3], [6])[1] > 0.8
    assert grouped_share_interval([], []) == (0.0, 1.0)


def test_the_interval_of_ratios_is_students_of_their_logarithms() -> None:
    one, other = [8.0, 9.0, 12.0, 11.0, 7.0], [10.0, 10.0, 11.0, 13.0, 9.0]
    found, logs = ratio_interval(one, other), mean_interval([log(a / b) for a, b in zip(one, other, strict=True)])
    assert found is not None
    assert logs is not None
    assert (log(found[0]), log(found[1])) == pytest.approx(logs)
    assert ratio_interval(one[:2], other[:2]) is ratio_interval([2.0] * 5, [1.0] * 5) is None


@pytest.mark.parametrize("entries", [6, 34, 48])
def test_intervals_over_entries_hold_the_true_difference_and_ratio_about_as_often_as_they_say(entries: int) -> None:
    """Of six entries, a bootstrap has either in 85 to 88 % of cases; ratios of times are skewed."""
    random, runs, held = np.random.default_rng(0), 300, [0, 0]
    groups = [k // 10 for k in range(10 * entries)]
    for _ in range(runs):
        one, other = (
            np.repeat(random.beta(a, b, entries), 10) > random.random(10 * entries) for a, b in ((3, 7), (2, 8))
        )
        found = paired_difference(one.tolist(), other.tolist(), groups)
        held[0] += found.interval[0] <= 0.1 <= found.interval[1]
        ratio = ratio_interval(np.exp(random.gamma(2.0, 0.06, entries)).tolist(), [1.0] * entries)
        assert ratio is not None
        held[1] += ratio[0] <= np.exp(0.12) <= ratio[1]
    assert all(0.89 * runs <= count <= 0.98 * runs for count in held), held


@given(st.lists(st.integers(-300, 300), min_size=3, max_size=12))
def test_the_interval_of_a_mean_difference_of_independent_pairs_is_students(ticks: list[int]) -> None:
    values = [tick / 30 for tick in ticks]
    found = mean_difference_interval(values, range(len(values)))
    assert (found is None) == (len(set(ticks)) == 1)
    assert found is None or found == pytest.approx(mean_interval(values))


@pytest.mark.parametrize("groups", [3, 6, 20])
def test_the_interval_of_a_mean_difference_has_the_true_mean_as_often_as_it_says(groups: int) -> None:
    """With groups of 1 to 4 pairs that are alike; of three groups a bootstrap has it in 70 %."""
    random = np.random.default_rng(0)
    sizes = [1 + k % 4 for k in range(groups)]
    labels = [k for k, size in enumerate(sizes) for _ in range(size)]
    held = 0
    for _ in range(2000):
        centres = random.normal(0.0, 1.0, groups)
        found = mean_difference_interval([centres[k] + random.normal(0.0, 0.3) for k in labels], labels)
        assert found is not None
        held += found[0] <= 0.0 <= found[1]
    assert 0.91 * 2000 <= held <= 0.97 * 2000


def test_differences_of_a_group_count_as_alike() -> None:
    values = [0.1 * (k // 10) for k in range(100)]
    apart = mean_difference_interval(values, range(100))
    groups = mean_difference_interval(values, [k // 10 for k in range(100)])
    assert apart is not None
    assert groups is not None
    assert groups[1] - groups[0] > 2.5 * (apart[1] - apart[0])
    assert groups == pytest.approx(mean_difference_interval([0.1 * k for k in range(10)], range(10)), abs=0.02)


@pytest.mark.parametrize("values", [[], [1.0], [1.0, 2.0], [0.3, 0.3, 0.3, 0.3]])
def test_what_does_not_tell_how_it_varies_has_no_interval(values: list[float]) -> None:
    assert mean_difference_interval(values, range(len(values))) is None


def test_times_that_differ_by_the_same_but_for_rounding_do_not_tell_how_they_vary() -> None:
    """A tenth of a second after 10, 20 and 30 s: the differences of the numbers are not equal."""
    differences = [(10.0 * k + 0.1) - 10.0 * k for k in (1, 2, 3)]
    assert len(set(differences)) > 1
    assert mean_difference_interval(differences, range(3)) is None
    assert mean_difference_p(differences, range(3)) is None
    assert mean_difference_interval([0.1, 0.1, 0.102], range(3)) is not None
