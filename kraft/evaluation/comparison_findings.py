"""What a comparison of two evaluations has found, in sentences: which rows differ beyond chance, and which do not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final

from kraft.evaluation.comparison import Comparison, PairedRow
from kraft.evaluation.statistics import GROUPS_MIN, SIGNIFICANT, holm
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
    if comparison.same:
        yield f"{number}: all drives are the same, bit by bit"
        return
    yield f"{number}; rows differ where p is below {SIGNIFICANT:g}, adjusted for the number of tests of each line:"
    yield f"successes: {_successes(rows)}"
    yield f"times of pairs that both succeeded: {_times(rows, 'such pairs', 'pairs')}"
    if totals:
        yield f"successes over all entries: {_successes(totals)}"
        yield f"times over all entries: {_times(totals, 'entries that have such pairs', 'entries')}"


def _successes(rows: Sequence[PairedRow]) -> str:
    return ", ".join(_judged(rows, lambda row: row.p if row.gained or row.lost else None, _success_change))


def _times(rows: Sequence[PairedRow], having_times: str, tested: str) -> str:
    """Sentence about times, whose tests are over the pairs, or over the entries, of a row that have times."""
    untested = [row for row in rows if row.time_p is None and not row.same]
    few = sum(row.time_groups < GROUPS_MIN for row in untested)
    parts = _judged([row for row in rows if row not in untested], lambda row: row.time_p, _time_change)
    if few:
        parts.append(f"cannot be tested in {counted(few, 'row')} with fewer than {GROUPS_MIN} {having_times}")
    if alike := len(untested) - few:
        parts.append(f"cannot be tested in {counted(alike, 'row')} where all {tested} have the same difference")
    return ", ".join(parts)


def _judged(
    rows: Sequence[PairedRow], p_of: Callable[[PairedRow], float | None], change: Callable[[PairedRow], str]
) -> list[str]:
    """Which rows differ beyond chance, in how many all drives are the same, and in how many no difference is shown."""
    p_values = [p_of(row) for row in rows]
    adjusted = iter(holm([p for p in p_values if p is not None]))
    differing = [row for row, p in zip(rows, p_values, strict=True) if p is not None and next(adjusted) < SIGNIFICANT]
    same = sum(row.same for row in rows)
    parts = [f"differ in {listed((f'{_name(row)} ({change(row)})' for row in differing), LISTED)}"] if differing else []
    if same:
        parts.append(f"the same in {counted(same, 'row')}, bit by bit")
    if others := len(rows) - len(differing) - same:
        parts.append(f"no difference is shown in {counted(others, 'row')}")
    return parts


def _name(row: PairedRow) -> str:
    return f"{row.entry}, {row.title}" if row.entry else row.title


def _success_change(row: PairedRow) -> str:
    return f"{row.counts[0]['success']} in A, {row.counts[1]['success']} in B, of {row.pairs}"


def _time_change(row: PairedRow) -> str:
    assert row.time_difference is not None, "there is no p-value without it"
    return f"B takes {decimals(abs(row.time_difference), 2)} s {'longer' if row.time_difference > 0.0 else 'less'}"
