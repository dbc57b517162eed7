"""Online identification: the factor graph of Sec. IV-A over the last seconds of the drive.

The graph is that of `kraft.sysid`: the model's parameters and the delay of commands as rho, states every `step` s, and
the observed poses between them.  Only time in which the vehicle moves counts: a vehicle at rest shows nothing of its
parameters, so a stop does not make the window forget.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from kraft.logs.log import Part
from kraft.sysid.chains import Segment, segment_between
from kraft.sysid.fast_graph import FastGraph
from kraft.sysid.observation import NoiseModel, threshold
from kraft.sysid.optimiser import optimise
from kraft.sysid.parameters import Parameters
from kraft.sysid.problem import Point, Problem, assemble
from kraft.sysid.settings import Noise
from ompl_ext.arrays import Floats, Matrix

POSES_MIN: Final = 5
"""Number of poses below which a stretch of motion is not used."""
ROBUST: Final = 2.0
"""Residual, in standard deviations, above which the weight of a pose decreases."""
MARGIN: Final = 0.5
"""Time before and after a motion that belongs to it, s: standstill determines the speed there."""


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


@dataclass(frozen=True)
class Identified:
    """Posterior of rho: mean (np,) and covariance (np, np); `residuals` (n, 3) of the poses at `times` (n,) s."""

    rho: Floats
    covariance: Matrix
    times: Floats
    residuals: Matrix


class SlidingWindow:
    """Identifies rho from the last `length` s in which the vehicle moved; the prior is that of `parameters`."""

    def __init__(
        self, parameters: Parameters, length: float, step: float, process: Floats, control: Floats, iterations: int
    ) -> None:
        """Set the noise of the model.

        Args:
            parameters: names, priors and bounds of rho.
            length: moving time in the window, s.
            step: time between two states, s.
            process: (nx,) standard deviation that the model adds, per square root of a second.
            control: (nu,) standard deviation of the applied control from the command.
            iterations: largest number of iterations of an update, which begins at the last one's result.
        """
        self.parameters = parameters
        self._length, self._step, self._iterations = length, step, iterations
        self._process, self._control = process, control
        self.rho = parameters.nominal.copy()

    def update(self, drive: Drive, moving: Sequence[tuple[float, float]], noise: Noise) -> Identified | None:
        """Identify from a drive; `moving` are the times (begin, end) in which the vehicle moved, ascending (s).

        `noise` is that of a pose.  Returns None if there is too little motion.
        """
        segments = self._segments(drive, moving)
        if not segments:
            return None
        model = NoiseModel(noise, self._process, self._control, threshold(ROBUST, 3))
        problem = assemble(segments, 1, self.parameters, model)
        graph = FastGraph(problem)
        optimum = optimise(graph, self._start(problem, drive), self._iterations)
        self.rho = optimum.point.rho
        free = self.parameters.free
        covariance = np.zeros((len(free), len(free)))
        covariance[np.ix_(free, free)] = np.linalg.inv(optimum.factors.total_information[np.ix_(free, free)])
        times = np.concatenate([s.part.pose_times[s.poses] for s in segments])
        return Identified(self.rho.copy(), covariance, times, -problem.pose_residuals(optimum.point))

    def _segments(self, drive: Drive, moving: Sequence[tuple[float, float]]) -> list[Segment]:
        """Segments of the last `length` s of motion, in the order of time."""
        left, spans = self._length, list[tuple[float, float]]()
        for begin, end in reversed(moving):
            first = max(begin, end - left)
            spans.append((first - MARGIN, end + MARGIN))
            left -= end - first
            if left <= 0.0:
                break
        part = Part(drive.command_times, drive.commands, drive.times, drive.poses)
        segments = []
        for begin, end in _joined(spans[::-1]):
            first, last = (int(k) for k in np.searchsorted(drive.times, (begin, end)))
            if last - first >= POSES_MIN:
                segments.append(segment_between(part, 0, self._step, first, last, resting=True))
        return segments

    def _start(self, problem: Problem, drive: Drive) -> Point:
        """The filter's states, and controls as commanded."""
        times = np.concatenate([s.times for s in problem.chains.segments])
        states = np.column_stack([np.interp(times, drive.times, column) for column in drive.states.T])
        return Point(states, problem.actuators.mean(self.rho)[0], self.rho.copy())


def _joined(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Spans (begin, end), ascending, with those that overlap joined."""
    joined: list[tuple[float, float]] = []
    for begin, end in spans:
        if joined and begin <= joined[-1][1]:
            joined[-1] = joined[-1][0], end
        else:
            joined.append((begin, end))
    return joined
