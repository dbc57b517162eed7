"""Common style of all pictures: colours that differ in lightness and hue, type sizes, and the output files."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final, TypeAlias

import matplotlib
import numpy as np
from matplotlib import style
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath
from PIL import Image

from kraft.errors import InputError
from kraft.files import check_all, check_writable, write_whole

INK: Final = "#16181d"
GREY: Final = "#667080"
RULE: Final = "#c9ced6"
SOLID: Final = "#b8bcc8"  # obstacles
SOLID_EDGE: Final = "#7b8390"
OUTSIDE: Final = "#ececf0"
CYCLE: Final = "#0072b2"  # what is being executed
WARNING: Final = "#d55e00"  # what keeps it safe
CYCLE_FAINT: Final = "#e4f0f8"
CYCLE_PALE: Final = "#cce4f4"
WARNING_PALE: Final = "#fcdcc4"
GOAL: Final = "#009e73"
GOAL_PALE: Final = "#b4e0d4"
GOAL_HALF: Final = "#50bc9c"
Style: TypeAlias = dict[str, Any]  # arguments of matplotlib's artists
Dashes: TypeAlias = tuple[float, tuple[float, ...]]
DASHED: Final[Dashes] = (0, (2.4, 0.9))  # what would happen instead

TITLE, VALUE, LABEL, SMALL, TINY = 13.0, 10.5, 8.0, 7.0, 4.5  # type sizes, pt

SETTINGS: Final[dict[str, Any]] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same glyphs everywhere
    "font.size": LABEL,
    "axes.edgecolor": GREY,
    "axes.labelcolor": GREY,
    "axes.linewidth": 0.6,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "svg.hashsalt": "kraft",  # otherwise each SVG would have other identifiers
}

FORMATS: Final = (".png", ".svg", ".pdf")
PNG_WIDTH: Final = 1600
PRINT_DPI: Final = 300  # of what is drawn as pixels inside a vector picture

_UNDATED: Final = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


@contextmanager
def plot_style() -> Iterator[None]:
    """Draw with these settings alone, independent of the user's matplotlibrc, and restore the settings afterwards."""
    with style.context(SETTINGS, after_reset=True):
        yield


def cost_colours() -> ListedColormap:
    """Viridis without its ends and paler, so that the plan stands out."""
    colours = matplotlib.colormaps["viridis"](np.linspace(0.08, 0.95, 256))[:, :3]
    return ListedColormap(0.8 * colours + 0.2, name="cost-to-come")


def plain_number(value: float) -> str:
    """A number for a tick: three digits, no trailing zeros, a true minus sign; thousands without a power of ten."""
    text = f"{value:,.0f}" if 999.5 <= abs(value) < 1e6 else f"{value + 0.0:.3g}"
    return text.replace("-", "\N{MINUS SIGN}")


@lru_cache(maxsize=1024)
def text_width(text: str, size: float, *, bold: bool = False) -> float:
    """Width of a line of text of `size` pt, in pt."""
    if not text.strip():
        return 0.0
    weight = "bold" if bold else "normal"
    properties = FontProperties(family="DejaVu Sans", weight=weight)
    escaped = text.replace("$", r"\$")  # a TextPath always parses mathematics
    return float(np.ptp(TextPath((0, 0), escaped, size=size, prop=properties).vertices[:, 0]))


def shortened(text: str, size: float, width: float, *, bold: bool = False) -> str:
    """The text on one line, cut where it would be wider than `width` pt: between words, if that leaves half of it."""
    line = " ".join(text.split())
    if text_width(line, size, bold=bold) <= width:
        return line
    fits, too_long = 0, len(line)
    while too_long - fits > 1:
        middle = (fits + too_long) // 2
        wide = text_width(line[:middle].rstrip() + "…", size, bold=bold) > width
        fits, too_long = (fits, middle) if wide else (middle, too_long)
    between = line.rfind(" ", 0, fits + 1)
    return line[: between if 2 * between >= fits else fits].rstrip(" ,;:") + "…"


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


def check_picture(path: Path) -> None:
    """Check before the work that a picture can be written.

    Raises:
        InputError: if no picture is made with the suffix of its path, and if nothing can be written there.
    """
    check_all(partial(picture_format, path), partial(check_writable, path))


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
    """PNG with colours rounded to steps of 4 of 255, which halves its size without a visible difference."""
    dpi = PNG_WIDTH / figure.get_figwidth()
    raw = io.BytesIO()
    figure.savefig(raw, format="png", dpi=dpi, facecolor="white", pil_kwargs={"compress_level": 0})
    exact = np.asarray(Image.open(raw).convert("RGB"), dtype=np.int16)
    rounded = np.minimum((exact + 2) // 4 * 4, 255).astype(np.uint8)
    Image.fromarray(rounded).save(content, "PNG", optimize=True, dpi=(dpi, dpi))
