"""Path following without time: a PID on the direction to a lookahead point, a baseline of the paper."""

from __future__ import annotations

import math
from typing import Final

from kraft.driving.car_model import CarModel
from kraft.driving.control.path import SPACING, Path, PathTracker, Projection
from kraft.driving.control_settings import Geometric
from kraft.driving.messages import Estimate, Reference, ReferenceKind
from ompl_ext.arrays import Floats

INTEGRAL_LIMIT: Final = 0.5
"""Limit of the integral part, as a share of the largest steering (anti-windup)."""
DERIVATIVE_TIME_CONSTANT: Final = 0.25
"""Time constant of the filtered derivative, s; with the gains of the paper's authors also that of the response."""


class GeometricController:
    """Steers to the point `lookahead` m beyond the nearest one; the throttle grows with the distance to that point."""

    def __init__(self, settings: Geometric, model: CarModel) -> None:
        self._settings, self._model = settings, model
        self._tracker = PathTracker(model, 0.0, settings.window)
        self._integral_limit = INTEGRAL_LIMIT * float(min(-model.low[model.steering], model.high[model.steering]))
        self._integral = 0.0
        self._filtered_error = 0.0
        self._time: float | None = None

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time; past the end of the path the rest control of the reference."""
        tracker, model, time = self._tracker, self._model, estimate.time
        tracker.set_reference(reference, time)
        projection = tracker.project(estimate.state)
        while not tracker.is_last and tracker.path.is_past_end(projection):
            tracker.next_path(time)
            projection = tracker.project(estimate.state)
        path = tracker.path
        if path.is_past_end(projection):
            return model.clamped(reference.rest)
        dx, dy = self._to_lookahead_point(estimate.state, path, projection)
        heading = float(estimate.state[model.theta]) + (0.0 if path.direction > 0 else math.pi)
        error = math.remainder(math.atan2(dy, dx) - heading, math.tau)
        steering = path.direction * self._pid(time, error)
        if reference.kind is ReferenceKind.CONTINGENCY:
            return model.command(float(reference.control_at(time)[model.throttle]), steering)
        share = math.hypot(dx, dy) / self._settings.lookahead
        return model.command(self._planned_throttle(path, projection) * share, steering)

    def _to_lookahead_point(self, state: Floats, path: Path, projection: Projection) -> tuple[float, float]:
        """Vector from the car to the lookahead point (m), which lies on the tangent beyond the end of the path."""
        x, y = path.point_at(projection.arc_length + self._settings.lookahead)
        return x - float(state[self._model.x]), y - float(state[self._model.y])

    def _pid(self, time: float, error: float) -> float:
        """Output of the PID (rad) for an error (rad)."""
        proportional, integral, derivative = self._settings.gains
        if self._time is None:
            self._time, self._filtered_error = time, error
        step = min(max(time - self._time, 0.0), 2.0 / self._settings.rate_hz)  # a pause must not be integrated
        self._time = time
        change = math.remainder(error - self._filtered_error, math.tau)
        self._filtered_error += change * (1.0 - math.exp(-step / DERIVATIVE_TIME_CONSTANT))
        self._integral += integral * error * step
        self._integral = min(max(self._integral, -self._integral_limit), self._integral_limit)
        return proportional * error + self._integral + derivative * change / DERIVATIVE_TIME_CONSTANT

    def _planned_throttle(self, path: Path, projection: Projection) -> float:
        """Throttle for the mean planned speed on the way to the lookahead point."""
        last = path.index_at(projection.arc_length + self._settings.lookahead)
        first = max(last - max(1, round(self._settings.lookahead / SPACING)), 0)
        duration = float(path.time[last] - path.time[first])
        if duration <= 0.0:
            return float(path.throttle[last])
        return self._model.throttle_for(path.direction * path.spacing * (last - first) / duration)
