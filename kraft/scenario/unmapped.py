"""Parts of the bounds that no occupancy map covers: nothing is known there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from kraft.config.schema import LENGTH_MIN
from kraft.scenario.geometry import OccupancyMap, Polygon, signed_area
from kraft.scenario.scenario import Task
from kraft.scenario.schema import Bounds

Corners = NDArray[np.float64]
"""Corners (n, 2) of a convex polygon, anticlockwise, m."""


def unmapped(bounds: Bounds, maps: Sequence[OccupancyMap], height: float) -> tuple[Polygon, ...]:
    """Disjoint convex obstacles of `height` m that cover what is inside the bounds and outside of all maps.

    Parts narrower than the shortest length of a scenario are left out: rounded bounds exceed their map a little.
    """
    (x0, x1), (y0, y1) = bounds.x, bounds.y
    parts = [np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])]
    for each in maps:
        parts = [rest for part in parts for rest in _without(part, each.corners)]
    names = [f"outside the map {k}" for k in range(1, len(parts) + 1)]
    return tuple(
        Polygon(tuple((float(x), float(y)) for x, y in part), height, name)
        for part, name in zip(parts, names, strict=True)
    )


def unstated_outside(task: Task) -> str:
    """What to say of bounds that reach beyond the maps of a scenario that does not state what is there; else empty."""
    maps = [each for each in task.obstacles if isinstance(each, OccupancyMap)]
    stated = any(each.states_outside for each in maps)
    parts = () if stated or not maps else unmapped(task.bounds, maps, 0.2)
    if not parts:
        return ""
    (x0, x1), (y0, y1) = task.bounds.x, task.bounds.y
    share = sum(signed_area(np.array(each.vertices)) for each in parts) / ((x1 - x0) * (y1 - y0))
    return (
        f"{max(share, 0.01):.0%} of the bounds are outside the map and count as free; expected `outside: occupied` "
        "beside its file, because nothing is known there, or `outside: free` if the map is one obstacle among others"
    )


def _without(part: Corners, hole: Corners) -> Iterator[Corners]:
    """Convex parts of one convex polygon outside of another one."""
    for one, other in zip(hole, np.roll(hole, -1, axis=0), strict=True):
        outside = _cut(part, other, one)
        if _width(outside) >= LENGTH_MIN:
            yield outside
        part = _cut(part, one, other)
        if len(part) == 0:
            return


def _cut(part: Corners, one: Corners, other: Corners) -> Corners:
    """Part of a convex polygon to the left of the line from `one` to `other` (2,); empty if there is none."""
    along, following = other - one, np.roll(part, -1, axis=0)
    left = along[0] * (part[:, 1] - one[1]) - along[1] * (part[:, 0] - one[0])
    found = []
    for corner, after, here, there in zip(part, following, left, np.roll(left, -1), strict=True):
        if here >= 0.0:
            found.append(corner)
        if here * there < 0.0:
            found.append(corner + here / (here - there) * (after - corner))
    kept = [corner for corner, last in zip(found, found[-1:] + found, strict=False) if _are_apart(corner, last)]
    return np.array(kept).reshape(-1, 2) if len(kept) > 2 else np.empty((0, 2))


def _are_apart(one: Corners, other: Corners) -> bool:
    return bool(np.linalg.norm(one - other) >= LENGTH_MIN)


def _width(part: Corners) -> float:
    """Least distance (m) of two parallel lines that hold a convex polygon between them; 0 without corners."""
    widths = []
    for one, other in zip(part, np.roll(part, -1, axis=0), strict=True):
        along, to = (other - one) / np.linalg.norm(other - one), part - one
        widths.append(float(np.max(along[0] * to[:, 1] - along[1] * to[:, 0])))
    return min(widths, default=0.0)
