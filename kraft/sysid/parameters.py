"""The numbers that an identification may change: the model's own parameters, then the extras."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kraft.errors import Diagnostic, InputError
from kraft.suggest import choose
from kraft.sysid.extras import extras_of
from kraft.sysid.settings import Settings
from kraft.vehicle import configured
from kraft.vehicle_config import Parameter, VehicleConfig
from ompl_ext.arrays import Bools, Floats
from ompl_ext.vehicle import Vehicle

WIDE = 10.0
"""Without bounds a parameter is taken to be known to this factor."""


@dataclass(frozen=True)
class Number:
    """One parameter: nominal value, bounds, prior."""

    name: str
    value: float
    min: float
    max: float
    std: float
    """of the prior, centred at `value`"""
    unit: str
    description: str
    stated: bool
    """whether the prior was stated, not assumed"""


@dataclass(frozen=True)
class Parameters:
    """What is estimated, in the order of the vector rho: `own` parameters of the vehicle's model, then extras."""

    vehicle: Vehicle
    numbers: tuple[Number, ...]
    frozen: frozenset[str]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of rho's components."""
        return tuple(number.name for number in self.numbers)

    @property
    def own(self) -> int:
        """How many of rho's first components are the model's."""
        return len(self.vehicle.parameters)

    @cached_property
    def extras(self) -> tuple[str, ...]:
        """Names of the extras."""
        return self.names[self.own :]

    def index(self, name: str) -> int:
        """Place of a parameter in rho, -1 if it is not there."""
        return self.names.index(name) if name in self.names else -1

    @cached_property
    def nominal(self) -> Floats:
        """(np,) values before the identification."""
        return np.array([number.value for number in self.numbers])

    @cached_property
    def low(self) -> Floats:
        """(np,) lower bounds."""
        return np.array([number.min for number in self.numbers])

    @cached_property
    def high(self) -> Floats:
        """(np,) upper bounds."""
        return np.array([number.max for number in self.numbers])

    @cached_property
    def std(self) -> Floats:
        """(np,) standard deviations of the priors."""
        return np.array([number.std for number in self.numbers])

    @cached_property
    def free(self) -> Bools:
        """(np,) whether a parameter is estimated."""
        return np.array([number.name not in self.frozen for number in self.numbers], dtype=bool)

    def model_values(self, rho: Floats) -> Floats:
        """The part of rho that the model takes, at least one number long (as `Vehicle.parameter_array`)."""
        return np.ascontiguousarray(rho[: self.own]) if self.own else np.zeros(1)


def vehicle_of(vehicle: VehicleConfig | Vehicle) -> Vehicle:
    """The model with its values."""
    return configured(vehicle) if isinstance(vehicle, VehicleConfig) else vehicle


def parameters_of(vehicle: VehicleConfig | Vehicle, settings: Settings, extras: tuple[str, ...]) -> Parameters:
    """The model's parameters and the named extras with their bounds and priors.

    Raises:
        InputError: if settings name a parameter that does not exist, or a value outside its bounds.
    """
    model = vehicle_of(vehicle)
    stated = vehicle.parameters if isinstance(vehicle, VehicleConfig) else {}
    numbers = [_number(name, value, stated.get(name)) for name, value in model.parameters.items()]
    known = extras_of(model)
    numbers += [
        Number(e.name, 0.0, e.min, e.max, e.std, e.unit, e.description, False) for e in (known[n] for n in extras)
    ]
    numbers = [_at(number, settings.values) for number in numbers]
    frozen = frozenset(settings.frozen) & {number.name for number in numbers}
    return Parameters(model, tuple(numbers), frozen)


def check_names(vehicle: Vehicle, settings: Settings) -> None:
    """Refuse settings that name what the vehicle does not have.

    Raises:
        InputError: with every such name.
    """
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
    problems = [
        Diagnostic(setting, f"{vehicle.name} has no {kind} {name}", choose(name, options))
        for setting, names, options, kind in questions
        for name in names
        if name not in options
    ]
    positive: list[tuple[str, Mapping[str, float]]] = [
        ("process", settings.process),
        ("control_noise", settings.control_noise),
        ("noise", vars(settings.noise) if settings.noise else {}),
        ("settings", {"step": settings.step, "robust": 1.0 if settings.robust is None else settings.robust}),
    ]
    problems += [
        Diagnostic(setting, f"{name} is {value:g}", "expected a number greater than 0")
        for setting, values in positive
        for name, value in values.items()
        if not (value > 0.0 and math.isfinite(value))
    ]
    if problems:
        raise InputError(problems)


def _number(name: str, value: float, stated: Parameter | None) -> Number:
    """A parameter of the model; what its file leaves open is wide."""
    low, high = _wide(value)
    if stated is None:
        return Number(name, value, low, high, high - low, "", "", False)
    low = low if stated.min is None else stated.min
    high = high if stated.max is None else stated.max
    if not low <= value <= high:  # one bound is stated, and the nominal value lies far from it
        low, high = min(low, value), max(high, value)
    std = stated.std if stated.std is not None else high - low
    return Number(name, value, low, high, std, stated.unit, stated.description, stated.std is not None)


def _wide(value: float) -> tuple[float, float]:
    """Bounds for a value of which nothing else is known: its sign and magnitude, or that it is about 1 at most."""
    if value == 0.0:
        return -1.0, 1.0
    ends = sorted((value / WIDE, value * WIDE))
    return ends[0], ends[1]


def _at(number: Number, values: Mapping[str, float]) -> Number:
    if number.name not in values:
        return number
    value = float(values[number.name])
    if not number.min <= value <= number.max:
        raise InputError.of(
            number.name,
            f"is {value:g}",
            f"expected a value from {number.min:g} to {number.max:g} {number.unit}".strip(),
        )
    return Number(
        number.name, value, number.min, number.max, number.std, number.unit, number.description, number.stated
    )
