"""Overview of a report: successes of each method in each entry, and causes of failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import urlencode
from xml.etree.ElementTree import Element

from kraft.evaluation.journal import DEFECT, OWN_CODE_ERROR
from kraft.evaluation.report.elements import NO_VALUE, Content, element, hint, outcome_legend, stacked
from kraft.evaluation.report.results import RecordedCell, Results
from kraft.evaluation.report.sweeps import settings_text
from kraft.evaluation.summary import MANY, Result
from kraft.text import counted
from kraft.trial.cause import CauseKind

ERRORS_MAX: Final = 5
"""Number of different errors that the table of causes has."""
UNRECORDED = "not recorded"
"""Cause of a failure in older evaluations."""


@dataclass(frozen=True)
class Count:
    """Numbers of trials by their outcomes."""

    trials: int
    success: int
    collision: int
    timeout: int
    failed: int

    @classmethod
    def over(cls, results: Iterable[Result]) -> Count:
        """Numbers of trials in several rows together."""
        rows = list(results)
        return cls(*(sum(getattr(row, name) for row in rows) for name in cls.__dataclass_fields__))

    @property
    def bar(self) -> str:
        """Widths of the bar of outcomes behind a cell, for its style."""
        ends = (self.success, self.success + self.timeout, self.success + self.timeout + self.collision)
        return "; ".join(f"--{name}: {100 * end / self.trials:.3g}%" for name, end in zip("stc", ends, strict=True))

    @property
    def others(self) -> list[str]:
        """Numbers of the outcomes that are not a success, in words."""
        counts = ((self.collision, "collision"), (self.timeout, "timeout"))
        words = [counted(count, noun) for count, noun in counts if count]
        return [*words, *([f"{self.failed} failed"] if self.failed else [])]

    @property
    def share(self) -> float:
        """Share of successes; 0 without trials."""
        return self.success / self.trials if self.trials else 0.0


def overview(results: Results) -> Element:
    """Table with a row for each entry and a column for each method; of many entries, those that fail most come first.

    The first row has the totals; several methods have a last column of all together.
    """
    summary = results.summary
    entries, methods = list(results.entries.values()), results.methods
    by_cell, counts = summary.by_cell, {cell.name: Count.over(summary.of_entry(cell.name)) for cell in entries}
    many, several = len(entries) > MANY, len(methods) > 1
    if many:
        # stable: the order of the suite where it is equal, and without trials at the end
        entries.sort(key=lambda cell: counts[cell.name].share if counts[cell.name].trials else 2.0)
    rows = [
        _line(
            _name(results, cell),
            [
                *(_cell(by_cell.get((cell.name, method))) for method in methods),
                *([_together(counts[cell.name], entry=cell.name)] if several else []),
            ],
        )
        for cell in entries
    ]
    totals = {method: Count.over(summary.of_method(method)) for method in methods}
    everything = [_together(Count.over(summary.results))] if several else []
    titles = [*methods.values(), *(["all"] if several else [])]
    heading = element("tr", element("th", "entry"), *(element("th", title) for title in titles))
    first = _line(["all entries"], [*(_together(n, method=m) for m, n in totals.items()), *everything], class_="totals")
    table = element(
        "table",
        element("thead", heading),
        element("tbody", first, class_="totals") if len(entries) > 1 else None,
        element("tbody", *rows, class_="rows"),
        class_="overview sortable many" if many else "overview sortable",
        aria_label="successes by entry and method",
    )
    order = " Those that fail most come first." if many else ""
    words = f"Successes of each method in each entry; the colours of a cell are a bar of its outcomes.{order}"
    return element(
        "section",
        element("h2", "Overview"),
        element(
            "p",
            *outcome_legend(summary.failed > 0, soft=True),
            words,
            hint(" A heading sorts by its column, a number lists its trials."),
            class_="key",
        ),
        element("div", table, class_="wide"),
        id="overview",
    )


def causes(results: Results) -> Element | None:
    """Table of the causes of collisions, timeouts and failed trials for each method; None if all succeeded."""
    by_method: dict[str, Counter[str]] = {method: Counter() for method in results.methods}
    for result in results.summary.results:
        found = by_method[result.method]
        found.update(result.causes)
        if without := result.collision + result.timeout - sum(result.causes.values()):
            found[UNRECORDED] += without
    errors: dict[str, Counter[str]] = {OWN_CODE_ERROR: Counter(), DEFECT: Counter()}
    for row in results.rows.values():
        if row.outcome == "failed" and row.why is not None:
            cause, error = row.why
            by_method[row.method][cause] += 1
            errors[cause][error] += 1
    all_of = sum(by_method.values(), Counter[str]())
    if not all_of:
        return None
    names = sorted(all_of, key=lambda name: (-all_of[name], name))
    most = max(count for found in by_method.values() for count in found.values())
    rows = [
        element(
            "tr",
            element("th", title, scope="row"),
            *(_cause_cell(by_method[method][name], method, name, most) for name in names),
            element("td", str(sum(by_method[method].values())), class_="number"),
        )
        for method, title in results.methods.items()
    ]
    heading = element("tr", element("th", "method"), *(element("th", name) for name in names), element("th", "all"))
    total = element(
        "tr",
        element("th", "all methods", scope="row"),
        *(element("td", str(all_of[name]), class_="number") for name in names),
        element("td", str(all_of.total()), class_="number"),
    )
    several = len(results.methods) > 1  # the totals of one method are its own
    foot = element("tbody", total, class_="totals") if several else None
    table = element("table", element("thead", heading), element("tbody", *rows), foot, class_="causes",
        aria_label="causes of failures by method",
    )  # fmt: skip
    meanings = [(name, MEANINGS.get(name) or _errors_text(errors[name])) for name in names]
    return element(
        "section",
        element("h2", "Why trials failed"),
        element("p", "Trials that did not succeed, by their cause.", hint(" A number lists its trials."), class_="key"),
        element("div", stacked(table), class_="wide"),
        element("dl", *(element("div", element("dt", name), element("dd", text)) for name, text in meanings if text),
                class_="meanings"),
        id="causes",
    )  # fmt: skip


def _errors_text(errors: Counter[str]) -> str:
    """The most frequent errors of failed trials, with their numbers, and how many others there are."""
    shown = [f"{counted(count, 'trial')}: {error}" for error, count in errors.most_common(ERRORS_MAX)]
    more = len(errors) - len(shown)
    return "; ".join([*shown, *([f"and {counted(more, 'other error')}, which the list of trials has"] if more else [])])


MEANINGS: Final = {str(kind): kind.meaning for kind in CauseKind} | {UNRECORDED: "the trial is of an older kraft"}
"""What each cause means."""


def settings_of(cell: RecordedCell) -> str:
    """What an entry sets, and its scenario where the name does not state it."""
    label = cell.base or cell.name
    parts = [] if label == cell.scenario else [cell.scenario]
    return ", ".join([*parts, *([settings_text(cell.set)] if cell.set else [])])


def chip(result: Result) -> Element:
    """Successes of a method in the summary line of an entry."""
    count = Count.over([result])
    if not count.trials:
        return element("span", f"{result.title} {NO_VALUE}", class_="chip")
    aligned = str(count.success).rjust(len(str(count.trials)), "\u2007")  # a space as wide as a digit
    text = f"{result.title} ", element("b", aligned), f" of {count.trials}"
    return element("span", *text, class_="chip ends", style=count.bar, title=", ".join(count.others) or None)


def _name(results: Results, cell: RecordedCell) -> list[Content]:
    settings = settings_of(cell)
    link = element("a", cell.base or cell.name, href=f"#{results.slugs[cell.name]}")
    return [link, element("small", settings, title=settings) if settings else None]


def _line(name: Sequence[Content], cells: Sequence[Element], **attributes: Any) -> Element:
    return element("tr", element("th", *name, scope="row"), *cells, **attributes)


def _cause_cell(count: int, method: str, cause: str, most: int) -> Element:
    if not count:
        return element("td", NO_VALUE, class_="number none", data_value=0.0)
    link = element("a", str(count), href=_list_link(method=method, cause=cause)) if cause != UNRECORDED else str(count)
    return element("td", link, class_="number heat", style=f"--heat: {count / most:.2f}", data_value=float(count))


def _list_link(**chosen: str) -> str:
    """Address that filters the list of trials."""
    return f"#show&{urlencode(chosen)}"


def _cell(result: Result | None) -> Element:
    if result is None or not result.trials:
        return element("td", NO_VALUE, data_value="")
    paper = f"paper {result.paper.success} of {result.paper.trials}" if result.paper else None
    return _counts(Count.over([result]), paper, _list_link(entry=result.entry, method=result.method))


def _together(count: Count, **chosen: str) -> Element:
    """Cell of the trials of several rows, which a filter of the list of trials selects."""
    return _counts(count, None, _list_link(**chosen)) if count.trials else element("td", NO_VALUE, data_value="")


def _counts(count: Count, note: str | None, link: str) -> Element:
    others = [*count.others, *([note] if note else [])]
    number = element("a", element("b", str(count.success)), element("span", f" of {count.trials}"), href=link)
    beside = (element("small", text) for text in others)
    title = ", ".join(others) or None
    return element("td", number, *beside, class_="ends", style=count.bar, title=title, data_value=round(count.share, 6))
