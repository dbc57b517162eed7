"""Text over the picture: title, legend, numbers, plan or contingency, and outcome."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final, TypeAlias

import matplotlib
import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from kraft.driving.messages import ReferenceKind
from kraft.trial.result import Outcome, TrialResult, TrialSpec, outcome_text
from kraft.video.drawing import (
    BACKGROUND,
    CONTINGENCY,
    ESTIMATE,
    FAILURE,
    PLAN,
    PREDICTED,
    SECONDARY_TEXT,
    SUCCESS,
    TEXT,
    Snapshot,
    colour,
    speed_colours,
)
from kraft.video.renderer import Image, is_turned

BAND: Final = 84
"""Height of the band at the foot, px."""
COLUMN: Final = 118
MARGIN: Final = 16
OPACITY: Final = 0.8
TURNED: Final = "the map is turned by 90°: x points up"

SAMPLE: Final = 34
ROW: Final = 22
TYPE: Final = 14
Sample: TypeAlias = Callable[[ImageDraw.ImageDraw, int, int], None]
LegendRow: TypeAlias = tuple[str, Sample]


class Overlay:
    """Draws over pictures of one trial."""

    def __init__(self, spec: TrialSpec, size: tuple[int, int], map_width: int, driver: str | None = None) -> None:
        """`size` is the picture's width and height, of which the map takes `map_width` at the right; px.

        `driver` names another program that drives, whose plans and estimates are not known.
        """
        self._width, self._height = size[0] - map_width, size[1]
        self._knows_plans = driver is None
        self._static = Pillow.new("RGBA", size, (0, 0, 0, 0))
        draw = ImageDraw.Draw(self._static)
        draw.rectangle((0, self._height - BAND, self._width - 1, self._height), fill=BACKGROUND)
        draw.rectangle((self._width - 1, 0, self._width, self._height), fill=BACKGROUND)
        if is_turned(spec.scenario.bounds):
            self._note_turn(draw, map_width)
        self._title(draw, spec.scenario.name, spec.method.title if driver is None else driver)
        rows = legend_rows(spec.vehicle.top_speed)
        draw_legend(draw, self._width - MARGIN, MARGIN, rows if self._knows_plans else rows[-1:], _background())

    def over(self, picture: Image, snapshot: Snapshot, result: TrialResult | None = None) -> Image:
        """Picture with title, legend, numbers and state; with a result also the outcome."""
        image = Pillow.fromarray(picture)
        image.paste(self._static, (0, 0), self._static)
        draw = ImageDraw.Draw(image)
        self._numbers(draw, snapshot)
        self._state(draw, snapshot)
        if result is not None:
            self._outcome(draw, result)
        return np.asarray(image)

    def _note_turn(self, draw: ImageDraw.ImageDraw, map_width: int) -> None:
        """Say at the foot of the map how it lies."""
        middle, half = self._width + map_width / 2, font(TYPE).getlength(TURNED) / 2 + 10
        draw.rounded_rectangle((middle - half, self._height - 32, middle + half, self._height - 8), 6, _background())
        draw.text((middle, self._height - 20), TURNED, TEXT, font(TYPE), "mm")

    def _title(self, draw: ImageDraw.ImageDraw, name: str, driver: str) -> None:
        width = int(max(font(24, bold=True).getlength(name), font(15).getlength(driver))) + 28
        draw.rounded_rectangle((MARGIN, MARGIN, MARGIN + width, MARGIN + 66), 8, fill=_background())
        draw.text((MARGIN + 14, MARGIN + 30), name, TEXT, font(24, bold=True), "ls")
        draw.text((MARGIN + 14, MARGIN + 53), driver, SECONDARY_TEXT, font(15), "ls")

    def _numbers(self, draw: ImageDraw.ImageDraw, snapshot: Snapshot) -> None:
        numbers = [
            ("time", f"{snapshot.time:.1f}", "s"),
            ("speed", f"{round(snapshot.speed, 2) + 0.0:.2f}", "m/s"),
            ("clearance", f"{100 * max(snapshot.clearance, 0.0):.0f}", "cm"),
        ]
        if self._knows_plans:
            numbers.insert(2, _plan_to_goal(snapshot))
        foot = self._height - BAND
        for column, (name, value, unit) in enumerate(numbers):
            x = MARGIN + 4 + COLUMN * column
            draw.text((x, foot + 27), name, SECONDARY_TEXT, font(14), "ls")
            draw.text((x, foot + 62), value, TEXT, font(28, bold=True), "ls")
            right = x + font(28, bold=True).getlength(value) + 6
            draw.text((right, foot + 62), unit, SECONDARY_TEXT, font(15), "ls")

    def _state(self, draw: ImageDraw.ImageDraw, snapshot: Snapshot) -> None:
        """Draw plan or contingency, and the reason for it."""
        if snapshot.cycle is None:
            return
        planned = snapshot.cycle.kind is ReferenceKind.PLAN
        x, foot = MARGIN + 4 * COLUMN + 12, self._height - BAND
        text = "PLAN" if planned else "CONTINGENCY"
        fill = PLAN if planned else CONTINGENCY
        width = font(16, bold=True).getlength(text) + 28
        top = foot + 27 if planned else foot + 10
        draw.rounded_rectangle((x, top, x + width, top + 30), 15, fill=fill)
        draw.text((x + width / 2, top + 15), text, TEXT, font(16, bold=True), "mm")
        for row, line in enumerate(wrapped(snapshot.cycle.reason, 13, self._width - x - MARGIN, 2)):
            draw.text((x + 2, foot + 58 + 16 * row), line, TEXT, font(13), "ls")

    def _outcome(self, draw: ImageDraw.ImageDraw, result: TrialResult) -> None:
        text, fill = outcome_caption(result)
        middle, top = self._width / 2, 0.24 * self._height
        half = font(34, bold=True).getlength(text) / 2 + 30
        draw.rounded_rectangle((middle - half, top, middle + half, top + 70), 12, fill=fill)
        draw.text((middle, top + 35), text, TEXT, font(34, bold=True), "mm")


def _plan_to_goal(snapshot: Snapshot) -> tuple[str, str, str]:
    """Name, value and unit of the time that the plan takes to the goal."""
    ahead = snapshot.cycle.cost_to_goal if snapshot.cycle else math.inf
    if snapshot.cycle is None or not math.isfinite(ahead):
        return "plan to goal", "–", ""
    return "plan to goal", f"{max(0.0, ahead - (snapshot.time - snapshot.cycle.time)):.1f}", "s"


def outcome_caption(result: TrialResult) -> tuple[str, str]:
    """Text and colour for the outcome of a trial."""
    text = outcome_text(result.outcome, result.obstacle, result.time, digits=1)
    return text, SUCCESS if result.outcome is Outcome.SUCCESS else FAILURE


def _background() -> tuple[int, int, int, int]:
    red, green, blue, opacity = (round(255 * part) for part in colour(BACKGROUND, OPACITY))
    return red, green, blue, opacity


def legend_rows(top_speed: float) -> list[LegendRow]:
    """Names of the kinds of lines, each with how to draw a sample; that of the driven path, by speed (m/s), is last."""
    return [
        ("plan", lambda d, x, y: d.line((x, y, x + SAMPLE, y), PLAN, 4)),
        ("predicted", lambda d, x, y: d.rectangle((x, y - 5, x + SAMPLE, y + 5), PREDICTED)),
        ("contingency", _dashes),
        ("search tree", lambda d, x, y: d.line((x, y, x + SAMPLE, y), SECONDARY_TEXT, 1)),
        (
            "estimated pose",
            lambda d, x, y: d.rectangle((x, y - 6, x + SAMPLE, y + 6), outline=ESTIMATE, width=2),
        ),
        (f"driven, 0 to {top_speed:.2g} m/s", _speeds),
    ]


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


def _dashes(draw: ImageDraw.ImageDraw, x: int, y: int) -> None:
    for k in range(3):
        draw.line((x + 13 * k, y, x + 13 * k + 7, y), CONTINGENCY, 4)


def _speeds(draw: ImageDraw.ImageDraw, x: int, y: int) -> None:
    for k, shade in enumerate(speed_colours(np.linspace(0.0, 1.0, SAMPLE + 1), 1.0)):
        red, green, blue = (round(255 * float(part)) for part in shade[:3])
        draw.line((x + k, y - 2, x + k, y + 2), (red, green, blue))


@lru_cache
def font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """The font at a size in px."""
    file = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / file), size)


def wrapped(text: str, size: int, width: int, lines: int) -> list[str]:
    """The text in at most `lines` lines of at most `width` px; what does not fit is cut, with an ellipsis."""
    found: list[str] = []
    words = text.split()
    while words and len(found) < lines:
        count = next((k for k in range(len(words), 1, -1) if _fits(" ".join(words[:k]), size, width)), 1)
        found.append(" ".join(words[:count]))
        words = words[count:]
    if words or (found and not _fits(found[-1], size, width)):
        last = found[-1]
        while last and not _fits(f"{last}…", size, width):
            last = last[:-1]
        found[-1] = f"{last.rstrip()}…"
    return found


def _fits(text: str, size: int, width: int) -> bool:
    return font(size).getlength(text) <= width
