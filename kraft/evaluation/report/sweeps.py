"""Sweeps of an evaluation: shares and times of every method over the values of a varied key, and their picture.

The picture has small multiples with a column for each scenario; it needs no style sheet.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final
from xml.etree.ElementTree import Element

from kraft.config.overrides import value_text
from kraft.config.schema import lookup
from kraft.config.source import parse_path
from kraft.evaluation.journal import success_times
from kraft.evaluation.report.elements import Content, element, number, svg
from kraft.evaluation.report.results import RecordedCell, Results
from kraft.evaluation.statistics import mean_interval, wilson
from kraft.evaluation.summary import Result
from kraft.scenario.schema import ScenarioFile

UNIT: Final = re.compile(r"(?:^|, )(m per m/s|m/s|s|m|rad|kg|degrees)(?:$|[ ;])")
"""Unit at the end of a key's description."""


@dataclass(frozen=True)
class Statistic:
    """Share or mean with its 95 % interval, if it has one."""

    value: float
    interval: tuple[float, float] | None


@dataclass(frozen=True)
class SweepPoint:
    """One method at one value of the varied key.

    Attributes:
        place: position on the axis of the varied key.
        result: row of the summary.
        success, collision: share of the trials; None without trials.
        time: mean duration of the successful trials, s; None without any.
    """

    place: float
    result: Result
    success: Statistic | None
    collision: Statistic | None
    time: Statistic | None


@dataclass(frozen=True)
class Axis:
    """Axis of a varied key.

    Attributes:
        key: the dotted key.
        label: name of the quantity and its unit.
        places: position of each value; the value itself, or its number if not all values are numbers.
        texts: text of each value.
    """

    key: str
    label: str
    places: tuple[float, ...]
    texts: tuple[str, ...]


@dataclass(frozen=True)
class Sweep:
    """Small multiples of one varied key; `fixed` are the values of the other varied keys.

    `panels` has the points of each method, by its name, for each entry before varying.
    """

    axis: Axis
    fixed: Mapping[str, Any]
    panels: Mapping[str, Mapping[str, Sequence[SweepPoint]]]

    @property
    def name(self) -> str:
        """What is varied, and at which values of the other keys."""
        return f"Sweep of {self.axis.key} {settings_text(self.fixed)}".strip()


def sweeps(results: Results) -> list[Sweep]:
    """Sweeps of an evaluation: one for each combination of values of the varied keys but the one with most values."""
    values = varied(results)
    if not values:
        return []
    key = max(values, key=lambda name: len(values[name]))  # the first one of several
    axis = axis_of(key, values[key])
    others = [[(name, value) for value in values[name]] for name in values if name != key]
    return [_sweep(results, axis, values[key], dict(fixed)) for fixed in itertools.product(*others)]


def varied(results: Results) -> dict[str, list[Any]]:
    """Values of each varied key, in their order; a key with one value is not varied."""
    found: dict[str, list[Any]] = {}
    for cells in _bases(results).values():
        for key in cells[0].set if len(cells) > 1 else ():
            values = _distinct(cell.set.get(key) for cell in cells)
            if len(values) > 1:
                known = found.setdefault(key, [])
                known += [value for value in values if value_text(value) not in map(value_text, known)]
    return found


def axis_of(key: str, values: Sequence[Any]) -> Axis:
    """Axis of a key with its values."""
    numeric = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
    places = tuple(float(value) if numeric else float(k) for k, value in enumerate(values))
    return Axis(key, label_of(key), places, tuple(value_text(value) for value in values))


def label_of(key: str, value: Any = None) -> str:
    """Name of a key's quantity with its unit, or with a value: ``delay, s``, ``delay = 0.3 s``."""
    name, unit = _quantity(key)
    if value is not None:
        return f"{name} = {value_text(value)} {unit}".rstrip()
    return f"{name}, {unit}" if unit else name


def _quantity(key: str) -> tuple[str, str]:
    """Name and unit of a key's quantity."""
    *_, name = [part for part in parse_path(key) if isinstance(part, str)] or [key]
    for ending, unit in (("_deg", "degrees"), ("_hz", "Hz")):
        if name.endswith(ending):
            return _words(name.removesuffix(ending)), unit
    found = UNIT.search(lookup(ScenarioFile, parse_path(key)).description or "")
    return _words(name), found[1] if found else ""


def settings_text(settings: Mapping[str, Any]) -> str:
    """Keys with their values in one line."""
    return ", ".join(f"{key} = {value_text(value)}" for key, value in settings.items())


def _bases(results: Results) -> dict[str, list[RecordedCell]]:
    """Entries by their name before varying; older manifests have none."""
    found: dict[str, list[RecordedCell]] = {}
    for cell in results.entries.values():
        found.setdefault(cell.base or cell.name, []).append(cell)
    return found


