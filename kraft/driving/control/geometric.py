"""Follows the path alone: a PID towards a point of it a fixed length ahead, the paper's baseline."""

from __future__ import annotations

import math
from typing import Final

from kraft.driving.car_model import Model
from kraft.driving.control.path import SPACING, Guide, Path, Place
from kraft.driving.messages import Estimate, Kind, Reference
from kraft.driving.method import Geometric
from ompl_ext.arrays import Floats

WINDUP: Final = 0.5
"""Largest share of the steering that the integral may come to."""
SMOOTHING: Final = 0.25
"""Time constant of the slope of a noisy error, s: with the paper's authors' gains it is that of the whole response."""


class GeometricController:
    """Steers to a point `lookahead` m beyond the nearest one; the throttle grows with the distance to that point."""

    def __init__(self, settings: Geometric, model: Model) -> None:
        self._settings, self._model = settings, model
        self._guide = Guide(model, 0.0, settings.window)
        self._widest = WINDUP * float(min(-model.low[model.steering], model.high[model.steering]))
        self._sum = 0.0
        self._smooth = 0.0
        self._time: float | None = None

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time; past the end of the path what the reference holds at rest."""
        guide, model, time = self._guide, self._model, estimate.time
        guide.take(reference, time)
        place = guide.locate(estimate.state)
        while not guide.is_last and guide.path.is_over_at(place):
            guide.go_on(time)
            place = guide.locate(estimate.state)
        path = guide.path
        if path.is_over_at(place):
            return model.clamped(reference.rest)
        dx, dy = self._towards(estimate.state, path, place)
        heading = float(estimate.state[model.theta]) + (0.0 if path.direction > 0 else math.pi)
        error = math.remainder(math.atan2(dy, dx) - heading, math.tau)
        steering = path.direction * self._pid(time, error)
        if reference.kind is Kind.CONTINGENCY:
            return model.command(float(reference.control_at(time)[model.throttle]), steering)
        share = math.hypot(dx, dy) / self._settings.lookahead
        return model.command(self._planned(path, place) * share, steering)

    def _towards(self, state: Floats, path: Path, place: Place) -> tuple[float, float]:
        """From the car to the point aimed at, m; beyond the end of the path it lies on the tangent."""
        x, y = path.point(place.distance + self._settings.lookahead)
        return x - float(state[self._model.x]), y - float(state[self._model.y])

    def _pid(self, time: float, error: float) -> float:
        """Output of the PID (rad) for an error (rad)."""
        proportional, integral, derivative = self._settings.gains
        if self._time is None:
            self._time, self._smooth = time, error
        step = min(max(time - self._time, 0.0), 2.0 / self._settings.rate_hz)  # a pause is no error that lasted
        self._time = time
        gap = math.remainder(error - self._smooth, math.tau)
        self._smooth += gap * (1.0 - math.exp(-step / SMOOTHING))
        self._sum += integral * error * step
        self._sum = min(max(self._sum, -self._widest), self._widest)
        return proportional * error + self._sum + derivative * gap / SMOOTHING

    def _planned(self, path: Path, place: Place) -> float:
        """Throttle for the mean planned speed on the way to the point aimed at."""
        last = path.sample(place.distance + self._settings.lookahead)
        first = max(last - max(1, round(self._settings.lookahead / SPACING)), 0)
        took = float(path.time[last] - path.time[first])
        if took <= 0.0:
            return float(path.throttle[last])
        return self._model.throttle_for(path.direction * path.spacing * (last - first) / took)
