"""The sentences of a comparison: they name what differs after adjustment for the number of tests, and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kraft.evaluation.comparison import Comparison, PairedRow
from kraft.evaluation.comparison_findings import findings
from kraft.evaluation.statistics import mean_difference_interval, mean_difference_p


def row(
    entry: str, gained: int = 0, p: float = 1.0, time_p: float | None = None, identical: int = 0, groups: int = 10
) -> PairedRow:
    """Row of 20 pairs, of which A succeeds in 10."""
    counts = ({"success": 10}, {"success": 10 + gained})
    difference = None if time_p is None else -0.25
    return PairedRow(
        entry,
        entry,
        "kraft",
        "KRAFT",
        20,
        counts,
        gained,
        0,
        p,
        10,
        difference,
        None,
        time_p,
        groups,
        20,
        identical,
        True,
    )


def found(*rows: PairedRow, totals: tuple[PairedRow, ...] = ()) -> list[str]:
    return list(findings(Comparison((Path("a"), Path("b")), rows, totals, (), ((), ()), (0, 0))))


def test_rows_that_differ_are_named_with_their_change_and_the_others_counted() -> None:
    lines = found(row("turns", gained=8, p=0.008, time_p=0.001), row("slip", time_p=0.4), row("bump", groups=2))
    assert lines[0].startswith("60 pairs in 3 rows; ")
    assert lines[1:] == [
        "successes: differ in turns, KRAFT (10 in A, 18 in B, of 20), no difference is shown in 2 rows",
        "times of pairs that both succeeded: differ in turns, KRAFT (B takes 0.25 s less), "
        "no difference is shown in 1 row, cannot be tested in 1 row with fewer than 3 such pairs",
    ]


def test_what_is_below_the_limit_only_without_adjustment_is_not_named() -> None:
    lines = found(*(row(f"e{k}", gained=6, p=0.03, time_p=0.03) for k in range(2)))
    assert lines[1:] == [
        "successes: no difference is shown in 2 rows",
        "times of pairs that both succeeded: no difference is shown in 2 rows",
    ]
    alone = found(row("e0", gained=6, p=0.03), row("e1"))
    assert alone[1].startswith("successes: differ in e0"), "a row without a pair that differs adds no test"


def test_all_entries_have_sentences_of_their_own() -> None:
    lines = found(row("turns"), row("slip"), totals=(row("", gained=9, p=0.01, groups=2),))
    assert lines[3:] == [
        "successes over all entries: differ in KRAFT (10 in A, 19 in B, of 20)",
        "times over all entries: cannot be tested in 1 row with fewer than 3 entries that have such pairs",
    ]


def test_rows_whose_drives_are_the_same_are_the_same_and_not_untested() -> None:
    lines = found(row("turns", identical=20), row("slip", time_p=0.4), row("bump"), totals=(row("", identical=20),))
    assert lines[1:] == [
        "successes: the same in 1 row, bit by bit, no difference is shown in 2 rows",
        "times of pairs that both succeeded: the same in 1 row, bit by bit, no difference is shown in 1 row, "
        "cannot be tested in 1 row where all pairs have the same difference",
        "successes over all entries: the same in 1 row, bit by bit",
        "times over all entries: the same in 1 row, bit by bit",
    ]


def test_drives_that_are_all_the_same_need_no_test() -> None:
    assert found(row("turns", identical=20)) == ["20 pairs in 1 row: all drives are the same, bit by bit"]


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.6, 1.2])
@pytest.mark.parametrize("groups", [range(12), [k // 3 for k in range(12)]])
def test_the_p_value_of_a_mean_difference_is_below_the_limit_where_its_interval_excludes_zero(
    shift: float, groups: list[int]
) -> None:
    values = list(np.random.default_rng(3).normal(shift, 0.8, 12))
    interval, p = mean_difference_interval(values, groups), mean_difference_p(values, groups)
    assert interval is not None
    assert p is not None
    assert (p < 0.05) == (not interval[0] <= 0.0 <= interval[1])
    for end in interval:  # the differences that the interval just holds
        assert mean_difference_p([value - end for value in values], groups) == pytest.approx(0.05)
