"""Curve of the true speed in the last seconds, at the foot of a film, with the times of contingencies."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Final, TypeAlias

from PIL import ImageDraw

from kraft.driving.messages import ReferenceKind
from kraft.video.drawing import CONTINGENCY, SECONDARY_TEXT, TEXT, Snapshot
from kraft.video.type import font

SHOWN: Final = 10.0
"""Time that the curve covers, s."""
TICKS: Final = 5
"""Time between the ticks of its axis, s."""
CAPTION, AXIS = 13, 12
"""Sizes of the letters of caption and axis, px."""
NAME: Final = "contingency"
GRID: Final = "#39414c"
CONTINGENCY_DARK: Final = "#6b3410"
Part: TypeAlias = tuple[int, int, int, int]
"""Left, top, right and bottom, px."""


def draw_history(draw: ImageDraw.ImageDraw, part: Part, past: Sequence[Snapshot], top_speed: float) -> None:
    """Draw the speeds of the snapshots, in the order of their times, m/s; from `SHOWN` s on the last at the right end.

    The axis has the top speed, and ends there, or at the largest speed that is shown, if that is larger.
    """
    left, top, right, bottom = part
    begin = max(past[-1].time - SHOWN, 0.0)
    shown = [snapshot for snapshot in past if snapshot.time >= begin]
    full = max(top_speed, *(abs(snapshot.speed) for snapshot in shown))
    label = font(AXIS).getlength(f"{top_speed:.2g}") + 6
    low, high = top + 24, bottom - 14
    inner = left + label

    def place(snapshot: Snapshot) -> tuple[float, float]:
        share = (snapshot.time - begin) / SHOWN
        return inner + share * (right - inner), high - abs(snapshot.speed) / full * (high - low)

    stopping = [pair for pair in itertools.pairwise(shown) if _is_contingency(pair[0])]
    for before, after in stopping:
        draw.rectangle((place(before)[0], low, place(after)[0], high), CONTINGENCY_DARK)
    for time in range(math.ceil(begin), math.floor(begin + SHOWN) + 1):
        if time % TICKS == 0:
            x = inner + (time - begin) / SHOWN * (right - inner)
            draw.line((x, high, x, high + 3), SECONDARY_TEXT)
            text = f"{time:g} s"
            half = font(AXIS).getlength(text) / 2
            draw.text((min(max(x, inner + half), right - half), bottom + 1), text, SECONDARY_TEXT, font(AXIS), "ms")
    for height, text in ((high - top_speed / full * (high - low), f"{top_speed:.2g}"), (high, "0")):
        draw.line((inner, height, right, height), GRID)
        draw.text((inner - 6, height), text, SECONDARY_TEXT, font(AXIS), "rm")
    draw.line([place(snapshot) for snapshot in shown], TEXT, 2)
    caption = f"speed in the last {SHOWN:g} s, m/s"
    draw.text((inner, top + 14), caption, SECONDARY_TEXT, font(CAPTION), "ls")
    if stopping and right - inner > font(CAPTION).getlength(f"{caption}  {NAME}"):
        draw.text((right, top + 14), NAME, CONTINGENCY, font(CAPTION), "rs")


def _is_contingency(snapshot: Snapshot) -> bool:
    """Whether the vehicle tracked a contingency at the time of a snapshot."""
    return snapshot.cycle is not None and snapshot.cycle.kind is ReferenceKind.CONTINGENCY
