"""Validation of settings against a vehicle, before any log is read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

from kraft.errors import Code, Diagnostic, InputError
from kraft.sysid.parameters import auxiliary_parameters, out_of_bounds, parameter_specs, vehicle_of
from kraft.sysid.selection import candidates_of
from kraft.sysid.settings import Settings
from kraft.text import suggestion
from kraft.vehicles.config import VehicleConfig
from ompl_ext.vehicle import Vehicle


def check_settings(vehicle: VehicleConfig | Vehicle, settings: Settings) -> None:
    """Refuse settings that name what the vehicle or the fit does not have, and values outside their bounds.

    Raises:
        InputError: with every such name and value.
    """
    model = vehicle_of(vehicle)
    problems = [*_unknown(model, settings), *_not_positive(settings), *_excluded_auxiliary(model, settings)]
    every = parameter_specs(vehicle, tuple(auxiliary_parameters(model)))
    problems += [found for spec in every if (found := out_of_bounds(spec, settings.values))]
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
    ]
    for field, values in fields:
        for name, value in values.items():
            if not (value > 0.0 and math.isfinite(value)):
                yield Diagnostic(field, f"{name} is {value:g}", "expected a number greater than 0", argument=True)
