"""What a comparison of two evaluations has found, in sentences: which rows differ beyond chance, and which do not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final

from kraft.evaluation.comparison import Comparison, PairedRow
from kraft.evaluation.statistics import SIGNIFICANT, holm
from kraft.text import counted, decimals, listed

LISTED: Final = 5
"""Most rows that a sentence lists."""


def findings(comparison: Comparison) -> Iterator[str]:
    """Number of pairs, then a sentence about successes and one about times, of the rows and of all entries together.

    The p-values of each sentence are adjusted for their number by Holm's method.  Successes of rows in which no pair
    differs are not among them: the tests are conditional on the number of pairs that do, and none cannot be shown.
    """
    rows, totals = comparison.rows, comparison.totals
    pairs = sum(row.pairs for row in rows)
    number = f"{counted(pairs, 'pair')} in {counted(len(rows), 'row')}"
    if all(row.identical == row.pairs for row in rows):
        yield f"{number}: all drives are the same, bit by bit"
        return
    yield f"{number}; rows differ where p is below {SIGNIFICANT:g}, adjusted for the number of tests of each line:"
    yield f"successes: {_sentence(rows, _success_p, _success_change)}"
    yield f"times of pairs that both succeeded: {_sentence(rows, _time_p, _time_change, _untestable)}"
    if totals:
        yield f"successes over all entries: {_sentence(totals, _success_p, _success_change)}"
        yield f"times over all entries: {_sentence(totals, _time_p, _time_change, _untestable)}"


def _sentence(
    rows: Sequence[PairedRow],
    p_of: Callable[[PairedRow], float | None],
    change: Callable[[PairedRow], str],
    untestable: Callable[[PairedRow], bool] = lambda _: False,
) -> str:
    """Which rows differ beyond chance, in how many others no difference is shown, and how many cannot be tested."""
    p_values = [p_of(row) for row in rows]
    adjusted = iter(holm([p for p in p_values if p is not None]))
    differing = [row for row, p in zip(rows, p_values, strict=True) if p is not None and next(adjusted) < SIGNIFICANT]
    untested = sum(map(untestable, rows))
    same = len(rows) - untested - len(differing)
    parts = [f"differ in {listed((f'{_name(row)} ({change(row)})' for row in differing), LISTED)}"] if differing else []
    if same:
        parts.append(f"no difference is shown in {counted(same, 'row')}")
    if untested:
        parts.append(f"cannot be tested in {counted(untested, 'row')}")
    return ", ".join(parts)


def _name(row: PairedRow) -> str:
    return f"{row.entry}, {row.title}" if row.entry else row.title


def _success_p(row: PairedRow) -> float | None:
    """p-value of the successes; None where no pair differs in them."""
    return row.p if row.gained or row.lost else None


def _success_change(row: PairedRow) -> str:
    return f"{row.counts[0]['success']} in A, {row.counts[1]['success']} in B, of {row.pairs}"


def _time_p(row: PairedRow) -> float | None:
    return row.time_p


def _untestable(row: PairedRow) -> bool:
    """Whether too few pairs or entries have times, or all differences are the same."""
    return row.time_p is None


def _time_change(row: PairedRow) -> str:
    assert row.time_difference is not None, "there is no p-value without it"
    return f"B {decimals(abs(row.time_difference), 2)} s {'later' if row.time_difference > 0.0 else 'earlier'}"
