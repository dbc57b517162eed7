"""Information about the parameters that drives would give, before they are driven.

A drive is simulated open loop with the present parameters.  Eliminated as a log is, with the same noise of poses,
controls and process, its graph leaves the Fisher information of its poses on the parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from kraft.logs.log import Part
from kraft.sysid.chains import Segment
from kraft.sysid.dynamics import DIFFERENCE_STEP
from kraft.sysid.fast_graph import FastGraph
from kraft.sysid.identify import has_terms
from kraft.sysid.observation import NoiseModel, noise_model
from kraft.sysid.parameters import Parameters, parameters_of, vehicle_of
from kraft.sysid.prediction import HORIZONS
from kraft.sysid.problem import Point, Problem, assemble, simulated
from kraft.sysid.result import Identification
from kraft.sysid.selection import candidates_of
from kraft.sysid.settings import Noise, Settings
from kraft.sysid.structure import AUXILIARY
from kraft.sysid.uncertainty import inverse
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Bools, Floats, Ints, Matrix
from ompl_ext.vehicle import Vehicle

STEP = 0.05
"""Time between two states, s."""


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
        information: (drives, free, free) on the free parameters.
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
        noise: of the drives to come.
        rate: of their poses, 1/s.
    """

    parameters: Parameters
    covariance: Matrix
    scale: Floats
    noise: NoiseModel
    rate: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(name for name, free in zip(self.parameters.names, self.parameters.free, strict=True) if free)

    @property
    def std(self) -> Floats:
        """(free,)"""
        std: Floats = self.scale * np.sqrt(np.diag(self.covariance))
        return std

    def after(self, information: Floats) -> Knowledge:
        """What is known after drives with the information (free, free)."""
        return replace(self, covariance=inverse(inverse(self.covariance) + information))

    def covariances(self, information: Floats) -> Floats:
        """(drives, free, free) of the parameters after each of the drives alone."""
        size = 1.0 / np.sqrt(np.diag(self.covariance))
        total = (inverse(self.covariance) + information) / np.outer(size, size)
        found: Floats = np.linalg.inv(total) * np.outer(self.scale / size, self.scale / size)
        return found

    def simulate(self, drives: Sequence[Commands]) -> Drives:
        """Predicted paths and information of drives."""
        problem, point = self._simulated(drives)
        graph = FastGraph(problem)
        graph.linearise(point)
        free = self.parameters.free
        information = graph.reduce(0.0).information[:, free][:, :, free]
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
        span = round(HORIZONS[-1] / STEP)
        at = [
            np.arange(first, last - span, span)
            for first, last in zip(problem.chains.first[:-1], problem.chains.first[1:], strict=True)
        ]
        chain = np.repeat(np.arange(len(drives)), [len(windows) for windows in at])
        begin = np.concatenate(at)
        rho, free = point.rho, np.flatnonzero(self.parameters.free)
        changes = DIFFERENCE_STEP * np.maximum(np.abs(rho), 0.1)
        base = self._predicted(problem, point, chain, begin, rho)
        slopes = np.stack(
            [
                (self._predicted(problem, point, chain, begin, rho + changes * (np.arange(len(rho)) == k)) - base)
                / changes[k]
                for k in free
            ],
            axis=-1,
        )
        rows = slopes.reshape(-1, len(free))
        weight: Matrix = rows.T @ rows / (len(begin) * len(HORIZONS))
        return weight

    def _predicted(self, problem: Problem, point: Point, chain: Ints, begin: Ints, rho: Floats) -> Floats:
        """(windows, horizons, 2) positions after each horizon with `rho`, from the poses shown at the beginning."""
        start = point.states[begin]
        shown = problem.observation.predict(start, point.rho)
        for k, name in ((2, "theta"), (0, "x"), (1, "y")):  # the yaw first: a lever turns with it
            if name in self.parameters.vehicle.state:
                column = self.parameters.vehicle.index(name)
                start[:, column] += shown[:, k] - problem.observation.predict(start, rho)[:, k]
        span = round(HORIZONS[-1] / STEP)
        controls = problem.actuators.mean(rho)[0]
        first = begin - chain  # a chain has one state more than steps
        states = problem.dynamics.simulate(
            start, controls[first + np.arange(span)[:, None]], rho, np.full(len(begin), STEP)
        )
        seen = [problem.observation.predict(states[round(t / STEP)], rho)[:, :2] for t in HORIZONS]
        return np.stack(seen, axis=1)

    def _simulated(self, drives: Sequence[Commands]) -> tuple[Problem, Point]:
        problem = assemble(
            [self._segment(i, d) for i, d in enumerate(drives)], len(drives), self.parameters, self.noise
        )
        rho = self.parameters.nominal
        controls = problem.actuators.mean(rho)[0]
        start = np.zeros((len(drives), problem.dynamics.nx))
        return problem, Point(simulated(problem, start, controls, rho), controls, rho)

    def _segment(self, log: int, drive: Commands) -> Segment:
        steps = math.ceil(drive.end / STEP - 1e-9)
        times = np.arange(0.0, steps * STEP + 1e-9, 1.0 / self.rate)
        part = Part(drive.times, drive.controls, times, np.zeros((len(times), 3)))
        return Segment(log, part, 0.0, steps, STEP, slice(0, len(times)), True)


def known_after(
    vehicle: VehicleConfig | Vehicle, identification: Identification, settings: Settings, rate: float
) -> Knowledge:
    """What an identification knows; `rate` is that of the poses of drives to come, 1/s."""
    free = frozenset(identification.names)
    values, process = identification.values, {**identification.process, **settings.process}
    given = replace(settings, values=values, frozen=tuple(name for name in values if name not in free), process=process)
    parameters = parameters_of(vehicle, given, identification.auxiliary)
    graph = identification.graph_covariance
    scale = np.maximum(np.sqrt(np.diag(identification.covariance) / np.diag(graph)), 1.0)
    return Knowledge(parameters, graph, scale, _noise(parameters, given, identification.noise), rate)


def known_before(vehicle: VehicleConfig | Vehicle, noise: Noise, rate: float) -> Knowledge:
    """What is known before any drive: the priors of a vehicle file."""
    settings = Settings()
    auxiliary = AUXILIARY if has_terms(vehicle) else candidates_of(vehicle_of(vehicle), settings)
    parameters = parameters_of(vehicle, settings, auxiliary)
    free: Bools = parameters.free
    covariance = np.diag(parameters.std[free] ** 2)
    return Knowledge(parameters, covariance, np.ones(free.sum()), _noise(parameters, settings, noise), rate)


def _noise(parameters: Parameters, settings: Settings, noise: Noise) -> NoiseModel:
    """Noise with squares as loss: simulated poses have no outliers."""
    return noise_model(vehicle_of(parameters.vehicle), replace(settings, robust=None), noise)
