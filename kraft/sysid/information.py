"""Information about the parameters that drives would give, before they are driven.

A drive is simulated open loop with the present parameters.  Eliminated as a log is, with the same noise of poses,
controls and process, its graph leaves the Fisher information of its poses on the parameters.

No model is exact.  Drives at full throttle alone would bend the parameters to full throttle, and the fit would predict
other drives worse (Box, Draper: A basis for the selection of a response surface design, 1959).  Errors that depend on a
command or on the speed are therefore added to the controls, each with a small prior.  They bend the estimates; drives
are expected to be good if they bend them as very many random drives would, which are to be predicted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.signal import lfilter

from kraft.logs.log import Part
from kraft.sysid.chains import Chains, Segment
from kraft.sysid.factor_graph import FastGraph
from kraft.sysid.interface import Identification, Noise, Settings
from kraft.sysid.optimiser import inverse
from kraft.sysid.parameters import Parameters, parameters_of, speed_index
from kraft.sysid.prediction import HORIZONS
from kraft.sysid.problem import NoiseModel, Point, Problem, assemble, noise_model, simulated
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.times import SAME_TIME
from ompl_ext.vehicle import Vehicle

STEP = 0.05
"""Time between two states, s."""
MODEL_ERROR = 0.03
"""Standard deviation of each error of the model, as a share of the range of the control."""
MODEL_LAG = 0.1
"""Lag of a control that the model may lack, s."""
LEVELS = np.linspace(0.0, 1.0, 5)
"""Commands, as shares of their range, at which the errors of the model are independent ..."""
SPEEDS = np.array([0.0, 0.5, 1.0])
"""... and speeds, as shares of the top speed."""
REST_STD = 0.05
"""Standard deviation of speeds and angles of the wheels of a vehicle at rest, m/s, rad and rad/s."""


class Commands(Protocol):
    """Open-loop commands of a drive that begins at rest."""

    @property
    def times(self) -> Floats:
        """(m,) of the commands, s; each is held until the next one."""

    @property
    def controls(self) -> Matrix:
        """(m, nu)"""

    @property
    def end(self) -> float:
        """Time until which the last command is held, s."""


@dataclass(frozen=True, eq=False)
class Drives:
    """Simulated drives.

    Attributes:
        paths: (drives, n, 3) predicted poses of the tracked point, `STEP` apart from 0, at rest at the origin at first;
            a drive that ends before the others remains at its last pose.
        information: (drives, free + m, free + m) on the free parameters and m errors of the model.
    """

    paths: Floats
    information: Floats


@dataclass(frozen=True, eq=False)
class Knowledge:
    """What is known of the parameters: values, covariance, and the noise of the drives to come.

    Attributes:
        parameters: those of the model and auxiliary ones at their present values, the others than the free ones frozen.
        covariance: (free, free) under the stated noise.
        scale: (free,) reported standard deviations over those under the stated noise: where logs disagree more than
            their noise explains, a drive to come gives as much less information.
        prior: (free,) standard deviations before any drive.
        driven: (free + m, free + m) information of all drives so far, as simulated.
        noise: of the drives to come.
        rate: of their poses, 1/s.
    """

    parameters: Parameters
    covariance: Matrix
    scale: Floats
    prior: Floats
    driven: Matrix
    noise: NoiseModel
    rate: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return self.parameters.free_names

    @property
    def std(self) -> Floats:
        """(free,)"""
        std: Floats = self.scale * np.sqrt(np.diag(self.covariance))
        return std

    def after(self, information: Matrix) -> Knowledge:
        """What is known after drives with the information (free + m, free + m)."""
        count = len(self.scale)
        covariance = inverse(inverse(self.covariance) + information[:count, :count])
        return replace(self, covariance=covariance, driven=self.driven + information)

    def uncertainty_errors(self, weight: Matrix, information: Floats) -> Floats:
        """Expected errors (drives,) of predictions by the uncertainty of the parameters after each drive alone, m.

        `weight` is that of `prediction_weight`, `information` (drives, free + m, free + m) that of the drives.
        """
        count = len(self.scale)
        covariance = inverse(inverse(self.covariance) + information[:, :count, :count])
        own = weight * np.outer(self.scale, self.scale)
        errors: Floats = np.sqrt(np.einsum("ij,nij->n", own, covariance))
        return errors

    def model_errors(self, weight: Matrix, reference: Matrix, information: Floats) -> Floats:
        """Expected errors (drives,) of predictions by the errors of the model, after all drives so far and each, m.

        They are the differences from predictions with the parameters that the reference gives: drives with the
        information (free + m, free + m), so many that the noise of their poses does not matter.
        """
        off = self._bent(self.driven + information) - self._bent(reference[None])
        errors: Floats = np.sqrt(np.maximum(np.einsum("nij,ik,nkj->n", off, weight, off), 0.0))
        return errors

    def _bent(self, information: Floats) -> Floats:
        """Changes (n, free, m) of the estimates by the errors of the model in drives with the information."""
        count = len(self.scale)
        own = information[:, :count, :count] + np.diag(self.prior**-2.0)
        bent: Floats = inverse(own) @ information[:, :count, count:]
        return bent

    def simulate(self, drives: Sequence[Commands]) -> Drives:
        """Predicted paths and information of drives."""
        problem, point = self._simulated(drives)
        graph = FastGraph(problem)
        graph.linearise(point)
        effects = _effects(problem, point)
        kept = np.concatenate([self.parameters.free, np.ones(effects.shape[2], dtype=bool)])
        information = graph.information_with(effects, self._start())[:, kept][:, :, kept]
        shown = problem.observation.predict(point.states, point.rho)
        first, most = problem.chains.first, int(np.diff(problem.chains.first).max())
        at = np.minimum(first[:-1, None] + np.arange(most), first[1:, None] - 1)
        return Drives(shown[at], information)

    def prediction_weight(self, drives: Sequence[Commands]) -> Matrix:
        """Weight W (free, free) that makes tr(W C) the mean squared error of predicted positions, m^2.

        Of windows one after another in the drives, predicted open loop from known poses and speeds, after each of
        `HORIZONS`; C is the covariance of the parameters.
        """
        problem, point = self._simulated(drives)
        chains = problem.chains
        span = round(HORIZONS[-1] / STEP)
        at = [np.arange(a, b - span, span) for a, b in zip(chains.first[:-1], chains.first[1:], strict=True)]
        begin = np.concatenate(at)
        step = begin - np.repeat(np.arange(len(at)), [len(windows) for windows in at])  # one fewer than states by chain
        _, jacobian = problem.dynamics.linearise(point.states[chains.state], point.controls, point.rho, chains.h)
        nx, nu = problem.dynamics.nx, problem.dynamics.nu
        forced = jacobian[:, :, nx : nx + nu] @ problem.actuators.mean(point.rho)[1] + jacobian[:, :, nx + nu :]
        _, by_state, by_rho = problem.observation.linearise(point.states, point.rho)
        slope = np.zeros((len(begin), nx, forced.shape[2]))
        for k, name in ((2, "theta"), (0, "x"), (1, "y")):  # the shown pose is known; the yaw first
            if name in self.parameters.vehicle.state:
                shown = np.einsum("nx,nxr->nr", by_state[begin, k], slope) + by_rho[begin, k]
                slope[:, self.parameters.vehicle.index(name)] -= shown
        rows = []
        for k in range(span):
            slope = jacobian[step + k, :, :nx] @ slope + forced[step + k]
            if any(round(after / STEP) == k + 1 for after in HORIZONS):
                rows.append(
                    (by_state[begin + k + 1, :2] @ slope + by_rho[begin + k + 1, :2]).reshape(-1, slope.shape[2])
                )
        found = np.concatenate(rows)[:, self.parameters.free]
        weight: Matrix = found.T @ found / (len(begin) * len(HORIZONS))
        return weight

    def _start(self) -> Floats:
        """Information (nx,) on the first state of a drive: at rest, at a pose that is not known.

        Without it the angle of wheels that nobody has seen is unknown without limits.  A lag forgets that angle, so
        that its information grows from nothing by the same factor in every step, and from what rounding leaves of it,
        which may be negative.
        """
        vehicle = self.parameters.vehicle
        return np.array([0.0 if name in ("x", "y", "theta") else REST_STD**-2.0 for name in vehicle.state])

    def _simulated(self, drives: Sequence[Commands]) -> tuple[Problem, Point]:
        segments = [self._segment(i, drive) for i, drive in enumerate(drives)]
        problem = assemble(segments, len(drives), self.parameters, self.noise)
        rho = self.parameters.nominal
        controls = problem.actuators.mean(rho)[0]
        start = np.zeros((len(drives), problem.dynamics.nx))
        return problem, Point(simulated(problem, start, controls, rho), controls, rho)

    def _segment(self, log: int, drive: Commands) -> Segment:
        steps = math.ceil(drive.end / STEP - 1e-9)
        times = np.arange(0.0, steps * STEP + SAME_TIME, 1.0 / self.rate)
        part = Part(drive.times, drive.controls, times, np.zeros((len(times), 3)))
        return Segment(log, part, 0.0, steps, STEP, slice(0, len(times)), True)


def _effects(problem: Problem, point: Point) -> Floats:
    """Effects (N, nu, m) of the errors of the model on the controls of each step, each of one standard deviation.

    An error of a control depends on its command or on the speed, piecewise linearly, or grows with the square of the
    speed in proportion to the command, or is that of a lag.
    """
    vehicle, x = problem.parameters.vehicle, point.states[problem.chains.state]
    k = speed_index(vehicle)
    speed = np.abs(x[:, k]) / vehicle.top_speed if k >= 0 else np.zeros(len(x))
    speeds = _hats(speed, SPEEDS)
    found = []
    for c, (low, high) in enumerate(vehicle.controls.values()):
        own = (point.controls[:, c] - low) / (high - low)
        features = np.column_stack([_hats(own, LEVELS), speeds, point.controls[:, c] / (high - low) * speed**2])
        effect = np.zeros((len(x), len(vehicle.controls), features.shape[1] + 1))
        effect[:, c, :-1] = MODEL_ERROR * (high - low) * features
        effect[:, c, -1] = _lagging(problem.chains, point.controls[:, c]) - point.controls[:, c]
        found.append(effect)
    return np.concatenate(found, axis=2)


def _lagging(chains: Chains, control: Floats) -> Floats:
    """Control (N,) of all steps behind a lag of `MODEL_LAG`."""
    found = np.empty_like(control)
    keep = math.exp(-STEP / MODEL_LAG)
    for begin, end in pairwise(chains.first_step):
        own = control[begin:end]
        found[begin:end] = lfilter([1.0 - keep], [1.0, -keep], own, zi=[keep * own[0]])[0]
    return found


def _hats(values: Floats, knots: Floats) -> Matrix:
    """(n, knots) piecewise linear functions, each 1 at its knot and 0 at the others."""
    return interpolated_rows(values, knots, np.eye(len(knots)))


def known_after(
    vehicle: VehicleConfig | Vehicle,
    identification: Identification,
    settings: Settings,
    logs: Sequence[Commands],
    rate: float,
) -> Knowledge:
    """What an identification from logs with these commands knows; `rate` is that of poses to come, 1/s."""
    free = frozenset(identification.names)
    values, process = identification.values, {**identification.process, **settings.process}
    given = replace(settings, values=values, frozen=tuple(name for name in values if name not in free), process=process)
    parameters = parameters_of(vehicle, given, identification.auxiliary)
    graph = identification.graph_covariance
    scale = np.maximum(np.sqrt(np.diag(identification.covariance) / np.diag(graph)), 1.0)
    noise = _noise(parameters, given, identification.noise)
    known = Knowledge(parameters, graph, scale, parameters.std[parameters.free], np.zeros((0, 0)), noise, rate)
    return replace(known, driven=known.simulate(logs).information.sum(axis=0))


def known_before(vehicle: VehicleConfig | Vehicle, noise: Noise, rate: float) -> Knowledge:
    """What is known before any drive: the priors of a vehicle file."""
    settings = Settings()
    parameters = parameters_of(vehicle, settings, ())
    prior = parameters.std[parameters.free]
    model = _noise(parameters, settings, noise)
    size = len(prior) + (len(LEVELS) + len(SPEEDS) + 2) * len(parameters.vehicle.controls)
    return Knowledge(parameters, np.diag(prior**2), np.ones(len(prior)), prior, np.zeros((size, size)), model, rate)


def _noise(parameters: Parameters, settings: Settings, noise: Noise) -> NoiseModel:
    """Noise with squares as loss: simulated poses have no outliers."""
    return noise_model(parameters.vehicle, replace(settings, robust=None), noise)
