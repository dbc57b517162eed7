"""Online identification: the factor graph of Sec. IV-A over the last seconds of the drive, and the noise of its poses.

The graph is that of `kraft.sysid`: the model's parameters and the delay of commands as rho, states every `step` s, and
the observed poses between them.  Only time in which the vehicle moves counts: a vehicle at rest shows nothing of its
parameters, so a stop does not make the window forget.  The noise of poses is as the settings state it, and as the
residuals of the identification measure it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from kraft.driving.estimation.camera_model import CameraModel
from kraft.driving.estimation.dead_reckoning import DELAY_MAX
from kraft.driving.estimation.sloping_floor import SLOPE, SlopingObservation
from kraft.driving.messages import Observation
from kraft.driving.method import Adaptive
from kraft.driving.vehicle_model import VehicleModel
from kraft.logs.log import Part
from kraft.sysid.chains import Segment, segment_between
from kraft.sysid.factor_graph import FastGraph
from kraft.sysid.interface import Noise
from kraft.sysid.optimiser import optimise
from kraft.sysid.parameters import Parameters
from kraft.sysid.problem import NoiseModel, Point, Problem, assemble, threshold
from ompl_ext.arrays import Bools, Floats, Matrix

POSES_MIN: Final = 5
"""Number of poses below which a stretch of motion is not used."""
ROBUST: Final = 2.0
"""Residual, in standard deviations, above which the weight of a pose decreases."""
MARGIN: Final = 0.5
"""Time before and after a motion that belongs to it, s: standstill determines the speed there."""
SEEN: Final = 1.0
"""Time in which poses show whether the vehicle moves, s."""
SEEN_WAY: Final = 0.03
"""Distance of the mean place in the second half of that time from the one in the first half, at least, m."""
SEEN_DEVIATIONS: Final = 2.0
"""The same in standard deviations of a position."""
ROUNDING: Final = 1e-9
"""Difference of two times by rounding, s."""
RECENT: Final = 1.0
"""Shortest motion in which a parameter may differ from what it was before, s."""
EARLIER: Final = 1.0
"""Least motion before that, in the window, with which it is compared, s."""
SIGNIFICANT: Final = 1.0
"""Change of a parameter, in standard deviations, up to which it is taken as noise."""
NOTICED: Final = 1.5
"""Change of a parameter, in standard deviations, from which on a new change is followed."""
CHANGE_STD: Final = 2.0
"""Standard deviation of a change, as a multiple of that of the parameter's prior."""
INFORMATIVE: Final = 0.3
"""Information on a parameter, as a share of that of its prior, below which its change is not looked for."""
REST_BEFORE: Final = 0.5
"""Time before the drive in which the vehicle rested at its start, s."""
DRIVE_MAX: Final = 30.0
"""Age of the oldest poses that are kept for the window, s."""
RECORD_ROWS: Final = 256
"""Number of rows for which a record has room at first."""


@dataclass(frozen=True)
class Drive:
    """Recorded drive: poses with the states that the filter had at their times, and commands.

    Attributes:
        times: (n,) of the poses, ascending, s.
        poses: (n, 3) x, y (m), yaw (rad, continuous).
        states: (n, nx) estimated by the filter.
        command_times: (m,) ascending, s.
        commands: (m, nu).
    """

    times: Floats
    poses: Matrix
    states: Matrix
    command_times: Floats
    commands: Matrix

    @property
    def interval(self) -> float:
        """Mean time between poses, s."""
        return float(self.times[-1] - self.times[0]) / (len(self.times) - 1)


class _Record:
    """Rows of an array with ascending times; what has been given out stays as it is."""

    def __init__(self, columns: int) -> None:
        self._rows, self._begin, self._end = np.empty((RECORD_ROWS, 1 + columns)), 0, 0

    def append(self, time: float, *values: Floats) -> None:
        """Add a row at `time` s."""
        if self._end == len(self._rows):
            kept = self._rows[self._begin :]
            self._rows = np.empty((RECORD_ROWS + 2 * len(kept), kept.shape[1]))
            self._rows[: len(kept)] = kept
            self._begin, self._end = 0, len(kept)
        self._rows[self._end, 0], self._rows[self._end, 1:] = time, np.concatenate(values)
        self._end += 1

    def forget(self, before: float) -> None:
        """Drop the rows before `before` s, apart from the newest one."""
        self._begin += int(np.searchsorted(self.times[:-1], before))

    @property
    def times(self) -> Floats:
        """Times (n,) of the rows, s."""
        return self._rows[self._begin : self._end, 0]

    @property
    def values(self) -> Matrix:
        """Rows (n, columns)."""
        return self._rows[self._begin : self._end, 1:]


