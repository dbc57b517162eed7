"""The page: how large it is and where map, panels, heading and key stand on it.  Lengths in inches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from kraft.plot.frame import Frame
from kraft.plot.style import GREY, INK, LABEL, TITLE, VALUE, WARNING, shortened, text_width

WIDTH = 9.0
LEFT, RIGHT = 0.55, 0.2
HEAD, NOTES, KEY = 0.48, 0.42, 0.3  # title; a row of notes; a row of the key
UNDER_MAP, UNDER_PANELS = 0.45, 0.42
PANEL, PANEL_GAP = 0.55, 0.2
MAP_HEIGHT_MAX = 5.6
FLAT = 0.6  # a map flatter than this has the panels below it, any other beside it
SIDE = 2.9  # panels beside the map and the space between
NARROWEST = 5.0
NOTE_GAP = 20.0  # between notes, pt


@dataclass(frozen=True)
class Rectangle:
    """A part of the page; `top` counts from the page's top."""

    left: float
    top: float
    width: float
    height: float

    @property
    def bottom(self) -> float:
        """Distance of its lower edge from the page's top."""
        return self.top + self.height


@dataclass(frozen=True)
class Page:
    """Where everything stands."""

    width: float
    height: float
    map: Rectangle
    key: Rectangle
    panels: tuple[Rectangle, ...]
    note_rows: tuple[tuple[tuple[str, str], ...], ...]

    def axes(self, figure: Figure, part: Rectangle) -> Axes:
        """Axes that fill a part of the page."""
        bottom = self.height - part.top - part.height
        box = (part.left / self.width, bottom / self.height, part.width / self.width, part.height / self.height)
        return figure.add_axes(box)

    def heading(self, figure: Figure, title: str, warning: str | None) -> None:
        """Title, what is wrong with the plan, and the notes."""
        room = 72 * (self.width - LEFT - RIGHT)
        alarm = "" if warning is None else warning
        text = shortened(title, TITLE, room - text_width(alarm, TITLE, bold=True) - 12, bold=True)
        self.text(figure, LEFT, 0.32, text, TITLE, INK, weight="bold")
        if alarm:
            self.text(figure, self.width - RIGHT, 0.32, alarm, TITLE, WARNING, weight="bold", ha="right")
        for row, notes in enumerate(self.note_rows):
            left, top = LEFT, HEAD + row * NOTES
            for name, value in notes:
                self.text(figure, left, top + 0.15, value, VALUE, INK, weight="bold")
                self.text(figure, left, top + 0.30, name, LABEL, GREY)
                left += _note_width(name, value)

    def text(self, figure: Figure, left: float, top: float, text: str, size: float, colour: str, **more: Any) -> None:
        """One line of text on the page, `top` being its base line."""
        place = left / self.width, 1 - top / self.height
        figure.text(*place, text, fontsize=size, color=colour, va="baseline", parse_math=False, **more)


def lay_out(frame: Frame, notes: Mapping[str, str], panels: int, key_widths: Sequence[float]) -> Page:
    """Compose the page: the map as large as it can be, panels below a flat map and beside any other.

    `key_widths` are those of the key's entries, in.
    """
    flat = frame.size[1] < FLAT * frame.size[0]
    aspect = frame.size[1] / frame.size[0]
    beside = SIDE if panels and not flat else 0.0
    map_width = min(WIDTH - LEFT - RIGHT - beside, MAP_HEIGHT_MAX / aspect)
    width = max(NARROWEST, LEFT + map_width + beside + RIGHT)
    room = width - LEFT - RIGHT
    note_rows = note_rows_of(notes, room)
    top = HEAD + len(note_rows) * NOTES + 0.08
    place = Rectangle(LEFT, top, map_width, map_width * aspect)
    key = Rectangle(LEFT, place.bottom + UNDER_MAP, room, KEY * len(flow(key_widths, room)))
    height, under = key.bottom + 0.1, None
    if panels and flat:
        under = Rectangle(LEFT, key.bottom + 0.22, room, panels * (PANEL + PANEL_GAP) - PANEL_GAP)
        height = under.bottom + UNDER_PANELS
    elif panels:
        left = place.left + place.width + 0.5
        under = Rectangle(left, top + 0.12, width - RIGHT - left, place.height - 0.12)
    return Page(width, height, place, key, _stacked(under, panels) if under else (), note_rows)


def flow(widths: Sequence[float], room: float) -> list[list[int]]:
    """Indices of items of these widths, set in rows of at most `room`."""
    rows: list[list[int]] = []
    used = room
    for i, width in enumerate(widths):
        if not rows or used + width > room:
            rows.append([])
            used = 0.0
        rows[-1].append(i)
        used += width
    return rows


def _stacked(part: Rectangle, count: int) -> tuple[Rectangle, ...]:
    height = (part.height + PANEL_GAP) / count - PANEL_GAP
    tops = [part.top + k * (height + PANEL_GAP) for k in range(count)]
    return tuple(Rectangle(part.left, top, part.width, height) for top in tops)


def note_rows_of(notes: Mapping[str, str], room: float) -> tuple[tuple[tuple[str, str], ...], ...]:
    """Notes set in rows of at most `room` in, shortened where one alone is wider."""
    most = 72 * room
    pairs = [(shortened(k, LABEL, most), shortened(v, VALUE, most, bold=True)) for k, v in notes.items()]
    rows = flow([_note_width(*pair) for pair in pairs], room + NOTE_GAP / 72)
    return tuple(tuple(pairs[i] for i in row) for row in rows)


def _note_width(name: str, value: str) -> float:
    return (max(text_width(name, LABEL), text_width(value, VALUE, bold=True)) + NOTE_GAP) / 72
