"""Common parts of the pages about logs and identification: colours, captions, axes, stacked panels, floor plans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from kraft.plot.page import ColouredText, Page, Panel, Rectangle, draw_panel
from kraft.plot.style import CYCLE, GOAL, GREY, INK, LABEL, RULE, SMALL, WARNING, plain_number, text_width
from ompl_ext.arrays import Matrix

DATA: Final = "#7d8896"
FITTED: Final = INK
HELD_OUT: Final = GOAL
IDENTIFIED: Final = CYCLE  # with the identified parameters
INITIAL: Final = WARNING  # with the initial ones


def caption(figure: Figure, page: Page, part: Rectangle, words: Sequence[ColouredText]) -> None:
    """Write a caption above a part of the page, in the colours of its curves; the first text is bold."""
    left = part.left
    for k, (text, colour) in enumerate(words):
        weight = "bold" if k == 0 else "normal"
        page.text(figure, left, part.top - 0.09, text, LABEL, colour, weight=weight)
        left += (text_width(text, LABEL, bold=k == 0) + 5.5) / 72


def plain_axes(axes: Axes, *, across: int = 5, along: int = 4) -> None:
    """Few ticks, plain numbers, no frame at the top and the right."""
    axes.spines[["top", "right"]].set_visible(False)
    for axis, count in ((axes.xaxis, across), (axes.yaxis, along)):
        axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))


def draw_stack(figure: Figure, page: Page, part: Rectangle, panels: Sequence[Panel]) -> None:
    """Draw panels above each other on one time axis."""
    gap = 0.2
    height = (part.height + gap) / len(panels) - gap
    begin = min(float(curve.times[0]) for panel in panels for curve in panel.curves if len(curve.times))
    end = max(float(curve.times[-1]) for panel in panels for curve in panel.curves if len(curve.times))
    for k, panel in enumerate(panels):
        place = Rectangle(part.left, part.top + k * (height + gap), part.width, height)
        axes = page.axes(figure, place)
        plain_axes(axes, across=10, along=3)
        draw_panel(axes, panel, (begin, end), last=panel is panels[-1])
        left = place.left
        for text, colour in panel.title:
            page.text(figure, left, place.top - 0.03, text, SMALL, colour)
            left += (text_width(text, SMALL) + 6.0) / 72
    axes.set_xlabel("time, s", labelpad=1)


def draw_paths(axes: Axes, paths: Sequence[Matrix], colour: str, *, width: float = 0.9, zorder: float = 3.0) -> None:
    """Ways (n, 2) on the floor, a dot where each begins."""
    for path in paths:
        axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=width, solid_capstyle="round", zorder=zorder)
        axes.plot(*path[0, :2], ".", color=colour, markersize=4.0, markeredgewidth=0, zorder=zorder)


def set_floor_limits(axes: Axes, paths: Sequence[Matrix], part: Rectangle) -> None:
    """Limits that hold all ways with the same scale along both axes, m, and fill the part of the page."""
    points = np.concatenate([path[:, :2] for path in paths])
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 0.1) * 1.1
    scale = max(size[0] / part.width, size[1] / part.height)
    middle = (low + high) / 2
    half = 0.5 * scale * np.array([part.width, part.height])
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))
    plain_axes(axes)
    axes.set_xlabel("x, m", labelpad=1)
    axes.set_ylabel("y, m", labelpad=1)
    axes.grid(color=RULE, linewidth=0.4)
    axes.set_axisbelow(True)


def draw_message(axes: Axes, text: str) -> None:
    """Write a text in the middle of an empty part."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=LABEL, color=GREY)
