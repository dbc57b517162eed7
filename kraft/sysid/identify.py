"""Identify a vehicle from logs: from data to initial values, through the graph to parameters and their doubts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from kraft.sysid.chains import whole
from kraft.sysid.checks import Case, at_bound, unidentified, warnings_of
from kraft.sysid.data import screened, usable_logs
from kraft.sysid.dynamics import Motion
from kraft.sysid.fast_graph import FastGraph
from kraft.sysid.initial_values import Search, Smooth, smooth
from kraft.sysid.observation import NoiseModel, noise_model
from kraft.sysid.optimiser import Linearised, Optimum, Watch, held_at_bounds, optimise, unwatched
from kraft.sysid.parameters import Parameters, parameters_of, vehicle_of
from kraft.sysid.problem import Point, Problem, assemble, residual_ratio, starting_point
from kraft.sysid.result import Estimated, Identification, LogFit, PartFit
from kraft.sysid.selection import asked_for, choice, shown, to_try
from kraft.sysid.settings import Settings
from kraft.sysid.settings_validation import check_free, check_settings
from kraft.sysid.smoothing import measured_noise
from kraft.sysid.uncertainty import Uncertainty, uncertainty
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log


TYPICAL = 1.5
"""Residuals by this factor larger or smaller than the noise lets expect set the threshold of the robust loss."""
REFITS = 3
"""Most times that extras are dropped and the rest is fitted anew."""
SECONDS, STEP = 3.0, 0.02
SHARE = 0.1
"""Of the full steering: a gentle turn."""


def identify(
    vehicle: VehicleConfig | Vehicle,
    logs: Sequence[Log],
    settings: Settings | None = None,
    watch: Watch = unwatched,
) -> Identification:
    """Estimate the parameters of a vehicle from logs.

    Args:
        vehicle: a vehicle file, whose parameters have bounds and priors, or a vehicle from code, which gets wide ones.
        logs: of `kraft.logs.reader.read_logs`; the sandwich interval treats them as independent of each other.
        settings: by default what suits most logs.
        watch: is told after each iteration of the optimiser how many it made, trying extras included, and the cost.

    Raises:
        InputError: if the logs cannot be used (no motion, controls that the vehicle does not have), or a setting names
            a parameter that does not exist, or they leave none to identify.
    """
    settings = settings or Settings()
    model = vehicle_of(vehicle)
    check_settings(vehicle, settings)
    check_free(vehicle, settings)
    task = _Task(vehicle, model, settings, usable_logs(model, logs), watch)
    extras = to_try(model, settings)
    fit = task.fit(task.start(extras), settings.iterations)
    if task.rescale(fit):
        fit = task.fit(task.without(fit, extras), settings.iterations)
    short = screened(logs)
    notes = [*(f"left out: {problem}" for problem in short.problems), *short.shortened]
    if settings.extras in ("auto", "plan"):
        for _ in range(REFITS):
            kept = shown(fit.problem.parameters, fit.optimum.point.rho, fit.uncertain, task.asked)
            if kept == fit.problem.parameters.extras:
                break
            fit = task.fit(task.without(fit, kept), settings.iterations)
        notes.append(choice(extras, fit.problem.parameters.extras, task.asked))
    names = [log.name for log in task.logs]
    case = Case(fit.problem, fit.optimum, fit.uncertain, task.data, names, not settings.noise, task.iterations)
    return identification(case, warnings_of(case), tuple(notes))


@dataclass(frozen=True, eq=False)
class _Start:
    """A problem and where to begin with it."""

    problem: Problem
    point: Point


@dataclass(frozen=True, eq=False)
class _Fit:
    """A problem solved."""

    problem: Problem
    optimum: Optimum
    uncertain: Uncertainty


class _Task:
    """What stays the same while extras come and go."""

    def __init__(
        self, vehicle: VehicleConfig | Vehicle, model: Vehicle, settings: Settings, logs: Sequence[Log], watch: Watch
    ) -> None:
        self.watch, self.iterations = watch, 0
        self.vehicle, self.model, self.settings, self.logs = vehicle, model, settings, logs
        self.stretches = [whole(part, i, settings.step) for i, log in enumerate(logs) for part in log.parts]
        self.noise: NoiseModel = noise_model(
            model,
            settings,
            settings.noise
            or measured_noise([s.part.pose_times for s in self.stretches], [s.part.poses for s in self.stretches]),
        )
        self.asked = asked_for(settings)

    def rescale(self, fit: _Fit) -> bool:
        """Count outliers by how large residuals are where that is not what the noise says, and whether it is not.

        Noise that is stated too small would make an outlier of every pose.
        """
        scale = math.sqrt(residual_ratio(fit.problem, fit.optimum.point))
        if 1.0 / TYPICAL < scale < TYPICAL or not self.noise.robust:
            return False
        self.noise = replace(self.noise, threshold=scale * self.noise.threshold)
        return True

    def problem(self, parameters: Parameters) -> Problem:
        """The problem with some parameters."""
        return assemble(self.stretches, len(self.logs), parameters, self.noise)

    def start(self, extras: tuple[str, ...]) -> _Start:
        """Begin with what the data alone say."""
        problem = self.problem(parameters_of(self.vehicle, self.settings, extras))
        self.data: Smooth = smooth(problem.chains)
        nominal = problem.parameters.nominal
        search = Search(
            problem.parameters, problem.dynamics.motion, problem.chains, self.data, problem.commands.mean(nominal)[0]
        )
        return _Start(problem, starting_point(problem, self.data, search.best()))

    def without(self, fit: _Fit, extras: tuple[str, ...]) -> _Start:
        """Begin where a fit with more extras ended."""
        problem = self.problem(parameters_of(self.vehicle, self.settings, extras))
        before = dict(zip(fit.problem.parameters.names, fit.optimum.point.rho, strict=True))
        rho: Floats = np.array([before[name] for name in problem.parameters.names])
        deviations = fit.problem.control_residuals(fit.optimum.point)
        controls = problem.commands.mean(rho)[0] + deviations
        return _Start(problem, replace(fit.optimum.point, rho=rho, controls=controls))

    def fit(self, start: _Start, iterations: int) -> _Fit:
        """Solve a problem."""
        before = self.iterations
        optimum = optimise(
            self._graph(start.problem), start.point, iterations, lambda made, cost: self.watch(before + made, cost)
        )
        self.iterations += optimum.iterations
        p, rho = start.problem.parameters, optimum.point.rho
        held = held_at_bounds(optimum.factors, p.low - rho, p.high - rho)
        return _Fit(start.problem, optimum, uncertainty(optimum.factors, p.free, held))

    def _graph(self, problem: Problem) -> Linearised:
        if self.settings.graph == "fast":
            return FastGraph(problem)
        from kraft.sysid.paper_graph import PaperGraph

        return PaperGraph(problem)


def ahead_of_axle(parameters: Parameters, motion: Motion, rho: Floats) -> float | None:
    """Distance of the model's point ahead of its rear axle, m; None for a vehicle without steering.

    In a steady turn a point b ahead of the axle moves sideways with b times the turning rate.
    """
    vehicle = parameters.vehicle
    controls = list(vehicle.controls)
    if "steering" not in controls or vehicle.index("theta") < 0:
        return None
    control = np.maximum(vehicle.control_bounds[:, 1], 0.0)
    control[controls.index("steering")] *= SHARE
    steps = round(SECONDS / STEP)
    states = motion.simulate(
        np.zeros((1, motion.nx)),
        np.tile(control, (steps, 1, 1)),
        parameters.model_values(rho)[None],
        np.array([STEP]),
    )[-2:, 0]
    dx, dy, turn = np.diff(states, axis=0)[0][[vehicle.index(name) for name in ("x", "y", "theta")]]
    middle = states[0, vehicle.index("theta")] + 0.5 * turn
    sideways = dy * np.cos(middle) - dx * np.sin(middle)
    return float(sideways / turn) if abs(turn) > 1e-6 else None


def identification(case: Case, warnings: tuple[str, ...], notes: tuple[str, ...]) -> Identification:
    """The result."""
    p, noise = case.problem.parameters, case.problem.noise
    vehicle, rho = p.vehicle, case.optimum.point.rho
    axle = ahead_of_axle(p, case.problem.dynamics.motion, rho)
    lever = float(rho[k]) if (k := p.extra("lever")) >= 0 else 0.0
    return Identification(
        model=vehicle.name,
        parameters=_estimated(case),
        extras=p.extras,
        names=tuple(case.names),
        covariance=case.uncertain.covariance,
        interval=case.uncertain.kind,
        graph_covariance=case.uncertain.graph,
        unidentified=unidentified(case),
        converged=case.optimum.converged,
        iterations=case.iterations,
        cost=case.optimum.cost,
        noise=noise.noise,
        noise_measured=case.noise_measured,
        process={name: float(value) for name, value in zip(vehicle.state, noise.process, strict=True)},
        warnings=warnings,
        notes=notes,
        logs=_log_fits(case),
        rear_axle=None if axle is None else axle + lever,
    )


def _estimated(case: Case) -> dict[str, Estimated]:
    p, rho = case.problem.parameters, case.optimum.point.rho
    std: Floats = np.zeros(len(rho))
    std[p.free] = case.uncertain.std
    half, bounds = case.uncertain.quantile * std, at_bound(case)
    return {
        number.name: Estimated(
            value=float(rho[k]),
            std=float(std[k]),
            ci95=(max(float(rho[k] - half[k]), number.min), min(float(rho[k] + half[k]), number.max)),
            unit=number.unit,
            description=number.description,
            initial=number.value,
            min=number.min,
            max=number.max,
            frozen=not p.free[k],
            at_bound=number.name in bounds,
        )
        for k, number in enumerate(p.numbers)
    }


def _log_fits(case: Case) -> tuple[LogFit, ...]:
    problem, point, chains = case.problem, case.optimum.point, case.problem.chains
    fitted = problem.observation.predict(problem.between(point.states), point.rho)
    weights = problem.noise.weights(problem.pose_residuals(point))
    parts: list[list[PartFit]] = [[] for _ in case.logs]
    step, pose = 0, 0
    for c, stretch in enumerate(chains.stretches):
        count = len(stretch.part.pose_times[stretch.poses])
        parts[stretch.log].append(
            PartFit(
                times=stretch.times,
                states=point.states[chains.first[c] : chains.first[c + 1]],
                controls=point.controls[step : step + stretch.steps],
                pose_times=stretch.part.pose_times[stretch.poses],
                poses=stretch.part.poses[stretch.poses],
                fitted=fitted[pose : pose + count],
                weights=weights[pose : pose + count],
            )
        )
        step, pose = step + stretch.steps, pose + count
    return tuple(LogFit(name, tuple(found)) for name, found in zip(case.logs, parts, strict=True))
