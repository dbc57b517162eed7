"""OpenCV, which only rendered sensing needs, and the tag that both its pictures and its detector know."""

from __future__ import annotations

import importlib
from typing import Any, Final

from kraft.errors import MissingDependency
from ompl_ext.arrays import Matrix

PURPOSE: Final = "sensing.preset rendered"
DICTIONARY: Final = "DICT_4X4_50"


def opencv() -> Any:
    """The module.

    Raises:
        MissingDependency: if it is not installed, does not load or lacks the detector of tags.
    """
    try:
        cv2 = importlib.import_module("cv2")
        cv2.aruco.ArucoDetector  # noqa: B018 - builds of OpenCV may lack it
    except (ImportError, OSError, AttributeError) as error:
        problem = f"{PURPOSE} needs OpenCV with its detector of ArUco tags ({error})"
        raise MissingDependency(f"{problem}; pip install 'kraft[vision]'") from None
    return cv2


def dictionary() -> Any:
    """Dictionary of the tag; the car has number 0."""
    aruco = opencv().aruco
    return aruco.getPredefinedDictionary(getattr(aruco, DICTIONARY))


def tag_cells() -> Matrix:
    """Cells (n, n) of the tag with its black border, 1 for white, its picture's first row first."""
    words = dictionary()
    cells: Matrix = (opencv().aruco.generateImageMarker(words, 0, words.markerSize + 2) > 127).astype(float)
    return cells
