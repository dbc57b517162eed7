"""Tracks the planned trajectory: Stanley's steering law, speed and steering fed forward from the plan.

Hoffmann, Tomlin, Montemerlo, Thrun: Autonomous Automobile Trajectory Tracking for Off-Road Driving: Controller Design,
Experimental Validation and Racing. ACC 2007.
"""

from __future__ import annotations

import math
from typing import Final

from kraft.driving.car_model import Model
from kraft.driving.control.path import Guide, Path, Place
from kraft.driving.messages import Estimate, Kind, Reference
from kraft.driving.method import Kinodynamic
from ompl_ext.arrays import Floats

WINDOW: Final = 25
"""Samples to both sides among which the next nearest one is searched."""


class KinodynamicController:
    """Steers the front axle onto the path of the planned front axle, and drives as fast as planned and to catch up.

    Where the car is beside the path decides the steering, and how far the plan has got by now decides, with where the
    car is along it, the throttle.  In reverse it is the rear axle that is steered onto its path.
    """

    def __init__(self, settings: Kinodynamic, model: Model) -> None:
        self._settings, self._model = settings, model
        self._guide = Guide(model, 0.5 * model.wheelbase, WINDOW)

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time; past the end of the path what the reference holds at rest."""
        guide = self._guide
        guide.take(reference, estimate.time)
        guide.keep_time(estimate.time + self._settings.look)
        place, path = guide.locate(estimate.state), guide.path
        if guide.is_last and path.is_over_at(place):
            return self._model.clamped(reference.rest)
        speed = abs(float(estimate.state[self._model.v]))
        ahead = path.sample(place.distance + self._settings.look * speed)
        steering = float(path.steering[ahead]) + self._correction(estimate.state, speed, path, place)
        return self._model.command(self._throttle(estimate.time, reference, path, place), steering)

    def _correction(self, state: Floats, speed: float, path: Path, place: Place) -> float:
        """Steering beyond the planned one, rad (Hoffmann et al. 2007, eq. 5, with a softened denominator).

        The front axle moves in the direction theta + steering, so the heading error to the direction of its path is the
        error of the car's heading and the planned steering, which is fed forward.  Backwards, turning the wheels turns
        the car the other way, so the heading error changes sign; the error across the path does not.
        """
        settings = self._settings
        heading = math.remainder(float(path.theta[place.index] - state[self._model.theta]), math.tau)
        across = math.atan2(settings.k_path * place.across, speed + settings.softening)
        return path.direction * settings.k_heading * heading - across

    def _throttle(self, time: float, reference: Reference, path: Path, place: Place) -> float:
        """Planned throttle and more where the car is behind; a manoeuvre that stops the car is never given more.

        What is planned for this time counts, not for this place: a car that is a little early where the plan crawls
        would else be given the throttle of a later, faster part, and be earlier still.
        """
        behind = path.distance_at(time) - place.distance
        planned = float(reference.control_at(time + self._settings.look)[self._model.throttle])
        throttle = planned + path.direction * self._settings.k_along * behind
        if reference.kind is Kind.PLAN:
            return throttle
        if time >= reference.end:
            return float(reference.rest[self._model.throttle])
        return min(throttle, planned) if path.direction > 0 else max(throttle, planned)
