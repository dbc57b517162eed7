"""Layout of a page: size, map and what it shows, panels, heading, notes and legend; and the legend itself.

Lengths are inches, but for those in the world.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle as Box
from matplotlib.ticker import FuncFormatter, MaxNLocator

from kraft.plot.style import (
    DASHED,
    GREY,
    INK,
    LABEL,
    RULE,
    SMALL,
    TITLE,
    VALUE,
    WARNING,
    Style,
    plain_number,
    shortened,
    text_width,
)
from kraft.scenario import Bounds
from ompl_ext.arrays import Floats

WIDTH = 9.0
LEFT, RIGHT = 0.55, 0.2
HEADING, NOTES, LEGEND = 0.48, 0.42, 0.3  # title; a row of notes; a row of the key
UNDER_MAP, UNDER_PANELS = 0.45, 0.42
PANEL, PANEL_GAP = 0.55, 0.2
MAP_HEIGHT_MAX = 5.6
FLAT_ASPECT = 0.6  # a map flatter than this has the panels below it, any other beside it
SIDE = 2.9  # panels beside the map and the space between
MIN_WIDTH = 5.0
NOTE_GAP = 20.0  # between notes, pt

SAMPLE, OUTLINE, GAP = 0.28, 0.2, 0.18  # inches: samples of a line and of a footprint, space between entries
BAR, BAR_HEIGHT = 1.2, 0.09
TALL = 1.2  # a scene higher than this many widths is turned by a quarter, so that it fills the page's width
MARGIN = 0.02  # of the longer side, so that walls on the bounds are visible


@dataclass(frozen=True)
class Frame:
    """The visible part of the world, m, and whether the page shows it turned clockwise by a quarter.

    Page coordinates are metres too: (x, y), or (y, -x) when turned.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    turned: bool

    @classmethod
    def around(cls, bounds: Bounds) -> Frame:
        """Frame of the bounds with a margin; never flatter than 1 : 8, so that there is room for labels."""
        width, height = (high - low for low, high in (bounds.x, bounds.y))
        longest = max(width, height)
        spans = []
        for (low, high), size in ((bounds.x, width), (bounds.y, height)):
            margin = max(MARGIN * longest, (longest / 8 - size) / 2)
            spans.append((low - margin, high + margin))
        return cls(spans[0], spans[1], height > TALL * width)

    @property
    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Horizontal and vertical limits of the page, m."""
        return (self.y, (-self.x[1], -self.x[0])) if self.turned else (self.x, self.y)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height on the page, m."""
        (left, right), (low, high) = self.limits
        return right - left, high - low

    def points(self, world: Floats) -> Floats:
        """Page coordinates of points in the world, both of shape (..., 2), m."""
        return np.stack([world[..., 1], -world[..., 0]], axis=-1) if self.turned else world

    def heading(self, theta: float) -> float:
        """Direction on the page, rad, of a heading in the world."""
        return theta - math.pi / 2 if self.turned else theta


@dataclass(frozen=True)
class Rectangle:
    """Part of the page; `top` is measured from the page's top."""

    left: float
    top: float
    width: float
    height: float

    @property
    def bottom(self) -> float:
        """Distance of its lower edge from the page's top."""
        return self.top + self.height


@dataclass(frozen=True)
class Page:
    """Size of the page and the places of its parts."""

    width: float
    height: float
    map: Rectangle
    legend: Rectangle
    panels: tuple[Rectangle, ...]
    note_rows: tuple[tuple[tuple[str, str], ...], ...]

    def axes(self, figure: Figure, part: Rectangle) -> Axes:
        """Axes that fill a part of the page."""
        bottom = self.height - part.top - part.height
        box = (part.left / self.width, bottom / self.height, part.width / self.width, part.height / self.height)
        return figure.add_axes(box)

    def heading(self, figure: Figure, title: str, verdict: str | None, colour: str = WARNING) -> None:
        """Title, what is wrong with the plan or how the drive ended, and the notes."""
        room = 72 * (self.width - LEFT - RIGHT)
        right = "" if verdict is None else verdict
        text = shortened(title, TITLE, room - text_width(right, TITLE, bold=True) - 12, bold=True)
        self.text(figure, LEFT, 0.32, text, TITLE, INK, weight="bold")
        if right:
            self.text(figure, self.width - RIGHT, 0.32, right, TITLE, colour, weight="bold", ha="right")
        for row, notes in enumerate(self.note_rows):
            left, top = LEFT, HEADING + row * NOTES
            for name, value in notes:
                self.text(figure, left, top + 0.15, value, VALUE, INK, weight="bold")
                self.text(figure, left, top + 0.30, name, LABEL, GREY)
                left += _note_width(name, value)

    def text(self, figure: Figure, left: float, top: float, text: str, size: float, colour: str, **more: Any) -> None:
        """One line of text on the page, `top` being its base line."""
        place = left / self.width, 1 - top / self.height
        figure.text(*place, text, fontsize=size, color=colour, va="baseline", parse_math=False, **more)


