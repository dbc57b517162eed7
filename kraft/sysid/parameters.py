"""The numbers that an identification may change: the model's own parameters, then the extras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kraft.errors import Diagnostic, InputError
from kraft.sysid.auxiliary import extras_of
from kraft.sysid.settings import Settings
from kraft.vehicles.config import Parameter, VehicleConfig
from kraft.vehicles.load import configured
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

    def extra(self, name: str) -> int:
        """Place of an extra in rho, -1 if it is not there; a parameter of the model that is called so is none."""
        return self.own + self.extras.index(name) if name in self.extras else -1

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

    def within_bounds(self, rho: Floats) -> Floats:
        """Values (np,) at most a rounding error beyond the bounds, within them: low + (high - low) may exceed high."""
        clipped: Floats = np.clip(rho, self.low, self.high)
        return clipped

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
    numbers = tuple(_at(number, settings.values) for number in stated_numbers(vehicle, extras))
    frozen = frozenset(settings.frozen) & {number.name for number in numbers}
    return Parameters(vehicle_of(vehicle), numbers, frozen)


def stated_numbers(vehicle: VehicleConfig | Vehicle, extras: tuple[str, ...]) -> tuple[Number, ...]:
    """The model's parameters and the named extras as they are where no setting changes them."""
    model = vehicle_of(vehicle)
    stated = vehicle.parameters if isinstance(vehicle, VehicleConfig) else {}
    own = (_number(name, value, stated.get(name)) for name, value in model.parameters.items())
    known = extras_of(model)
    added = (Number(e.name, 0.0, e.min, e.max, e.std, e.unit, e.description, False) for e in (known[n] for n in extras))
    return (*own, *added)


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
    if problem := out_of_bounds(number, values):
        raise InputError([problem])
    return replace(number, value=float(values.get(number.name, number.value)))


def out_of_bounds(number: Number, values: Mapping[str, float]) -> Diagnostic | None:
    """What is wrong with the value that a number is given, if it is given one."""
    value = values.get(number.name, number.value)
    if number.min <= value <= number.max:
        return None
    unit = "" if number.unit == "1" else f" {number.unit}"
    expected = f"expected a value from {number.min:g} to {number.max:g}{unit}".strip()
    return Diagnostic(number.name, f"is {value:g}", expected)
