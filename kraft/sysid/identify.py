"""Identification of a vehicle from logs: initial values, factor graph, model selection, parameters and warnings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kraft.logs.log import Log, LogSet
from kraft.sysid.base_vehicle import load_base_vehicle
from kraft.sysid.chains import whole_segment
from kraft.sysid.checks import SolvedProblem, warnings_of
from kraft.sysid.data import screen_logs, usable_logs
from kraft.sysid.factor_graph import FastGraph, PaperGraph
from kraft.sysid.fit_progress import FitProgress, OnIteration, ignore_iteration
from kraft.sysid.initial_values import InitialSearch, SmoothedPoses, smooth_chains
from kraft.sysid.interface import Identification, Settings
from kraft.sysid.optimiser import (
    LinearisedGraph,
    Optimum,
    ParameterUncertainty,
    estimate_uncertainty,
    held_at_bounds,
    optimise,
)
from kraft.sysid.parameters import Parameters, parameters_of, vehicle_of
from kraft.sysid.problem import NoiseModel, Point, Problem, assemble, noise_model, residual_ratio, starting_point
from kraft.sysid.result import assemble_identification
from kraft.sysid.selection import (
    candidates_of,
    check_free_parameters,
    check_settings,
    requested_names,
    selected,
    selection_note,
    with_clock_offset,
)
from kraft.sysid.smoothing import measured_noise
from kraft.sysid.terms import has_terms, identify_terms
from kraft.vehicles.config import VehicleConfig
from kraft.vehicles.reference import reference_of
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

RESIDUAL_SCALE_TOLERANCE = 1.5
"""Factor between residuals and their expectation from which the residuals set the threshold of the robust loss."""
REFITS_MAX = 3
"""Most rounds of model selection, each of which removes auxiliary parameters and fits the others again."""


def identify(
    vehicle: VehicleConfig | Vehicle | str | Path,
    logs: LogSet | Sequence[Log],
    settings: Settings | None = None,
    on_iteration: OnIteration = ignore_iteration,
) -> Identification:
    """Estimate the parameters of a vehicle from logs.

    Args:
        vehicle: a vehicle file, whose parameters have bounds and priors, or a vehicle from code, which gets wide ones;
            or a reference to either.
        logs: of `kraft.logs.reader.read_logs`; the sandwich interval treats them as independent of each other.
        settings: None for the defaults.
        on_iteration: called after each iteration with the number of the fit, about how many there will be, the
            iteration and the cost.

    Raises:
        InputError: if the logs cannot be used (no motion, other controls than those of the vehicle), or if the settings
            name a parameter that does not exist or leave none to identify.
        TypeError: if vehicle, logs or settings are of another type.
    """
    settings = Settings() if settings is None else settings
    if not isinstance(settings, Settings):
        raise TypeError(f"settings: expected kraft.sysid.Settings, not {type(settings).__name__}")
    if not isinstance(vehicle, VehicleConfig | Vehicle):
        vehicle = load_base_vehicle(reference_of(vehicle)).definition
    logs = logs.logs if isinstance(logs, LogSet) else logs
    if not isinstance(logs, Sequence) or not all(isinstance(log, Log) for log in logs):
        raise TypeError(f"logs: expected the result of read_logs, or a list of its logs, not {type(logs).__name__}")
    if isinstance(vehicle, VehicleConfig) and has_terms(vehicle):
        return identify_terms(vehicle, logs, settings, on_iteration).identification
    model = vehicle_of(vehicle)
    check_settings(vehicle, settings)
    check_free_parameters(vehicle, settings)
    usable = usable_logs(model, logs)
    settings = with_clock_offset(settings, usable)
    estimator = _Estimator(vehicle, model, settings, usable, on_iteration)
    auxiliary = candidates_of(model, settings)
    fit = estimator.fit(estimator.start(auxiliary), settings.iterations)
    if estimator.rescale(fit):
        fit = estimator.fit(estimator.without(fit, auxiliary), settings.iterations)
    short = screen_logs(logs)
    notes = [*(f"left out: {problem}" for problem in short.problems), *short.shortened]
    if settings.auxiliary in ("auto", "plan"):
        for _ in range(REFITS_MAX):
            kept = selected(fit.problem.parameters, fit.optimum.point.rho, fit.uncertainty, estimator.requested)
            if kept == fit.problem.parameters.auxiliary:
                break
            fit = estimator.fit(estimator.without(fit, kept), settings.iterations)
        notes.append(selection_note(auxiliary, fit.problem.parameters.auxiliary, estimator.requested))
    names = [log.name for log in estimator.logs]
    solution = SolvedProblem(
        fit.problem, fit.optimum, fit.uncertainty, estimator.data, names, not settings.noise, estimator.iterations
    )
    return assemble_identification(solution, warnings_of(solution), tuple(notes))


@dataclass(frozen=True, eq=False)
class _InitialProblem:
    """A problem and its initial point."""

    problem: Problem
    point: Point


@dataclass(frozen=True, eq=False)
class _Fit:
    """A problem and its solution."""

    problem: Problem
    optimum: Optimum
    uncertainty: ParameterUncertainty


class _Estimator:
    """Fits of the same logs with different auxiliary parameters."""

    def __init__(
        self,
        vehicle: VehicleConfig | Vehicle,
        model: Vehicle,
        settings: Settings,
        logs: Sequence[Log],
        on_iteration: OnIteration,
    ) -> None:
        self.on_iteration, self.iterations, self.fits = on_iteration, 0, 0
        selects = settings.auxiliary in ("auto", "plan")
        self.fits_planned = 1 + (REFITS_MAX if selects else 0)
        self.vehicle, self.model, self.settings, self.logs = vehicle, model, settings, logs
        self.segments = [whole_segment(part, i, settings.step) for i, log in enumerate(logs) for part in log.parts]
        self.noise: NoiseModel = noise_model(
            model,
            settings,
            settings.noise
            or measured_noise([s.part.pose_times for s in self.segments], [s.part.poses for s in self.segments]),
        )
        self.requested = requested_names(settings)

    def rescale(self, fit: _Fit) -> bool:
        """Set the threshold of the robust loss by the residuals if they differ from the noise; return whether they do.

        Otherwise noise that is stated too small would make every pose an outlier.
        """
        scale = math.sqrt(residual_ratio(fit.problem, fit.optimum.point))
        if 1.0 / RESIDUAL_SCALE_TOLERANCE < scale < RESIDUAL_SCALE_TOLERANCE or not self.noise.robust:
            return False
        self.noise = replace(self.noise, threshold=scale * self.noise.threshold)
        self.fits_planned += 1
        return True

    def problem(self, parameters: Parameters) -> Problem:
        """The problem with the given parameters."""
        return assemble(self.segments, len(self.logs), parameters, self.noise)

    def start(self, auxiliary: tuple[str, ...]) -> _InitialProblem:
        """The problem with initial values from the data alone."""
        problem = self.problem(parameters_of(self.vehicle, self.settings, auxiliary))
        self.data: SmoothedPoses = smooth_chains(problem.chains)
        nominal = problem.parameters.nominal
        search = InitialSearch(
            problem.parameters,
            problem.dynamics.discrete_model,
            problem.chains,
            self.data,
            problem.actuators.mean(nominal)[0],
        )
        return _InitialProblem(problem, starting_point(problem, self.data, search.best()))

    def without(self, fit: _Fit, auxiliary: tuple[str, ...]) -> _InitialProblem:
        """The problem with fewer auxiliary parameters, from the solution of a fit with more."""
        problem = self.problem(parameters_of(self.vehicle, self.settings, auxiliary))
        before = dict(zip(fit.problem.parameters.names, fit.optimum.point.rho, strict=True))
        rho: Floats = np.array([before[name] for name in problem.parameters.names])
        deviations = fit.problem.control_residuals(fit.optimum.point)
        controls = problem.actuators.mean(rho)[0] + deviations
        return _InitialProblem(problem, replace(fit.optimum.point, rho=rho, controls=controls))

    def fit(self, start: _InitialProblem, iterations: int) -> _Fit:
        """Solve a problem from its initial point."""
        self.fits += 1
        fit, planned = self.fits, max(self.fits, self.fits_planned)
        optimum = optimise(
            self._graph(start.problem),
            start.point,
            iterations,
            lambda made, cost: self.on_iteration(FitProgress(fit, planned, made, cost)),
        )
        self.iterations += optimum.iterations
        p, rho = start.problem.parameters, optimum.point.rho
        held = held_at_bounds(optimum.factors, p.low - rho, p.high - rho)
        return _Fit(start.problem, optimum, estimate_uncertainty(optimum.factors, p.free, held))

    def _graph(self, problem: Problem) -> LinearisedGraph:
        if self.settings.graph == "fast":
            return FastGraph(problem)
        return PaperGraph(problem)
