"""An extended Kalman filter over all observed poses that doubts those that are far from what it expects."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import gammaincinv

from kraft.driving.car_model import STEP, Model
from kraft.driving.estimation.dead_reckoning import DeadReckoning
from kraft.driving.messages import Estimate, Observation
from kraft.driving.method import Filter
from ompl_ext.arrays import Floats, Matrix

KEPT: Final = 32
"""Observations that are kept to be gone through again after one that comes out of order."""
PATIENCE: Final = 5
"""Outliers in a row that agree with each other before they are believed: the vehicle was moved, not mismeasured."""


@dataclass(frozen=True)
class Belief:
    """Mean (nx + 1,) and covariance after `observation`; `doubted` are the innovations (sd) of the latest outliers."""

    time: float
    mean: Floats
    covariance: Matrix
    observation: Observation | None = None
    doubted: tuple[Floats, ...] = ()


class PoseFilter:
    """Weighs every pose against the model by their noise.

    Observations count at their stamps; what was commanded since leads from there to the present.  An outlier's noise is
    taken to be larger by its distance over the limit (Huber's weight), so its influence is bounded.
    """

    def __init__(self, settings: Filter, model: Model, start_state: Floats) -> None:
        self._model, self._motion = model, DriftModel(model)
        heading, drift = math.radians(settings.heading_noise_deg), math.radians(settings.heading_drift_deg)
        self._pose = [model.x, model.y, model.theta]
        self._noise = np.diag([settings.position_noise**2, settings.position_noise**2, heading**2])
        self._rate = np.zeros(self._motion.size)  # variance that the model adds per second
        self._rate[self._pose] = settings.drift**2, settings.drift**2, drift**2
        self._rate[-1] = settings.speed_drift**2
        self._limit = math.sqrt(2.0 * float(gammaincinv(1.5, settings.confidence)))  # of chi with three degrees
        spread = np.zeros(self._motion.size)
        spread[self._pose] = (
            *[settings.start_position_noise**2] * 2,
            math.radians(settings.start_heading_noise_deg) ** 2,
        )
        mean = np.append(np.asarray(start_state, dtype=np.float64), 0.0)
        self._beliefs = [Belief(0.0, mean, np.diag(spread))]
        self._reckoning = DeadReckoning(self._motion.advance, model.rest, 0.0, mean)

    @property
    def belief(self) -> Belief:
        """After the newest observation."""
        return self._beliefs[-1]

    def observe(self, observation: Observation) -> None:
        """Take in a pose at its stamp; after one out of order the newer ones are gone through again."""
        k = bisect_right([belief.time for belief in self._beliefs], observation.time)
        if k == 0 or (self._beliefs[k - 1].time == observation.time and self._beliefs[k - 1].observation is not None):
            return
        newer = [belief.observation for belief in self._beliefs[k:]]
        del self._beliefs[k:]
        for pose in (observation, *newer):
            if pose is not None:
                self._beliefs.append(self._updated(self._beliefs[-1], pose))
        del self._beliefs[:-KEPT]
        self._reckoning.anchor(self.belief.time, self.belief.mean, self._beliefs[0].time)

    def commanded(self, time: float, control: Floats) -> None:
        """Note that `control` (nu,) is sent at `time` (s, ascending) and held from then on."""
        self._reckoning.command(time, control)

    def estimate(self, time: float) -> Estimate:
        """State at `time` (s), its speed with the excess over the model's that the poses show."""
        state = self._reckoning.at(time)
        state[self._model.v] += state[-1]
        seen = self.belief.time if self.belief.observation is not None else -math.inf
        return Estimate(time, state[:-1], time - seen)

    def replanning_estimate(self, time: float) -> Estimate:
        """The same: it rests on all observations anyway."""
        return self.estimate(time)

    def _predicted(self, belief: Belief, time: float) -> tuple[Floats, Matrix]:
        mean, covariance = belief.mean, belief.covariance
        for control, duration in self._reckoning.commands.between(belief.time, time):
            mean, slope = self._motion.linearised(mean, control, duration)
            covariance = slope @ covariance @ slope.T + np.diag(self._rate * duration)
        return mean, covariance

    def _updated(self, belief: Belief, pose: Observation) -> Belief:
        """The belief after a pose: Kalman's update with Huber's weight."""
        mean, covariance = self._predicted(belief, pose.time)
        x, y, theta = mean[self._pose]
        innovation = np.array([pose.x - x, pose.y - y, math.remainder(pose.theta - theta, math.tau)])
        shared = covariance[:, self._pose]
        expected, noise = covariance[np.ix_(self._pose, self._pose)], self._noise
        white = np.linalg.solve(np.linalg.cholesky(expected + noise), innovation)
        doubted: tuple[Floats, ...] = ()
        if (distance := float(np.linalg.norm(white))) > self._limit:
            doubted = (*belief.doubted, white)
            if len(doubted) >= PATIENCE and float(np.linalg.norm(np.mean(doubted, axis=0))) > self._limit:
                return self._moved(pose, mean, covariance, innovation)
            doubted, noise = doubted[-PATIENCE:], noise * (distance / self._limit)
        gain = np.linalg.solve(expected + noise, shared.T).T
        after = covariance - gain @ shared.T
        return Belief(pose.time, mean + gain @ innovation, 0.5 * (after + after.T), pose, doubted)

    def _moved(self, pose: Observation, mean: Floats, covariance: Matrix, innovation: Floats) -> Belief:
        """Begin anew at a pose that keeps being seen."""
        mean, covariance = mean.copy(), covariance.copy()
        mean[self._pose] += innovation
        covariance[self._pose, :] = covariance[:, self._pose] = 0.0
        covariance[np.ix_(self._pose, self._pose)] = self._noise
        return Belief(pose.time, mean, covariance, pose)


MEMORY: Final = 2.0
"""Time constant with which an excess of speed that is no longer observed is forgotten, s."""
PROBE: Final = 1e-5
"""Step of the numeric derivatives, SI."""


class DriftModel:
    """State (nx + 1,): the vehicle's, then the excess of its speed (m/s).

    A speed that follows the commands in the model cannot be corrected for long by observations, the model pulls it
    back.  So the excess stands beside it: the model's motion plus that of driving `excess` m/s faster along the same
    curve.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self.size = len(model.vehicle.state) + 1

    def advance(self, state: Floats, control: Floats, duration: float) -> Floats:
        """State (nx + 1,) after a control (nu,) was held for `duration` s."""
        steps = max(1, math.ceil(duration / STEP - 1e-9))
        for _ in range(steps if duration > 0.0 else 0):
            state = self._step(state, control, duration / steps)
        return state

    def linearised(self, state: Floats, control: Floats, duration: float) -> tuple[Floats, Matrix]:
        """The state (nx + 1,) after `duration` s and its derivative (nx + 1, nx + 1) by the state before."""
        after = self.advance(state, control, duration)
        jacobian = np.eye(self.size)
        for k in range(self.size):
            if k not in (self._model.x, self._model.y):  # a car moves alike everywhere
                probed = state.copy()
                probed[k] += PROBE
                jacobian[:, k] = (self.advance(probed, control, duration) - after) / PROBE
        return after, jacobian

    def _step(self, state: Floats, control: Floats, duration: float) -> Floats:
        model, excess = self._model, float(state[-1])
        after = np.empty(self.size)
        after[:-1] = model.advance(state[:-1], control, duration)
        kept = math.exp(-duration / MEMORY)
        way = excess * MEMORY * (1.0 - kept)
        steering = float(control[model.steering])
        turn = model.curvature(steering) * way
        direction = 0.5 * float(state[model.theta] + after[model.theta]) + 0.5 * turn + model.slip(steering)
        after[model.x] += way * math.cos(direction)
        after[model.y] += way * math.sin(direction)
        after[model.theta] += turn
        after[-1] = kept * excess
        return after
