"""Identification of a vehicle from logs: initial values, factor graph, model selection, parameters and warnings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.logs.log import Log, LogSet
from kraft.sysid.base_vehicle import load_base_vehicle
from kraft.sysid.chains import whole_segment
from kraft.sysid.checks import SolvedProblem, SteeringInMotion, at_bound, unidentified, warnings_of
from kraft.sysid.data import screen_logs, usable_logs
from kraft.sysid.dynamics import DiscreteModel
from kraft.sysid.factor_graph import FastGraph, PaperGraph
from kraft.sysid.initial_values import InitialSearch, SmoothedPoses, smooth_chains
from kraft.sysid.interface import Identification, LogFit, ModelTrial, ParameterEstimate, PartFit, Settings
from kraft.sysid.optimiser import (
    LinearisedGraph,
    OnIteration,
    Optimum,
    Uncertainty,
    estimate_uncertainty,
    held_at_bounds,
    ignore_iteration,
    optimise,
)
from kraft.sysid.parameters import DELAY_MIN, Parameters, parameters_of, vehicle_of
from kraft.sysid.prediction import process_noise
from kraft.sysid.problem import NoiseModel, Point, Problem, assemble, noise_model, residual_ratio, starting_point
from kraft.sysid.screening import turns_before_steered
from kraft.sysid.selection import (
    candidates_of,
    check_free_parameters,
    check_settings,
    requested_names,
    selected,
    selection_note,
)
from kraft.sysid.smoothing import measured_noise
from kraft.sysid.structure import HORIZON_SHARES, StructureSearch
from kraft.sysid.structure_choice import NEGLIGIBLE, Structure, best_of, chosen, is_near
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

RESIDUAL_SCALE_TOLERANCE = 1.5
"""Factor between residuals and their expectation from which the residuals set the threshold of the robust loss."""
REFITS_MAX = 3
"""Most rounds of model selection, each of which removes auxiliary parameters and fits the others again."""
BOTH_SIDES = ("phi_diff", "asymmetry", "yaw_offset")
"""Parameters of a car that turns to one side do not tell from the steering curve and the slip."""
WHEELBASE = "L"
TURN_SECONDS, TURN_STEP = 3.0, 0.02
TURN_STEERING_SHARE = 0.1
"""Steering of the simulated turn, as a share of the full steering."""


def identify(
    vehicle: VehicleConfig | Vehicle | str,
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
        on_iteration: called after each iteration with the number of iterations, those of model selection included,
            and the cost.

    Raises:
        InputError: if the logs cannot be used (no motion, other controls than those of the vehicle), or if the settings
            name a parameter that does not exist or leave none to identify.
    """
    settings = settings or Settings()
    vehicle = load_base_vehicle(vehicle).definition if isinstance(vehicle, str) else vehicle
    logs = logs.logs if isinstance(logs, LogSet) else logs
    if isinstance(vehicle, VehicleConfig) and has_terms(vehicle):
        return identify_terms(vehicle, logs, settings, on_iteration).identification
    model = vehicle_of(vehicle)
    check_settings(vehicle, settings)
    check_free_parameters(vehicle, settings)
    usable = usable_logs(model, logs)
    settings = _with_clock_offset(settings, usable)
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


@dataclass(frozen=True)
class ModelChoice:
    """The chosen model and its parameters."""

    vehicle: VehicleConfig
    identification: Identification


def has_terms(vehicle: VehicleConfig | Vehicle) -> bool:
    """Whether the model has terms that identification may switch off."""
    return isinstance(vehicle, VehicleConfig) and any(p.neutral is not None for p in vehicle.parameters.values())


