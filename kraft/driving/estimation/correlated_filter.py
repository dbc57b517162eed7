"""Filter of poses with correlated errors and an offset, by a camera that may take a sloping floor as level."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from kraft.driving.estimation.camera_model import CameraModel
from kraft.driving.estimation.pose_filter import PoseFilter, Posterior, Prior, ProcessModel
from kraft.driving.estimation.pose_noise import NoiseEstimate
from kraft.driving.estimation.sloping_floor import possible, slope_deviations
from kraft.driving.estimator_settings import Adaptive
from kraft.driving.messages import Observation
from kraft.driving.vehicle_model import VehicleModel
from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.kernels.pose_fusion import FLOOR_SIZE, Sensor
from ompl_ext.vehicle import Vehicle

CORRELATED, OFFSET, FLOOR = slice(0, 3), slice(3, 6), slice(6, 6 + FLOOR_SIZE)
"""Parts of the pose error, and the floor that it depends on, within the last components of the filter's state."""
ERRORS: Final = FLOOR.stop
"""Number of these components."""
SAME_TURN: Final = 1.0
"""Time for which the error of a turning rate by wrong parameters counts as the same, s."""
SAME_ACCELERATION: Final = 0.5
"""Time for which the error of an acceleration by wrong parameters counts as the same, s."""
MOVED_AFTER: Final = 1.0
"""Time with larger errors of poses than the noise explains after which the vehicle may have been moved instead, s."""


