"""Methods on the page over all entries together: shares and times with intervals, and δ(v) against the deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final
from xml.etree.ElementTree import Element

from kraft.evaluation.journal import success_times
from kraft.evaluation.report.elements import NO_VALUE, element, number, stacked, svg
from kraft.evaluation.report.measures import LEAST_TOP
from kraft.evaluation.report.results import Results
from kraft.evaluation.report.sweeps import nice_ticks
from kraft.evaluation.statistics import mean_interval, percentile, wilson
from kraft.evaluation.summary import Result
from kraft.text import decimals, percent
from kraft.trial.measures import BIN, Measures, pooled

WIDTH, HEIGHT = 150.0, 26.0
EDGE: Final = 9.0
"""Size of a drawing of an interval, and its margin, px."""
PANEL: Final = (300.0, 170.0)
LEFT, RIGHT, TOP, BOTTOM = 44.0, 10.0, 10.0, 34.0
"""Size of a drawing of deviations, and its margins, px."""


@dataclass(frozen=True)
class _Total:
    """A method over all entries: its trials, numbers of outcomes, durations of its successes (s), and measures.

    `ratios` are these durations over the lower bounds of their entries, `commands` the times of the controller's
    commands (ms), none in older evaluations, of which `late` took longer than the time between two.
    """

    title: str
    trials: int
    success: int
    collision: int
    timeout: int
    durations: Sequence[float]
    ratios: Sequence[float]
    measures: Measures
    commands: Sequence[float]
    late: int

    @classmethod
    def of(cls, results: Results, method: str, rows: Sequence[Result]) -> _Total:
        bounds = {row.entry: row.bound for row in rows}
        ended = [
            (time, bounds.get(entry))
            for entry in results.entries
            for time in success_times(results.of_cell(entry, method))
        ]
        return cls(
            results.methods[method],
            sum(row.trials for row in rows),
            sum(row.success for row in rows),
            sum(row.collision for row in rows),
            sum(row.timeout for row in rows),
            [time for time, _ in ended],
            [time / bound for time, bound in ended if bound],
            pooled(row.measures for row in rows),
            [
                value / 1000.0
                for entry in results.entries
                for trial in results.of_cell(entry, method)
                for value in trial.measured.command_us
            ],
            sum(row.late_commands for row in rows),
        )


def methods(results: Results) -> Element | None:
    """Section about the methods over all entries; None without trials."""
    totals = [_Total.of(results, method, results.summary.of_method(method)) for method in results.methods]
    totals = [total for total in totals if total.trials]
    if not totals:
        return None
    words = (
        "Every method over all its trials: dots with 95\u00a0% intervals, Wilson's of shares and Student's of mean "
        "times. Times are of successful trials, so a method that fails where others take long has a lower one. The "
        "bound is the time of the shortest path of the disc inscribed in the car, at the top speed of the fastest "
        "model."
    )
    quantiles = [total.measures.deviation_quantiles((0.5, 0.9, 0.99)) for total in totals]
    most = [row[3] for found in quantiles for row in found] + [t.measures.clearance.delta_mean or 0.0 for t in totals]
    panels = [
        _panel(total, found, max([*most, LEAST_TOP]), max(found[-1][0] for found in quantiles if found))
        for total, found in zip(totals, quantiles, strict=True)
        if found
    ]
    return element(
        "section",
        element("h2", "Methods over all entries"),
        element("p", words, class_="key"),
        element("div", stacked(_table(totals)), class_="wide"),
        *([element("h3", "Deviation from the prediction, and the clearance δ(v)")] if panels else []),
        *([element("p", DEVIATION, class_="key"), element("div", *panels, class_="panels")] if panels else []),
        id="methods",
    )


DEVIATION: Final = (
    "Largest distance of a point of the true car from where the committed prediction has it, by the time since the "
    "commit: median, and the bands up to 90\u00a0% and 99\u00a0% of the ticks. The dashed line is the mean of the "
    "clearance δ(v) that the method asked for. A clearance that is fixed in the settings of a method is no bound of "
    "what the car may deviate; only the bound that a method measures while it drives promises that the deviation "
    "stays below it."
)


def _table(totals: Sequence[_Total]) -> Element:
    ticks = _ticks([t.durations for t in totals])
    bounded, timed = any(t.ratios for t in totals), any(t.commands for t in totals)
    ratios = _ticks([t.ratios for t in totals])
    shares = [0.0, 0.25, 0.5, 0.75, 1.0]
    heading = element(
        "tr",
        element("th", "method"),
        element("th", "succeeded", class_="number"),
        element("th", _axis(shares, [f"{share:.0%}" for share in shares]), aria_label="succeeded, drawn"),
        element("th", "collided", class_="number"),
        element("th", _axis(shares, [f"{share:.0%}" for share in shares]), aria_label="collided, drawn"),
        element("th", "timed out", class_="number"),
        element("th", "mean time, s", class_="number"),
        element("th", _axis(ticks, [f"{tick:g}" for tick in ticks]), aria_label="mean time, drawn"),
        *([element("th", "time / bound", class_="number")] if bounded else []),
        *(
            [element("th", _axis(ratios, [f"{tick:g}" for tick in ratios]), aria_label="time / bound, drawn")]
            if bounded
            else []
        ),
        element("th", "δ(v) kept", class_="number"),
        *([element("th", "command, ms", element("small", "median"), class_="number")] if timed else []),
    )
    return element(
        "table",
        element("thead", heading),
        element("tbody", *(_row(total, ticks, ratios if bounded else None, timed=timed) for total in totals)),
        class_="totals-table",
        aria_label="methods over all entries",
    )


def _ticks(each: Sequence[Sequence[float]]) -> list[float]:
    """Ticks that hold the means with their intervals."""
    means = [sum(values) / len(values) for values in each if values]
    intervals = [found for values in each if (found := mean_interval(values)) is not None]
    ends = [*means, *(end for found in intervals for end in found)]
    return nice_ticks(max(0.0, min(ends)), max(ends)) if ends else [0.0, 1.0]


def _row(total: _Total, ticks: Sequence[float], ratios: Sequence[float] | None, *, timed: bool) -> Element:
    coverage = total.measures.clearance.coverage
    good, bad = wilson(total.success, total.trials), wilson(total.collision, total.trials)
    return element(
        "tr",
        element("th", total.title, scope="row"),
        _share(f"{total.success} of {total.trials}", good),
        element("td", _dot(total.success / total.trials, good, (0.0, 1.0), "success"), class_="drawing"),
        _share(str(total.collision), bad),
        element("td", _dot(total.collision / total.trials, bad, (0.0, 1.0), "collision"), class_="drawing"),
        element("td", str(total.timeout), class_="number"),
        *_mean(total.durations, ticks),
        *(_mean(total.ratios, ratios) if ratios is not None else ()),
        element("td", percent(coverage, NO_VALUE), class_="number"),
        *([_commands(total)] if timed else []),
    )  # fmt: skip


def _commands(total: _Total) -> Element:
    """Cell of the time of a command: the median, the 99 % quantile, and the share that were late."""
    if not total.commands:
        return element("td", NO_VALUE, class_="number")
    median, most = (decimals(percentile(total.commands, share), 2) for share in (0.5, 0.99))
    late = f"{total.late} of {len(total.commands)} commands took longer than the time between two"
    share = f"{100.0 * total.late / len(total.commands):.1f}% late"
    return element(
        "td", median, element("small", f"99\u00a0%: {most}"), element("small", share), class_="number", title=late
    )


def _share(text: str, interval: tuple[float, float]) -> Element:
    return element("td", text, element("small", f"{interval[0]:.0%} to {interval[1]:.0%}"), class_="number")


def _mean(values: Sequence[float], ticks: Sequence[float]) -> tuple[Element, Element]:
    """Cells of a mean and of its drawing."""
    mean = sum(values) / len(values) if values else None
    drawing = _dot(mean, mean_interval(values), (ticks[0], ticks[-1]), "time")
    return (
        element("td", NO_VALUE if mean is None else f"{mean:.2f}", class_="number"),
        element("td", drawing, class_="drawing"),
    )


def _across(value: float, low: float, high: float) -> float:
    return EDGE + (WIDTH - 2 * EDGE) * (value - low) / (high - low)


def _axis(ticks: Sequence[float], texts: Sequence[str]) -> Element:
    """Labels above a column of dots; every second one if there are many."""
    step = 1 if len(ticks) <= 5 else 2
    labels = [
        element("text", text, x=_across(tick, ticks[0], ticks[-1]), y=11.0, class_="tick")
        for tick, text in list(zip(ticks, texts, strict=True))[::step]
    ]
    return svg(WIDTH, 14.0, *labels, class_="axis", aria_hidden="true")


def _dot(value: float | None, interval: tuple[float, float] | None, ends: tuple[float, float], look: str) -> Element:
    """Dot with its interval; an interval that leaves the axis is cut."""
    middle = HEIGHT / 2
    parts = [element("line", class_="base", x1=EDGE, x2=WIDTH - EDGE, y1=middle, y2=middle)]
    if interval is not None:
        low, high = (_across(min(max(end, ends[0]), ends[1]), *ends) for end in interval)
        parts.append(element("line", class_=f"range {look}", x1=low, x2=high, y1=middle, y2=middle))
    if value is not None:
        parts.append(element("circle", class_=f"dot {look}", cx=_across(value, *ends), cy=middle, r=4.5))
    return svg(WIDTH, HEIGHT, *parts, aria_hidden="true")  # the numbers stand beside it


def _panel(total: _Total, quantiles: Sequence[Sequence[float]], top: float, last: float) -> Element:
    """Deviation of a method by the time since the commit; all panels have the axes up to `top` (m) and `last` (s)."""
    delta = total.measures.clearance.delta_mean
    width, height = PANEL

    def x(time: float) -> float:
        return LEFT + (width - LEFT - RIGHT) * time / last

    def y(value: float) -> float:
        return height - BOTTOM - (height - TOP - BOTTOM) * value / top

    def line(k: int) -> str:
        return "L".join(f"{number(x(row[0] - BIN / 2))} {number(y(row[k]))}" for row in quantiles)

    def band(k: int) -> str:
        ends = (x(row[0] - BIN / 2) for row in (quantiles[-1], quantiles[0]))
        return f"M{line(k)}{''.join(f'L{number(end)} {number(y(0.0))}' for end in ends)}z"

    parts = [element("path", class_="band far", d=band(3)), element("path", class_="band near", d=band(2))]
    parts.append(element("path", class_="median", d=f"M{line(1)}"))
    for tick in nice_ticks(0.0, top, 5):
        if tick <= top:
            parts.append(element("line", class_="base", x1=LEFT, x2=width - RIGHT, y1=y(tick), y2=y(tick)))
            parts.append(element("text", f"{100 * tick:g} cm", class_="tick end", x=LEFT - 5.0, y=y(tick) + 4.0))
    for tick in nice_ticks(0.0, last, 3):
        if tick <= last + 1e-9:
            parts.append(element("text", f"{tick:g} s", class_="tick", x=x(tick), y=height - BOTTOM + 15.0))
    if delta is not None:
        parts.append(element("line", class_="delta", x1=LEFT, x2=width - RIGHT, y1=y(delta), y2=y(delta)))
    kept = total.measures.clearance.coverage
    half, most = quantiles[-1][1], quantiles[-1][3]
    words = f"{100 * half:.1f} cm median, {100 * most:.1f} cm at 99 %, {quantiles[-1][0]:g} s after the commit"
    if delta is not None and kept is not None:
        words += f"; δ(v) {100 * delta:.1f} cm on average, kept at {percent(kept)} of the ticks"
    drawing = svg(width, height, *parts, class_="deviation-panel", aria_label=f"{total.title}: {words}")
    caption = element("figcaption", element("b", total.title), element("small", words))
    return element("figure", caption, drawing, aria_label=f"deviation of {total.title}")
