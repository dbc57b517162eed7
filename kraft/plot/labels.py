"""Labels beside what they name, placed where they cover least."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from kraft.plot.page import Frame
from kraft.plot.style import (
    LABEL,
    text_width,
)
from ompl_ext.arrays import Floats

LINE_HEIGHT = 1.25 * LABEL  # pt
PAD = 3.0  # between text and frame, pt
DISTANCES = (8.0, 14.0, 22.0, 34.0, 50.0)  # from what is labelled to the label's nearest point, pt
DIRECTIONS = math.pi / 2 + np.linspace(0.0, 2 * math.pi, 16, endpoint=False)  # above first


@dataclass(frozen=True)
class Label:
    """Text for an object of a `radius` at a `place` in the world, m."""

    text: str
    place: tuple[float, float]
    colour: str
    radius: float


@dataclass(frozen=True)
class _Area:
    """A rectangle on the page, pt."""

    x: float
    y: float
    width: float
    height: float

    @property
    def middle(self) -> Floats:
        return np.array([self.x + self.width / 2, self.y + self.height / 2])

    def outside(self, page: _Area) -> float:
        """Distance by which the rectangle exceeds the page, pt."""
        return max(0.0, -self.x, -self.y, self.x + self.width - page.width, self.y + self.height - page.height)

    def overlaps(self, other: _Area) -> bool:
        return (abs(2 * (self.x - other.x) + self.width - other.width) < self.width + other.width) and (
            abs(2 * (self.y - other.y) + self.height - other.height) < self.height + other.height
        )

    def hidden_weight(self, points: Floats) -> float:
        """Sum of the weights of the covered points; points are (n, 3): x, y, weight."""
        inside = (np.abs(points[:, 0] - self.x - self.width / 2) < self.width / 2 + PAD) & (
            np.abs(points[:, 1] - self.y - self.height / 2) < self.height / 2 + PAD
        )
        return float(points[inside, 2].sum())


def draw_labels(axes: Axes, frame: Frame, labels: Sequence[Label], avoid: Floats, scale: float) -> None:
    """Place the labels one after the other.

    `avoid` (n, 3) are points that labels should not cover: x, y in m, weight.  `scale` is inches per m.
    """
    corner, to_points = np.array([frame.limits[0][0], frame.limits[1][0]]), 72 * scale
    page = _Area(0.0, 0.0, frame.size[0] * to_points, frame.size[1] * to_points)
    occupied = np.column_stack([(frame.points(avoid[:, :2]) - corner) * to_points, avoid[:, 2]])
    placed: list[_Area] = []
    for label in labels:
        anchor = (frame.points(np.array(label.place)) - corner) * to_points
        area, leader = _best_placement(label, anchor, label.radius * to_points, page, occupied, placed)
        placed.append(area)
        occupied = np.vstack([occupied, leader])
        _draw(axes, label, leader[0, :2] / to_points + corner, area.middle / to_points + corner)


def _draw(axes: Axes, label: Label, tip: Floats, middle: Floats) -> None:
    axes.annotate(
        label.text,
        xy=tuple(tip),
        xytext=tuple(middle),
        ha="center",
        va="center",
        fontsize=LABEL,
        color=label.colour,
        parse_math=False,
        zorder=9,
        bbox={"boxstyle": "round,pad=0.3", "fc": "white", "ec": label.colour, "lw": 0.7, "alpha": 0.95},
        arrowprops={"arrowstyle": "-", "color": label.colour, "lw": 0.8, "shrinkA": 0, "shrinkB": 0},
    )


def _best_placement(
    label: Label, anchor: Floats, radius: float, page: _Area, occupied: Floats, placed: Sequence[_Area]
) -> tuple[_Area, Floats]:
    """Area of a label, and weighted points (n, 3) along its leader from the labelled object on, all in pt."""
    lines = label.text.split("\n")
    width = max(text_width(line, LABEL) for line in lines) + 2 * PAD
    height = len(lines) * LINE_HEIGHT + 2 * PAD
    found: tuple[float, _Area, Floats] | None = None
    for distance in DISTANCES:
        for angle in DIRECTIONS:
            outward = np.array([math.cos(angle), math.sin(angle)])
            # as far out as its half extent reaches in this direction, so that it keeps the distance
            reach = 0.5 * min(width / max(abs(outward[0]), 1e-9), height / max(abs(outward[1]), 1e-9))
            x, y = anchor + outward * (radius + distance + reach) - np.array([width, height]) / 2
            area = _Area(float(x), float(y), width, height)
            line = anchor + outward * np.linspace(radius, radius + distance, 8)[:, None]
            leader = np.column_stack([line, np.full(len(line), 50.0)])
            penalty = area.hidden_weight(occupied) + 0.3 * distance + 100 * area.outside(page)
            penalty += sum(1000 * area.overlaps(other) + other.hidden_weight(leader) for other in placed)
            if found is None or penalty < found[0]:
                found = penalty, area, leader
    assert found is not None, "there are distances and directions to choose from"
    return found[1], found[2]
