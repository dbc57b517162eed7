"""Comparison of two evaluations, trial by trial: of two versions of a method file, of a vehicle, or of kraft.

Trials are paired by entry, method and seed.  The first evaluation is the reference: differences are those of the second
from it.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from kraft.errors import Code, InputError, Problems
from kraft.evaluation.journal import OUTCOMES, Key, TrialRow
from kraft.evaluation.manifest import Difference, manifest_differences
from kraft.evaluation.report.results import RecordedTrials, read_trials
from kraft.evaluation.statistics import mcnemar, mean_difference_interval, mean_difference_p, sign_flip_p
from kraft.provenance import MISSING

Pair: TypeAlias = tuple[TrialRow, TrialRow]


@dataclass(frozen=True)
class PairedRow:
    """Row of a comparison: a method in an entry, or in all entries.

    Attributes:
        entry: name of the entry; empty for all entries together.
        scenario: name of its scenario; empty for all entries together.
        method, title: name and title of the method.
        pairs: number of trials that both evaluations have.
        counts: numbers of these trials by outcome, in either evaluation.
        gained, lost: numbers of pairs in which only the second, or only the first trial succeeded.
        p: two-sided p-value under the hypothesis of equal success rates: of the exact McNemar test, or for all entries
            of the exact sign-flip test over entries.
        both: number of pairs in which both trials succeeded.
        time_difference: mean difference of the durations of these pairs, s; None without any.
        time_interval: Student's 95 % interval of that, over pairs, or for all entries over entries; None with fewer
            than three of them, or if they are all the same.
        time_p: two-sided p-value of no difference, of the test that belongs to the interval; None without one.
        time_groups: number of what this test is over: of those pairs, or for all entries of the entries that have any.
        digests: number of pairs that have digests of both drives.
        identical: number of those whose drives are the same, bit by bit.
        same_scenario: whether the content of the scenario is the same in both evaluations; of all entries, in each.
    """

    entry: str
    scenario: str
    method: str
    title: str
    pairs: int
    counts: tuple[Mapping[str, int], Mapping[str, int]]
    gained: int
    lost: int
    p: float
    both: int
    time_difference: float | None
    time_interval: tuple[float, float] | None
    time_p: float | None
    time_groups: int
    digests: int
    identical: int
    same_scenario: bool

    @property
    def same(self) -> bool:
        """Whether all drives of the row are the same, bit by bit."""
        return self.identical == self.pairs


@dataclass(frozen=True)
class Comparison:
    """Comparison of the evaluations in two folders.

    Attributes:
        folders: the two folders.
        rows: rows with trials of both, in the order of the second evaluation.
        totals: the same over all entries, a row for each method; empty if only one entry is compared.
        differences: what differs between the manifests, where both have the row, scenario, method or vehicle.
        alone: entries and methods that only the first, or only the second evaluation has trials of.
        missing: numbers of trials that have not run yet in either.
    """

    folders: tuple[Path, Path]
    rows: tuple[PairedRow, ...]
    totals: tuple[PairedRow, ...]
    differences: tuple[Difference, ...]
    alone: tuple[tuple[tuple[str, str], ...], tuple[tuple[str, str], ...]]
    missing: tuple[int, int]

    @property
    def same(self) -> bool:
        """Whether all drives of all rows are the same, bit by bit."""
        return all(row.same for row in self.rows)


def compare(one: str | Path, other: str | Path) -> Comparison:
    """Compare the evaluations in two results folders, complete or not; `one` is the reference.

    Raises:
        InputError: if one of them is not a results folder or is damaged, or if they have no trial in common.
    """
    folders = Path(one), Path(other)
    problems = Problems()
    first, second = (problems.of(partial(read_trials, folder)) for folder in folders)
    problems.check()
    assert first is not None, "every problem was raised"
    assert second is not None, "every problem was raised"
    changed = _changed_entries(first, second)
    pairs = _pairs(first.rows, second.rows)
    if not pairs:
        problem = f"has no trial in common with {folders[0]}: {_difference(first.rows, second.rows)}"
        expected = "expected an evaluation that shares entries, methods and seeds with it"
        raise InputError.of(str(folders[1]), problem, expected, Code.MISMATCH)
    names = [name for name in second.manifest.names if (name.entry, name.method) in pairs]
    rows = [
        _paired_row(name.entry, name.scenario, name.method, name.title, pairs[name.entry, name.method], changed)
        for name in names
    ]
    titles = {name.method: name.title for name in names}
    several = len({name.entry for name in names}) > 1
    totals = [_total(method, title, pairs, changed) for method, title in titles.items()] if several else []
    return Comparison(
        folders,
        tuple(rows),
        tuple(totals),
        tuple(manifest_differences(first.content, second.content)),
        (_alone(first.rows, second.rows), _alone(second.rows, first.rows)),
        (first.missing, second.missing),
    )


def _difference(one: Mapping[Key, TrialRow], other: Mapping[Key, TrialRow]) -> str:
    """Why two evaluations have no trial in common."""
    if not one or not other:
        return "one of them has no trial yet"
    for k, name in enumerate(("entry", "method", "seed")):
        if not {key[k] for key in one} & {key[k] for key in other}:
            return f"no {name} is in both"
    return "no entry has a method and a seed that are in both"


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """Content of the ``kraft.compare/1`` object, without its schema."""
    return {
        "a": str(comparison.folders[0]),
        "b": str(comparison.folders[1]),
        "results": [_row_json(row) for row in comparison.rows],
        "totals": [_row_json(row) for row in comparison.totals],
        "differences": [_difference_json(each) for each in comparison.differences],
        "only_in_a": [{"entry": entry, "method": method} for entry, method in comparison.alone[0]],
        "only_in_b": [{"entry": entry, "method": method} for entry, method in comparison.alone[1]],
        "missing_in_a": comparison.missing[0],
        "missing_in_b": comparison.missing[1],
    }


def _changed_entries(first: RecordedTrials, second: RecordedTrials) -> set[str]:
    """Entries of one name with different scenarios."""
    one, other = first.manifest.scenarios, second.manifest.scenarios
    return {name for name in one.keys() & other.keys() if one[name].sha256 != other[name].sha256}


def _pairs(one: Mapping[Key, TrialRow], other: Mapping[Key, TrialRow]) -> dict[tuple[str, str], list[Pair]]:
    """Trials with the same key in both, by entry and method, ordered by seed."""
    found: dict[tuple[str, str], list[Pair]] = {}
    for key in sorted(one.keys() & other.keys()):
        found.setdefault(key[:2], []).append((one[key], other[key]))
    return found


def _alone(one: Mapping[Key, TrialRow], other: Mapping[Key, TrialRow]) -> tuple[tuple[str, str], ...]:
    """Entries and methods that only `one` has trials of."""
    return tuple(sorted({key[:2] for key in one} - {key[:2] for key in other}))


def _paired_row(
    entry: str, scenario: str, method: str, title: str, pairs: Sequence[Pair], changed: set[str]
) -> PairedRow:
    """Row of a method in an entry."""
    successes = [{row.seed: row.outcome == "success" for row in side} for side in zip(*pairs, strict=True)]
    p = mcnemar(successes[1], successes[0]).p
    seeds = [one.seed for one, _ in pairs]
    return _row(entry, scenario, method, title, pairs, p, seeds, same_scenario=entry not in changed)


def _total(method: str, title: str, pairs: Mapping[tuple[str, str], Sequence[Pair]], changed: set[str]) -> PairedRow:
    """Row of a method in all entries."""
    mine = [pair for (_, name), found in pairs.items() if name == method for pair in found]
    entries = [one.key[0] for one, _ in mine]
    changes = dict.fromkeys(entries, 0)
    for one, other in mine:
        changes[one.key[0]] += (other.outcome == "success") - (one.outcome == "success")
    p = sign_flip_p(list(changes.values()))
    return _row("", "", method, title, mine, p, entries, same_scenario=not changed & set(entries))


def _row(
    entry: str,
    scenario: str,
    method: str,
    title: str,
    pairs: Sequence[Pair],
    p: float,
    groups: Sequence[Hashable],
    *,
    same_scenario: bool,
) -> PairedRow:
    """Row of these pairs, each of which belongs to a group of pairs that are alike."""
    outcomes = [(one.outcome, other.outcome) for one, other in pairs]
    times = [
        (after - before, group)
        for (one, other), group in zip(pairs, groups, strict=True)
        if (before := one.success_time) is not None and (after := other.success_time) is not None
    ]
    differences, their_groups = [difference for difference, _ in times], [group for _, group in times]
    digests = [(one.digest, other.digest) for one, other in pairs if one.digest and other.digest]
    counts = tuple({name: side.count(name) for name in OUTCOMES} for side in zip(*outcomes, strict=True))
    return PairedRow(
        entry=entry,
        scenario=scenario,
        method=method,
        title=title,
        pairs=len(pairs),
        counts=(counts[0], counts[1]),
        gained=sum(one != "success" == other for one, other in outcomes),
        lost=sum(one == "success" != other for one, other in outcomes),
        p=p,
        both=len(differences),
        time_difference=sum(differences) / len(differences) if differences else None,
        time_interval=mean_difference_interval(differences, their_groups),
        time_p=mean_difference_p(differences, their_groups),
        time_groups=len(set(their_groups)),
        digests=len(digests),
        identical=sum(one == other for one, other in digests),
        same_scenario=same_scenario,
    )


def _row_json(row: PairedRow) -> dict[str, Any]:
    return {
        **({"entry": row.entry, "scenario": row.scenario} if row.entry else {}),
        "method": row.method,
        "pairs": row.pairs,
        "a": dict(row.counts[0]),
        "b": dict(row.counts[1]),
        "gained": row.gained,
        "lost": row.lost,
        "p": row.p,
        "both_succeed": row.both,
        "time_difference_s": None if row.time_difference is None else round(row.time_difference, 6),
        "time_difference_ci95": None if row.time_interval is None else [round(end, 6) for end in row.time_interval],
        "time_p": row.time_p,
        "digests": row.digests,
        "identical": row.identical,
        "same_scenario": row.same_scenario,
    }


def _difference_json(difference: Difference) -> dict[str, Any]:
    """Difference with the values that there are."""
    values = {"a": difference.one, "b": difference.other}
    return {"path": ".".join(difference.path), **{k: value for k, value in values.items() if value is not MISSING}}
