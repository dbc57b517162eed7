"""Identification of a model with terms that may be switched off: the ones that the logs need, with their parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.logs.log import Log
from kraft.sysid.checks import STEERING_SPREAD_MIN, SolvedProblem, SteeringInMotion, warnings_of
from kraft.sysid.command_units import SIDES
from kraft.sysid.data import usable_logs
from kraft.sysid.fit_progress import OnIteration, ignore_iteration
from kraft.sysid.interface import Identification, ModelTrial, Settings
from kraft.sysid.optimiser import (
    estimate_uncertainty,
    held_at_bounds,
)
from kraft.sysid.parameters import Parameters, vehicle_of
from kraft.sysid.prediction import process_noise
from kraft.sysid.problem import Point, residual_ratio
from kraft.sysid.result import assemble_identification
from kraft.sysid.selection import (
    check_settings,
    with_clock_offset,
)
from kraft.sysid.structure import HORIZON_SHARES, StructureSearch
from kraft.sysid.structure_choice import CLEARLY_WORSE, NEGLIGIBLE_LOSS, Structure, best_of, chosen, is_near
from kraft.sysid.tracked_side import search_with_side
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

BOTH_SIDES = ("phi_diff", "asymmetry", "yaw_offset")
"""Parameters that turns to one side alone do not distinguish from the steering curve and the slip."""


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
        on_iteration: called after each iteration of each fit.
        simpler: a model with fewer states, which is chosen with the same terms if it predicts as well, and with its own
            if it predicts better or, with all terms, as well: the other one may have lags that the vehicle lacks.

    Raises:
        InputError: if the logs cannot be used, or a control never changes in them.
    """
    usable, settings, held = _prepared(vehicle, logs, settings or Settings())
    steered = SteeringInMotion.of(usable)
    search = StructureSearch(vehicle, usable, settings, on_iteration)
    every = search.full()
    wider = search_with_side(search, every, usable, on_iteration) if steered.both_sides else search
    found = searched(search, every) if wider is search else searched(wider)
    settings = wider.settings
    if simpler is not None and steered.changes:
        other = StructureSearch(simpler, usable, settings, on_iteration)
        other.growth, other.variation = wider.growth, wider.variation
        other.goes_on(found.final)
        alike = other.alike(found.best)
        own = StructureSearch(simpler, usable, settings, on_iteration)
        own.goes_on(other)
        taken = simplified(found, alike, own)
        vehicle = vehicle if taken.best is found.best else simpler
        found = taken._replace(final=other) if taken.best is alike else taken
        found.final.iterations = max(found.final.iterations, own.iterations)
    best, final = found.final.in_all_windows(found.best)
    identification = _identified(best, final, usable, settings)
    trials = [best if s is found.best else s for s in found.trials]
    rows = tuple(_trial(s, chosen=s is best, horizon=settings.horizon) for s in trials)
    notes = [f"not identified, because only turns to both sides show them: {', '.join(held)}"] if held else []
    return ModelChoice(vehicle, replace(identification, trials=rows, notes=(*identification.notes, *notes)))


def errors_of_all_terms(
    vehicle: VehicleConfig, logs: Sequence[Log], settings: Settings, on_iteration: OnIteration = ignore_iteration
) -> Floats:
    """Errors (folds,) of a model with all of its terms on logs that it was not fitted to, m/s; NaN where unknown.

    Arguments are those of `identify_terms`.
    """
    usable, settings, _ = _prepared(vehicle, logs, settings)
    return StructureSearch(vehicle, usable, settings, on_iteration).full().scores


def _prepared(
    vehicle: VehicleConfig, logs: Sequence[Log], settings: Settings
) -> tuple[list[Log], Settings, tuple[str, ...]]:
    """Usable logs, the settings for them, and the parameters that these freeze because no log shows them."""
    check_settings(vehicle, settings)
    usable = usable_logs(vehicle_of(vehicle), logs)
    steered = SteeringInMotion.of(usable)
    check_controls(usable, steered)
    settings = with_clock_offset(settings, usable)
    held = _shown_by_both_sides(vehicle, steered)
    return usable, replace(settings, frozen=(*settings.frozen, *held)), held


class Searched(NamedTuple):
    """Result of a search for the terms that the logs need."""

    best: Structure
    """the chosen structure"""
    final: StructureSearch
    """the search that fitted it last"""
    path: list[Structure]
    """structures from all terms to few"""
    trials: list[Structure]
    """all structures to report"""


def searched(search: StructureSearch, every: Structure | None = None) -> Searched:
    """Search for the terms that the logs need; `every` is the fit of all terms, if it is known."""
    path = search.path(every)
    simplest = search.converged(chosen(path))
    best = search.completed(simplest, path)
    best = search.pruned(best) if search.is_exact(best) else best
    best, final = search.in_long_windows(best, path)
    if not best.optimum.converged:  # the last fit, after a term was switched off, had few iterations
        best = replace(final.converged(best), added=best.added)
    trials = [simplest if s.terms == simplest.terms else s for s in path]
    return Searched(best, final, path, trials + ([] if best is simplest else [best]))


