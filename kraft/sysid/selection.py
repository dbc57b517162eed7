"""Model selection: which parameters the data show.

Auxiliary parameters are kept that are significant, relevant and distinguishable from other parameters, by backward
elimination on the linearised graph: of those that are not, the one whose removal increases the cost least is removed,
and so on; then the remaining parameters are fitted again.  The uncertainty of an auxiliary parameter is the larger of
that under the stated noise and that between logs: a few logs may agree by chance about a parameter that they hardly
identify.  A term of a model is judged by the likelihood with it and without it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Final

import numpy as np

from kraft.errors import Code, Diagnostic, InputError, out_of_range
from kraft.logs.log import Log
from kraft.sysid.interface import CORRELATION_REMOVED, GRAPHS, SELECTIONS, Settings
from kraft.sysid.optimiser import Optimum, ParameterUncertainty, held_at_bounds, inverse
from kraft.sysid.parameters import (
    DELAY_MIN,
    Parameters,
    auxiliary_parameters,
    is_unknown_to_planning,
    out_of_bounds,
    parameter_specs,
    vehicle_of,
)
from kraft.sysid.screening import turns_before_steered
from kraft.text import suggestion
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.vehicle import Vehicle

NEGLIGIBLE_BELOW: Final = {"delay": 0.01, "lag_throttle": 0.01, "lag_steering": 0.01, "dead_band_throttle": 0.01,
                    "dead_band_steering": 0.005, "play_steering": 0.005, "friction": 0.01, "lever": 0.01,
                    "yaw_offset": 0.005}  # fmt: skip
"""Candidates of the automatic selection, and the value below which each is negligible, in its unit."""
SIGNIFICANCE = 3.0
"""Least distance from 0 of an auxiliary parameter that is kept, in standard deviations."""
STD_RATIO_MAX = 0.5
"""Largest standard deviation of an auxiliary parameter that is kept, over that of its prior."""
GAIN_MIN = 4.0
"""Least decrease of the cost by a term that the likelihood shows: one without effect has it once in 200 times."""


def requested_names(settings: Settings) -> frozenset[str]:
    """Names that the settings freeze or give a value: auxiliary parameters of these names are always kept."""
    return frozenset(settings.values) | frozenset(settings.frozen)


def candidates_of(vehicle: Vehicle, settings: Settings) -> tuple[str, ...]:
    """Auxiliary parameters in the first fit."""
    known, wanted = auxiliary_parameters(vehicle), settings.auxiliary
    if wanted == "none":
        return ()
    if isinstance(wanted, tuple):
        return tuple(name for name in known if name in wanted)
    names = {
        name for name in NEGLIGIBLE_BELOW if wanted == "auto" or not is_unknown_to_planning(name)
    } | requested_names(settings)
    return tuple(name for name in known if name in names)


def excluded_for_planning(vehicle: Vehicle, settings: Settings) -> tuple[str, ...]:
    """Auxiliary parameters that the selection `plan` excludes because planning does not model them."""
    if settings.auxiliary != "plan":
        return ()
    candidates = candidates_of(vehicle, settings)
    return tuple(name for name in auxiliary_parameters(vehicle) if name in NEGLIGIBLE_BELOW and name not in candidates)


def selection_note(candidates: tuple[str, ...], kept: tuple[str, ...], requested: frozenset[str]) -> str:
    """Result of the model selection as a message; requested parameters are kept whatever the data show."""
    if not candidates:
        return "no auxiliary parameter applies to this vehicle"
    given = [name for name in kept if name in requested]
    significant = [name for name in kept if name not in requested]
    removed = [name for name in candidates if name not in kept]
    note = [f"requested auxiliary parameters, kept: {', '.join(given)}"] if given else []
    if significant:
        note.append(f"significant auxiliary parameters, kept: {', '.join(significant)}")
    elif removed:
        note.append(f"no {'other ' if given else ''}auxiliary parameter is significant")
    if removed:
        note.append(f"removed: {', '.join(removed)}")
    return "; ".join(note)


def selected(
    parameters: Parameters, rho: Floats, uncertainty: ParameterUncertainty, requested: frozenset[str]
) -> tuple[str, ...]:
    """Auxiliary parameters to keep; `requested` and frozen ones are always kept."""
    names = parameters.free_names
    prior = dict(zip(parameters.names, parameters.std, strict=True))
    remaining = list(range(len(names)))
    while True:
        value, graph, covariance = _reduced(rho[parameters.free], uncertainty, remaining)
        variance = np.maximum(np.diag(covariance), np.diag(graph))
        removable = [
            i
            for i, name in enumerate(names[k] for k in remaining)
            if name in parameters.auxiliary and name not in requested
            and (_indistinguishable(graph, i) or not _significant(name, value[i], variance[i], prior[name]))
        ]  # fmt: skip
        if not removable:
            break
        del remaining[min(removable, key=lambda i: value[i] ** 2 / graph[i, i])]
    dropped = set(names) - {names[k] for k in remaining}
    return tuple(name for name in parameters.auxiliary if name not in dropped)


def _reduced(rho: Floats, uncertainty: ParameterUncertainty, remaining: list[int]) -> tuple[Floats, Matrix, Matrix]:
    """Values (remaining,) if the other parameters were 0, and covariances of the graph and as reported."""
    information = inverse(uncertainty.graph)
    graph = inverse(information[np.ix_(remaining, remaining)])
    follow = graph @ information[remaining]  # how the remaining parameters change with the removed ones
    follow[:, remaining] = np.eye(len(remaining))
    moving = uncertainty.covariance * np.outer(~uncertainty.held, ~uncertainty.held)
    return follow @ rho, graph, follow @ moving @ follow.T if uncertainty.kind == "sandwich" else graph


def _indistinguishable(covariance: Matrix, k: int) -> bool:
    """Whether a parameter is indistinguishable from another one."""
    std = np.sqrt(np.diag(covariance))
    along = np.abs(covariance[k]) > CORRELATION_REMOVED * std[k] * std
    return bool(along.sum() > along[k])


def _significant(name: str, value: float, variance: float, prior: float) -> bool:
    """Whether an auxiliary parameter is significant, not negligible, and more certain than its prior."""
    std = float(np.sqrt(variance))
    return abs(value) >= max(NEGLIGIBLE_BELOW[name], SIGNIFICANCE * std) and std <= STD_RATIO_MAX * prior


def size_of_term(p: Parameters, optimum: Optimum, name: str) -> float:
    """Distance of a term from its neutral value in standard deviations of its prior."""
    k = p.index(name)
    return abs(float(optimum.point.rho[k]) - _neutral(p, k)) / p.specs[k].std


def is_shown(p: Parameters, optimum: Optimum, name: str, gain: float) -> bool:
    """Whether a term is more probable than none, by Laplace's approximation of the likelihood of its size.

    Where folds or windows differ more than noise explains, the `gain`, the decrease of the cost by the term, counts as
    much less.  Commands that act some milliseconds off their times disturb each window by itself, which its poses
    repeat: a few folds tell that only roughly.
    """
    factors, rho = optimum.factors, optimum.point.rho
    held = held_at_bounds(factors, p.low - rho, p.high - rho)
    if held[p.index(name)]:
        return False
    free = p.free & ~held
    k = int(np.count_nonzero(free[: p.index(name)]))
    covariance = inverse(factors.total_information[np.ix_(free, free)])
    variances = [
        _sandwich(gradient[:, free], covariance[k])
        for gradient in (factors.gradient, factors.window_gradient)
        if gradient is not None
    ]
    disagreement = max(1.0, *(variance / float(covariance[k, k]) for variance in variances))
    narrowed = math.log(p.specs[p.index(name)].std / math.sqrt(disagreement * covariance[k, k]))
    return gain / disagreement > max(narrowed, GAIN_MIN)


def _sandwich(gradient: Matrix, row: Floats) -> float:
    """Huber's sandwich variance of a parameter by independent gradients (n, k); `row` (k,) of the covariance."""
    count = len(gradient)
    influence = (gradient - gradient.mean(axis=0)) @ row
    return float(influence @ influence) * count / max(count - 1, 1)


