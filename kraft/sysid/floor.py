"""A floor that leans, as logs of a car show it: how the change of the speed depends on the heading.

A slope accelerates a car by the same amount in one direction of the world, whatever it is commanded.  Models without it
explain this by wrong drive and friction, and nothing in their parameters tells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.sysid.log_motion import SPAN, STEP, are_of_cars, motions, sums_of
from kraft.sysid.screening import GROUP_DELAYS, driving_terms, regressed, unexplained

if TYPE_CHECKING:
    from kraft.logs.log import Log

LEAST: Final = 0.02
"""Share of the changes of the speed that the heading explains in addition, at least."""
RATIO: Final = 0.8
"""Share of what is left of them without the heading that is left with it, at most."""


def leaning_floor(logs: Sequence[Log]) -> str:
    """What the logs show of a floor that leans, with what to do; empty if they show none or are not of a car."""
    found = motions(logs) if logs and are_of_cars(logs) else []
    if not found:
        return ""
    count = round(SPAN / STEP)
    headings = [np.column_stack([np.cos(m.yaw), np.sin(m.yaw)]) for m in found]
    pull = np.concatenate([STEP * np.column_stack([sums_of(axis, count) for axis in h.T]) for h in headings])
    tried = []
    for delay in GROUP_DELAYS:
        samples = [driving_terms(m, delay) for m in found]
        terms, change = (np.concatenate(columns) for columns in zip(*samples, strict=True))
        factors, left = regressed(np.column_stack([terms, pull]), change)
        tried.append((left, unexplained(terms, change), factors[-2:]))
    left, without, (x, y) = min(tried, key=lambda each: each[0])
    if without - left < LEAST or left > RATIO * without:
        return ""
    direction = math.degrees(math.atan2(y, x))
    return (
        f"the car gains about {math.hypot(x, y):.2g} m/s^2 in the direction {direction:.0f} deg of the map, whatever "
        "is commanded: the floor leans, which this model lacks; drive on a level floor, or identify mushr-force"
    )