def simplified(found: Searched, alike: Structure, own: StructureSearch) -> Searched:
    """What was found, or what the simpler model gives if that predicts as well.

    Args:
        found: of the model with more states.
        alike: the simpler model with the same terms.
        own: search for the terms of the simpler model.
    """
    if set(found.best.terms) <= set(alike.terms) and is_near(
        alike, best_of(found.path), NEGLIGIBLE_LOSS, CLEARLY_WORSE
    ):
        return found._replace(best=alike, trials=[*found.trials, alike])
    every, better = own.full(), not is_near(found.best, alike, NEGLIGIBLE_LOSS)
    # lags that the vehicle lacks bend the choice of other terms, with which the simpler model predicts badly as well
    if not better and not is_near(every, found.path[0], NEGLIGIBLE_LOSS):
        return found._replace(trials=[*found.trials, alike])
    other = searched(own, every)
    trials = [*found.trials, *other.trials]
    # of few logs that differ much a standard error is large, and lags are cheaper than errors of that size
    if better or is_near(other.best, found.best, NEGLIGIBLE_LOSS, CLEARLY_WORSE):
        return other._replace(trials=trials)
    return found._replace(trials=trials)


def _shown_by_both_sides(vehicle: VehicleConfig, steered: SteeringInMotion) -> tuple[str, ...]:
    """Parameters that are not identified because the logs show turns to one side only."""
    return () if steered.both_sides else tuple(name for name in BOTH_SIDES if name in vehicle.parameters)


SEVERAL_VALUES: Final = "expected drives in which it takes several values, such as forward and coasting"
"""Expected of a control other than the steering."""


def check_controls(logs: Sequence[Log], steered: SteeringInMotion) -> None:
    """Refuse logs in which a control never changes, or both sides of a robot never apart: nothing shows what it does.

    Raises:
        InputError: with every such control.
    """
    problems: list[Diagnostic] = []
    for name in logs[0].controls:
        values = np.concatenate([part.commands[:, log.controls.index(name)] for log in logs for part in log.parts])
        expected = "expected drives with arcs to both sides" if name == "steering" else SEVERAL_VALUES
        if np.ptp(values) <= 0.0:
            problem = f"have commands in which {name} is always {values[0]:g}"
            problems.append(Diagnostic("logs", problem, expected, code=Code.DATA))
        elif name == "steering" and not steered.varies:
            problem = "have commands whose steering hardly changes while the vehicle moves"
            problems.append(Diagnostic("logs", problem, expected, code=Code.DATA))
    problems = problems or _of_sides(logs)
    if problems:
        raise InputError(problems)


def _of_sides(logs: Sequence[Log]) -> list[Diagnostic]:
    """Problems of the commands of both sides of a robot: straight drives alone, or turns on the spot alone."""
    if set(logs[0].controls) != set(SIDES):
        return []
    left, right = (
        np.concatenate([part.commands[:, log.controls.index(name)] for log in logs for part in log.parts])
        for name in SIDES
    )
    least, problems = STEERING_SPREAD_MIN * max(np.abs(left).max(), np.abs(right).max()), []
    for gap, like, drives in (
        (right - left, "hardly differ", "turns to both sides"),
        (right + left, "hardly differ but for their sign", "straight drives"),
    ):
        if np.std(gap) <= least:
            problem = f"have commands of left and right that {like}"
            problems.append(Diagnostic("logs", problem, f"expected {drives} too", code=Code.DATA))
    return problems


def _trial(structure: Structure, *, chosen: bool, horizon: float) -> ModelTrial:
    times = [share * horizon for share in HORIZON_SHARES]
    errors = {
        t: float(t * np.nanmean(of_folds))
        for t, of_folds in zip(times, structure.errors.T, strict=True)
        if not np.isnan(of_folds).all()
    }
    name = structure.graph.problem.parameters.vehicle.name
    return ModelTrial(name, structure.terms, structure.without, errors, chosen, structure.added)


def switched_off(p: Parameters, rho: Floats, terms: Sequence[str]) -> tuple[str, ...]:
    """Parameters of a model that are off with the values rho (np,): those at which they have no effect.

    The `terms` that are on are none of them, and neither is a term that settings state and keep.
    """
    own = zip(p.specs[: p.model_size], rho.tolist(), strict=False)
    return tuple(spec.name for spec, value in own if spec.name not in terms and value == spec.neutral)


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
    off = switched_off(p, point.rho, best.terms)
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
    of_logs = len(others) == len(logs) == len({s.log for s in search.windows.segments})
    return replace(found, off=off, without_log=tuple(others) if of_logs else ())