def identify_terms(
    vehicle: VehicleConfig,
    logs: Sequence[Log],
    settings: Settings | None = None,
    on_iteration: OnIteration = ignore_iteration,
    simpler: VehicleConfig | None = None,
) -> ModelChoice:
    """Choose the terms of a model that the logs need, and estimate their parameters.

    Args:
        vehicle: a vehicle file in which some parameters have a neutral value.
        logs: of `kraft.logs.reader.read_logs`.
        settings: None for the defaults.
        on_iteration: called after each iteration with the number of iterations and the cost.
        simpler: a model with fewer states, which is chosen with the same terms if it predicts as well, and with its own
            if it predicts better: the other one may have lags that the vehicle lacks.

    Raises:
        InputError: if the logs cannot be used, or a control never changes in them.
    """
    settings = settings or Settings()
    check_settings(vehicle, settings)
    usable = usable_logs(vehicle_of(vehicle), logs)
    steered = SteeringInMotion.of(usable)
    check_controls(usable, steered)
    settings = _with_clock_offset(settings, usable)
    held = _shown_by_both_sides(vehicle, steered)
    settings = replace(settings, frozen=(*settings.frozen, *held))
    search = StructureSearch(vehicle, usable, settings, on_iteration)
    best, final, path, trials = _searched(search)
    if simpler is not None and steered.changes:
        other = StructureSearch(simpler, usable, settings, on_iteration)
        other.growth = search.growth
        alike = other.alike(best)
        final.iterations += other.iterations
        trials.append(alike)
        if set(best.terms) <= set(alike.terms) and is_near(alike, best_of(path), NEGLIGIBLE):
            vehicle, best = simpler, alike
        elif not is_near(best, alike, NEGLIGIBLE):
            own = StructureSearch(simpler, usable, settings, on_iteration)
            own.iterations = final.iterations
            vehicle, trials = simpler, trials[:-1]
            best, final, _, more = _searched(own)
            trials += more
    identification = _identified(best, final, usable, settings)
    rows = tuple(_trial(s, chosen=s is best, horizon=settings.horizon) for s in trials)
    notes = [f"not identified, because only turns to both sides show them: {', '.join(held)}"] if held else []
    notes += _wheelbase_note(identification, settings)
    return ModelChoice(vehicle, replace(identification, trials=rows, notes=(*identification.notes, *notes)))


def _searched(
    search: StructureSearch,
) -> tuple[Structure, StructureSearch, list[Structure], list[Structure]]:
    """The chosen structure with the search that fitted it last, the path to few terms, and all structures to report."""
    path = search.path()
    simplest = search.converged(chosen(path))
    best = search.completed(simplest, path)
    best = search.pruned(best) if search.is_exact(best) else best
    best, final = search.in_long_windows(best, path)
    trials = [simplest if s.terms == simplest.terms else s for s in path]
    return best, final, path, trials + ([] if best is simplest else [best])


def _wheelbase_note(identification: Identification, settings: Settings) -> list[str]:
    """What to do about a wheelbase that nobody stated."""
    known = identification.parameters.get(WHEELBASE)
    if known is None or not known.frozen or WHEELBASE in settings.values:
        return []
    return [
        f"poses do not show {WHEELBASE}, the wheelbase, but its ratio to the steering: it remains {known.value:g} m, "
        "and wheel angles are those of such a car; state the measured one, with which predictions are the same"
    ]


def _with_clock_offset(settings: Settings, logs: Sequence[Log]) -> Settings:
    """Settings that allow a negative delay where the logs show it; elsewhere it would stand for what a model lacks."""
    if settings.clock_offset is not None:
        return settings
    return replace(settings, clock_offset=-DELAY_MIN if turns_before_steered(logs) else 0.0)


def _shown_by_both_sides(vehicle: VehicleConfig, steered: SteeringInMotion) -> tuple[str, ...]:
    """Parameters that are not identified because the logs show turns to one side only."""
    return () if steered.both_sides else tuple(name for name in BOTH_SIDES if name in vehicle.parameters)


def check_controls(logs: Sequence[Log], steered: SteeringInMotion) -> None:
    """Refuse logs in which a control never changes: nothing shows what it does.

    Raises:
        InputError: with every such control.
    """
    problems = []
    for k, name in enumerate(logs[0].controls):
        values = np.concatenate([part.commands[:, k] for log in logs for part in log.parts])
        expected = "expected drives in which it takes several values, left and right, or forward and coasting"
        if np.ptp(values) <= 0.0:
            problems.append(Diagnostic("logs", f"{name} is always {values[0]:g}", expected, code=Code.DATA))
        elif name == "steering" and not steered.varies:
            problem = "steering hardly changes while the vehicle moves"
            problems.append(Diagnostic("logs", problem, expected, code=Code.DATA))
    if problems:
        raise InputError(problems)


