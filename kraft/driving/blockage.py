"""Blockage: a vehicle that does not move though it is on a plan, because of something that the map does not have.

A box that gave way for a while and now stands against a wall, a doorstep, a cable: the plan is free of obstacles on
the map, and the vehicle pushes without effect.  What is in front of it then counts as an obstacle, so that the next
plans lead round it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from kraft.driving.messages import Reference, ReferenceKind
from ompl_ext.arrays import Floats
from ompl_ext.obstacles import Polygon, box
from ompl_ext.poses import pose_of
from ompl_ext.vehicle import Vehicle

MOVED: Final = (0.06, 0.15)
"""Distance (m) and turn (rad) that show that a vehicle moves: more than the error of an estimate at rest."""
INTENDED: Final = 0.2
"""Travel that plans intended, ahead less backwards, below which a vehicle that stands is not blocked, m.

It becomes less with the time for which the vehicle stands: one that seems to have a weak drive, because it does not
move, has plans that hardly intend to move.
"""
DOUBT: Final = 1.0
"""Intended speed per standard deviation of the drive's acceleration that a wrong model alone may intend, s.

It is what two standard deviations cause in half a second: a drive that is so uncertain may be too weak to move.
"""
GAP: Final = 0.1
"""Distance between the vehicle and what it cannot push, m."""
DEPTH: Final = 0.2
"""Length of what it cannot push, m."""


@dataclass(frozen=True)
class Blocked:
    """The `obstacle` that has held a vehicle since `begin` (s)."""

    obstacle: Polygon
    begin: float


class Blockage:
    """Counts the time for which a vehicle is on a plan without moving."""

    def __init__(self, patience: float, vehicle: Vehicle) -> None:
        """`patience` is the time after which a vehicle counts as blocked, s; see `doubt`."""
        self._patience, self._vehicle = patience, vehicle
        self._place: tuple[float, float, float] | None = None
        self._begin = self._since = self._on_plan = self._intended = 0.0

    def doubt(self) -> None:
        """Wait twice as long from now on: no way led round what was found, which may be no obstacle at all."""
        self._patience *= 2.0

    def observe(self, time: float, state: Floats, reference: Reference, acceleration: float = 0.0) -> Blocked | None:
        """What blocks a vehicle with an estimated state (nx,) that tracks `reference` at `time` (s), if it is blocked.

        `acceleration` is the standard deviation of that of the drive, m/s^2; see `DOUBT`.
        The obstacle is where the plans led in the mean, ahead or behind.  Where that is nowhere, the vehicle drives to
        and fro in a narrow place.
        """
        pose, elapsed = pose_of(state, self._vehicle), time - self._since
        self._since = time
        if self._place is None or _has_moved(self._place, pose):
            self._place, self._begin, self._on_plan, self._intended = pose, time, 0.0, 0.0
        elif reference.kind is ReferenceKind.PLAN:
            self._on_plan += elapsed
            self._intended += elapsed * self._intended_speed(reference, time)
        least = max(
            MOVED[0],
            INTENDED * self._patience / max(self._on_plan, self._patience),
            DOUBT * acceleration * self._on_plan,
        )
        if self._on_plan < self._patience or abs(self._intended) < least:
            return None
        self._place = None
        return Blocked(self._obstacle(pose, math.copysign(1.0, self._intended)), self._begin)

    def _intended_speed(self, reference: Reference, time: float) -> float:
        """Mean speed of a reference in the next second, along the heading at its beginning, m/s."""
        x, y, theta = pose_of(reference.state_at(time), self._vehicle)
        after = pose_of(reference.state_at(time + 1.0), self._vehicle)
        return (after[0] - x) * math.cos(theta) + (after[1] - y) * math.sin(theta)

    def _obstacle(self, pose: tuple[float, float, float], direction: float) -> Polygon:
        shape, (x, y, theta) = self._vehicle.footprint, pose
        ahead = shape.offset + direction * (0.5 * shape.length + GAP + 0.5 * DEPTH)
        center = x + ahead * math.cos(theta), y + ahead * math.sin(theta)
        return box(center, (DEPTH, shape.width), theta)


def _has_moved(before: tuple[float, float, float], now: tuple[float, float, float]) -> bool:
    turned = abs(math.remainder(now[2] - before[2], math.tau))
    return math.dist(before[:2], now[:2]) > MOVED[0] or turned > MOVED[1]
