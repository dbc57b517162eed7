"""Text in pictures of a film: the font, and lines of a width."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import matplotlib
from PIL import ImageFont


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
