"""Text over the picture: title, legend, numbers, plan or contingency, and outcome."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw

from kraft.driving.messages import ReferenceKind
from kraft.trial.result import Outcome, TrialResult, TrialSpec, outcome_text
from kraft.video.drawing import (
    BACKGROUND,
    CONTINGENCY,
    FAILURE,
    PLAN,
    SECONDARY_TEXT,
    SUCCESS,
    TEXT,
    Snapshot,
    colour,
)
from kraft.video.history import draw_history
from kraft.video.legend import TYPE, draw_legend, driven_row, plan_rows, scene_rows
from kraft.video.renderer import Image, is_turned
from kraft.video.type import font, wrapped

BAND: Final = 84
"""Height of the band at the foot, px."""
PLAN_TO_GOAL: Final = "plan to goal"
COLUMNS: Final = {"time": 96, "speed": 128, PLAN_TO_GOAL: 112, "clearance": 108}
"""Widths of the numbers in it, px."""
STATE, HISTORY, HISTORY_MIN = 232, 330, 200
"""Width of what is tracked, with the reason; largest and least width of the curve of the speed, px."""
MARGIN: Final = 16
OPACITY: Final = 0.8
TURNED: Final = "the map is turned by 90°: x points up"


class Overlay:
    """Draws over pictures of one trial."""

    def __init__(self, spec: TrialSpec, size: tuple[int, int], map_width: int, driver: str | None = None) -> None:
        """`size` is the picture's width and height, of which the map takes `map_width` at the right; px.

        `driver` names another program that drives, whose plans and estimates are not known.
        """
        self._width, self._height = size[0] - map_width, size[1]
        self._knows_plans, self._top_speed = driver is None, spec.vehicle.top_speed
        widths = [width for name, width in COLUMNS.items() if self._knows_plans or name != PLAN_TO_GOAL]
        self._state_left = MARGIN + sum(widths) + 8
        free = self._width - MARGIN - self._state_left - (STATE if self._knows_plans else 0)
        self._history_width = min(free, HISTORY) if free >= HISTORY_MIN else 0
        self._static = Pillow.new("RGBA", size, (0, 0, 0, 0))
        draw = ImageDraw.Draw(self._static)
        draw.rectangle((0, self._height - BAND, self._width - 1, self._height), fill=BACKGROUND)
        draw.rectangle((self._width - 1, 0, self._width, self._height), fill=BACKGROUND)
        if is_turned(spec.scenario.bounds):
            self._note_turn(draw, map_width)
        self._title(draw, spec.scenario.name, spec.method.title if driver is None else driver)
        plans = plan_rows() if self._knows_plans else []
        rows = [*plans, driven_row(spec.vehicle.top_speed), *scene_rows(spec.scenario)]
        draw_legend(draw, self._width - MARGIN, MARGIN, rows, _background())

    def over(self, picture: Image, past: Sequence[Snapshot], result: TrialResult | None = None) -> Image:
        """Picture with title, legend, numbers, state and speeds; with a result also the outcome.

        `past` has the snapshot that the picture shows, and those before it in the order of their times.
        """
        snapshot = past[-1]
        image = Pillow.fromarray(picture)
        image.paste(self._static, (0, 0), self._static)
        draw = ImageDraw.Draw(image)
        self._numbers(draw, snapshot)
        self._state(draw, snapshot)
        if self._history_width:
            right, foot = self._width - MARGIN, self._height - BAND
            place = right - self._history_width, foot + 8, right, self._height - 10
            draw_history(draw, place, past, self._top_speed)
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
        x = MARGIN + 4
        for name, value, unit in numbers:
            draw.text((x, foot + 27), name, SECONDARY_TEXT, font(14), "ls")
            draw.text((x, foot + 62), value, TEXT, font(28, bold=True), "ls")
            right = x + font(28, bold=True).getlength(value) + 6
            draw.text((right, foot + 62), unit, SECONDARY_TEXT, font(15), "ls")
            x += COLUMNS[name]

    def _state(self, draw: ImageDraw.ImageDraw, snapshot: Snapshot) -> None:
        """Draw plan or contingency, and the reason for it."""
        if snapshot.cycle is None:
            return
        planned = snapshot.cycle.kind is ReferenceKind.PLAN
        x, foot = self._state_left, self._height - BAND
        room = self._width - MARGIN - x - (self._history_width + MARGIN if self._history_width else 0)
        text = "PLAN" if planned else "CONTINGENCY"
        fill = PLAN if planned else CONTINGENCY
        width = font(16, bold=True).getlength(text) + 28
        top = foot + 27 if planned else foot + 6
        draw.rounded_rectangle((x, top, x + width, top + 28), 14, fill=fill)
        draw.text((x + width / 2, top + 14), text, TEXT, font(16, bold=True), "mm")
        for row, line in enumerate(wrapped(snapshot.cycle.reason, 12, room, 3)):
            draw.text((x + 2, foot + 49 + 15 * row), line, TEXT, font(12), "ls")

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
        return PLAN_TO_GOAL, "–", ""
    return PLAN_TO_GOAL, f"{max(0.0, ahead - (snapshot.time - snapshot.cycle.time)):.1f}", "s"


def outcome_caption(result: TrialResult) -> tuple[str, str]:
    """Text and colour for the outcome of a trial."""
    text = outcome_text(result.outcome, result.obstacle, result.time, digits=1)
    return text, SUCCESS if result.outcome is Outcome.SUCCESS else FAILURE


def _background() -> tuple[int, int, int, int]:
    red, green, blue, opacity = (round(255 * part) for part in colour(BACKGROUND, OPACITY))
    return red, green, blue, opacity
