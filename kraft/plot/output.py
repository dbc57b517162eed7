"""Writing a picture: the format follows from the suffix, the bytes from the content, and it is whole or not there."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from kraft.errors import InputError
from kraft.files import write_whole

FORMATS: Final = (".png", ".svg", ".pdf")
PNG_WIDTH: Final = 1600
PRINT_DPI: Final = 300  # of what is drawn as pixels inside a vector picture

_UNDATED: Final = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


def picture_format(path: Path) -> str:
    """Suffix of a picture's path, in lower case.

    Raises:
        InputError: if no picture is made with this suffix.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        problem = f"ends in {path.suffix!r}" if path.suffix else "has no suffix"
        raise InputError.of(str(path), f"the picture's name {problem}", f"expected {', '.join(FORMATS)}")
    return suffix


def write_picture(path: Path, figure: Figure) -> None:
    """Render the figure and put it at `path` in one step, in place of what is there.

    Raises:
        InputError: if the suffix is not known or the file cannot be written.
    """
    suffix = picture_format(path)
    content = io.BytesIO()
    if suffix == ".png":
        _render_pixels(figure, content)
    else:
        figure.savefig(content, format=suffix[1:], dpi=PRINT_DPI, metadata=_UNDATED[suffix], facecolor="white")
    write_whole(path, content.getvalue())


def _render_pixels(figure: Figure, content: io.BytesIO) -> None:
    """PNG in colours rounded to steps of 4 of 255: half the size, and the eye sees no difference."""
    dpi = PNG_WIDTH / figure.get_figwidth()
    raw = io.BytesIO()
    figure.savefig(raw, format="png", dpi=dpi, facecolor="white", pil_kwargs={"compress_level": 0})
    exact = np.asarray(Image.open(raw).convert("RGB"), dtype=np.int16)
    rounded = np.minimum((exact + 2) // 4 * 4, 255).astype(np.uint8)
    Image.fromarray(rounded).save(content, "PNG", optimize=True, dpi=(dpi, dpi))