def costs_of_terms(p: Parameters, optimum: Optimum, terms: Iterable[str]) -> dict[str, float]:
    """Increase of the linearised cost by switching off each term."""
    return {name: cost_of_terms(p, optimum, [name]) for name in terms}


def cost_of_terms(p: Parameters, optimum: Optimum, terms: Iterable[str]) -> float:
    """Increase of the linearised cost by switching off some terms together."""
    factors, rho = optimum.factors, optimum.point.rho
    total, held = factors.total_information, held_at_bounds(factors, p.low - rho, p.high - rho)
    off = np.array([p.index(name) for name in terms])
    others = p.free & ~held & ~np.isin(np.arange(len(rho)), off)
    follow = np.linalg.lstsq(total[np.ix_(others, others)], total[np.ix_(others, off)], rcond=None)[0]
    change = np.array([_neutral(p, k) for k in off]) - rho[off]
    return float(0.5 * change @ (total[np.ix_(off, off)] - total[np.ix_(off, others)] @ follow) @ change)


def _neutral(p: Parameters, k: int) -> float:
    """Value at which a term is off."""
    neutral = p.specs[k].neutral
    assert neutral is not None, "only terms have a neutral value"
    return neutral


def check_settings(vehicle: VehicleConfig | Vehicle, settings: Settings) -> None:
    """Refuse settings that name what the vehicle or the fit does not have, and values outside their bounds.

    Raises:
        InputError: with every such name and value.
    """
    model = vehicle_of(vehicle)
    problems = [*_unknown(model, settings), *_not_positive(settings), *_excluded_auxiliary(model, settings)]
    if settings.graph not in GRAPHS:
        problems.append(
            Diagnostic("graph", f"is {settings.graph!r}", suggestion(settings.graph, GRAPHS), argument=True)
        )
    if isinstance(settings.auxiliary, str) and settings.auxiliary not in SELECTIONS:
        expected = f"{suggestion(settings.auxiliary, SELECTIONS)}, or a tuple of names"
        problems.append(Diagnostic("auxiliary", f"is {settings.auxiliary!r}", expected, argument=True))
    texts = {name: value for name, value in settings.values.items() if not isinstance(value, Real)}
    for name, value in texts.items():
        problems.append(Diagnostic("values", f"is {value!r}", "expected a number", path=name, argument=True))
    every = parameter_specs(vehicle, tuple(auxiliary_parameters(model)))
    given = {name: value for name, value in settings.values.items() if name not in texts}
    problems += [found for spec in every if (found := out_of_bounds(spec, given))]
    if problems:
        raise InputError(problems)


