"""Dead reckoning: the prediction from a known state with the commands since then, its drift, and an estimator by it."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from kraft.driving.estimator_settings import Adaptive, Latest
from kraft.driving.messages import Estimate, Observation
from kraft.driving.vehicle_model import VehicleModel
from kraft.errors import InputError
from kraft.vehicles import DELAY_MAX
from ompl_ext.arrays import Floats
from ompl_ext.times import SAME_TIME
from ompl_ext.vehicle import Vehicle

Held = Sequence[tuple[Floats, float]]
"""Controls (nu,) that are held one after the other, each with its duration (s)."""
Advance = Callable[[Floats, Held], Floats]
"""Function from a state (nx,) to the state (nx,) after held controls."""


class CommandHistory:
    """History of commands: each control (nu,) is held until the next one; before the first one `rest` is held.

    A command acts `delay` s after its time.
    """

    def __init__(self, rest: Floats) -> None:
        self.delay = 0.0
        self._times: list[float] = [-math.inf]
        self._controls: list[Floats] = [rest.copy()]

    def add(self, time: float, control: Floats) -> None:
        """Hold `control` from `time` (s) on; times ascend, and a second control at the same time replaces the first."""
        if time < self._times[-1]:
            raise ValueError(f"commanded at {time} s after a command at {self._times[-1]} s")
        if time == self._times[-1]:
            self._controls[-1] = control.copy()
            return
        self._times.append(time)
        self._controls.append(control.copy())

    def between(self, begin: float, end: float) -> Held:
        """Controls that act from `begin` to `end` (s), each with its duration (s)."""
        begin, end = begin - self.delay, end - self.delay
        if begin < self._times[0]:
            raise ValueError(f"the commands before {self._times[0]} s are forgotten, {begin} s is asked for")
        k, held = bisect_right(self._times, begin) - 1, []
        while begin < end:
            until = min(self._times[k + 1], end) if k + 1 < len(self._times) else end
            held.append((self._controls[k], until - begin))
            begin, k = until, k + 1
        return held

    def forget(self, before: float) -> None:
        """Drop the commands that are not needed for times from `before` (s) on, whatever the delay."""
        k = bisect_right(self._times, before - DELAY_MAX) - 1
        del self._times[:k], self._controls[:k]


class DeadReckoning:
    """Prediction from a known state, at first at time 0, with the recorded commands.

    Predictions continue from the latest one, so that their cost does not grow with the age of the known state.
    """

    def __init__(self, advance: Advance, rest: Floats, state: Floats) -> None:
        self._advance = advance
        self.commands = CommandHistory(rest)
        self.reset(0.0, state)

    def reset(self, time: float, state: Floats, keep: float = math.inf) -> None:
        """Predict from `state` at `time` (s) from now on; keep the commands since `keep` (s) if that is earlier."""
        self.time, self._state = time, state.copy()
        self._latest = self.time, self._state
        self.commands.forget(min(time, keep))

    def set_delay(self, delay: float) -> None:
        """Set the delay of all commands (s, at most `DELAY_MAX`), those of the past included."""
        self.commands.delay = delay
        self._latest = self.time, self._state

    def command(self, time: float, control: Floats) -> None:
        """Hold `control` (nu,) from `time` (s) on; it acts after the delay."""
        if time + self.commands.delay < self._latest[0]:
            self._latest = self.time, self._state
        self.commands.add(time, control)

    def at(self, time: float) -> Floats:
        """Predicted state at `time` (s); before the time of the known state that state."""
        if time < self._latest[0]:
            self._latest = self.time, self._state
        begin, state = self._latest
        self._latest = max(begin, time), self.propagate(state, begin, time)
        return self._latest[1].copy()

    def propagate(self, state: Floats, begin: float, end: float) -> Floats:
        """State (nx,) at `end` (s) predicted from any `state` at `begin` (s), as far back as commands are kept."""
        return self._advance(state, self.commands.between(begin, end))


def require_finite(observation: Observation) -> None:
    """Refuse a pose that is not a number, which would spoil every later estimate.

    Raises:
        InputError: a number of it is not finite.
    """
    values = observation.time, observation.x, observation.y, observation.theta
    if not all(map(math.isfinite, values)):
        time, x, y, theta = values
        problem = f"x, y, theta at t = {time:.12g} s are {x:.12g}, {y:.12g}, {theta:.12g}"
        raise InputError.of_argument("observation", problem, "expected finite numbers")


class LatestPose:
    """Uses the newest pose without filtering.

    State components that a pose does not contain, such as the speed, follow the commands by the model.  In the paper
    the speed is the commanded one (Sec. V), which a model with a lag contradicts.  A plan is committed for a
    whole cycle, so one bad pose could admit a bad plan: replanning therefore uses the mean of the newest poses.
    """

    horizon: Final = 0.0
    belief: Final = None

    def __init__(self, settings: Latest, model: VehicleModel, start_state: Floats) -> None:
        self._model = model
        self._reckoning = DeadReckoning(model.after_commands, model.rest, start_state)
        self._newest_time = -math.inf
        self._window = settings.replanning_window
        self._window_poses: deque[tuple[float, Floats]] = deque()

    def observe(self, observation: Observation) -> None:
        """Predict from this pose on, unless a newer one has arrived before.

        Raises:
            InputError: the pose is not finite; the estimate is as before.
        """
        require_finite(observation)
        if observation.time <= self._newest_time or observation.time < self._reckoning.time:
            return
        self._newest_time = observation.time
        state, model = self._reckoning.at(observation.time), self._model
        state[model.x], state[model.y] = observation.x, observation.y
        # continuous over full turns
        state[model.theta] += math.remainder(observation.theta - state[model.theta], math.tau)
        self._window_poses.append((observation.time, state))
        while self._window_poses[0][0] < observation.time - self._window - SAME_TIME:
            self._window_poses.popleft()
        self._reckoning.reset(observation.time, state, self._window_poses[0][0])

    def commanded(self, time: float, control: Floats) -> None:
        """Record that `control` (nu,) is sent at `time` (s, ascending) and held from then on."""
        self._reckoning.command(time, control)

    def estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s)."""
        return Estimate(time, self._reckoning.at(time), time - self._newest_time)

    def leave_out(self, begin: float, end: float) -> None:
        """Do nothing: nothing is identified."""

    def replanning_estimate(self, time: float) -> Estimate:
        """Estimate at `time` (s): mean of the predictions from each of the newest poses."""
        if len(self._window_poses) < 2:
            return self.estimate(time)
        states = np.array([self._reckoning.propagate(state, observed, time) for observed, state in self._window_poses])
        turned = states[:, self._model.theta] - states[-1, self._model.theta]
        states[:, self._model.theta] -= math.tau * np.round(turned / math.tau)  # outliers may be a full turn apart
        return Estimate(time, states.mean(axis=0), time - self._newest_time)

    def uncertainty(self, time: float) -> None:
        """No bound rests on this estimator: it states no uncertainty."""


def with_identified_drift(settings: Adaptive, vehicle: Vehicle) -> Adaptive:
    """Settings with at least the drifts that the errors of held-out drives in the vehicle's file show.

    A random walk of the position by `drift` and one of the speed by `speed_drift` lead to the variance
    drift^2 t + speed_drift^2 t^3 / 3 along the vehicle.  The drives at the speed with the largest errors count.
    """
    if not vehicle.errors_by_speed:
        return settings
    from scipy.optimize import nnls  # which takes a fifth of what a process of a drive loads

    drift, heading, speed = settings.drift, settings.heading_drift_deg, settings.speed_drift
    for errors in vehicle.errors_by_speed:
        after, variance = np.array(errors.after), np.maximum(np.square(errors.along), np.square(errors.across))
        terms = np.column_stack([after, after**3 / 3.0])
        scale = 1.0 / np.maximum(variance, 1e-12)
        position, moving = np.sqrt(nnls(terms * scale[:, None], variance * scale)[0])
        drift, speed = max(drift, float(position)), max(speed, float(moving))
        heading = max(heading, math.degrees(math.sqrt(float(np.mean(np.square(errors.yaw) / after)))))
    return settings.model_copy(update={"drift": drift, "heading_drift_deg": heading, "speed_drift": speed})