class DriveHistory:
    """Recorded poses with the filter's states, commands and times of motion, the last `DRIVE_MAX` s of them."""

    def __init__(self, start_state: Floats, model: VehicleModel) -> None:
        self._theta = model.theta
        pose = start_state[[model.x, model.y, model.theta]]
        self._poses = _Record(3 + len(start_state))
        for t in np.arange(-REST_BEFORE, -0.05, 0.1):
            self._poses.append(float(t), pose, start_state)
        self._commands = _Record(len(model.rest))
        self._commands.append(-math.inf, model.rest)
        self.moving: list[tuple[float, float]] = []

    def observe(self, observation: Observation, state: Floats) -> None:
        """Add a pose with the state (nx,) that the filter has at its time; late ones are left out."""
        if observation.time <= self._poses.times[-1]:
            return
        yaw = state[self._theta] + math.remainder(observation.theta - state[self._theta], math.tau)
        self._poses.append(observation.time, np.array([observation.x, observation.y, yaw]), state)
        if self._poses.times[0] < observation.time - 2.0 * DRIVE_MAX:  # where another process identifies, nobody asks
            self._forget(observation.time - DRIVE_MAX - REST_BEFORE)

    def command(self, time: float, control: Floats, moves: bool) -> None:
        """Add a command, and whether the vehicle moves at its time."""
        last = float(self._commands.times[-1])
        self._commands.append(time, control)
        if moves:
            if self.moving and self.moving[-1][1] >= last:
                self.moving[-1] = self.moving[-1][0], time
            else:
                self.moving.append((time, time))

    def has_moved(self, variance: float) -> bool:
        """Whether the poses of the latest `SEEN` s show a motion, given the variance of their position (m^2)."""
        times, places = self._poses.times, self._poses.values[:, :2]
        first, middle = (int(k) for k in np.searchsorted(times, times[-1] - SEEN * np.array([1.0, 0.5])))
        if first == middle:
            return False
        away = places[middle:].mean(axis=0) - places[first:middle].mean(axis=0)
        return math.hypot(*away) > max(SEEN_WAY, SEEN_DEVIATIONS * math.sqrt(variance))

    def leave_out(self, begin: float, end: float) -> None:
        """Take the time from `begin` to `end` (s), and what belongs to a motion before and after, as standstill."""
        first, last = begin - MARGIN, end + MARGIN
        parts = [part for a, b in self.moving for part in ((a, min(b, first)), (max(a, last), b))]
        self.moving = [(a, b) for a, b in parts if a < b]

    def drive(self, begin: float) -> Drive | None:
        """The recorded drive from `begin` (s) on; None before two poses."""
        self._forget(begin)
        times, poses, commanded = self._poses.times, self._poses.values, self._commands.times
        if len(times) < 2:
            return None
        first = min([times[0], *commanded[1:2]]) - 1.0
        return Drive(times, poses[:, :3], poses[:, 3:], np.maximum(commanded, first), self._commands.values)

    def _forget(self, before: float) -> None:
        """Drop what is not needed for a drive from `before` (s) on."""
        self._poses.forget(before)
        acting = int(np.searchsorted(self._commands.times, before - DELAY_MAX, side="right")) - 1
        self._commands.forget(float(self._commands.times[max(acting, 0)]))
        self.moving = [span for span in self.moving if span[1] >= before]


@dataclass(frozen=True)
class Identified:
    """Posterior of rho: mean (np,) and covariance (np, np); `residuals` (n, 3) of the poses at `times` (n,) s.

    Residuals are in the directions and units of their noise: along and across the line of sight of a known camera.

    `constant` (np,) with `constant_covariance` (np, np) is the posterior if no parameter has changed in the window.
    """

    rho: Floats
    covariance: Matrix
    times: Floats
    residuals: Matrix
    constant: Floats
    constant_covariance: Matrix


