"""Overview of the page: how every method did in every entry, and in all of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element

from kraft.evaluation.report.elements import NO_VALUE, Content, element
from kraft.evaluation.report.results import Cell, Results
from kraft.evaluation.report.sweeps import settings_text
from kraft.evaluation.statistics import wilson
from kraft.evaluation.summary import MANY, Result
from kraft.text import counted


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
    def others(self) -> str:
        """Outcomes that are not a success, in words."""
        counts = ((self.collision, "collision"), (self.timeout, "timeout"), (self.failed, "defect"))
        return ", ".join(counted(count, noun) for count, noun in counts if count)


def overview(results: Results) -> Element:
    """Table of all methods and entries; entries are in rows if they are many or have settings."""
    by_cell = {(result.entry, result.method): result for result in results.summary.results}
    entries, methods = list(results.entries.values()), results.methods
    names = [_name(results, cell) for cell in entries]
    totals = {m: Count.over(r for r in results.summary.results if r.method == m) for m in methods}
    heading: Sequence[Content]
    several = len(entries) > 1
    in_rows = len(entries) > MANY or any(cell.set for cell in entries)
    if in_rows:
        heading = list(methods.values())
        rows = [
            _line(
                names[k],
                [_cell(by_cell.get((cell.name, method))) for method in methods],
                class_="begin" if _begins_group(entries, k) else None,
            )
            for k, cell in enumerate(entries)
        ]
        rows += [_line(["all"], [_total(total) for total in totals.values()], class_="totals")] if several else []
    else:
        heading = [*(element("span", *name) for name in names), *(["all"] if several else [])]
        rows = [
            _line([title], [*(_cell(by_cell.get((cell.name, method))) for cell in entries),
                            *([_total(totals[method])] if several else [])])
            for method, title in methods.items()
        ]  # fmt: skip
    first = element("tr", element("th", "successes"), *(element("th", text) for text in heading))
    table = element("table", first, *rows, class_="overview many" if in_rows else "overview")
    return element("section", element("div", table, class_="wide"))


def settings_of(cell: Cell) -> str:
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
    return element("span", *text, class_="chip ends", style=count.bar, title=count.others or None)


def _name(results: Results, cell: Cell) -> list[Content]:
    settings = settings_of(cell)
    link = element("a", cell.base or cell.name, href=f"#{results.slugs[cell.name]}")
    return [link, element("small", settings) if settings else None]


def _begins_group(entries: Sequence[Cell], k: int) -> bool:
    """Whether an entry is the first one of a sweep; the next one has the same base."""
    bases = [cell.base or cell.name for cell in entries]
    return 0 < k < len(bases) - 1 and bases[k] not in bases[:k] and bases[k] == bases[k + 1]


def _line(name: Sequence[Content], cells: Sequence[Element], **attributes: Any) -> Element:
    return element("tr", element("th", *name, scope="row"), *cells, **attributes)


def _cell(result: Result | None) -> Element:
    if result is None or not result.trials:
        return element("td", NO_VALUE)
    paper = f"paper {result.paper.success} of {result.paper.trials}" if result.paper else None
    return _counts(Count.over([result]), paper)


def _total(count: Count) -> Element:
    if not count.trials:
        return element("td", NO_VALUE)
    low, high = wilson(count.collision, count.trials)
    return _counts(count, f"collided {count.collision / count.trials:.0%} ({low:.0%} to {high:.0%})")


def _counts(count: Count, note: str | None) -> Element:
    small = [element("small", text) for text in (count.others, note) if text]
    return element(
        "td", element("b", str(count.success)), f" of {count.trials}", *small, class_="ends", style=count.bar
    )
