"""Legend of a film: the lines that are drawn on the floor, and what stands on it in this scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Final, TypeAlias

import numpy as np
from PIL import ImageDraw

from kraft.scenario import Scenario
from kraft.simulation.appearance import COLOURS
from kraft.simulation.scene import is_wall
from kraft.video.drawing import CONTINGENCY, ESTIMATE, PLAN, PREDICTED, TEXT, TREE, speed_colours
from kraft.video.type import font

SAMPLE: Final = 34
ROW: Final = 20
TYPE: Final = 14
FLOOR: Final = "#c6c4c0"
Sample: TypeAlias = Callable[[ImageDraw.ImageDraw, int, int], None]
LegendRow: TypeAlias = tuple[str, Sample]
"""A name, and what draws its sample from the left end of its middle line, px."""


def plan_rows() -> list[LegendRow]:
    """What the vehicle plans and estimates."""
    return [
        ("plan", lambda d, x, y: d.line((x, y, x + SAMPLE, y), PLAN, 4)),
        ("predicted", lambda d, x, y: d.rectangle((x, y - 5, x + SAMPLE, y + 5), PREDICTED)),
        ("contingency", _dashes),
        ("search tree", _edges),
        ("estimated pose", lambda d, x, y: d.rectangle((x, y - 6, x + SAMPLE, y + 6), outline=ESTIMATE, width=2)),
    ]


def driven_row(top_speed: float) -> LegendRow:
    """The driven path, by speed, m/s."""
    return f"driven, 0 to {top_speed:.2g} m/s", _speeds


def scene_rows(scenario: Scenario) -> list[LegendRow]:
    """The kinds of things that this scene has; those of its truth are unknown to the planner."""
    truth, walls = scenario.truth, [is_wall(obstacle) for obstacle in scenario.obstacles]
    rows: list[tuple[bool, str, Sample]] = [
        (True, "goal", _filled(COLOURS["goal"])),
        (any(walls), "wall", _filled(COLOURS["wall"])),
        (not all(walls), "obstacle", _filled(COLOURS["obstacle"])),
        (bool(truth.movable_boxes), "box, not known", _striped(COLOURS["cardboard"], COLOURS["tape"], across=True)),
        (bool(truth.speed_bumps), "bump, not known", _striped(COLOURS["bump"], COLOURS["bump stripe"], across=False)),
        (bool(truth.friction_patches), "other friction, not known", _filled(COLOURS["ice"])),
    ]
    return [(name, sample) for is_there, name, sample in rows if is_there]


def draw_legend(
    draw: ImageDraw.ImageDraw, right: int, top: int, rows: Sequence[LegendRow], plate: tuple[int, int, int, int]
) -> None:
    """A plate with the rows; its right and upper edge are given, px."""
    width = SAMPLE + 34 + int(max(font(TYPE).getlength(name) for name, _ in rows))
    left = right - width
    draw.rounded_rectangle((left, top, right, top + ROW * len(rows) + 14), 8, fill=plate)
    for row, (name, sample) in enumerate(rows):
        middle = top + 18 + ROW * row
        sample(draw, left + 12, middle)
        draw.text((left + 22 + SAMPLE, middle), name, TEXT, font(TYPE), "lm")


def _filled(fill: str) -> Sample:
    return lambda d, x, y: d.rectangle((x, y - 6, x + SAMPLE, y + 6), fill)


def _striped(fill: str, stripe: str, *, across: bool) -> Sample:
    """A sample with the tape of a box along its middle, or with the stripes of a bump."""

    def draw(d: ImageDraw.ImageDraw, x: int, y: int) -> None:
        d.rectangle((x, y - 6, x + SAMPLE, y + 6), fill)
        parts: Iterable[tuple[int, int, int, int]] = (
            [(x, y - 1, x + SAMPLE, y + 1)]
            if across
            else [(x + 9 * k + 5, y - 6, x + 9 * k + 8, y + 6) for k in range(SAMPLE // 9)]
        )
        for part in parts:
            d.rectangle(part, stripe)

    return draw


def _edges(draw: ImageDraw.ImageDraw, x: int, y: int) -> None:
    """Edges of a tree on the floor: they are darker than it, as the plate of the legend is."""
    draw.rectangle((x, y - 6, x + SAMPLE, y + 6), FLOOR)
    for left, right in ((-4, -2), (-1, 3), (4, 0)):
        draw.line((x, y + left, x + SAMPLE, y + right), TREE, 1)


def _dashes(draw: ImageDraw.ImageDraw, x: int, y: int) -> None:
    for k in range(3):
        draw.line((x + 13 * k, y, x + 13 * k + 7, y), CONTINGENCY, 4)


def _speeds(draw: ImageDraw.ImageDraw, x: int, y: int) -> None:
    for k, shade in enumerate(speed_colours(np.linspace(0.0, 1.0, SAMPLE + 1), 1.0)):
        red, green, blue = (round(255 * float(part)) for part in shade[:3])
        draw.line((x + k, y - 2, x + k, y + 2), (red, green, blue))
