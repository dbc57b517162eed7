"""Trajectory tracking: Stanley's steering law with speed and steering fed forward from the plan.

Hoffmann, Tomlin, Montemerlo, Thrun: Autonomous Automobile Trajectory Tracking for Off-Road Driving: Controller Design,
Experimental Validation and Racing. ACC 2007.
"""

from __future__ import annotations

import math
from typing import Final

from kraft.driving.car_model import CarModel
from kraft.driving.control.path import Path, PathTracker, Projection
from kraft.driving.control_settings import Kinodynamic
from kraft.driving.messages import Estimate, Reference, ReferenceKind
from kraft.driving.vehicle_model import stop_control
from ompl_ext.arrays import Floats

K_HOLD: Final = 3.0
"""Throttle per metre that a car which is held has drifted, 1/m."""
MOVING: Final = 0.01
"""Speed above which a car is braked, m/s."""
WINDOW: Final = 25
"""Samples to each side of the last nearest one among which the next one is searched."""


class KinodynamicController:
    """Steers the front axle onto the path of the planned front axle, and controls the progress along it.

    The cross-track error decides the steering.  The difference between the planned and the actual progress along the
    path decides the throttle.  In reverse the controller steers the rear axle onto its path instead.
    """

    def __init__(self, settings: Kinodynamic, model: CarModel) -> None:
        self._settings, self._model = settings, model
        self._tracker = PathTracker(model, 0.5 * model.wheelbase, WINDOW)

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time; past the end of the path the rest control of the reference."""
        tracker = self._tracker
        tracker.set_reference(reference, estimate.time)
        tracker.advance_to(estimate.time + self._settings.look)
        projection, path = tracker.project(estimate.state), tracker.path
        if tracker.is_last and path.is_past_end(projection):
            held, throttle = self._held(reference, path, projection), self._model.throttle
            held[throttle] = self._limited(float(held[throttle]), estimate, reference, path)
            return self._model.clamped(held)
        speed = abs(float(estimate.state[self._model.v]))
        ahead = path.index_at(projection.arc_length + self._settings.look * speed)
        steering = float(path.steering[ahead]) + self._feedback(estimate.state, speed, path, projection)
        return self._model.command(self._throttle(estimate, reference, path, projection), steering)

    def _feedback(self, state: Floats, speed: float, path: Path, projection: Projection) -> float:
        """Feedback added to the planned steering, rad (Hoffmann et al. 2007, eq. 5, with a softened denominator).

        The front axle moves in the direction theta + steering.  Its heading error relative to its path is therefore the
        heading error of the car plus the planned steering, which is fed forward.  In reverse, steering turns the car
        the other way, so the heading error changes its sign; the cross-track error does not.
        """
        settings = self._settings
        heading = math.remainder(float(path.theta[projection.index] - state[self._model.theta]), math.tau)
        cross_track_term = math.atan2(settings.k_path * projection.cross_track, speed + settings.softening)
        return path.direction * settings.k_heading * heading - cross_track_term

    def _held(self, reference: Reference, path: Path, projection: Projection) -> Floats:
        """Rest control (nu,); one that holds the car against a force is corrected by the way it has drifted."""
        held, throttle = reference.rest.copy(), self._model.throttle
        if held[throttle] != 0.0:
            held[throttle] += path.direction * K_HOLD * (path.length - projection.arc_length)
        return held

    def _throttle(self, estimate: Estimate, reference: Reference, path: Path, projection: Projection) -> float:
        """Planned throttle plus feedback on the progress; a contingency never gets more throttle than planned.

        The planned throttle is that of the present time, not of the present position: otherwise a car that is a little
        ahead of a slow part of the plan would get the throttle of a later, faster part and get further ahead.
        """
        time = estimate.time
        behind = path.arc_length_at(time) - projection.arc_length
        planned = float(reference.control_at(time + self._settings.look)[self._model.throttle])
        throttle = planned + path.direction * self._settings.k_along * behind
        if reference.kind is ReferenceKind.PLAN:
            return throttle
        if time >= reference.end:
            throttle = planned = float(self._held(reference, path, projection)[self._model.throttle])
        return self._limited(_slower(path, throttle, planned), estimate, reference, path)

    def _limited(self, throttle: float, estimate: Estimate, reference: Reference, path: Path) -> float:
        """At most the throttle with which the manoeuvre brakes the car at its present speed, as soon as it has begun.

        A car that is faster than planned would otherwise coast on where the planned throttle fades.
        """
        stop, speed = reference.stop, path.direction * float(estimate.state[self._model.v])
        if stop is None or estimate.time + self._settings.look < stop.begin or speed <= MOVING:
            return throttle
        braking = float(stop_control(self._model.vehicle, estimate.state, stop.manoeuvre)[self._model.throttle])
        return _slower(path, throttle, braking)


def _slower(path: Path, one: float, other: float) -> float:
    """The one of two throttles that drives less along a path."""
    return min(one, other) if path.direction > 0 else max(one, other)
