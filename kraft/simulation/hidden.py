"""Outlines of what a scenario hides from the planner, for pictures of a trial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from kraft.scenario import Box, Scenario
from ompl_ext.arrays import Matrix


@dataclass(frozen=True)
class HiddenFeature:
    """Outline (n, 2) of a hidden feature in the map's frame, m."""

    kind: Literal["patch", "bump", "box"]
    corners: Matrix


def hidden_features(scenario: Scenario, movable_poses: Matrix | None = None) -> list[HiddenFeature]:
    """Patches, bumps and movable boxes; boxes are at `movable_poses` (n, 3), m and rad, or at their initial poses."""
    truth = scenario.truth
    found = [
        HiddenFeature("patch", np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]))
        for (x0, x1), (y0, y1) in ((patch.x, patch.y) for patch in truth.friction_patches)
    ]
    found += [HiddenFeature("bump", _corners(Box(bump.center, bump.size, bump.yaw))) for bump in truth.speed_bumps]
    for i, box in enumerate(truth.movable_boxes):
        x, y, yaw = (*box.center, box.yaw) if movable_poses is None else map(float, movable_poses[i])
        found.append(HiddenFeature("box", _corners(Box((x, y), box.size[:2], yaw))))
    return found


def _corners(box: Box) -> Matrix:
    return np.array(box.corners)