@dataclass(frozen=True)
class _Change:
    """Change of a parameter at `begin` (s): its `significance`, in standard deviations, and rho after it."""

    begin: float
    significance: float
    rho: Floats
    covariance: Matrix


class SlidingWindow:
    """Identifies rho from the last `length` s in which the vehicle moved; the prior is that of `parameters`.

    rho is taken as constant in the window, except for one parameter of the model that may have changed once: the
    parameter and the time whose score is the most significant.  The times that are tried are `RECENT` s of motion ago,
    and the one that the last updates found.  The change is estimated with what the motion before it tells of all
    others, and shrunk by its significance, as in the estimator of James and Stein.  Lengths of the vehicle stay.
    """

    def __init__(
        self,
        parameters: Parameters,
        length: float,
        step: float,
        process: Floats,
        control: Floats,
        iterations: int,
        turning: Bools,
        camera: CameraModel | None = None,
    ) -> None:
        """Set the noise of the model.

        Args:
            parameters: names, priors and bounds of rho.
            length: moving time in the window, s.
            step: time between two states, s.
            process: (nx,) standard deviation that the model adds, per square root of a second.
            control: (nu,) standard deviation of the applied control from the command.
            iterations: largest number of iterations of an update, which begins at the last one's result.
            turning: (np,) whether a parameter acts on turning alone, see `VehicleModel.acts_on_turning`.
            camera: that the poses come from, if it is known; the noise of poses is then that straight below it.  It
                takes the floor as level if rho has a slope.
        """
        self.parameters = parameters
        self._length, self._step, self._iterations = length, step, iterations
        self._process, self._control = process, control
        self.rho = parameters.nominal.copy()
        of_model = np.arange(len(parameters.specs)) < parameters.model_size
        self._may_change = parameters.free & of_model & [spec.unit != "m" for spec in parameters.specs]
        self._turning, self._camera = turning, camera
        sloping = parameters.auxiliary_index(SLOPE[0]) >= 0
        self._observation = SlopingObservation(parameters, camera) if camera is not None and sloping else None
        self._changed_at: float | None = None

    def set_std(self, k: int, std: float) -> None:
        """Set the standard deviation of the prior of parameter `k`."""
        specs = list(self.parameters.specs)
        specs[k] = replace(specs[k], std=std)
        self.parameters = replace(self.parameters, specs=tuple(specs))

    def forget_change(self) -> None:
        """Forget the change that the last updates found; one that the drive still shows is found again."""
        self._changed_at = None

    def update(
        self, drive: Drive, moving: Sequence[tuple[float, float]], noise: Callable[[float], Noise]
    ) -> Identified | None:
        """Identify from a drive; `moving` are the times (begin, end) in which the vehicle moved, ascending (s).

        `noise` gives the noise of a pose for what is identified from a motion of so many seconds.  Returns None if
        there is too little motion.
        """
        segments = self._segments(drive, moving, self._length)
        if not segments:
            return None
        problem = assemble(segments, 1, self.parameters, self._noise_model(noise(math.inf)))
        if self._camera is not None:
            problem = replace(problem, frames=self._camera.frames(problem.chains.poses[:, :2]))
        if self._observation is not None:
            problem = replace(problem, observation=self._observation)
        graph = FastGraph(problem)
        optimum = optimise(graph, self._start(problem, drive), self._iterations)
        self.rho = optimum.point.rho
        free = self.parameters.free
        covariance = np.zeros((len(free), len(free)))
        covariance[np.ix_(free, free)] = np.linalg.inv(optimum.factors.total_information[np.ix_(free, free)])
        times = np.concatenate([s.part.pose_times[s.poses] for s in segments])
        found = self._with_change(graph, moving, noise, covariance)
        residuals = -problem.pose_residuals(optimum.point)
        return Identified(*found, times, residuals, self.rho.copy(), covariance)

    def _with_change(
        self,
        graph: FastGraph,
        moving: Sequence[tuple[float, float]],
        noise: Callable[[float], Noise],
        covariance: Matrix,
    ) -> tuple[Floats, Matrix]:
        """Rho and its covariance after the most significant change; those of the window if none is significant.

        `graph` is that of the window, linearised at its optimum.
        """
        best: _Change | None = None
        for begin in (_begin_of_last(moving, RECENT), self._changed_at):
            change = None if begin is None else self._change(graph, moving, noise, covariance, begin)
            if change is None or (begin != self._changed_at and change.significance < NOTICED):
                continue
            if best is None or change.significance > best.significance:
                best = change
        self._changed_at = None if best is None else best.begin
        return (self.rho.copy(), covariance) if best is None else (best.rho, best.covariance)

    def _change(
        self,
        graph: FastGraph,
        moving: Sequence[tuple[float, float]],
        noise: Callable[[float], Noise],
        covariance: Matrix,
        begin: float,
    ) -> _Change | None:
        """The most significant change of one parameter at `begin` s; None if none is significant.

        In the window poses have the noise of a long motion.  For what acts on turning alone, the poses since `begin`
        get that of a short one, and the optimum moves accordingly.  For the other parameters they do not: errors of the
        position that change from place to place look like another speed.
        """
        since, total = (sum(max(0.0, last - max(first, t)) for first, last in moving) for t in (begin, -math.inf))
        if not RECENT - ROUNDING <= since <= min(self._length, total) - EARLIER:
            return None
        brief, long = (graph.since(begin - MARGIN, self._noise_model(noise(each))) for each in (since, math.inf))
        if brief.poses < POSES_MIN:
            return None
        free, square = self.parameters.free, np.ix_(*2 * (self.parameters.free,))
        with_brief, shift = np.zeros_like(covariance), np.zeros_like(self.rho)
        with_brief[square] = np.linalg.inv(
            np.linalg.inv(covariance[square]) + (brief.information - long.information)[square]
        )
        shift[free] = -with_brief[square] @ (brief.gradient - long.gradient)[free]
        moved = brief.gradient + brief.information @ shift, brief.information
        found = [
            self._change_of(begin, self._may_change & self._turning, *moved, self.rho + shift, with_brief),
            self._change_of(
                begin, self._may_change & ~self._turning, long.gradient, long.information, self.rho, covariance
            ),
        ]
        return max(filter(None, found), key=lambda change: change.significance, default=None)

    def _change_of(
        self,
        begin: float,
        tested: Bools,
        gradient: Floats,
        information: Matrix,
        rho: Floats,
        covariance: Matrix,
    ) -> _Change | None:
        """The most significant change of one of the `tested` parameters from `rho`, the optimum of the whole window.

        The cost of the newest motion has the gradient g and the information A there; the covariance C includes A.  A
        change of a parameter along e has the score -e g, with the variance e (A - A C A) e if there was none, and moves
        what is known of the other parameters by -C A e.
        """
        variance = np.diag(information - information @ covariance @ information)
        told = tested & (variance > INFORMATIVE / self.parameters.std**2)
        significance = np.where(told, np.abs(gradient) / np.sqrt(np.where(told, variance, 1.0)), 0.0)
        k = int(significance.argmax())
        if significance[k] <= SIGNIFICANT:
            return None
        total = variance[k] + (CHANGE_STD * self.parameters.std[k]) ** -2.0
        share = 1.0 - (SIGNIFICANT / significance[k]) ** 2
        direction = -covariance @ information[:, k]
        direction[k] += 1.0
        direction[~self.parameters.free] = 0.0
        changed = self.parameters.within_bounds(rho - share * gradient[k] / total * direction)
        return _Change(
            begin, float(significance[k]), changed, covariance + share / total * np.outer(direction, direction)
        )

    def _noise_model(self, noise: Noise) -> NoiseModel:
        return NoiseModel(noise, self._process, self._control, threshold(ROBUST, 3))

    def _segments(self, drive: Drive, moving: Sequence[tuple[float, float]], length: float) -> list[Segment]:
        """Segments of the last `length` s of motion, in the order of time."""
        since = _begin_of_last(moving, length)
        spans = [(max(begin, since) - MARGIN, end + MARGIN) for begin, end in moving if end >= since]
        part = Part(drive.command_times, drive.commands, drive.times, drive.poses)
        segments = []
        for begin, end in _joined(spans):
            first, last = (int(k) for k in np.searchsorted(drive.times, (begin, end)))
            if last - first >= POSES_MIN:
                segments.append(segment_between(part, 0, self._step, first, last, resting=True))
        return segments

    def _start(self, problem: Problem, drive: Drive) -> Point:
        """The filter's states, and controls as commanded."""
        times = np.concatenate([s.times for s in problem.chains.segments])
        states = np.column_stack([np.interp(times, drive.times, column) for column in drive.states.T])
        return Point(states, problem.actuators.mean(self.rho)[0], self.rho.copy())


