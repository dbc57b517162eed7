"""Anti-aliasing after rendering: FXAA (Lottes 2009), ten times faster than multisampling without a GPU."""

from __future__ import annotations

from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ompl_ext.jit import compiled

Image = NDArray[np.uint8]

CONTRAST: Final = 0.11
"""Contrast from which on neighbours are an edge, as a share of the brightest."""
MIN_CONTRAST: Final = 6.0
"""Contrast below which there is no edge, of 255."""
MAX_SEARCH: Final = 6.0
"""Largest distance of samples along an edge, px."""


def smoothed(image: Image) -> Image:
    """Picture, uint8 (height, width, 3), with aliased edges blurred along their direction."""
    result = image.copy()
    brightness = image @ np.array([0.299, 0.587, 0.114], np.float32)
    _filter()(image, brightness, result)
    return result


@cache
def _filter() -> Any:
    """Compiled when it is first needed."""
    return compiled(_fxaa)


def _fxaa(image: Image, luma: NDArray[np.float32], result: Image) -> None:
    height, width, _ = image.shape
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            nw, ne, sw, se = luma[i - 1, j - 1], luma[i - 1, j + 1], luma[i + 1, j - 1], luma[i + 1, j + 1]
            here = luma[i, j]
            low, high = min(nw, ne, sw, se, here), max(nw, ne, sw, se, here)
            if high - low < max(MIN_CONTRAST, CONTRAST * high):
                continue
            # along the edge: square to the gradient
            dx, dy = (sw + se) - (nw + ne), (nw + sw) - (ne + se)
            least = min(abs(dx), abs(dy)) + max(0.03125 * (nw + ne + sw + se), 2.0)
            dx, dy = max(-MAX_SEARCH, min(MAX_SEARCH, dx / least)), max(-MAX_SEARCH, min(MAX_SEARCH, dy / least))
            for k in range(3):
                near = far = 0.0
                for share in (-0.5, -1.0 / 6.0, 1.0 / 6.0, 0.5):
                    y = max(0.0, min(height - 1.001, i + share * dy))
                    x = max(0.0, min(width - 1.001, j + share * dx))
                    a, b = int(y), int(x)
                    v, u = y - a, x - b
                    upper = (1 - u) * image[a, b, k] + u * image[a, b + 1, k]
                    lower = (1 - u) * image[a + 1, b, k] + u * image[a + 1, b + 1, k]
                    value = (1 - v) * upper + v * lower
                    if abs(share) < 0.4:
                        near += 0.5 * value
                    far += 0.25 * value
                blurred = far if low <= far <= high else near
                result[i, j, k] = np.uint8(blurred + 0.5)
