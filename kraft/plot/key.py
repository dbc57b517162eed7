"""The key below the map: what the lines mean, and the scale of the tree's colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle as Box
from matplotlib.ticker import FuncFormatter, MaxNLocator

from kraft.plot.page import KEY, Page, Rectangle, flow
from kraft.plot.style import DASHED, INK, LABEL, SMALL, Look, plain_number, text_width

SAMPLE, OUTLINE, GAP = 0.28, 0.2, 0.18  # inches: samples of a line and of a footprint, space between entries
BAR, BAR_HEIGHT = 1.2, 0.09


@dataclass(frozen=True)
class Entry:
    """One explanation; a `scale` is drawn as the colours from 0 to its largest value.

    `thickness` is that of a line or the size of dots, pt.
    """

    text: str
    kind: Literal["line", "dashes", "dots", "outline", "scale"]
    colour: str = INK
    thickness: float = 1.8
    scale: ScalarMappable | None = None

    @property
    def width(self) -> float:
        """Space it takes, in; the scale is the last in its row and needs no gap behind it."""
        sample = {"scale": BAR + 0.1, "outline": OUTLINE + GAP}.get(self.kind, SAMPLE + GAP)
        return sample + 0.08 + text_width(self.text, LABEL) / 72


def draw_key(figure: Figure, page: Page, entries: Sequence[Entry]) -> None:
    """Set the entries in rows; the scale of colours stands at the right end of its row."""
    for row, members in enumerate(flow([entry.width for entry in entries], page.key.width)):
        left, middle = page.key.left, page.key.top + KEY * row + 0.08
        for entry in (entries[i] for i in members):
            if entry.scale is not None:
                left = max(left, page.key.left + page.key.width - entry.width)
            _draw_entry(figure, page, entry, left, middle)
            left += entry.width


def _draw_entry(figure: Figure, page: Page, entry: Entry, left: float, middle: float) -> None:
    inches, height = figure.dpi_scale_trans, page.height - middle
    if entry.kind == "scale" and entry.scale is not None:
        text_left, bar_left = left, left + text_width(entry.text, LABEL) / 72 + 0.12
        _draw_scale(figure, page, entry.scale, Rectangle(bar_left, middle - BAR_HEIGHT / 2, BAR, BAR_HEIGHT))
    else:
        text_left = left + (OUTLINE if entry.kind == "outline" else SAMPLE) + 0.08
        if entry.kind == "dots":
            places = left + SAMPLE * np.array([0.15, 0.5, 0.85])
            dots: Look = {"color": entry.colour, "markersize": entry.thickness, "markeredgewidth": 0}
            figure.add_artist(Line2D(places, [height] * 3, linestyle="", marker=".", transform=inches, **dots))
        elif entry.kind != "outline":
            ends = [left, left + SAMPLE], [height, height]
            look: Look = {"color": entry.colour, "linewidth": entry.thickness, "transform": inches}
            figure.add_artist(Line2D(*ends, linestyle=DASHED if entry.kind == "dashes" else "solid", **look))
        else:
            shape: Look = {"fill": False, "edgecolor": entry.colour, "linewidth": 0.8, "transform": inches}
            figure.add_artist(Box((left, height - 0.07), OUTLINE, 0.14, **shape))
    style: Look = {"fontsize": LABEL, "color": INK, "va": "center_baseline", "transform": inches}
    figure.text(text_left, height, entry.text, **style)


def _draw_scale(figure: Figure, page: Page, scale: ScalarMappable, part: Rectangle) -> None:
    axes = page.axes(figure, part)
    bar = figure.colorbar(scale, cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    axes.tick_params(labelsize=SMALL, pad=1.5, length=2)
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