def _trial(structure: Structure, *, chosen: bool, horizon: float) -> ModelTrial:
    times = [share * horizon for share in HORIZON_SHARES]
    errors = {
        t: float(t * np.nanmean(of_folds))
        for t, of_folds in zip(times, structure.errors.T, strict=True)
        if not np.isnan(of_folds).all()
    }
    name = structure.graph.problem.parameters.vehicle.name
    return ModelTrial(name, structure.terms, structure.without, errors, chosen, structure.added)


def _identified(best: Structure, search: StructureSearch, logs: Sequence[Log], settings: Settings) -> Identification:
    """Result with the parameters of a structure; the smoothed states are those of its windows."""
    graph, optimum = best.graph, best.optimum
    p, problem = graph.problem.parameters, graph.problem
    controls = problem.actuators.mean(optimum.point.rho)[0]
    point = Point(graph.trajectories(optimum.point), controls, optimum.point.rho)
    scale = math.sqrt(residual_ratio(problem, point))
    walks = process_noise(p.vehicle, search.growth, settings.horizon)
    default = problem.noise.process
    process = np.array([max(walks.get(n, 0.0), d) for n, d in zip(p.vehicle.state, default, strict=True)])
    noise = replace(problem.noise, threshold=max(scale, 1.0) * problem.noise.threshold, process=process)
    problem = replace(problem, noise=noise)
    held = held_at_bounds(optimum.factors, p.low - point.rho, p.high - point.rho)
    uncertainty = estimate_uncertainty(optimum.factors, p.free, held)
    solution = SolvedProblem(
        problem, replace(optimum, point=point), uncertainty, graph.smoothed, [log.name for log in logs],
        not settings.noise, search.iterations,
    )  # fmt: skip
    off = tuple(
        spec.name for spec in p.specs[: p.model_size] if spec.neutral is not None and spec.name not in best.terms
    )
    unneeded = [name for name in off if name not in settings.frozen]
    missing = [name for name in search.auxiliary if name not in best.terms]
    notes = [f"terms that the logs do not need: {', '.join((*unneeded, *missing))}"] if unneeded or missing else []
    found = assemble_identification(solution, warnings_of(solution, windows=True), tuple(notes))
    found = replace(
        found,
        parameters={
            name: replace(value, variation=search.variation.total.get(name, 0.0))
            for name, value in found.parameters.items()
            if name not in missing
        },
        auxiliary=tuple(name for name in found.auxiliary if name not in missing),
    )
    others = [dict(zip(p.names, map(float, rho), strict=True)) for rho in best.others]
    return replace(found, off=off, without_log=tuple(others) if len(others) == len(logs) else ())


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
    uncertainty: Uncertainty


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
        self.on_iteration, self.iterations = on_iteration, 0
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
        before = self.iterations
        optimum = optimise(
            self._graph(start.problem),
            start.point,
            iterations,
            lambda made, cost: self.on_iteration(before + made, cost),
        )
        self.iterations += optimum.iterations
        p, rho = start.problem.parameters, optimum.point.rho
        held = held_at_bounds(optimum.factors, p.low - rho, p.high - rho)
        return _Fit(start.problem, optimum, estimate_uncertainty(optimum.factors, p.free, held))

    def _graph(self, problem: Problem) -> LinearisedGraph:
        if self.settings.graph == "fast":
            return FastGraph(problem)
        return PaperGraph(problem)


def tracked_ahead_of_axle(parameters: Parameters, discrete_model: DiscreteModel, rho: Floats) -> float | None:
    """Distance of the tracked point ahead of the rear axle, m; None for a vehicle without steering."""
    lever = float(rho[k]) if (k := parameters.index("lever")) >= 0 else 0.0
    if "lever" in parameters.vehicle.parameters:  # of the models with terms; that of a car is from its rear axle
        return lever if "steering" in parameters.vehicle.controls else None
    axle = ahead_of_axle(parameters, discrete_model, rho)
    return None if axle is None else axle + lever


