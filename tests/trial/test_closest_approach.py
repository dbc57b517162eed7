"""The smallest distance along a drive: exact, with few measurements."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kraft.planning.workspace import workspace_of
from kraft.scenario import load_scenario
from kraft.trial.closest_approach import ClosestApproach
from kraft.vehicles.load import load_vehicle
from ompl_ext.exact import ExactClearance


class Counted:
    """The exact distance in Boxes, and how often it was asked for."""

    def __init__(self) -> None:
        self.footprint = load_vehicle("mushr-drive").footprint
        self._exact = ExactClearance(workspace_of(load_scenario("boxes"), load_vehicle("mushr-drive")), self.footprint)
        self.asked = 0

    def __call__(self, x: float, y: float, theta: float) -> float:
        self.asked += 1
        return self._exact.distance(x, y, theta)


@pytest.mark.parametrize(("begin", "count", "touches"), [(1.6, 400, True), (-0.3, 60, False)])
@pytest.mark.parametrize("seed", range(5))
def test_it_is_the_smallest_of_all_distances_without_measuring_all(
    seed: int, begin: float, count: int, touches: bool
) -> None:
    rng, distance = np.random.default_rng(seed), Counted()
    approach = ClosestApproach(distance, distance.footprint.reach)
    heading = 1.4 + np.cumsum(rng.normal(0.0, 0.05, count))
    steps = 0.015 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    poses = np.column_stack([np.array([1.0, begin]) + np.cumsum(steps, axis=0), heading])
    for x, y, theta in poses:
        approach.add(float(x), float(y), float(theta))
    least, asked = approach.least(), distance.asked
    assert least == min(distance(*map(float, pose)) for pose in poses)
    assert (least == 0.0) == touches
    assert asked < 20


def test_a_turn_on_the_spot_counts() -> None:
    distance = Counted()
    approach = ClosestApproach(distance, distance.footprint.reach)
    for theta in np.linspace(0.0, 2.0 * math.pi, 60):
        approach.add(1.0, 1.75, float(theta))
    turned = [distance(1.0, 1.75, float(theta)) for theta in np.linspace(0.0, 2.0 * math.pi, 60)]
    assert approach.least() == min(turned) < max(turned)


def test_without_poses_and_without_obstacles_it_is_infinite() -> None:
    approach = ClosestApproach(lambda x, y, theta: math.inf, 0.3)
    assert approach.least() == math.inf
    approach.add(0.0, 0.0, 0.0)
    approach.add(1.0, 0.0, 0.0)
    assert approach.least() == math.inf
