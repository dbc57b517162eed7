"""Charts in a row of the table: outcomes, trials by seed, and durations of the successful trials."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final
from xml.etree.ElementTree import Element

from kraft.evaluation.journal import Key, TrialRow
from kraft.evaluation.paper import PaperRow
from kraft.evaluation.report.elements import element, svg
from kraft.evaluation.statistics import wilson
from kraft.evaluation.summary import Result
from kraft.trial.result import outcome_text

WIDTH: Final = 190.0
PAPER, BAR = 9.0, 14.0  # heights of the line above the bar and of the bar
CELLS: Final = 42  # trials in a line of the strip
TIMES: Final = 150.0
EDGE: Final = 8.0  # margin left and right of the times, for dots and labels at the ends


def outcomes(result: Result) -> Element:
    """Bar of the outcomes with Wilson's interval of the success rate; above it the paper's rate and interval."""
    parts: list[Element] = []
    left = 0.0
    for name, count in endings(result):
        width = WIDTH * count / result.trials
        share = element("title", f"{name}: {count} of {result.trials}")
        parts.append(element("rect", share, class_=name, x=left, y=PAPER, width=width, height=BAR))
        left += width
    if result.trials:
        title = f"95 % interval of the success rate: {result.interval[0]:.0%} to {result.interval[1]:.0%}"
        parts += _interval(result.interval, PAPER + BAR / 2, "interval", title)
    if result.paper:
        parts += _papers(result.paper)
    return svg(WIDTH, PAPER + BAR, *parts, class_="outcomes", aria_label="outcomes; the numbers stand beside them")


def endings(result: Result) -> list[tuple[str, int]]:
    """Outcomes that occurred, with their numbers of trials."""
    counts = {
        "success": result.success,
        "timeout": result.timeout,
        "collision": result.collision,
        "failed": result.failed,
    }
    return [(name, count) for name, count in counts.items() if count]


def trials(
    rows: Sequence[TrialRow], seeds: range, commands: Mapping[int, str | None], link: Callable[[Key], str]
) -> Element:
    """Strip with a cell for each seed, empty before the trial is run.

    `commands` by seed repeat the trials, `link` gives the address of a trial's replay.
    """
    found = {row.seed: row for row in rows}
    step = WIDTH / min(max(len(seeds), 1), CELLS)
    side = min(step, 10.0)
    cells = []
    for place, seed in enumerate(seeds):
        x, y = (place % CELLS) * step, (place // CELLS) * side
        row = found.get(seed)
        text = f"{trial_text(row)}\n{commands[seed] or f'{row.scenario}, {row.method}'}" if row else None
        title = element("title", text or f"seed {seed}: not run yet")
        look = row.outcome if row else "missing"
        cell = element("rect", title, class_=look, x=x, y=y, width=step - 1.0, height=side - 1.0)
        if row is not None:
            cell = element("a", cell, href=link(row.key), tabindex="-1")  # the list has the same links
        cells.append(cell)
    return svg(
        WIDTH, side * -(-len(seeds) // CELLS), *cells, class_="trials", role="group", aria_label="trials by seed"
    )


def trial_text(row: TrialRow) -> str:
    """Seed, outcome and error of a trial, in words."""
    text = f"seed {row.seed}: {outcome_text(row.outcome, row.obstacle, row.t_s, digits=1)}"
    return text + (f": {row.error}" if row.error else "")


def times(result: Result, rows: Sequence[TrialRow], longest: float) -> Element:
    """Durations of the successful trials as dots, their mean as a line, the paper's as a ring, the bound dashed."""
    dots = [
        element("circle", element("title", trial_text(row)), class_="time", cx=_at(time, longest), cy=12.0, r=3.0)
        for row in rows
        if (time := row.success_time) is not None
    ]
    base = [element("line", class_="base", x1=EDGE, x2=TIMES - EDGE, y1=12.0, y2=12.0)]
    if result.bound is not None and result.bound <= longest:
        x, title = _at(result.bound, longest), f"lower bound {result.bound:.2f} s: the shortest path at top speed"
        base.append(element("line", element("title", title), class_="bound", x1=x, x2=x, y1=1.0, y2=23.0))
    return svg(
        TIMES,
        24.0,
        *base,
        *dots,
        *_mean(result, longest),
        class_="times",
        aria_label="times of successes; their mean stands beside them",
    )


def time_axis(longest: float) -> Element:
    """Axis labels above a column of `times`, s."""
    step = next((s for s in (1, 2, 5, 10, 20, 50, 100, 200, 500) if longest / s <= 4), 1000)
    ticks = [step * k for k in range(int(longest // step) + 1)]
    labels = [element("text", f"{tick}", x=_at(tick, longest), y=10.0, class_="tick") for tick in ticks]
    return svg(TIMES, 13.0, *labels, class_="times", aria_hidden="true")


def _mean(result: Result, longest: float) -> Iterator[Element]:
    if result.t_ex is not None:
        x = _at(result.t_ex, longest)
        yield element("line", element("title", f"mean {result.t_ex:.2f} s"), class_="mean", x1=x, x2=x, y1=3.0, y2=21.0)
    if result.paper and result.paper.t_ex is not None:
        x = _at(result.paper.t_ex, longest)
        yield element(
            "circle", element("title", f"paper: {result.paper.t_ex:.2f} s"), class_="paper", cx=x, cy=12.0, r=4.0
        )


def _at(time: float, longest: float) -> float:
    return EDGE + (TIMES - 2 * EDGE) * time / longest


def _papers(paper: PaperRow) -> Iterator[Element]:
    interval = wilson(paper.success, paper.trials)
    title = f"paper: {paper.success} of {paper.trials}, 95 % interval {interval[0]:.0%} to {interval[1]:.0%}"
    yield from _interval(interval, PAPER / 2, "paper", title)
    rate = paper.success / paper.trials
    yield element("circle", element("title", title), class_="paper", cx=3.0 + (WIDTH - 6.0) * rate, cy=PAPER / 2, r=2.5)


def _interval(interval: tuple[float, float], y: float, look: str, title: str) -> Iterator[Element]:
    low, high = (0.75 + (WIDTH - 1.5) * end for end in interval)
    yield element("line", element("title", title), class_=look, x1=low, x2=high, y1=y, y2=y)
    for x in (low, high):
        yield element("line", class_=look, x1=x, x2=x, y1=y - 3.0, y2=y + 3.0)
