"""Adaptive estimator: a filter for the state, and online identification of the car, the delay and the noise.

Between cycles a Kalman filter with correlated pose errors follows the state.  Each cycle the sliding window identifies
the model's parameters and the delay of commands from the same poses; the planner, the controller and the filter use
them from then on.  Only the sum of the delays of commands and of time stamps shows in the data, and only their sum
matters: in the time of the stamps, a command acts that much later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from kraft.driving.estimation.camera_model import CameraModel
from kraft.driving.estimation.correlated_filter import CorrelatedFilter
from kraft.driving.estimation.dead_reckoning import require_finite, with_identified_drift
from kraft.driving.estimation.drive_history import DRIVE_MAX, DriveHistory, RecordedDrive
from kraft.driving.estimation.pose_noise import NoiseEstimate
from kraft.driving.estimation.sliding_window import Identified, SlidingWindow
from kraft.driving.estimation.sloping_floor import (
    ConstantOfDrive,
    possible,
    shows_slope,
    slope_deviations,
    slope_specs,
    slope_told,
)
from kraft.driving.estimator_settings import Adaptive
from kraft.driving.messages import Estimate, Observation, PoseBelief, Uncertainty
from kraft.driving.method import unstated_ranges
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import InputError
from kraft.sysid.parameters import Parameters, ParameterSpec
from kraft.vehicles import DELAY_MAX
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.names import FORCE
from ompl_ext.vehicle import Vehicle

DELAY: Final = "delay"
GRAVITY_SHARE_ERROR: Final = 0.25
"""Standard deviation of the share of gravity that a vehicle feels, as a share of it."""
MOVING: Final = 0.05
"""Speed or turning rate above which the vehicle moves, m/s or rad/s."""
CONTRADICTION: Final = 2.0
"""Difference between a stated delay and what poses say, in standard deviations, above which it is doubted."""
SIGNIFICANT: Final = 1.0
"""Squared change of the parameters, by their covariance, up to which those in use are kept."""
SLOW: Final = 0.2
"""Speed or turning rate below which identified parameters are used at once, m/s or rad/s."""
HOLDS: Final = 0.8
"""Largest force in use, as a share of what the drive can hold at rest."""
PASSING_FORCE: Final = 0.2
"""Standard deviation of a force that comes and goes, such as that of a box that the vehicle pushes, m/s^2."""
PASSING_TIME: Final = 2.5
"""Time for which such a force stays the same, s."""
LEAST_TURN: Final = 1e-3
"""Share of the motion that counts as across its mean direction, at least: forces there hardly show."""


@dataclass(frozen=True)
class Learned:
    """Result of the identification, and of the poses that it rests on their interval (s) and `directions`.

    `directions` (2, 2) is the mean of u u^T, where u is the direction of the heading.
    """

    identified: Identified
    interval: float
    directions: Matrix

    @classmethod
    def of(cls, identified: Identified, drive: RecordedDrive) -> Learned:
        """What was identified from a drive."""
        yaw = np.interp(identified.times, drive.times, drive.poses[:, 2])
        along = np.array([np.cos(yaw), np.sin(yaw)])
        return cls(identified, drive.interval, along @ along.T / len(yaw))

    @property
    def passing_force(self) -> Matrix:
        """Covariance (2, 2) of a constant force along x and y, by forces that come and go while it is measured.

        A vehicle feels the force along its heading.  Two headings that hardly differ tell the forces along x and y
        apart only if nothing else has changed in between.
        """
        times = max(1.0, self.interval * len(self.identified.times) / PASSING_TIME)
        amplified = np.asarray(np.linalg.inv(self.directions + LEAST_TURN * np.eye(2)), dtype=float)
        return PASSING_FORCE**2 / times * amplified


class AdaptiveEstimator:
    """Estimates state, parameters, delay and noise; see the module."""

    def __init__(
        self, settings: Adaptive, model: VehicleModel, start_state: Floats, camera: CameraModel | None = None
    ) -> None:
        """Begin at rest at `start_state` (nx,); `camera` is the one that the poses come from, if it is known.

        Its errors on a slope are corrected for a vehicle that states what share of gravity it feels.

        Raises:
            InputError: if the vehicle states no ranges of its parameters.
        """
        settings = with_identified_drift(settings, model.vehicle)
        self._settings, self._model = settings, model
        if camera is not None and not shows_slope(model.vehicle):
            camera = replace(camera, level_at=None)
        self._sloping = camera is not None and camera.level_at is not None and settings.identify
        parameters = online_parameters(model.vehicle, settings, sloping=self._sloping)
        self._noise = NoiseEstimate.of(settings)
        self._force = [] if model.vehicle.gravity_share is None else [parameters.index(name) for name in FORCE]
        self._filter = CorrelatedFilter(settings, model, start_state, camera)
        self._camera = camera
        self._filter.set_noise(self._noise)
        process = np.full(len(model.vehicle.state), settings.speed_drift)
        process[[model.x, model.y]], process[model.theta] = settings.drift, math.radians(settings.heading_drift_deg)
        low, high = model.vehicle.control_bounds.T
        turning = np.zeros(len(parameters.specs), bool)
        turning[: parameters.model_size] = model.acts_on_turning()
        self._window = SlidingWindow(
            parameters, settings.window, settings.step, process, settings.control_share * (high - low),
            settings.iterations, turning, camera,
        )  # fmt: skip
        self._values: Floats = np.array(list(model.vehicle.parameters.values()))  # of the vehicle, in use
        self._identified: Identified | None = None
        self.learned: Learned | None = None
        self._history = DriveHistory(start_state, model)
        if self._sloping:
            self._slope_of_drive = ConstantOfDrive(slope_deviations(model.vehicle))
        self._delay_index = parameters.index(DELAY)
        self.horizon = 0.0 if self._delay_index < 0 else parameters.specs[self._delay_index].value
        self._filter.set_delay(self.horizon)

    @property
    def belief(self) -> PoseBelief | None:
        """Pose with its covariance after the newest observation; None before one."""
        return self._filter.belief

    @property
    def floor(self) -> Floats:
        """Estimated slope (2,) of the floor, rise per metre along x and y; 0 if the camera measures heights itself."""
        return self._filter.floor

    def observe(self, observation: Observation) -> None:
        """Process a pose that has arrived, in any order of stamps; a repeated pose changes nothing.

        Raises:
            InputError: the pose is not finite; the estimate is as before.
        """
        require_finite(observation)
        if self._camera is not None:
            observation = self._camera.without_mean(observation)
        self._filter.observe(observation)
        self._history.observe(observation, self._filter.posterior.mean[: len(self._model.vehicle.state)])

    def commanded(self, time: float, control: Floats) -> None:
        """Record that `control` (nu,) is sent at `time` (s, ascending) and held until the next one."""
        self._filter.commanded(time, control)
        self._history.command(time, control, self._moves())

    def _moves(self) -> bool:
        """Whether the vehicle moves, by the filter or by the poses: a filter with wrong parameters may not see it."""
        state = self._filter.posterior.mean
        moves = any(abs(state[k]) > MOVING for k in self._model.velocities)
        return moves or self._history.has_moved(self._filter.position_variance)

    def leave_out(self, begin: float, end: float) -> None:
        """Identify nothing from the time from `begin` to `end` (s), nor a change that was found with it."""
        self._history.leave_out(begin, end)
        self._window.forget_change()

    def estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s) plus the horizon."""
        estimate = self._filter.estimate(time + self.horizon)
        return Estimate(estimate.time, estimate.state, estimate.age - self.horizon)

    def replanning_estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s) plus the horizon, after an update of the identification, with its uncertainty."""
        self._identify(time)
        estimate, identified = self.estimate(time), self._identified
        parameters = None
        if identified is not None and self._settings.identify:
            parameters = self._values
        return Estimate(estimate.time, estimate.state, estimate.age, parameters, self.uncertainty(time))

    def uncertainty(self, time: float) -> Uncertainty:
        """Covariance of the estimate at `time` (s) plus the horizon, and deviations of the delay and of the drive."""
        covariance = self._filter.covariance_at(time + self.horizon)
        return Uncertainty(covariance, self._delay_deviation, self._filter.acceleration_deviation)

    @property
    def _delay_deviation(self) -> float:
        """Standard deviation of the delay of commands, s."""
        k = self._delay_index
        if k < 0:
            return 0.0
        if self._identified is None:
            return self._window.parameters.specs[k].std
        return math.sqrt(float(self._identified.covariance[k, k]))

    def _identify(self, time: float) -> None:
        """Update parameters, delay and noise from the poses until `time` (s)."""
        drive = self._history.drive(time - DRIVE_MAX)
        if drive is None:
            return
        identified = self._window.update(drive, self._history.moving, partial(self._noise.of_one_pose, drive.interval))
        if identified is not None:
            self.learn(Learned.of(identified, drive))

    def learn(self, learned: Learned) -> None:
        """Use what was identified from now on: here, or by another estimator with the same poses and commands."""
        identified = learned.identified
        self.learned, self._identified = learned, identified
        self._noise = self._noise.updated(identified, learned.interval)
        self._filter.set_noise(self._noise)
        self._filter.set_parameter_spread(self._covariance_of(identified))
        if self._sloping:
            self._set_slope(learned)
        if self._settings.identify:
            self._use_parameters(identified)
        if self._delay_index >= 0:
            self.horizon = float(identified.rho[self._delay_index])
            self._filter.set_delay(self.horizon)
            self._doubt_delay(float(identified.covariance[self._delay_index, self._delay_index]))

    def _use_parameters(self, identified: Identified) -> None:
        """Use the identified parameters if they differ significantly from those in use.

        The costs of plans are those of the parameters.  Within what is not known of these they would change in every
        cycle, and plans with them.  Of a slow vehicle they decide whether it stands, so they are used at once.
        """
        values, covariance = self._window.parameters.model_values(identified.rho), self._covariance_of(identified)
        free = np.flatnonzero(np.diag(covariance) > 0.0)
        change = (values - self._values)[free]
        slow = bool((np.abs(self._filter.posterior.mean[self._model.velocities]) < SLOW).all())
        if slow or change @ np.linalg.solve(covariance[np.ix_(free, free)], change) > SIGNIFICANT:
            self._values = self._with_held_force(values)
        self._model.set_parameters(self._values)

    def _with_held_force(self, values: Floats) -> Floats:
        """Parameters (np,) with a force that the drive can hold at rest; a larger one is not a slope.

        A vehicle that pushes against a box until it stands seems to have a weak drive and a force against it.  With a
        force beyond the drive no manoeuvre would stop, so that nothing could be planned, not even the way back.
        """
        if not self._force:
            return values
        held, force = values.copy(), values[self._force]
        held[self._force] = 0.0
        most = HOLDS * self._model.acceleration_at_rest(held)
        held[self._force] = force * min(1.0, most / max(float(np.linalg.norm(force)), 1e-9))
        return held

    def _doubt_delay(self, variance: float) -> None:
        """Widen the prior of a delay that the vehicle's file states, if the poses contradict it.

        The estimate, of this `variance`, joins the prior and what the poses alone say.  If these differ significantly,
        the prior gets the variance with which their difference is as likely as it can be (maximum likelihood of the
        second kind), so that another delay than the stated one is found.
        """
        stated, k = self._model.vehicle.delay, self._delay_index
        if stated is None:
            return
        (value, std), used = stated, self._window.parameters.specs[k].std
        information = 1.0 / variance - used**-2.0
        if information > 0.0:
            alone = (self.horizon / variance - value / used**2) / information
            difference = (alone - value) ** 2
            contradicts = difference > CONTRADICTION**2 * (std**2 + 1.0 / information)
            self._window.set_std(k, math.sqrt(difference - 1.0 / information) if contradicts else std)

    def _covariance_of(self, identified: Identified) -> Matrix:
        """Covariance (np, np) of the vehicle's parameters."""
        size = len(self._model.vehicle.parameters)
        return identified.covariance[:size, :size]

    def _set_slope(self, learned: Learned) -> None:
        """Take the slope of the floor as what force and poses tell of it.

        The floor stays as it is: a force that has changed has another cause, such as a box that the vehicle pushes, so
        the force before the change counts.  What the drive showed before the window counts as well.
        """
        found = learned.identified
        begin, end = float(found.times[0]), float(found.times[-1])
        before = found.before
        told = slope_told(self._window.parameters, before.mean, before.covariance, learned.passing_force)
        mean, covariance = self._slope_of_drive.update(begin, end, *told)
        slope = possible(mean)
        error = GRAVITY_SHARE_ERROR * float(np.linalg.norm(slope))
        self._filter.set_slope(slope, covariance + error**2 * np.eye(2))


def online_parameters(vehicle: Vehicle, settings: Adaptive, sloping: bool = False) -> Parameters:
    """Parameters of the model, the delay, and the slope of a `sloping` floor, with their priors.

    Those are frozen that are known or not identified.

    Raises:
        InputError: if the vehicle states no range of a parameter.
    """
    if (problem := unstated_ranges(vehicle, "the estimator adaptive")) is not None:
        raise InputError([problem])
    ranges = vehicle.ranges
    known = frozenset(name for name, allowed in ranges.items() if allowed.is_known)
    specs = [
        ParameterSpec(name, value, ranges[name].low, ranges[name].high, ranges[name].std or 1.0, ranges[name].unit, "")
        for name, value in vehicle.parameters.items()
    ]
    frozen = known if settings.identify else frozenset(vehicle.parameters)
    if settings.compensate:
        delay, std = vehicle.delay or (0.0, settings.delay_std)
        specs.append(ParameterSpec(DELAY, delay, 0.0, DELAY_MAX, std, "s", ""))
    if sloping:
        specs += slope_specs(vehicle)
    return Parameters(vehicle, tuple(specs), frozen)