def lay_out(frame: Frame, notes: Mapping[str, str], panels: int, legend_widths: Sequence[float]) -> Page:
    """Compose the page: the map as large as it can be, panels below a flat map and beside any other.

    `legend_widths` are those of the key's entries, in.
    """
    flat = frame.size[1] < FLAT_ASPECT * frame.size[0]
    aspect = frame.size[1] / frame.size[0]
    beside = SIDE if panels and not flat else 0.0
    map_width = min(WIDTH - LEFT - RIGHT - beside, MAP_HEIGHT_MAX / aspect)
    width = max(MIN_WIDTH, LEFT + map_width + beside + RIGHT)
    room = width - LEFT - RIGHT
    note_rows = note_rows_of(notes, room)
    top = HEADING + len(note_rows) * NOTES + 0.08
    place = Rectangle(LEFT, top, map_width, map_width * aspect)
    legend = Rectangle(LEFT, place.bottom + UNDER_MAP, room, LEGEND * len(flow_rows(legend_widths, room)))
    height, under = legend.bottom + 0.1, None
    if panels and flat:
        under = Rectangle(LEFT, legend.bottom + 0.22, room, panels * (PANEL + PANEL_GAP) - PANEL_GAP)
        height = under.bottom + UNDER_PANELS
    elif panels:
        left = place.left + place.width + 0.5
        under = Rectangle(left, top + 0.12, width - RIGHT - left, place.height - 0.12)
    return Page(width, height, place, legend, _stacked(under, panels) if under else (), note_rows)


def flow_rows(widths: Sequence[float], room: float) -> list[list[int]]:
    """Indices of items of these widths, set in rows of at most `room`."""
    rows: list[list[int]] = []
    used = room
    for i, width in enumerate(widths):
        if not rows or used + width > room:
            rows.append([])
            used = 0.0
        rows[-1].append(i)
        used += width
    return rows


def _stacked(part: Rectangle, count: int) -> tuple[Rectangle, ...]:
    height = (part.height + PANEL_GAP) / count - PANEL_GAP
    tops = [part.top + k * (height + PANEL_GAP) for k in range(count)]
    return tuple(Rectangle(part.left, top, part.width, height) for top in tops)


def note_rows_of(notes: Mapping[str, str], room: float) -> tuple[tuple[tuple[str, str], ...], ...]:
    """Notes set in rows of at most `room` in, shortened where one alone is wider."""
    most = 72 * room
    pairs = [(shortened(k, LABEL, most), shortened(v, VALUE, most, bold=True)) for k, v in notes.items()]
    rows = flow_rows([_note_width(*pair) for pair in pairs], room + NOTE_GAP / 72)
    return tuple(tuple(pairs[i] for i in row) for row in rows)


def _note_width(name: str, value: str) -> float:
    return (max(text_width(name, LABEL), text_width(value, VALUE, bold=True)) + NOTE_GAP) / 72


@dataclass(frozen=True)
class LegendEntry:
    """One explanation; a `scale` is drawn as the colours from 0 to its largest value.

    `thickness` is that of a line or the size of dots or a ring, pt; `face` the colour within an outline.
    """

    text: str
    kind: Literal["line", "dashes", "dots", "ring", "outline", "scale"]
    colour: str = INK
    thickness: float = 1.8
    face: str = "none"
    scale: ScalarMappable | None = None

    @property
    def width(self) -> float:
        """Space it takes, in; the scale is the last in its row and needs no gap behind it."""
        sample = {"scale": BAR + 0.1, "outline": OUTLINE + GAP}.get(self.kind, SAMPLE + GAP)
        return sample + 0.08 + text_width(self.text, LABEL) / 72


def draw_legend(figure: Figure, page: Page, entries: Sequence[LegendEntry]) -> None:
    """Set the entries in rows; the scale of colours stands at the right end of its row."""
    for row, members in enumerate(flow_rows([entry.width for entry in entries], page.legend.width)):
        left, middle = page.legend.left, page.legend.top + LEGEND * row + 0.08
        for entry in (entries[i] for i in members):
            if entry.scale is not None:
                left = max(left, page.legend.left + page.legend.width - entry.width)
            _draw_entry(figure, page, entry, left, middle)
            left += entry.width


