"""Measures of what a method promises, as a table in an entry of the page.

They are clearance, contingencies, regressions, covariance and deviations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final
from xml.etree.ElementTree import Element

from kraft.evaluation.report.elements import NO_VALUE, Content, element, number, svg
from kraft.evaluation.report.results import Results
from kraft.evaluation.summary import Result
from kraft.text import counted, percent
from kraft.trial.measures import BAND, BIN, REGRESSION

DEVIATION_WIDTH, DEVIATION_HEIGHT = 170.0, 46.0
DEVIATION_EDGE: Final = 4.0
"""Size of a drawing of deviations, and its margin, px."""
LEAST_TOP: Final = 0.01
"""Least upper end of an axis of deviations, m: those of an exact model may all be 0."""
NO_REASON: Final = "retained, and yet longer"
"""Reason of a regression where the remainder of the last plan was retained."""


@dataclass(frozen=True)
class Shown:
    """Columns that some method of the page has."""

    clearance: bool
    contingencies: bool
    regressions: bool
    covariance: bool
    messages: bool
    watchdog: bool
    deviations: bool

    @classmethod
    def of(cls, results: Results) -> Shown:
        """Columns of a page; older trials have no measures."""
        each = [result.measures for result in results.summary.results]
        measured = any(one.deviation_mm for one in each)
        return cls(
            clearance=any(one.clearance.ticks for one in each),
            contingencies=measured and any(result.contingencies for result in results.summary.results),
            regressions=any(one.compared for one in each),
            covariance=any(one.consistency is not None for one in each),
            messages=any(one.messages_lost for one in each),
            watchdog=any(one.watchdog_stops for one in each),
            deviations=measured,
        )

    @property
    def any(self) -> bool:
        """Whether there is a table."""
        return self.clearance or self.regressions or self.covariance or self.deviations


@dataclass(frozen=True)
class _Deviations:
    """Median and 99 % quantile (m) of the deviation up to the times `until` since the commit (s)."""

    until: tuple[float, ...]
    median: tuple[float, ...]
    most: tuple[float, ...]

    @classmethod
    def of(cls, result: Result) -> _Deviations:
        quantiles = result.measures.deviation_quantiles((0.5, 0.99))
        until, median, most = zip(*quantiles, strict=True) if quantiles else ((), (), ())
        return cls(until, median, most)


def measures_table(shown: Shown, results: Sequence[Result], name: str) -> Element | None:
    """Table of an entry's methods; None if no method of the page has measures."""
    if not shown.any:
        return None
    each = [_Deviations.of(result) if shown.deviations else _Deviations((), (), ()) for result in results]
    cycle = max((d.until[-1] for d in each if d.until), default=0.0)
    deltas = [result.measures.clearance.delta_mean or 0.0 for result in results]
    top = max([LEAST_TOP, *deltas, *(value for d in each for value in d.most)])
    heading = [element("th", "what was promised, and what held"), *_headings(shown)]
    if shown.deviations:
        scale = f"until {cycle:.3g} s, up to {1000 * top:.0f} mm"
        heading.append(element("th", "deviation from the prediction", element("small", scale)))
    rows = []
    for result, deviations in zip(results, each, strict=True):
        cells = list(_cells(shown, result))
        if shown.deviations:
            cells.append(_drawing(result, deviations, cycle, top) if deviations.until else element("td", NO_VALUE))
        rows.append(element("tr", element("th", result.title, scope="row"), *cells))
    label = f"what was promised in {name}"
    return element("table", element("thead", element("tr", *heading)), *rows, class_="measures", aria_label=label)


def _headings(shown: Shown) -> Iterator[Element]:
    if shown.clearance:
        title = "share of the time in which no point of the true car was farther from the prediction than the clearance"
        yield _heading("clearance δ(v) kept", "mean δ(v)", title)
    if shown.contingencies:
        title = "verified when committed / verified by an earlier cycle / verified by nothing"
        yield _heading("contingencies", "safe / in hand / emergency", title)
    if shown.regressions:
        title = f"plans that cost over {REGRESSION:g} s more than what was left of the last plan"
        yield _heading("regressions", "of plans compared", title)
    if shown.covariance:
        band = f"{BAND[0]:.2f} to {BAND[1]:.2f}"
        title = f"squared error of the pose over its covariance: 3 on average if that is right; 95 % band {band}"
        yield _heading("covariance: NEES", "share in 95 % band", title)
    if shown.messages:
        yield _heading("messages lost", "replanner to car", "")
    if shown.watchdog:
        yield _heading("watchdog stops", "by the car itself", "")


