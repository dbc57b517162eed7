"""Extended Kalman filter over all observed poses that gives outliers less weight.

The process model of the filter is the vehicle's, with the excess of the speed over the model's as one more state
component.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from operator import attrgetter
from typing import Final

import numpy as np

from kraft.driving.estimation.dead_reckoning import DeadReckoning, Held, require_finite
from kraft.driving.estimator_settings import Adaptive, Filter
from kraft.driving.messages import Estimate, Observation, PoseBelief
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import Defect
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.kernels.moments import Process, moments
from ompl_ext.kernels.pose_fusion import WORK, Sensor, pose_fusion
from ompl_ext.kernels.specialise import kernels

MAX_HISTORY: Final = 32
"""Number of observations that are kept to be processed again after one that arrives out of order."""
NOTHING: Final = np.zeros(2, np.int64)
"""An empty range of indices."""
OUTLIERS_BEFORE_RESET: Final = 5
"""Number of consistent outliers in a row after which the filter resets: then the vehicle was moved."""


@dataclass(frozen=True)
class Posterior:
    """Mean (nx + 1,) and covariance after `observation`; `outliers` are the latest outliers' whitened innovations.

    If the filter estimates errors of poses: since `doubted_since` (s) they have been larger than the noise explains;
    they have come little by little if `drifted`.  `jumped` is the time of the last outlier, s.
    """

    time: float
    mean: Floats
    covariance: Matrix
    observation: Observation | None = None
    outliers: tuple[Floats, ...] = ()
    doubted_since: float = math.inf
    drifted: bool = False
    jumped: float = -math.inf


@dataclass(frozen=True)
class Prior:
    """Mean (n,) and covariance (n, n) predicted to the time of a pose, and how the pose differs from them.

    `cross_covariance` (n, 3) is of the state with the expected pose, `pose_covariance` (3, 3) that of this pose.
    """

    mean: Floats
    covariance: Matrix
    innovation: Floats
    cross_covariance: Matrix
    pose_covariance: Matrix


class ProcessModel:
    """Motion of the filter's state (size,): the vehicle's state, the excess of its speed, and errors that decay.

    In the model the speed follows the commands, so a correction of the speed itself would decay at once.  The excess is
    therefore a state component of its own: the vehicle moves as in the model and `excess` m/s faster along its curve.
    """

    def __init__(self, model: VehicleModel, times: Floats | None = None) -> None:
        """`times` (n,) are the time constants of the errors, s; there are none by default."""
        nx = len(model.vehicle.state)
        self._model, self.times = model, np.zeros(0) if times is None else times
        self.size = nx + 1 + len(self.times)
        self.variance_rate = np.zeros(self.size)
        """(size,) variance that the state gains in a second"""
        self.same = np.zeros(nx)
        """(nx,) time for which what uncertain parameters add to the derivative of a component counts as the same, s"""
        self.varying = np.zeros(2, np.int64)
        """errors from one index to another vary as much as they are large, too"""
        self.spread = np.zeros((0, len(model.parameters)))
        """(m, np) standard deviations of the parameters along the axes of their covariance"""
        self._functions = kernels(model.vehicle).functions
        self._where = np.array([model.x, model.y, model.theta, model.v, nx])
        self._block = np.zeros((8 + 2 * self.size, max(self.size, len(model.parameters))))
        self._moments = moments()

    def advance(self, state: Floats, held: Held) -> Floats:
        """State (size,) after controls (nu,), each with its duration (s)."""
        after = np.array(state, dtype=np.float64)
        if held:
            self._moments.advance(after, *_arrays(held), self._process, self._block)
        return after

    def predicted(
        self, mean: Floats, covariance: Matrix, held: Held, rate: Floats | None = None
    ) -> tuple[Floats, Matrix]:
        """Mean (size,) and covariance (size, size) after controls (nu,), each with its duration (s).

        `rate` (size,) is the variance gained in a second, instead of `variance_rate` and of what varies by its size.
        """
        mean, covariance = mean.copy(), covariance.copy()
        if held:
            process = self._process if rate is None else self._process._replace(rate=rate, varying=NOTHING)
            self._moments.predict(mean, covariance, *_arrays(held), process, self._block)
        return mean, covariance

    def rate_variance(self, state: Floats, control: Floats) -> Floats:
        """Variance (nx,) of the derivative of the vehicle's state by the uncertainty of the parameters."""
        variance = np.empty(len(self.same))
        held = np.ascontiguousarray(control, dtype=np.float64)
        self._moments.rate_variance(state, held, self._process, self._block, variance)
        return variance

    @property
    def _process(self) -> Process:
        return Process(
            functions=self._functions,
            parameters=self._model.parameters,
            spread=self.spread,
            where=self._where,
            rate=self.variance_rate,
            same=self.same,
            times=self.times,
            varying=self.varying,
        )


