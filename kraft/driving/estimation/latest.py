"""Estimate from the newest pose, predicted to the present: the estimator of the paper's experiments."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np

from kraft.driving.car_model import CarModel
from kraft.driving.estimation.dead_reckoning import DeadReckoning
from kraft.driving.messages import Estimate, Observation
from kraft.driving.method import Latest
from ompl_ext.arrays import Floats


class LatestPose:
    """Uses the newest pose without filtering.

    State components that a pose does not contain, such as the speed, follow the commands by the model (Sec. V: "the
    robot's current velocity is the commanded desired velocity from the previous timestep").  A plan is committed for a
    whole cycle, so one bad pose could admit a bad plan: replanning therefore uses the mean of the newest poses.
    """

    horizon: Final = 0.0
    belief: Final = None

    def __init__(self, settings: Latest, model: CarModel, start_state: Floats) -> None:
        self._model = model
        self._reckoning = DeadReckoning(model.advance, model.rest, 0.0, start_state)
        self._newest_time = -math.inf
        self._window = settings.replanning_window
        self._window_poses: deque[tuple[float, Floats]] = deque()

    def observe(self, observation: Observation) -> None:
        """Predict from this pose on, unless a newer one has arrived before."""
        if observation.time <= self._newest_time or observation.time < self._reckoning.time:
            return
        self._newest_time = observation.time
        state, model = self._reckoning.at(observation.time), self._model
        state[model.x], state[model.y] = observation.x, observation.y
        # continuous over full turns
        state[model.theta] += math.remainder(observation.theta - state[model.theta], math.tau)
        self._window_poses.append((observation.time, state))
        while self._window_poses[0][0] < observation.time - self._window - 1e-9:
            self._window_poses.popleft()
        self._reckoning.reset(observation.time, state, self._window_poses[0][0])

    def commanded(self, time: float, control: Floats) -> None:
        """Record that `control` (nu,) is sent at `time` (s, ascending) and held from then on."""
        self._reckoning.command(time, control)

    def estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s)."""
        return Estimate(time, self._reckoning.at(time), time - self._newest_time)

    def replanning_estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s): mean of the predictions from each of the newest poses."""
        if len(self._window_poses) < 2:
            return self.estimate(time)
        states = np.array([self._reckoning.propagate(state, observed, time) for observed, state in self._window_poses])
        turned = states[:, self._model.theta] - states[-1, self._model.theta]
        states[:, self._model.theta] -= math.tau * np.round(turned / math.tau)  # outliers may be a full turn apart
        return Estimate(time, states.mean(axis=0), time - self._newest_time)