def check_free_parameters(vehicle: VehicleConfig | Vehicle, settings: Settings) -> None:
    """Refuse settings that leave nothing to identify, whatever the logs are.

    Raises:
        InputError: if all parameters of the model are frozen, and so are all candidate auxiliary parameters.
    """
    model = vehicle_of(vehicle)
    names = (*model.parameters, *candidates_of(model, settings))
    if not set(names) <= set(settings.frozen):
        return
    expected = "expected a parameter that is not frozen, or an auxiliary parameter"
    if names:
        problem = f"leaves nothing of {model.name} to identify: it has only {', '.join(names)}"
        raise InputError.of_argument("frozen", problem, expected, Code.CONFLICT)
    problem = f"leaves nothing to identify: {model.name} has no parameters"
    raise InputError.of_argument("auxiliary", problem, expected, Code.CONFLICT)


def _unknown(vehicle: Vehicle, settings: Settings) -> Iterator[Diagnostic]:
    auxiliary = auxiliary_parameters(vehicle)
    parameters = [*vehicle.parameters, *auxiliary]
    named = settings.auxiliary if isinstance(settings.auxiliary, tuple) else ()
    fields: list[tuple[str, Iterable[str], list[str], str]] = [
        ("frozen", settings.frozen, parameters, "parameter"),
        ("values", settings.values, parameters, "parameter"),
        ("auxiliary", named, list(auxiliary), "auxiliary parameter"),
        ("process", settings.process, list(vehicle.state), "state component"),
        ("control_noise", settings.control_noise, list(vehicle.controls), "control"),
        ("variation", settings.variation, list(vehicle.parameters), "parameter"),
    ]
    for field, names, known, kind in fields:
        for name in names:
            if name not in known:
                problem = f"{vehicle.name} has no {kind} {name}"
                yield Diagnostic(field, problem, suggestion(name, known), code=Code.UNKNOWN, argument=True)


def _excluded_auxiliary(vehicle: Vehicle, settings: Settings) -> Iterator[Diagnostic]:
    """Auxiliary parameters that are frozen or given a value, but are excluded from the fit."""
    if settings.auxiliary in ("auto", "plan"):  # these include every parameter that is frozen or given a value
        return
    chosen = settings.auxiliary if isinstance(settings.auxiliary, tuple) else ()
    for field, names in (("frozen", settings.frozen), ("values", tuple(settings.values))):
        for name in names:
            if name in auxiliary_parameters(vehicle) and name not in chosen:
                problem = f"{name} is an auxiliary parameter that the selection {','.join(chosen) or 'none'} excludes"
                expected = f"expected the selection {','.join((*chosen, name))} or auto"
                yield Diagnostic(field, problem, expected, code=Code.CONFLICT, argument=True)


def _not_positive(settings: Settings) -> Iterator[Diagnostic]:
    fields: list[tuple[str, Mapping[str, float]]] = [
        ("process", settings.process),
        ("control_noise", settings.control_noise),
        ("noise", vars(settings.noise) if settings.noise else {}),
        ("settings", {"step": settings.step, "robust": 1.0 if settings.robust is None else settings.robust}),
        ("settings", {"horizon": settings.horizon}),
    ]
    for field, values in fields:
        for name, value in values.items():
            if not (_is_number(value) and value > 0.0):
                yield Diagnostic(field, f"{name} is {_shown(value)}", "expected a number greater than 0", argument=True)
    at_least_0: list[tuple[str, Mapping[str, float]]] = [
        ("variation", settings.variation), ("settings", {"clock_offset": settings.clock_offset or 0.0})
    ]  # fmt: skip
    for field, values in at_least_0:
        for name, value in values.items():
            if not (_is_number(value) and value >= 0.0):
                yield Diagnostic(field, f"{name} is {_shown(value)}", "expected a number of at least 0", argument=True)
    yield from out_of_range("iterations", settings.iterations, 1)


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def _shown(value: object) -> str:
    return f"{float(value):g}" if isinstance(value, Real) else repr(value)


def with_clock_offset(settings: Settings, logs: Sequence[Log]) -> Settings:
    """Settings that allow a negative delay where the logs show it; elsewhere it would stand for what a model lacks."""
    if settings.clock_offset is not None:
        return settings
    return replace(settings, clock_offset=-DELAY_MIN if turns_before_steered(logs) else 0.0)
