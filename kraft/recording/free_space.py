"""Free space of a scenario, and starts from which a manoeuvre is predicted to stay in it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from kraft.driving.vehicle_model import VehicleModel
from kraft.planning.workspace import workspace_of
from kraft.recording.manoeuvres import Manoeuvre
from kraft.scenario import Box, Scenario, Start
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.exact import ExactClearance
from ompl_ext.vehicle import Vehicle

STEP: Final = 0.1
"""Time between two predicted poses, s."""
CANDIDATES: Final = 300
"""Number of starts that are tried: the first that is free for the whole manoeuvre, else the one free for longest."""
MARGIN: Final = 0.25
"""Required clearance at the start, m."""
MARGIN_PER_METRE: Final = 0.1
"""Additional clearance for each metre driven, because the car deviates from its model."""


@dataclass(frozen=True)
class Place:
    """Start of a run, and the time for which the manoeuvre is predicted to have the required clearance, s."""

    start: Start
    time: float


class FreeSpace:
    """Floor of a scenario without its obstacles, its movable boxes and what is outside its bounds."""

    def __init__(self, scenario: Scenario, vehicle: Vehicle) -> None:
        boxes = tuple(Box(box.center, box.size[:2], box.yaw) for box in scenario.truth.movable_boxes)
        task = replace(scenario.task(), obstacles=scenario.obstacles + boxes)
        self._bounds = scenario.bounds
        self._exact = ExactClearance(workspace_of(task, vehicle), vehicle.footprint)

    def clearance(self, x: float, y: float, theta: float) -> float:
        """Distance of the footprint to the nearest obstacle or bound, m."""
        return self._exact.distance(x, y, theta)

    def place(self, path: Matrix, generator: np.random.Generator) -> Place:
        """Choose the start of a predicted path of poses (m, 3) from the origin, `STEP` apart."""
        travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
        required = MARGIN + MARGIN_PER_METRE * travelled
        (x0, x1), (y0, y1) = self._bounds.x, self._bounds.y
        best = Place(Start(0.0, 0.0, 0.0), -1.0)
        for _ in range(CANDIDATES):
            x, y, heading = map(float, generator.uniform((x0, y0, -math.pi), (x1, y1, math.pi)))
            start = Start(x, y, heading)
            time = self._free_time(moved(path, start), required, best.time)
            if time > best.time:
                best = Place(start, time)
            if time >= STEP * (len(path) - 1):
                break
        return best

    def _free_time(self, poses: Matrix, required: Floats, known: float) -> float:
        """Time for which poses keep the required clearance, s; `known` if the bounds make it no longer than that."""
        (x0, x1), (y0, y1) = self._bounds.x, self._bounds.y
        x, y = poses[:, 0], poses[:, 1]
        outside = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y)) < required
        inside = int(np.argmax(outside)) if outside.any() else len(poses)
        if STEP * (inside - 1) <= known:
            return known
        for k in range(inside):
            if self._exact.distance(*map(float, poses[k])) < required[k]:
                return STEP * (k - 1)
        return STEP * (inside - 1)


def predicted(model: VehicleModel, manoeuvre: Manoeuvre) -> Matrix:
    """Poses (m, 3) from the origin, `STEP` apart, predicted by the model."""
    state = np.zeros(len(model.vehicle.state))
    poses = [(0.0, 0.0, 0.0)]
    for k in range(round(manoeuvre.end / STEP)):
        state = model.advance(state, manoeuvre.control_at((k + 0.5) * STEP), STEP)
        poses.append((float(state[model.x]), float(state[model.y]), float(state[model.theta])))
    return np.array(poses)


def moved(path: Matrix, start: Start) -> Matrix:
    """Path from the origin moved to a start, (m, 3)."""
    c, s = math.cos(start.heading), math.sin(start.heading)
    x, y, theta = path.T
    return np.column_stack([start.x + c * x - s * y, start.y + s * x + c * y, start.heading + theta])
