"""What the pages about logs and identification have in common: colours, axes, and one quantity over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from kraft.plot.page import Page, Rectangle
from kraft.plot.style import CYCLE, GOAL, GREY, INK, LABEL, RULE, SMALL, WARNING, Look, plain_number, text_width
from ompl_ext.arrays import Floats, Matrix

DATA: Final = "#7d8896"
FITTED: Final = INK
HELD_OUT: Final = GOAL
AFTER: Final = CYCLE  # with the identified parameters
BEFORE: Final = WARNING  # with the initial ones
Word = tuple[str, str]
"""Text and its colour."""


@dataclass(frozen=True)
class Curve:
    """Values (n,) at times (n,), s; as dots, or held from each to the next, or joined."""

    times: Floats
    values: Floats
    colour: str
    kind: str = "line"
    width: float = 1.0


@dataclass(frozen=True)
class Panel:
    """A quantity over time, perhaps with a band to either side of 0 in which most of it is expected."""

    title: tuple[Word, ...]
    curves: tuple[Curve, ...]
    band: float | None = None


def caption(figure: Figure, page: Page, part: Rectangle, words: Sequence[Word]) -> None:
    """Say above a part of the page what it shows, in the colours it is shown in; the first words are bold."""
    left = part.left
    for k, (text, colour) in enumerate(words):
        weight = "bold" if k == 0 else "normal"
        page.text(figure, left, part.top - 0.09, text, LABEL, colour, weight=weight)
        left += (text_width(text, LABEL, bold=k == 0) + 5.5) / 72


def plain(axes: Axes, *, across: int = 5, along: int = 4) -> None:
    """Few ticks, plain numbers, no frame at the top and the right."""
    axes.spines[["top", "right"]].set_visible(False)
    for axis, count in ((axes.xaxis, across), (axes.yaxis, along)):
        axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))


def draw_stack(figure: Figure, page: Page, part: Rectangle, panels: Sequence[Panel]) -> None:
    """Panels above each other on one axis of time."""
    gap = 0.2
    height = (part.height + gap) / len(panels) - gap
    begin = min(float(curve.times[0]) for panel in panels for curve in panel.curves if len(curve.times))
    end = max(float(curve.times[-1]) for panel in panels for curve in panel.curves if len(curve.times))
    for k, panel in enumerate(panels):
        place = Rectangle(part.left, part.top + k * (height + gap), part.width, height)
        axes = page.axes(figure, place)
        _draw_panel(axes, panel)
        axes.set_xlim(begin, end)
        axes.tick_params(labelbottom=panel is panels[-1], bottom=panel is panels[-1])
        left = place.left
        for text, colour in panel.title:
            page.text(figure, left, place.top - 0.03, text, SMALL, colour)
            left += (text_width(text, SMALL) + 6.0) / 72
    axes.set_xlabel("time, s", labelpad=1)


def _draw_panel(axes: Axes, panel: Panel) -> None:
    plain(axes, across=10, along=3)
    if panel.band is not None:
        axes.axhspan(-panel.band, panel.band, color=RULE, alpha=0.35, linewidth=0, zorder=0)
    axes.axhline(0.0, color=RULE, linewidth=0.6, zorder=1)
    for curve in panel.curves:
        look: Look = {"color": curve.colour, "linewidth": curve.width}
        if curve.kind == "dots":
            look = {"color": curve.colour, "linestyle": "", "marker": ".", "markersize": 2.2, "markeredgewidth": 0}
        axes.plot(curve.times, curve.values, drawstyle="steps-post" if curve.kind == "held" else "default", **look)


def draw_ways(axes: Axes, ways: Sequence[Matrix], colour: str, *, width: float = 0.9, zorder: float = 3.0) -> None:
    """Ways (n, 2) on the floor, a dot where each begins."""
    for way in ways:
        axes.plot(way[:, 0], way[:, 1], color=colour, linewidth=width, solid_capstyle="round", zorder=zorder)
        axes.plot(*way[0, :2], ".", color=colour, markersize=4.0, markeredgewidth=0, zorder=zorder)


def fit_floor(axes: Axes, ways: Sequence[Matrix], part: Rectangle) -> None:
    """Limits that hold all ways with the same scale along both axes, m, and fill the part of the page."""
    points = np.concatenate([way[:, :2] for way in ways])
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 0.1) * 1.1
    scale = max(size[0] / part.width, size[1] / part.height)
    middle = (low + high) / 2
    half = 0.5 * scale * np.array([part.width, part.height])
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))
    plain(axes)
    axes.set_xlabel("x, m", labelpad=1)
    axes.set_ylabel("y, m", labelpad=1)
    axes.grid(color=RULE, linewidth=0.4)
    axes.set_axisbelow(True)


def note(axes: Axes, text: str) -> None:
    """Say something in the middle of an empty part."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=LABEL, color=GREY)
