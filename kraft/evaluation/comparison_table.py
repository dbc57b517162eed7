"""Tables of a comparison of two evaluations, and what differs between their manifests, for a terminal."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import count
from typing import Any, Final

from kraft.evaluation.comparison import Comparison, PairedRow
from kraft.evaluation.journal import OUTCOMES
from kraft.evaluation.manifest import Difference
from kraft.evaluation.statistics import SIGNIFICANT, least_sign_flip_p
from kraft.evaluation.table import Table
from kraft.provenance import MISSING
from kraft.text import counted, decimals, listed

COLUMNS: Final = {
    "entry": 9,
    "method": 9,
    "pairs": 6,
    "succ A/B": 8,
    "coll A/B": 8,
    "timeout A/B": 7,
    "failed A/B": 7,
    "only A/B": 4,
    "p": 5,
    "both": 2,
    "dT s": 5,
    "dT 95 % CI": 3,
    "same": 6,
}
"""Headings and their importance, see `kraft.evaluation.table.Table`."""
MEANINGS: Final = {
    "pairs": "trials with the same seed in A and B",
    "only A/B": "pairs in which only A / only B succeeded",
    "p": "exact McNemar test of the successes; in the table of all entries the exact sign-flip test over entries",
    "both": "pairs in which both succeeded",
    "dT s": "mean of the time in B minus that in A over these pairs",
    "dT 95 % CI": (
        "its interval, Student's, over pairs, in the table of all entries over entries; - with fewer than three of "
        "them, or if all differences are the same"
    ),
    "same": "pairs whose drives are the same, bit by bit",
}
"""What the columns hold whose heading does not say it."""
NAMES: Final = dict(zip(OUTCOMES, ("succ A/B", "coll A/B", "timeout A/B", "failed A/B"), strict=True))
NONE: Final = "0/0"
"""Cell of an outcome that no trial has: where all have it, its column is the first one that is left out."""
MARK: Final = " *"
"""Behind the name of an entry whose scenario is not the same in both evaluations."""
DIFFERENCES_MAX: Final = 20
"""Most differences that are printed."""
ROWS_MAX: Final = 20
"""Most rows of which those are printed too whose drives are all the same."""
VALUE_MAX: Final = 60
"""Most characters of a value that are printed."""


def comparison_tables(comparison: Comparison) -> list[Table]:
    """Table of the rows, of many only those that differ, and if there are several entries that of all together."""
    rows, totals = comparison.rows, comparison.totals
    left_out = set() if any(side["failed"] for row in rows for side in row.counts) else {"failed A/B"}
    shown = _shown(comparison)
    found = [_table("", shown, left_out)] if shown else []
    return [*found, _table("all entries", totals, left_out | {"entry"})] if totals else found


def _shown(comparison: Comparison) -> list[PairedRow]:
    """Rows of the table."""
    rows = comparison.rows
    return [row for row in rows if not row.same] if len(rows) > ROWS_MAX else list(rows)


def folders(comparison: Comparison) -> Iterator[str]:
    """Lines that say which folder is A and which is B, what has not run yet in each, and whether they are one."""
    for label, folder, missing in zip("AB", comparison.folders, comparison.missing, strict=True):
        yield f"{label}: {folder}" + (f", {counted(missing, 'trial')} not run yet" if missing else "")
    one, other = comparison.folders
    if one.resolve() == other.resolve():
        yield "A and B are the same folder"


def remarks(comparison: Comparison) -> Iterator[str]:
    """Lines about what was compared: of how much, what only one folder has, and what differs in the manifests."""
    yield from _too_few(comparison)
    same = len(comparison.rows) - len(_shown(comparison))
    if same:
        have = "has" if same == 1 else "have"
        yield f"{counted(same, 'row')} whose drives are all the same {have} no line above; --json has all"
    for label, alone in zip("AB", comparison.alone, strict=True):
        if alone:
            yield f"only in {label}: {listed((', '.join(each) for each in alone), DIFFERENCES_MAX)}"
    changed = list(dict.fromkeys(row.entry for row in comparison.rows if not row.same_scenario))
    if changed:
        names = listed(changed, DIFFERENCES_MAX)
        yield f"*: A and B have different versions of these scenarios, see the next lines: {names}"
    differences = comparison.differences
    yield from map(_difference, differences[:DIFFERENCES_MAX])
    if len(differences) > DIFFERENCES_MAX:
        yield f"and {counted(len(differences) - DIFFERENCES_MAX, 'further difference')}, which --json has"
    if not differences:
        of_both = " that both have" if any(comparison.alone) else ""
        yield f"scenarios, methods, vehicles and versions{of_both} are the same in A and B"


def _too_few(comparison: Comparison) -> Iterator[str]:
    """Lines about tests of so few pairs or entries that no outcome gives a p-value below `SIGNIFICANT`."""
    limit = f"p is {SIGNIFICANT:g} or more whatever the outcomes"
    least = next(number for number in count(1) if least_sign_flip_p(number) < SIGNIFICANT)
    few = sum(row.pairs < least and not row.same for row in comparison.rows)
    if few:
        have = "has" if few == 1 else "have"
        yield f"{counted(few, 'row')} {have} fewer than {least} pairs, too few for successes that differ ({limit})"
    entries = Counter(row.method for row in comparison.rows)
    if any(entries[total.method] < least and not total.same for total in comparison.totals):
        yield f"there are fewer than {least} entries, too few for successes that differ over all entries ({limit})"


def _table(title: str, rows: Sequence[PairedRow], left_out: set[str]) -> Table:
    names = [name for name in COLUMNS if name not in left_out]
    cells = [_cells(row) for row in rows]
    never = {name for name in ("coll A/B", "timeout A/B") if all(row[name] == NONE for row in cells)}
    importance = tuple(0 if name in never else COLUMNS[name] for name in names)
    return Table(title, tuple(names), tuple(tuple(row[name] for name in names) for row in cells), importance)


def _cells(row: PairedRow) -> dict[str, str]:
    one, other = row.counts
    interval = row.time_interval
    return {
        "entry": row.entry + ("" if row.same_scenario else MARK),
        "method": row.title,
        "pairs": str(row.pairs),
        **{heading: f"{one[name]}/{other[name]}" for name, heading in NAMES.items()},
        "only A/B": f"{row.lost}/{row.gained}",
        "p": f"{row.p:.2g}",
        "both": str(row.both),
        "dT s": _signed(row.time_difference),
        "dT 95 % CI": "-" if interval is None else f"{_signed(interval[0])} to {_signed(interval[1])}",
        "same": f"{row.identical}/{row.digests}" if row.digests else "-",
    }


def _signed(seconds: float | None) -> str:
    """Difference with its sign: ``+0.12``, ``-0.30``, ``0.00``."""
    text = decimals(seconds, 2)
    if seconds is None or float(text) == 0.0:
        return text.removeprefix("-") or text
    return f"+{text}" if seconds > 0.0 else text


def _difference(difference: Difference) -> str:
    one, other = (_value(value) for value in (difference.one, difference.other))
    return f"{'.'.join(difference.path)}: {one} in A, {other} in B"


def _value(value: Any) -> str:
    if value is MISSING:
        return "absent"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= VALUE_MAX else f"{text[: VALUE_MAX - 3]}..."
