"""Colours of videos, the same as in the plots for the same meaning."""

from __future__ import annotations

from typing import Final, TypeAlias

import matplotlib
import numpy as np
from matplotlib.colors import to_rgb

from kraft.plot.style import CYCLE, GOAL, WARNING
from ompl_ext.arrays import Floats, Matrix

Colour: TypeAlias = tuple[float, float, float, float]
"""Red, green, blue and opacity, 0 to 1."""


def colour(name: str, opacity: float = 1.0) -> Colour:
    """A colour by its code, #rrggbb."""
    red, green, blue = to_rgb(name)
    return red, green, blue, opacity


PLAN: Final = CYCLE
PREDICTED: Final = "#a9d3ee"
CONTINGENCY: Final = WARNING
CONTINGENCY_PALE: Final = "#f6cba8"
TREE: Final = "#44546c"
ESTIMATE: Final = "#a3178f"
SUCCESS: Final = GOAL
FAILURE: Final = "#c1121f"

BACKGROUND: Final = "#14171c"
TEXT: Final = "#ffffff"
SECONDARY_TEXT: Final = "#b9c2cf"


def speed_colours(speeds: Floats, top: float) -> Matrix:
    """Colours (n, 4) of speeds (n,): from standstill to `top` m/s, backwards like forwards."""
    scale = matplotlib.colormaps["viridis"]
    coloured: Matrix = scale(0.85 * np.clip(np.abs(speeds) / top, 0.0, 1.0))
    return coloured
