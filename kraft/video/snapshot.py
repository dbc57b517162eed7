"""Snapshots of a trial for pictures: truth, estimate and cycle at one time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kraft.driving.messages import Cycle, as_driven
from kraft.planning.workspace import poses_of, workspace_of
from kraft.simulation.true_world import TrueWorld
from kraft.trial.measures import Step
from kraft.trial.result import TrialSpec
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.exact import ExactClearance

TRAIL_SPACING = 0.04
"""Distance between the points of the trail, m."""


@dataclass(frozen=True)
class Snapshot:
    """State of a trial at one time: truth, estimate and current cycle.

    Poses are x, y (m) and heading (rad).  `trail` (n, 3) are x, y and speed (m/s) of where the car has been;
    `clearance` is the true distance of its footprint to the nearest obstacle, m.
    """

    time: float
    pose: Floats
    speed: float
    estimate: Floats
    clearance: float
    cycle: Cycle | None
    trail: Matrix


class SnapshotRecorder:
    """Makes snapshots from the callbacks of `run_trial`."""

    def __init__(self, spec: TrialSpec) -> None:
        self._vehicle = spec.vehicle
        self._exact = ExactClearance(workspace_of(spec.scenario.task(), spec.vehicle), spec.vehicle.footprint)
        self._cycles: list[Cycle] = []
        self._committed: list[Cycle] = []
        self._cycle: Cycle | None = None
        self._trail: list[tuple[float, float, float]] = []
        self._estimate: Floats = np.zeros(3)

    def on_cycle(self, cycle: Cycle) -> None:
        """Record a cycle; snapshots contain it from its start on."""
        self._cycles.append(cycle)
        self._committed.append(as_driven(self._cycles)[-1])

    def on_step(self, world: TrueWorld, step: Step) -> Snapshot:
        """Record a tick of the controller and return the snapshot at it."""
        self._estimate = poses_of(step.estimate[None, :], self._vehicle)[0]
        return self.now(world)

    def now(self, world: TrueWorld) -> Snapshot:
        """Snapshot of the world as it is; the estimate is that of the last tick."""
        while self._committed and self._committed[0].time <= world.time + 1e-9:
            self._cycle = self._committed.pop(0)
        x, y, theta = map(float, world.pose)
        here = (x, y, world.speed)
        if not self._trail or np.hypot(x - self._trail[-1][0], y - self._trail[-1][1]) >= TRAIL_SPACING:
            self._trail.append(here)
        return Snapshot(
            time=world.time,
            pose=np.array([x, y, theta]),
            speed=world.speed,
            estimate=self._estimate,
            clearance=self._exact.distance(x, y, theta),
            cycle=self._cycle,
            trail=np.array([*self._trail, here]),
        )