def _heading(text: str, small: str, title: str) -> Element:
    return element("th", text, element("small", small), class_="number", title=title or None)


def _cells(shown: Shown, result: Result) -> Iterator[Element]:
    measures = result.measures
    if shown.clearance:
        kept = measures.clearance
        title = f"plans {percent(measures.plans.coverage)}, contingencies {percent(measures.contingencies.coverage)}"
        delta = f"{_mm(kept.delta_mean)} mm"
        yield _cell(None if kept.coverage is None else percent(kept.coverage), delta, title)
    if shown.contingencies:
        yield _contingencies(result) if result.replans else _cell(None)
    if shown.regressions:
        count = sum(measures.regressions.values())
        reasons = "\n".join(f"{_reason(reason)}: {n}" for reason, n in measures.regressions.items())
        yield _cell(str(count) if measures.compared else None, f"of {measures.compared}", reasons)
    if shown.covariance:
        one = measures.consistency
        yield _cell(f"{one.mean:.3g}", percent(one.share)) if one and one.mean is not None else _cell(None)
    if shown.messages:
        yield _cell(str(measures.messages_lost) if result.replans or measures.messages_lost else None)
    if shown.watchdog:
        yield _cell(str(measures.watchdog_stops) if result.replans else None)


def _contingencies(result: Result) -> Element:
    measures = result.measures
    safe = result.contingencies - measures.in_hand - measures.emergencies
    emergencies: Content = str(measures.emergencies)
    if measures.emergencies:
        emergencies = element("b", str(measures.emergencies), class_="bad")
    small = element("small", f"of {counted(result.cycles, 'cycle')}")
    return element("td", f"{safe} / {measures.in_hand} / ", emergencies, small, class_="number")


def _cell(text: str | None, small: str | None = None, title: str = "") -> Element:
    if text is None:
        return element("td", NO_VALUE, class_="number")
    return element("td", text, element("small", small) if small else None, class_="number", title=title or None)


def _reason(reason: str) -> str:
    return NO_REASON if reason == "none" else reason


def _mm(length: float | None) -> str:
    return NO_VALUE if length is None else f"{1000 * length:.0f}"


def _drawing(result: Result, deviations: _Deviations, cycle: float, top: float) -> Element:
    """Median and 99 % lines over the time since the commit, and the mean of delta(v) as a dashed line."""

    def x(time: float) -> float:
        return DEVIATION_EDGE + (DEVIATION_WIDTH - 2 * DEVIATION_EDGE) * time / cycle

    def y(value: float) -> float:
        return DEVIATION_HEIGHT - DEVIATION_EDGE - (DEVIATION_HEIGHT - 2 * DEVIATION_EDGE) * value / top

    parts = [
        element("line", class_="base", x1=DEVIATION_EDGE, x2=DEVIATION_WIDTH - DEVIATION_EDGE, y1=y(0.0), y2=y(0.0))
    ]
    for look, name, values in (("most", "99 %", deviations.most), ("median", "median", deviations.median)):
        middles = [time - BIN / 2 for time in deviations.until]
        path = "M" + "L".join(f"{number(x(t))} {number(y(v))}" for t, v in zip(middles, values, strict=True))
        title = f"{name}: {1000 * values[0]:.0f} mm at first, {1000 * values[-1]:.0f} mm at last"
        parts.append(element("path", element("title", title), class_=look, d=path))
    delta = result.measures.clearance.delta_mean
    if delta is not None:
        mean = element("title", f"mean δ(v): {1000 * delta:.0f} mm")
        parts.append(
            element(
                "line",
                mean,
                class_="delta",
                x1=DEVIATION_EDGE,
                x2=DEVIATION_WIDTH - DEVIATION_EDGE,
                y1=y(delta),
                y2=y(delta),
            )
        )
    words = "deviation from the prediction by the time since the commit"
    drawing = svg(DEVIATION_WIDTH, DEVIATION_HEIGHT, *parts, class_="deviation", aria_label=words)
    return element("td", drawing, class_="drawing")
