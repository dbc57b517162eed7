"""Whether the newest map of a robot has something in the way of a plan that was decided without it.

The planner plans round it, but its next decision acts up to a cycle after the map has arrived.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from kraft.driving.messages import Commitment, Estimate
from kraft.robot.poses import Pose
from kraft.scenario import OccupancyMap
from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.poses import pose_of
from ompl_ext.vehicle import Footprint, Vehicle

STEP: Final = 0.05
"""Time between two poses of a motion that are compared with the map, s."""


class NewestMap:
    """The newest map that has arrived, if any has, and whether the planner has it."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._map: OccupancyMap | None = None
        self._pose = (0.0, 0.0, 0.0)  # where the vehicle was when it arrived
        self._decided_with: float = math.inf  # first cycle that the planner decides with it

    def take(self, grid: OccupancyMap, estimate: Estimate) -> None:
        """Take a map that has just arrived, with the estimate of now."""
        self._map, self._decided_with, self._pose = grid, math.inf, pose_of(estimate.state, self._vehicle)

    def hand_over(self, cycle: int) -> OccupancyMap | None:
        """Map that the planner gets before it decides `cycle` or a later one; None if it has it."""
        if self._map is None or self._decided_with < math.inf:
            return None
        self._decided_with = cycle
        return self._map

    def is_unknown_to(self, cycle: int) -> bool:
        """Whether the planner decided a cycle without the map.

        The time of the estimate of a decision does not tell it: it is ahead by the delay of commands, which the planner
        identifies before the controller learns it.
        """
        return self._map is not None and cycle < self._decided_with

    def in_the_way_of(self, commitment: Commitment, time: float) -> tuple[float, float] | None:
        """Place (m) in the map into which a commitment leads after `time` (s), until its last reference ends.

        None if there is no such place.  What the vehicle touched when the map arrived does not count: nothing would
        keep the vehicle away from that.
        """
        if self._map is None:
            return None
        footprint = self._vehicle.footprint
        for state in _states(commitment, time):
            pose = pose_of(state, self._vehicle)
            touched = _occupied_near(self._map, footprint, pose)
            touched = touched[self._touches(touched, pose) & ~self._touches(touched, self._pose)]
            if len(touched) > 0:
                return float(touched[0, 0]), float(touched[0, 1])
        return None

    def _touches(self, centres: Matrix, pose: Pose) -> Bools:
        """Whether the vehicle at a pose touches the discs that are inscribed in cells with these centres (n, 2)."""
        assert self._map is not None, "the cells are those of it"
        (x, y, heading), footprint = pose, self._vehicle.footprint
        c, s = math.cos(heading), math.sin(heading)
        ahead, left = ((centres - (x, y)) @ np.array([[c, -s], [s, c]])).T
        lengthwise = np.abs(ahead - footprint.offset) - 0.5 * footprint.length
        sideways = np.abs(left) - 0.5 * footprint.width
        touches: Bools = np.hypot(lengthwise.clip(0.0), sideways.clip(0.0)) <= 0.5 * self._map.resolution
        return touches


def _states(commitment: Commitment, begin: float) -> list[Floats]:
    """States (nx,) that a commitment has the vehicle drive through from `begin` (s) on."""
    parts = [(commitment.reference, commitment.switch)]
    if commitment.contingency is not None:
        parts.append((commitment.contingency, math.inf))
    states, time = list[Floats](), begin
    for reference, until in parts:
        end = max(time, min(reference.end, until))
        times = np.linspace(time, end, math.ceil((end - time) / STEP) + 1)
        states += [reference.state_at(each) for each in times.tolist()]
        time = end
    return states


def _occupied_near(grid: OccupancyMap, footprint: Footprint, pose: Pose) -> Matrix:
    """Centres (n, 2) of the occupied cells that the vehicle at a pose may touch, m."""
    (x, y, _), reach = pose, footprint.reach + grid.resolution
    return grid.cropped((x - reach, x + reach), (y - reach, y + reach)).occupied_centres
