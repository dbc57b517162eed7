"""Validation of settings against a vehicle, before any log is read."""

from __future__ import annotations

import math
from collections.abc import Mapping

from kraft.errors import Diagnostic, InputError
from kraft.sysid.auxiliary import extras_of
from kraft.sysid.parameters import out_of_bounds, stated_numbers, vehicle_of
from kraft.sysid.selection import to_try
from kraft.sysid.settings import Settings
from kraft.text import suggestion
from kraft.vehicles.config import VehicleConfig
from ompl_ext.vehicle import Vehicle


def check_settings(vehicle: VehicleConfig | Vehicle, settings: Settings) -> None:
    """Refuse settings that name what the vehicle or the fit does not have, and values beyond their bounds.

    Raises:
        InputError: with every such name and value.
    """
    model = vehicle_of(vehicle)
    problems = [*_unknown(model, settings), *_not_positive(settings), *_without_extra(model, settings)]
    every = stated_numbers(vehicle, tuple(extras_of(model)))
    problems += [found for number in every if (found := out_of_bounds(number, settings.values))]
    if problems:
        raise InputError(problems)


def check_free(vehicle: VehicleConfig | Vehicle, settings: Settings) -> None:
    """Refuse settings that leave nothing to identify, whatever the logs are.

    Raises:
        InputError: if all parameters of the model are frozen, and so are all extras that the fit may have.
    """
    model = vehicle_of(vehicle)
    names = (*model.parameters, *to_try(model, settings))
    if not set(names) <= set(settings.frozen):
        return
    expected = "expected a parameter that is not frozen, or extra parameters with --extras"
    if names:
        raise InputError.of("frozen", f"leaves nothing of {model.name} to identify beside {', '.join(names)}", expected)
    raise InputError.of("extras", f"there is nothing to identify of {model.name}, which has no parameters", expected)


def _unknown(vehicle: Vehicle, settings: Settings) -> list[Diagnostic]:
    extras = extras_of(vehicle)
    parameters = [*vehicle.parameters, *extras]
    asked = settings.extras if isinstance(settings.extras, tuple) else ()
    questions: list[tuple[str, Mapping[str, object] | tuple[str, ...], list[str], str]] = [
        ("frozen", settings.frozen, parameters, "parameter"),
        ("values", tuple(settings.values), parameters, "parameter"),
        ("extras", asked, list(extras), "extra parameter"),
        ("process", tuple(settings.process), list(vehicle.state), "state component"),
        ("control_noise", tuple(settings.control_noise), list(vehicle.controls), "control"),
    ]
    return [
        Diagnostic(setting, f"{vehicle.name} has no {kind} {name}", suggestion(name, options))
        for setting, names, options, kind in questions
        for name in names
        if name not in options
    ]


def _without_extra(vehicle: Vehicle, settings: Settings) -> list[Diagnostic]:
    """Extras that are frozen or given a value, and that the fit will not have."""
    if settings.extras in ("auto", "plan"):  # have those that are asked for
        return []
    chosen = settings.extras if isinstance(settings.extras, tuple) else ()
    return [
        Diagnostic(
            setting,
            f"{name} is an extra parameter, and --extras {','.join(chosen) or 'none'} leaves it out",
            f"expected --extras {','.join((*chosen, name))} or --extras auto with it",
        )
        for setting, names in (("frozen", settings.frozen), ("values", tuple(settings.values)))
        for name in names
        if name in extras_of(vehicle) and name not in chosen
    ]


def _not_positive(settings: Settings) -> list[Diagnostic]:
    positive: list[tuple[str, Mapping[str, float]]] = [
        ("process", settings.process),
        ("control_noise", settings.control_noise),
        ("noise", vars(settings.noise) if settings.noise else {}),
        ("settings", {"step": settings.step, "robust": 1.0 if settings.robust is None else settings.robust}),
    ]
    return [
        Diagnostic(setting, f"{name} is {value:g}", "expected a number greater than 0")
        for setting, values in positive
        for name, value in values.items()
        if not (value > 0.0 and math.isfinite(value))
    ]