def ahead_of_axle(parameters: Parameters, discrete_model: DiscreteModel, rho: Floats) -> float | None:
    """Distance of the model's point ahead of its rear axle, m; None for a vehicle without steering.

    In a steady turn a point b ahead of the axle moves sideways with b times the turning rate.
    """
    vehicle = parameters.vehicle
    controls = list(vehicle.controls)
    if "steering" not in controls or vehicle.index("theta") < 0:
        return None
    control = np.maximum(vehicle.control_bounds[:, 1], 0.0)
    control[controls.index("steering")] *= TURN_STEERING_SHARE
    steps = round(TURN_SECONDS / TURN_STEP)
    states = discrete_model.simulate(
        np.zeros((1, discrete_model.nx)),
        np.tile(control, (steps, 1, 1)),
        parameters.model_values(rho)[None],
        np.array([TURN_STEP]),
    )[-2:, 0]
    dx, dy, turn = np.diff(states, axis=0)[0][[vehicle.index(name) for name in ("x", "y", "theta")]]
    middle = states[0, vehicle.index("theta")] + 0.5 * turn
    sideways = dy * np.cos(middle) - dx * np.sin(middle)
    return float(sideways / turn) if abs(turn) > 1e-6 else None


def assemble_identification(
    solution: SolvedProblem, warnings: tuple[str, ...], notes: tuple[str, ...]
) -> Identification:
    """The result of an identification."""
    p, noise = solution.problem.parameters, solution.problem.noise
    vehicle, rho = p.vehicle, solution.optimum.point.rho
    return Identification(
        model=vehicle.name,
        parameters=_estimated(solution),
        auxiliary=p.auxiliary,
        names=solution.names,
        covariance=solution.uncertainty.covariance,
        interval=solution.uncertainty.kind,
        graph_covariance=solution.uncertainty.graph,
        unidentified=unidentified(solution),
        converged=solution.optimum.converged,
        iterations=solution.iterations,
        cost=solution.optimum.cost,
        noise=noise.noise,
        noise_measured=solution.noise_measured,
        process={name: float(value) for name, value in zip(vehicle.state, noise.process, strict=True)},
        warnings=warnings,
        notes=notes,
        logs=_log_fits(solution),
        rear_axle=tracked_ahead_of_axle(p, solution.problem.dynamics.discrete_model, rho),
        without_log=_without_log(solution),
    )


def _without_log(solution: SolvedProblem) -> tuple[dict[str, float], ...]:
    p, shifts = solution.problem.parameters, solution.uncertainty.shifts
    if len(shifts) != len(solution.logs) or len(shifts) < 2:
        return ()
    rhos = np.tile(solution.optimum.point.rho, (len(shifts), 1))
    rhos[:, p.free] += shifts
    return tuple(dict(zip(p.names, map(float, p.within_bounds(rho)), strict=True)) for rho in rhos)


def _estimated(solution: SolvedProblem) -> dict[str, ParameterEstimate]:
    p, rho = solution.problem.parameters, solution.optimum.point.rho
    std: Floats = np.zeros(len(rho))
    std[p.free] = solution.uncertainty.std
    half, bounds = solution.uncertainty.quantile * std, at_bound(solution)
    return {
        spec.name: ParameterEstimate(
            value=float(rho[k]),
            std=float(std[k]),
            ci95=(max(float(rho[k] - half[k]), spec.min), min(float(rho[k] + half[k]), spec.max)),
            unit=spec.unit,
            description=spec.description,
            initial=spec.value,
            min=spec.min,
            max=spec.max,
            frozen=not p.free[k],
            at_bound=spec.name in bounds,
        )
        for k, spec in enumerate(p.specs)
    }


def _log_fits(solution: SolvedProblem) -> tuple[LogFit, ...]:
    problem, point, chains = solution.problem, solution.optimum.point, solution.problem.chains
    fitted = problem.observation.predict(problem.at_poses(point.states), point.rho)
    weights = problem.noise.weights(problem.pose_residuals(point))
    parts: list[list[PartFit]] = [[] for _ in solution.logs]
    step, pose = 0, 0
    for c, segment in enumerate(chains.segments):
        count = len(segment.part.pose_times[segment.poses])
        parts[segment.log].append(
            PartFit(
                times=segment.times,
                states=point.states[chains.first[c] : chains.first[c + 1]],
                controls=point.controls[step : step + segment.steps],
                pose_times=segment.part.pose_times[segment.poses],
                poses=segment.part.poses[segment.poses],
                fitted=fitted[pose : pose + count],
                weights=weights[pose : pose + count],
            )
        )
        step, pose = step + segment.steps, pose + count
    return tuple(LogFit(name, tuple(found)) for name, found in zip(solution.logs, parts, strict=True))