def _distinct(values: Iterator[Any]) -> list[Any]:
    return list({value_text(value): value for value in values}.values())


def _sweep(results: Results, axis: Axis, values: Sequence[Any], fixed: Mapping[str, Any]) -> Sweep:
    by_cell = results.summary.by_cell
    texts = {key: value_text(value) for key, value in fixed.items()}
    panels: dict[str, dict[str, list[SweepPoint]]] = {}
    for base, cells in _bases(results).items():
        mine = [cell for cell in cells if all(value_text(cell.set.get(key)) == text for key, text in texts.items())]
        entries = {value_text(cell.set[axis.key]): cell.name for cell in mine if axis.key in cell.set}
        places = sorted((place, entries[value_text(value)]) for place, value in zip(axis.places, values, strict=True)
                        if value_text(value) in entries)  # fmt: skip
        if places:
            panels[base] = {
                method: [
                    _point(results, place, by_cell[entry, method])
                    for place, entry in places
                    if (entry, method) in by_cell
                ]
                for method in results.methods
            }
    return Sweep(axis, fixed, panels)


def _point(results: Results, place: float, result: Result) -> SweepPoint:
    rows = results.of_cell(result.entry, result.method)
    time = None if result.t_ex is None else Statistic(result.t_ex, mean_interval(success_times(rows)))
    return SweepPoint(place, result, _share(result.success, result), _share(result.collision, result), time)


def _share(count: int, result: Result) -> Statistic | None:
    return Statistic(count / result.trials, wilson(count, result.trials)) if result.trials else None


def _words(name: str) -> str:
    return name.replace("_", " ")


GROUND, INK, GREY, RULE = "#fff", "#16181d", "#667080", "#e3e6eb"  # style.css names them, for dark pages
COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#16181d")
"""Palette of Okabe and Ito without its yellow."""
FONT: Final = "system-ui, 'DejaVu Sans', Helvetica, Arial, sans-serif"
LEFT, GAP, RIGHT = 78.0, 26.0, 10.0  # px beside and between panels
HEIGHT, BETWEEN = 126.0, 20.0  # px of a panel and between two rows of panels
TITLE, FOOT, APART = 30.0, 46.0, 14.0  # px above and below a column of panels, and between two lines of columns
PANEL_MAX: Final = 380.0
DODGE: Final = 5.0  # px between the points of two methods at one value, at most
NARROW: Final = 250.0  # px; narrower panels have smaller marks
INSET: Final = 6.0  # px between the ends of an axis and the edge of a panel
CHARACTER: Final = 6.4  # px, mean width

Pick = Callable[[SweepPoint], Statistic | None]


@dataclass(frozen=True)
class Paper:
    """Room for a picture: its width (px), and the most scenarios beside each other."""

    width: float
    columns: int


DESK, TABLET, PHONE = Paper(1232.0, 6), Paper(700.0, 3), Paper(366.0, 1)


@dataclass(frozen=True)
class _Measure:
    """Row of panels: what it shows, and its axis with `ticks`, of which some are `labelled`."""

    label: str
    pick: Pick
    low: float
    high: float
    ticks: Sequence[float]
    labelled: Sequence[float]
    text: Callable[[float], str]
    of: Callable[[SweepPoint], str]


@dataclass(frozen=True)
class _Frame:
    """Panel at (x, y), `width` wide."""

    x: float
    y: float
    width: float

    def across(self, share: float) -> float:
        """Horizontal position, px."""
        margin = max(14.0, 0.09 * self.width)
        return self.x + margin + share * (self.width - 2 * margin)

    def up(self, measure: _Measure, value: float) -> float:
        """Vertical position of a value, px; values outside of the axis lie on its ends."""
        share = (min(max(value, measure.low), measure.high) - measure.low) / (measure.high - measure.low)
        return self.y + HEIGHT - INSET - share * (HEIGHT - 2 * INSET)


def sweep_pictures(sweeps: Sequence[Sweep], titles: Mapping[str, str], paper: Paper = DESK) -> list[Element]:
    """Draw sweeps with the same axes; `titles` are those of the methods, by name."""
    measures = _measures(sweeps)
    return [_picture(sweep, measures, titles, paper) for sweep in sweeps]