def _arrays(held: Held) -> tuple[Matrix, Floats]:
    """Controls (m, nu) and their durations (m,), s."""
    controls, durations = zip(*held, strict=True)
    return np.array(controls, dtype=np.float64), np.array(durations)


class PoseFilter:
    """Fuses all poses with the model by their covariances.

    Observations are processed at their stamps; the commands since then lead to the present.  The noise of an outlier is
    scaled by its distance over the limit (Huber's weight), so its influence is bounded.
    """

    horizon: Final = 0.0

    def __init__(
        self,
        settings: Filter | Adaptive,
        model: VehicleModel,
        start_state: Floats,
        process_model: ProcessModel | None = None,
    ) -> None:
        self._model = model
        self._process_model = process_model or ProcessModel(model)
        heading, drift = math.radians(settings.heading_noise_deg), math.radians(settings.heading_drift_deg)
        self._pose = np.array([model.x, model.y, model.theta])
        self._pose_block = np.ix_(self._pose, self._pose)
        self._noise = np.diag([settings.position_noise**2, settings.position_noise**2, heading**2])
        self._sensor = Sensor(self._pose[None], np.eye(3), floor=np.zeros(0, np.int64), camera=np.zeros(0))
        self._fusion, self._work = pose_fusion(), np.empty(WORK)
        self._variance_rate = self._process_model.variance_rate
        self._variance_rate[: len(start_state)] = model.velocity_drift(settings.speed_drift)
        self._variance_rate[self._pose] = settings.drift**2, settings.drift**2, drift**2
        self._variance_rate[len(start_state)] = settings.speed_drift**2
        self._limit = _chi_limit(settings.confidence)
        variance = np.zeros(self._process_model.size)
        variance[self._pose] = (
            *[settings.start_position_noise**2] * 2,
            math.radians(settings.start_heading_noise_deg) ** 2,
        )
        mean = np.zeros(self._process_model.size)
        mean[: len(start_state)] = start_state
        self._posteriors = [Posterior(0.0, mean, np.diag(variance))]
        self._reckoning = DeadReckoning(self._process_model.advance, model.rest, mean)

    @property
    def posterior(self) -> Posterior:
        """Posterior after the newest observation."""
        return self._posteriors[-1]

    @property
    def belief(self) -> PoseBelief | None:
        """Pose with its covariance after the newest observation; None before one."""
        newest = self.posterior
        if newest.observation is None:
            return None
        return PoseBelief(newest.time, newest.mean[self._pose], newest.covariance[self._pose_block])

    def observe(self, observation: Observation) -> None:
        """Process a pose at its stamp; after one that arrives out of order, process the newer ones again.

        Raises:
            InputError: the pose is not finite; the estimate is as before.
        """
        require_finite(observation)
        k = bisect_right(self._posteriors, observation.time, key=attrgetter("time"))
        if k == 0:
            return
        previous = self._posteriors[k - 1]
        if previous.time == observation.time and previous.observation is not None:
            return
        newer = [posterior.observation for posterior in self._posteriors[k:]]
        del self._posteriors[k:]
        for pose in (observation, *newer):
            if pose is not None:
                self._posteriors.append(self._update(self._posteriors[-1], pose))
        del self._posteriors[:-MAX_HISTORY]
        self._reckoning.reset(self.posterior.time, self.posterior.mean, self._posteriors[0].time)

    def commanded(self, time: float, control: Floats) -> None:
        """Record that `control` (nu,) is sent at `time` (s, ascending) and held from then on."""
        self._reckoning.command(time, control)

    def estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s); its speed includes the estimated excess over the model's speed."""
        state = self._reckoning.at(time)
        nx = len(self._model.vehicle.state)
        state[self._model.v] += state[nx]
        newest = self.posterior.time if self.posterior.observation is not None else -math.inf
        return Estimate(time, state[:nx], time - newest)

    def leave_out(self, begin: float, end: float) -> None:
        """Do nothing: nothing is identified."""

    def replanning_estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s), the same as `estimate`, which already rests on all observations."""
        return self.estimate(time)

    def uncertainty(self, time: float) -> None:
        """No bound rests on this estimator: it states no uncertainty."""

    def _predict(self, posterior: Posterior, time: float) -> tuple[Floats, Matrix]:
        commands = self._reckoning.commands.between(posterior.time, time)
        return self._process_model.predicted(posterior.mean, posterior.covariance, commands, self._rate(posterior))

    def _rate(self, posterior: Posterior) -> Floats | None:
        """Variance (size,) that the state gains in a second after a posterior; None for that of the process model."""
        return None

    def _look_at(self, x: float, y: float) -> None:
        """Set the noise of a pose at a place (m): it is the same everywhere."""

    def _update(self, posterior: Posterior, pose: Observation) -> Posterior:
        """Posterior after a pose: the Kalman update, or that after an outlier."""
        mean, covariance = self._predict(posterior, pose.time)
        self._look_at(float(mean[self._model.x]), float(mean[self._model.y]))
        (x, y, theta), cross_covariance, pose_covariance = self._expected(mean, covariance)
        innovation = np.array([pose.x - x, pose.y - y, math.remainder(pose.theta - theta, math.tau)])
        prior, whitened = Prior(mean, covariance, innovation, cross_covariance, pose_covariance), np.empty(3)
        self._fusion.whiten(pose_covariance + self._noise, innovation, self._work, whitened)
        distance = math.sqrt(float(whitened @ whitened))
        if math.isnan(distance):
            raise Defect(f"the covariance of the pose at t = {pose.time:.3f} s is not positive definite")
        if distance > self._limit:
            return self._after_outlier(posterior, pose, prior, whitened)
        return self._fused(pose, prior, self._noise)

    def _after_outlier(self, posterior: Posterior, pose: Observation, prior: Prior, whitened: Floats) -> Posterior:
        """Posterior after a pose whose `whitened` innovation (3,) is beyond the limit: Huber's weight, or a reset."""
        outliers = (*posterior.outliers, whitened)
        agree = float(np.linalg.norm(np.mean(outliers, axis=0))) > self._limit
        if len(outliers) >= OUTLIERS_BEFORE_RESET and agree:
            return self._reset(pose, prior)
        noise = self._noise * (math.sqrt(float(whitened @ whitened)) / self._limit)
        return self._fused(pose, prior, noise, outliers[-OUTLIERS_BEFORE_RESET:])

    def _fused(self, pose: Observation, prior: Prior, noise: Matrix, outliers: tuple[Floats, ...] = ()) -> Posterior:
        """Posterior after a pose with a `noise` (3, 3)."""
        gain, after = self._gain(prior.covariance, prior.cross_covariance, prior.pose_covariance + noise)
        return Posterior(pose.time, prior.mean + gain @ prior.innovation, after, pose, outliers)

    def _gain(self, covariance: Matrix, cross_covariance: Matrix, innovation: Matrix) -> tuple[Matrix, Matrix]:
        """Gain (n, 3) of a pose, and the covariance (n, n) after it.

        `cross_covariance` (n, 3) is of the state with the expected pose, `innovation` (3, 3) that of the innovation.
        """
        transposed, after = np.empty(cross_covariance.shape[::-1]), np.empty_like(covariance)
        self._fusion.correct(
            covariance, cross_covariance, innovation, self._sensor.floor, self._work, transposed, after
        )
        return transposed.T, after

    def _expected(self, mean: Floats, covariance: Matrix) -> tuple[Floats, Matrix, Matrix]:
        """Expected pose (3,), its covariance with the state (n, 3), and its covariance without noise (3, 3)."""
        pose, cross, expected = np.empty(3), np.empty((len(mean), 3)), np.empty((3, 3))
        self._fusion.expect(mean, covariance, self._sensor, self._work, pose, cross, expected)
        return pose, cross, expected

    def _reset(self, pose: Observation, prior: Prior) -> Posterior:
        """Posterior with the pose reset to a measured one."""
        mean, covariance = prior.mean.copy(), prior.covariance.copy()
        mean[self._pose] += prior.innovation
        covariance[self._pose, :] = covariance[:, self._pose] = 0.0
        covariance[self._pose_block] = self._noise
        return Posterior(pose.time, mean, covariance, pose)


def _chi_limit(confidence: float) -> float:
    """Quantile of the chi distribution with three degrees of freedom."""
    from scipy.special import gammaincinv  # which takes a tenth of what a trial imports

    return math.sqrt(2.0 * float(gammaincinv(1.5, confidence)))