def _draw_entry(figure: Figure, page: Page, entry: LegendEntry, left: float, middle: float) -> None:
    inches, height = figure.dpi_scale_trans, page.height - middle
    if entry.kind == "scale" and entry.scale is not None:
        text_left, bar_left = left, left + text_width(entry.text, LABEL) / 72 + 0.12
        _draw_colour_bar(figure, page, entry.scale, Rectangle(bar_left, middle - BAR_HEIGHT / 2, BAR, BAR_HEIGHT))
    else:
        text_left = left + (OUTLINE if entry.kind == "outline" else SAMPLE) + 0.08
        if entry.kind == "dots":
            places = left + SAMPLE * np.array([0.15, 0.5, 0.85])
            dots: Style = {"color": entry.colour, "markersize": entry.thickness, "markeredgewidth": 0}
            figure.add_artist(Line2D(places, [height] * 3, linestyle="", marker=".", transform=inches, **dots))
        elif entry.kind == "ring":
            ring: Style = {"markeredgecolor": entry.colour, "markerfacecolor": "white", "markeredgewidth": 1.2}
            place = [left + SAMPLE / 2], [height]
            size = entry.thickness
            figure.add_artist(Line2D(*place, linestyle="", marker="o", markersize=size, transform=inches, **ring))
        elif entry.kind != "outline":
            ends = [left, left + SAMPLE], [height, height]
            line_style: Style = {"color": entry.colour, "linewidth": entry.thickness, "transform": inches}
            figure.add_artist(Line2D(*ends, linestyle=DASHED if entry.kind == "dashes" else "solid", **line_style))
        else:
            shape: Style = {"facecolor": entry.face, "edgecolor": entry.colour, "linewidth": 0.8, "transform": inches}
            figure.add_artist(Box((left, height - 0.07), OUTLINE, 0.14, **shape))
    style: Style = {"fontsize": LABEL, "color": INK, "va": "center_baseline", "transform": inches}
    figure.text(text_left, height, entry.text, **style)


def _draw_colour_bar(figure: Figure, page: Page, scale: ScalarMappable, part: Rectangle) -> None:
    axes = page.axes(figure, part)
    bar = figure.colorbar(scale, cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    axes.tick_params(labelsize=SMALL, pad=1.5, length=2)
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))


HELD: Final[Style] = {"drawstyle": "steps-post"}
"""Each value is held until the next one."""
DOTS: Final[Style] = {"linestyle": "", "marker": ".", "markersize": 2.2, "markeredgewidth": 0}
ColouredText: TypeAlias = tuple[str, str]
"""Text and its colour."""


@dataclass(frozen=True)
class Curve:
    """Values (n,) at times (n,), s; `style` are arguments of the line that matplotlib draws."""

    times: Floats
    values: Floats
    style: Style


@dataclass(frozen=True)
class Panel:
    """One quantity: its lowest and highest value, or limits from its curves.

    `band` is the half width of a band around 0 that most values are expected in.
    """

    title: tuple[ColouredText, ...]
    curves: tuple[Curve, ...]
    limits: tuple[float, float] | None = None
    band: float | None = None


def draw_panel(axes: Axes, panel: Panel, span: tuple[float, float], *, last: bool) -> None:
    """Curves over a span of time (s); ticks of the time axis only below the last panel of a stack."""
    axes.set_xlim(span)
    if panel.limits is not None:
        low, high = panel.limits
        room = 0.12 * (high - low)
        axes.set_ylim(low - room, high + room)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
    if panel.band is not None:
        axes.axhspan(-panel.band, panel.band, color=RULE, alpha=0.35, linewidth=0, zorder=0)
    axes.axhline(0.0, color=RULE, linewidth=0.6, zorder=1)
    for curve in panel.curves:
        axes.plot(curve.times, curve.values, **curve.style)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelbottom=last, bottom=last)


def draw_title(axes: Axes, title: Sequence[ColouredText]) -> None:
    """Write the title of a panel above its left edge."""
    style: Style = {"fontsize": SMALL + 0.5, "va": "bottom", "parse_math": False}
    for text, colour in title:
        axes.text(0.0, 1.03, text, transform=axes.transAxes, color=colour, **style)


def quantity(name: str) -> tuple[ColouredText, ...]:
    """Title of a panel with a single quantity."""
    return ((name, GREY),)