def _picture(sweep: Sweep, measures: Sequence[_Measure], titles: Mapping[str, str], paper: Paper) -> Element:
    lines = -(-len(sweep.panels) // paper.columns)
    columns = -(-len(sweep.panels) // lines)
    step = min(PANEL_MAX, (paper.width - LEFT - RIGHT + GAP) / columns - GAP)
    width = LEFT + columns * (step + GAP) - GAP + RIGHT
    fixed = ", ".join(label_of(key, value) for key, value in sweep.fixed.items())
    legend, top = _legend(titles, width, 40.0 if fixed else 16.0)
    tall = TITLE + len(measures) * (HEIGHT + BETWEEN) - BETWEEN + FOOT
    parts: list[Content] = [
        element("rect", x=0.0, y=0.0, width=width, height=top + lines * (tall + APART), fill=GROUND)
    ]
    parts += [_text(fixed, LEFT, 17.0, size=14, anchor="start", weight="600") if fixed else None, *legend]
    for k, (base, points) in enumerate(sweep.panels.items()):
        line, column = divmod(k, columns)
        x, y = LEFT + column * (step + GAP), top + line * (tall + APART)
        parts.append(_text(base, x + step / 2, y + 16.0, size=14, weight="600"))
        for row, measure in enumerate(measures):
            frame = _Frame(x, y + TITLE + row * (HEIGHT + BETWEEN), step)
            last = row == len(measures) - 1
            parts += _panel(frame, measure, sweep.axis, first=column == 0, last=last)
            parts += _lines(frame, measure, sweep.axis, points, titles)
        parts.append(_text(sweep.axis.label, x + step / 2, y + tall - 10.0))
    drawing = svg(width, top + lines * (tall + APART), *parts, class_="sweep", font_family=FONT, font_size=12.0)
    drawing.set("xmlns", "http://www.w3.org/2000/svg")
    drawing.insert(0, element("title", sweep.name))
    drawing.set("aria-label", sweep.name)
    return drawing


def _measures(sweeps: Sequence[Sweep]) -> list[_Measure]:
    shares = (0.0, 0.25, 0.5, 0.75, 1.0)
    found = [
        _Measure("success", lambda p: p.success, 0.0, 1.0, shares, shares[::2], "{:.0%}".format, _successes),
        _Measure("collision", lambda p: p.collision, 0.0, 1.0, shares, shares[::2], "{:.0%}".format, _collisions),
    ]
    points = [point for sweep in sweeps for panel in sweep.panels.values() for line in panel.values() for point in line]
    means = [point.time.value for point in points if point.time]
    if means:
        ticks = nice_ticks(min(means), max(means))
        labelled, name = ticks if len(ticks) <= 7 else ticks[::2], "time of successes, s"
        found.append(_Measure(name, lambda p: p.time, ticks[0], ticks[-1], ticks, labelled, "{:g}".format, _times))
    return found


def nice_ticks(low: float, high: float, count: int = 4) -> list[float]:
    """About `count` round numbers, the first below `low` and the last above `high`."""
    spread = max(high - low, 0.1 * abs(high), 1e-9)
    low, high = low - 0.15 * spread, high + 0.15 * spread  # room for intervals
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * k for k in (1, 2, 5, 10) if power * k >= raw * 0.999)
    first, last = math.floor(max(low, 0.0) / step), math.ceil(high / step)
    return [step * k for k in range(first, last + 1)]


def _panel(frame: _Frame, measure: _Measure, axis: Axis, *, first: bool, last: bool) -> Iterator[Element]:
    """Grid, ticks and labels of a panel; only the first column and the last row have labels."""
    right, bottom = frame.x + frame.width, frame.y + HEIGHT
    for tick in measure.ticks:
        y = frame.up(measure, tick)
        yield element("line", x1=frame.x, x2=right, y1=y, y2=y, stroke=RULE, stroke_width=1.0)
        if first and tick in measure.labelled:
            yield _text(measure.text(tick), frame.x - 8.0, y + 4.0, anchor="end", fill=GREY)
    yield element("line", x1=frame.x, x2=right, y1=bottom, y2=bottom, stroke=GREY, stroke_width=1.0)
    until = -math.inf
    for place, text in sorted(zip(axis.places, axis.texts, strict=True)):  # values may be given in any order
        x = frame.across(_share_of_axis(axis, place))
        yield element("line", x1=x, x2=x, y1=bottom, y2=bottom + 4.0, stroke=GREY, stroke_width=1.0)
        half = CHARACTER * len(text) / 2
        if last and x - half > until:
            yield _text(text, x, bottom + 17.0, fill=GREY)
            until = x + half + 4.0
    if first:
        label = _text(measure.label, 0.0, 0.0)
        label.set("transform", f"translate({number(frame.x - 56.0)} {number(frame.y + HEIGHT / 2)}) rotate(-90)")
        yield label


def _lines(
    frame: _Frame, measure: _Measure, axis: Axis, panel: Mapping[str, Sequence[SweepPoint]], titles: Mapping[str, str]
) -> Iterator[Element]:
    """Intervals of all methods, then their lines, then their points."""
    below: list[Element] = []
    above: list[Element] = []
    apart = _apart(frame, axis, len(titles))
    size = 0.8 if frame.width < NARROW else 1.0
    for k, method in enumerate(titles):
        shift = apart * (k - (len(titles) - 1) / 2)
        path: list[str] = []
        joined = False
        for point in panel.get(method, ()):
            found = measure.pick(point)
            if found is None:
                joined = False
                continue
            x, y = frame.across(_share_of_axis(axis, point.place)) + shift, frame.up(measure, found.value)
            path.append(f"{'L' if joined else 'M'}{number(x)} {number(y)}")
            joined = True
            below += _interval(frame, measure, found, x, colour(k))
            above.append(_marker(k, x, y, size, element("title", _title(measure, point, found, titles[method]))))
        line = element(
            "path", d="".join(path), fill="none", stroke=colour(k), stroke_width=1.8, stroke_linejoin="round"
        )
        if path:
            yield line
    yield from below
    yield from above


def _interval(frame: _Frame, measure: _Measure, found: Statistic, x: float, stroke: str) -> Iterator[Element]:
    """Bar of an interval; an end outside of the axis has no cap."""
    if found.interval is None:
        return
    ends = [(end, frame.up(measure, end)) for end in found.interval]
    look: dict[str, Any] = {"stroke": stroke, "stroke_width": 1.1, "stroke_opacity": 0.6}
    yield element("line", x1=x, x2=x, y1=ends[0][1], y2=ends[1][1], **look)
    for end, y in ends:
        if measure.low <= end <= measure.high:
            yield element("line", x1=x - 2.2, x2=x + 2.2, y1=y, y2=y, **look)


def _apart(frame: _Frame, axis: Axis, methods: int) -> float:
    """Distance between the points of two methods at one value, px: less where the values are close."""
    across = sorted(frame.across(_share_of_axis(axis, place)) for place in axis.places)
    gap = min(after - before for before, after in itertools.pairwise(across))
    return min(DODGE, 0.6 * gap / methods)


def _share_of_axis(axis: Axis, place: float) -> float:
    low, high = min(axis.places), max(axis.places)
    return (place - low) / (high - low)


def _title(measure: _Measure, point: SweepPoint, found: Statistic, method: str) -> str:
    text = f"{point.result.entry}, {method}: {measure.of(point)}"
    if found.interval is None:
        return text
    low, high = (measure.text(round(end, 2)) for end in found.interval)
    return f"{text}, 95 % interval {low} to {high}"


def _successes(point: SweepPoint) -> str:
    return f"{point.result.success} of {point.result.trials} succeeded"


def _collisions(point: SweepPoint) -> str:
    return f"{point.result.collision} of {point.result.trials} collided"


def _times(point: SweepPoint) -> str:
    return f"mean time of successes {point.result.t_ex:.2f} s"


def _legend(titles: Mapping[str, str], width: float, y: float) -> tuple[list[Element], float]:
    """Legend whose first line is at `y`, and where it ends."""
    parts: list[Element] = []
    x = LEFT
    for k, title in enumerate(titles.values()):
        long = 40.0 + 7.0 * len(title)
        if x > LEFT and x + long > width:
            x, y = LEFT, y + 22.0
        parts.append(element("line", x1=x, x2=x + 26.0, y1=y, y2=y, stroke=colour(k), stroke_width=1.8))
        parts.append(_marker(k, x + 13.0, y))
        parts.append(_text(title, x + 33.0, y + 4.5, anchor="start", size=13))
        x += long + 14.0
    return parts, y + 20.0


def colour(k: int) -> str:
    """Colour of the k-th method."""
    return COLOURS[k % len(COLOURS)]


def _marker(k: int, x: float, y: float, size: float = 1.0, title: Element | None = None) -> Element:
    """Point of the k-th method, with a shape of its own, so that it can be told apart without colours."""
    look: dict[str, Any] = {"fill": colour(k), "stroke": GROUND, "stroke_width": size}
    shape = k % 5
    if shape == 0:
        return element("circle", title, cx=x, cy=y, r=4.0 * size, **look)
    if shape == 1:
        return element("rect", title, x=x - 3.6 * size, y=y - 3.6 * size, width=7.2 * size, height=7.2 * size, **look)
    outlines = {
        2: ((0.0, -4.8), (4.5, 3.4), (-4.5, 3.4)),
        3: ((0.0, -5.2), (5.2, 0.0), (0.0, 5.2), (-5.2, 0.0)),
        4: ((0.0, 4.8), (4.5, -3.4), (-4.5, -3.4)),
    }
    points = " ".join(f"{number(x + size * dx)},{number(y + size * dy)}" for dx, dy in outlines[shape])
    return element("polygon", title, points=points, **look)


def _text(
    text: str, x: float, y: float, *, size: int = 12, anchor: str = "middle", fill: str = INK, weight: str | None = None
) -> Element:
    return element("text", text, x=x, y=y, text_anchor=anchor, font_size=float(size), fill=fill, font_weight=weight)