def _begin_of_last(moving: Sequence[tuple[float, float]], length: float) -> float:
    """Time at which the last `length` s of motion begin, or all motion if there is less; infinite without any."""
    first = math.inf
    for begin, end in reversed(moving):
        first = max(begin, end - length)
        length -= end - first
        if length <= 0.0:
            break
    return first


def _joined(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Spans (begin, end), ascending, with those that overlap joined."""
    joined: list[tuple[float, float]] = []
    for begin, end in spans:
        if joined and begin <= joined[-1][1]:
            joined[-1] = joined[-1][0], end
        else:
            joined.append((begin, end))
    return joined


PRIOR_SAMPLES: Final = 8.0
"""Number of independent poses that the stated noise counts for beside the measured residuals."""
PRIOR_CORRELATION: Final = 4.0
"""Number of correlation times of residuals that weigh as much as the stated share."""
LAG: Final = 0.05
"""Time over which the correlation of residuals is measured, s."""
SHARE_MAX: Final = 0.95
"""Largest share of the pose error that counts as correlated."""


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise of poses: variances (3,), of which the share `share` (3,) decays with the time constant `time` (s).

    With a known camera that of poses straight below it: along and across its line of sight, and of the heading.
    """

    variance: Floats
    share: Floats
    time: float
    stated_variance: Floats
    stated_share: Floats

    @classmethod
    def of(cls, settings: Adaptive) -> NoiseEstimate:
        """Noise that the settings state."""
        sigmas = np.array([settings.position_noise, settings.position_noise, math.radians(settings.heading_noise_deg)])
        share = np.full(3, settings.correlated_share if settings.correlated else 0.0)
        return cls(sigmas**2, share, settings.correlation_time, sigmas**2, share)

    def updated(self, identified: Identified, interval: float) -> NoiseEstimate:
        """Noise measured by residuals, weighed with the stated noise as `PRIOR_SAMPLES` independent poses.

        Correlated residuals count as fewer independent ones, with the same information together.
        """
        residuals, count = identified.residuals, len(identified.residuals)
        squares = np.minimum(residuals**2, 16.0 * self.variance)  # outliers are the robust loss's
        part = 1.0 / self._inflation(interval)
        total = PRIOR_SAMPLES * self.stated_variance + part * squares.sum(axis=0)
        variance = total / (PRIOR_SAMPLES + part * count)
        share = self.share
        lag = max(1, round(LAG / interval))
        if self.stated_share.any() and count > 2 * lag:
            products = np.clip(residuals[lag:] * residuals[:-lag], -4.0 * self.variance, 4.0 * self.variance)
            correlation = products.mean(axis=0) / np.maximum(squares.mean(axis=0), 1e-9)
            weight = count * interval / self.time / PRIOR_CORRELATION
            measured = np.clip(correlation * math.exp(lag * interval / self.time), 0.0, SHARE_MAX)
            share = (self.stated_share + weight * measured) / (1.0 + weight)
        return NoiseEstimate(variance, share, self.time, self.stated_variance, self.stated_share)

    def _inflation(self, interval: float, length: float = math.inf) -> Floats:
        """Number (3,) of poses, `interval` s apart, with the information of an independent one, see `of_one_pose`."""
        kept = math.exp(-interval / self.time)
        density = (1.0 - kept**2) / (1.0 - 2.0 * kept * math.cos(math.tau * interval / length) + kept**2)
        return 1.0 - self.share + self.share * density

    def of_one_pose(self, interval: float, length: float = math.inf) -> Noise:
        """Noise of a pose as if poses, `interval` s apart, were independent: with the same information together.

        That is the information on what varies once in `length` s: errors that vary more slowly change little in a
        short motion.  It is the white noise with the same spectral density at that frequency.
        """
        sigma = np.sqrt(self.variance * self._inflation(interval, length))
        return Noise(float(math.sqrt(0.5 * (sigma[0] ** 2 + sigma[1] ** 2))), float(sigma[2]))
