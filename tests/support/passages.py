"""Passages at a given distance from an obstacle."""

from __future__ import annotations

import numpy as np

from kraft.driving.messages import Passage
from ompl_ext.obstacles import Workspace, box
from ompl_ext.vehicle import Footprint


def passage(clearance: float) -> Passage:
    """Passage with that clearance (m); one that touches with 0."""
    wall = box((0.7 + clearance if clearance > 0.0 else 0.6, 0.0), (1.0, 1.0))
    return Passage(Workspace(((-2.0, 2.0), (-2.0, 2.0)), (wall,)), Footprint(0.4, 0.2), np.zeros((1, 3)))
