"""What the lines on the floor mean."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

import numpy as np
from PIL import ImageDraw

from kraft.video import palette
from kraft.video.type import font

SAMPLE: Final = 34
ROW: Final = 22
TYPE: Final = 14
Sample: TypeAlias = Callable[[ImageDraw.ImageDraw, int, int], None]


def draw_legend(
    draw: ImageDraw.ImageDraw, right: int, top: int, top_speed: float, plate: tuple[int, int, int, int]
) -> None:
    """A plate with one row for each kind of line; its right and upper edge are given, px, and the top speed, m/s."""
    rows: list[tuple[str, Sample]] = [
        ("plan", lambda d, x, y: d.line((x, y, x + SAMPLE, y), palette.PLAN, 4)),
        ("predicted", lambda d, x, y: d.rectangle((x, y - 5, x + SAMPLE, y + 5), palette.PREDICTED)),
        ("contingency", _dashes),
        ("search tree", lambda d, x, y: d.line((x, y, x + SAMPLE, y), palette.QUIET, 1)),
        (
            "believed pose",
            lambda d, x, y: d.rectangle((x, y - 6, x + SAMPLE, y + 6), outline=palette.ESTIMATE, width=2),
        ),
        (f"driven, 0 to {top_speed:.2g} m/s", _speeds),
    ]
    width = SAMPLE + 34 + int(max(font(TYPE).getlength(name) for name, _ in rows))
    left = right - width
    draw.rounded_rectangle((left, top, right, top + ROW * len(rows) + 14), 8, fill=plate)
    for row, (name, sample) in enumerate(rows):
        middle = top + 18 + ROW * row
        sample(draw, left + 12, middle)
        draw.text((left + 22 + SAMPLE, middle), name, palette.TEXT, font(TYPE), "lm")


def _dashes(draw: ImageDraw.ImageDraw, x: int, y: int) -> None:
    for k in range(3):
        draw.line((x + 13 * k, y, x + 13 * k + 7, y), palette.CONTINGENCY, 4)


def _speeds(draw: ImageDraw.ImageDraw, x: int, y: int) -> None:
    for k, shade in enumerate(palette.speed_colours(np.linspace(0.0, 1.0, SAMPLE + 1), 1.0)):
        red, green, blue = (round(255 * float(part)) for part in shade[:3])
        draw.line((x + k, y - 2, x + k, y + 2), (red, green, blue))
