"""A quantity over time: the panel that the pages about plans, runs and logs share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter

from kraft.plot.style import GREY, RULE, SMALL, Style, plain_number
from ompl_ext.arrays import Floats

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