class CorrelatedFilter(PoseFilter):
    """Filter whose state (nx + 9,) has errors of the pose beside the excess of the speed: correlated ones, and offsets.

    Correlated errors are those that a known camera would have straight below it, along and across its line of sight.
    The offset is that of the camera at the place of the vehicle.  Only the start, which is known, tells about it.  The
    last components are the floor, by which a camera that takes it as level is wrong.  Single poses do not
    correct it; what the identification tells replaces it.  Its uncertainty is part of all covariances.
    """

    def __init__(
        self, settings: Adaptive, model: VehicleModel, start_state: Floats, camera: CameraModel | None = None
    ) -> None:
        times = np.full(ERRORS, settings.offset_time)
        times[FLOOR] = math.inf
        process = ProcessModel(model, times)
        super().__init__(settings, model, start_state, process)
        self._components = np.arange(process.size - ERRORS, process.size)
        process.same[model.theta], process.same[model.velocities] = SAME_TURN, SAME_ACCELERATION
        process.varying[:] = self._part(CORRELATED)[[0, -1]] + (0, 1)
        if settings.identify:
            process.spread = stated_spread(model.vehicle)
        offset = settings.position_offset, settings.position_offset, math.radians(settings.heading_offset_deg)
        self._set_variance(OFFSET, np.square(offset), settings.offset_time)
        self._sensor = Sensor(
            parts=np.stack([self._pose, self._part(CORRELATED), self._part(OFFSET)]),
            spread=np.eye(3),
            floor=self._part(FLOOR),
            camera=np.zeros(0) if camera is None else camera.values,
        )
        self._camera = camera
        if camera is not None and camera.level_at is not None:
            self.posterior.covariance[self._part(FLOOR), self._part(FLOOR)] = slope_deviations(model.vehicle) ** 2

    @property
    def floor(self) -> Floats:
        """Estimated slope (2,) of the floor, see `CameraModel`, at most `STEEPEST`."""
        return possible(self.posterior.mean[self._part(FLOOR)])

    def set_slope(self, slope: Floats, covariance: Matrix) -> None:
        """Replace the estimate of the floor's slope by (2,) and its covariance (2, 2), and all that depends on it.

        Means and covariances change in place: nothing else holds those of the kept posteriors.
        """
        means = np.array([posterior.mean for posterior in self._posteriors])
        covariances = np.array([posterior.covariance for posterior in self._posteriors])
        work = np.empty((2, means.shape[1]))
        self._fusion.replace(means, covariances, self._sensor.floor, slope, covariance, work)
        for posterior, mean, changed in zip(self._posteriors, means, covariances, strict=True):
            posterior.mean[:], posterior.covariance[:] = mean, changed
        self._reckoning.reset(self.posterior.time, self.posterior.mean, self._posteriors[0].time)

    def _part(self, part: slice) -> Ints:
        """Indices of a part of the pose error, or of the floor, into the state."""
        return self._components[part]

    def set_noise(self, noise: NoiseEstimate) -> None:
        """Set the noise of poses from now on."""
        self._process_model.times[CORRELATED], self._correlated_variance = noise.time, noise.variance * noise.share
        self._independent_variance = noise.variance * (1.0 - noise.share)
        self._set_variance(CORRELATED, self._correlated_variance, noise.time)

    def _look_at(self, x: float, y: float) -> None:
        """Set the noise of a pose at a place (m), by what the camera has there."""
        spread = self._sensor.spread
        if self._camera is not None:
            spread[:] = self._camera.spread(x, y)
        self._noise = (spread * self._independent_variance) @ spread.T

    @property
    def position_variance(self) -> float:
        """Largest variance of an observed x or y at the place of the vehicle, m^2."""
        variance = self._independent_variance + self._correlated_variance
        return float((self._sensor.spread[:2] ** 2 @ variance).max())

    def _set_variance(self, part: slice, variance: Floats, time: float) -> None:
        """Set the stationary variance (3,) of a part of the pose error, whose time constant is `time` s."""
        components = self._part(part)
        self._variance_rate[components] = 2.0 * variance / time
        if self.posterior.observation is None:  # the error of the first pose is of full size
            self.posterior.covariance[components, components] = variance

    def set_delay(self, delay: float) -> None:
        """Set the delay of commands, s."""
        self._reckoning.set_delay(delay)

    def covariance_at(self, time: float) -> Matrix:
        """Covariance (nx, nx) of the state at `time` (s); its speed includes the excess."""
        nx = len(self._model.vehicle.state)
        _, covariance = self._predict(self.posterior, max(time, self.posterior.time))
        joined = np.zeros((nx, len(covariance)))
        joined[range(nx), range(nx)] = 1.0
        joined[self._model.v, nx] = 1.0
        found: Matrix = joined @ covariance @ joined.T
        return found

    @property
    def acceleration_deviation(self) -> float:
        """Standard deviation of the acceleration at full drive by the uncertainty of the parameters, m/s^2."""
        forward = self._model.drive_control(1.0, 0.0)
        return math.sqrt(float(self._process_model.rate_variance(self.posterior.mean, forward)[self._model.v]))

    def set_parameter_spread(self, covariance: Matrix) -> None:
        """Set the covariance (np, np) of the parameters, by which the vehicle moves otherwise than predicted."""
        values, axes = np.linalg.eigh(covariance)
        self._process_model.spread = np.ascontiguousarray((axes * np.sqrt(np.maximum(values, 0.0))).T)

    def _after_outlier(self, posterior: Posterior, pose: Observation, prior: Prior, whitened: Floats) -> Posterior:
        """Posterior with the correlated errors as uncertain as it takes to make an outlier as likely as the limit is.

        In a burst of correlated errors all poses are outliers.
        """
        covariance, correlated, distance = (
            prior.covariance.copy(),
            self._part(CORRELATED),
            float(np.linalg.norm(whitened)),
        )
        error = np.linalg.solve(self._sensor.spread, prior.innovation)
        unexpected = np.outer(error, error)
        covariance[np.ix_(correlated, correlated)] += (self._limit**-2.0 - distance**-2.0) * unexpected
        _, cross, expected = self._expected(prior.mean, covariance)
        doubted = replace(prior, covariance=covariance, cross_covariance=cross, pose_covariance=expected)
        return replace(self._fused(pose, doubted, self._noise), jumped=pose.time)

    def _rate(self, posterior: Posterior) -> Floats | None:
        """Variance (size,) that the state gains in a second, if the motion is doubted.

        Errors of poses jump.  If they came little by little, the vehicle has moved otherwise than the model.  Then the
        motion varies as much as they are large, and they do not.
        """
        if not posterior.drifted:
            return None
        rate, error = self._variance_rate.copy(), self._sensor.spread @ posterior.mean[self._part(CORRELATED)]
        rate[self._pose] += 2.0 * error**2 / self._process_model.times[CORRELATED]
        return rate

    def _update(self, posterior: Posterior, pose: Observation) -> Posterior:
        """Posterior after a pose; errors that the noise does not explain are believed for a while."""
        after = super()._update(posterior, pose)
        if after.jumped < posterior.jumped:
            after = replace(after, jumped=posterior.jumped)
        error = after.mean[self._part(CORRELATED)]
        usual = len(error) if posterior.drifted else self._limit**2
        if (error**2 / np.maximum(self._correlated_variance, 1e-12)).sum() <= usual:
            return after
        since = min(posterior.doubted_since, pose.time)
        if pose.time - since < MOVED_AFTER:
            begins = since == pose.time and since - after.jumped > MOVED_AFTER
            return replace(after, doubted_since=since, drifted=posterior.drifted or begins)
        return self._half_moved(after)

    def _half_moved(self, posterior: Posterior) -> Posterior:
        """Posterior after errors of poses that stay: either the vehicle was moved by as much, or they are that large.

        Both get half of it and the variance; what follows tells, for the errors decay.
        """
        mean, covariance, correlated = posterior.mean.copy(), posterior.covariance.copy(), self._part(CORRELATED)
        error = mean[correlated]
        of_pose = self._sensor.spread @ error
        covariance[self._pose_block] += np.outer(of_pose, of_pose)
        covariance[np.ix_(correlated, correlated)] += np.outer(error, error)
        _, cross, expected = self._expected(mean, covariance)
        _, after = self._gain(covariance, cross, expected + self._noise)
        mean[self._pose] += 0.5 * of_pose
        mean[correlated] += -0.5 * error
        return Posterior(posterior.time, mean, after, posterior.observation, jumped=posterior.jumped)


def stated_spread(vehicle: Vehicle) -> Matrix:
    """Standard deviations of the parameters before any is identified, as a diagonal matrix (np, np)."""
    return np.diag([vehicle.ranges[name].std for name in vehicle.parameters])
