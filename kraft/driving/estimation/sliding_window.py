"""Online identification: the factor graph of Sec. IV-A over the last seconds of the drive.

The graph is that of `kraft.sysid`: the model's parameters and the delay of commands as rho, states every `step` s, and
the observed poses between them.  Only time in which the vehicle moves counts: a vehicle at rest shows nothing of its
parameters, so a stop does not make the window forget.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from kraft.driving.estimation.camera_model import CameraModel
from kraft.driving.estimation.drive_history import AROUND_MOTION, RecordedDrive
from kraft.driving.estimation.sloping_floor import SLOPE, SlopingObservationModel
from kraft.logs.log import Part
from kraft.sysid.chains import Segment, segment_between
from kraft.sysid.factor_graph import FastGraph
from kraft.sysid.interface import Noise
from kraft.sysid.optimiser import optimise
from kraft.sysid.parameters import Parameters
from kraft.sysid.problem import NoiseModel, Point, Problem, assemble, threshold
from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.times import SAME_TIME

POSES_MIN: Final = 5
"""Number of poses below which a stretch of motion is not used."""
ROBUST: Final = 2.0
"""Residual, in standard deviations, above which the weight of a pose decreases."""
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


@dataclass(frozen=True)
class Gaussian:
    """Distribution of rho: mean (np,) and covariance (np, np)."""

    mean: Floats
    covariance: Matrix


@dataclass(frozen=True)
class Identified:
    """Posterior of rho: mean (np,) and covariance (np, np); `residuals` (n, 3) of the poses at `times` (n,) s.

    Residuals are in the directions and units of their noise: along and across the line of sight of a known camera.

    `before` is the posterior of what rho was before a parameter changed in the window.
    """

    rho: Floats
    covariance: Matrix
    times: Floats
    residuals: Matrix
    before: Gaussian


@dataclass(frozen=True)
class _Change:
    """Change of a parameter at `begin` (s): its `significance`, in standard deviations, and rho before and after it."""

    begin: float
    significance: float
    before: Gaussian
    after: Gaussian


class SlidingWindow:
    """Identifies rho from the last `length` s in which the vehicle moved; the prior is that of `parameters`.

    rho is taken as constant in the window, except for one parameter of the model that may have changed once: the
    parameter and the time whose score is the most significant.  The times that are tried are `RECENT` s of motion ago,
    and the one that the last updates found.  The change is estimated with what the motion before it tells of all
    others, and shrunk by its significance, as in the estimator of James and Stein.  Lengths of the vehicle stay.  What
    rho was before the change takes it in full: of the parameter that has changed, only the motion before tells.
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
        self._process, self._control, self._threshold = process, control, threshold(ROBUST, 3)
        self.rho = parameters.nominal.copy()
        of_model = np.arange(len(parameters.specs)) < parameters.model_size
        self._may_change = parameters.free & of_model & [spec.unit != "m" for spec in parameters.specs]
        self._turning, self._camera = turning, camera
        sloping = parameters.auxiliary_index(SLOPE[0]) >= 0
        self._observation = SlopingObservationModel(parameters, camera) if camera is not None and sloping else None
        self._changed_at: float | None = None

    def set_std(self, k: int, std: float) -> None:
        """Set the standard deviation of the prior of parameter `k`."""
        specs = list(self.parameters.specs)
        if specs[k].std == std:  # in most cycles: the parameters keep the arrays that they have made
            return
        specs[k] = replace(specs[k], std=std)
        self.parameters = replace(self.parameters, specs=tuple(specs))

    def forget_change(self) -> None:
        """Forget the change that the last updates found; one that the drive still shows is found again."""
        self._changed_at = None

    def update(
        self, drive: RecordedDrive, moving: Sequence[tuple[float, float]], noise: Callable[[float], Noise]
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
        square = np.ix_(*2 * (self.parameters.free,))
        covariance = np.zeros_like(optimum.factors.total_information)
        covariance[square] = np.linalg.inv(optimum.factors.total_information[square])
        times = np.concatenate([s.part.pose_times[s.poses] for s in segments])
        before, now = self._with_change(graph, moving, noise, covariance)
        return Identified(now.mean, now.covariance, times, -graph.pose_residuals, before)

    def _with_change(
        self,
        graph: FastGraph,
        moving: Sequence[tuple[float, float]],
        noise: Callable[[float], Noise],
        covariance: Matrix,
    ) -> tuple[Gaussian, Gaussian]:
        """Rho before and after the most significant change; if none is significant, twice that of the window.

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
        constant = Gaussian(self.rho.copy(), covariance)
        return (constant, constant) if best is None else (best.before, best.after)

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
        if not RECENT - SAME_TIME <= since <= min(self._length, total) - EARLIER:
            return None
        brief = graph.since(begin - AROUND_MOTION, self._noise_model(noise(since)))
        if brief.poses < POSES_MIN:
            return None
        long = graph.since(begin - AROUND_MOTION, graph.problem.noise)
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
        others = np.where(self.parameters.free, -covariance @ information[:, k], 0.0)

        def moved(along: Floats, share: float) -> Gaussian:
            mean = self.parameters.within_bounds(rho - share * gradient[k] / total * along)
            return Gaussian(mean, covariance + share / total * np.outer(along, along))

        after = others + (np.arange(len(rho)) == k)
        return _Change(begin, float(significance[k]), moved(others, 1.0), moved(after, share))

    def _noise_model(self, noise: Noise) -> NoiseModel:
        return NoiseModel(noise, self._process, self._control, self._threshold)

    def _segments(self, drive: RecordedDrive, moving: Sequence[tuple[float, float]], length: float) -> list[Segment]:
        """Segments of the last `length` s of motion, in the order of time."""
        since = _begin_of_last(moving, length)
        spans = [(max(begin, since) - AROUND_MOTION, end + AROUND_MOTION) for begin, end in moving if end >= since]
        part = Part(drive.command_times, drive.commands, drive.times, drive.poses)
        segments = []
        for begin, end in _joined(spans):
            first, last = (int(k) for k in np.searchsorted(drive.times, (begin, end)))
            if last - first >= POSES_MIN:
                segments.append(segment_between(part, 0, self._step, first, last, resting=True))
        return segments

    def _start(self, problem: Problem, drive: RecordedDrive) -> Point:
        """The filter's states, and controls as commanded."""
        times = np.concatenate([s.times for s in problem.chains.segments])
        states = interpolated_rows(times, drive.times, drive.states)
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
