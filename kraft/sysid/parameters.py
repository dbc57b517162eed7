"""Parameter vector rho of an identification: the parameters of the model, then the auxiliary parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kraft.errors import Diagnostic, InputError
from kraft.sysid.interface import Settings
from kraft.vehicles import DELAY_MAX
from kraft.vehicles.config import Parameter, VehicleConfig, stated_parameters
from kraft.vehicles.load import configured, units_of
from ompl_ext.arrays import Bools, Floats
from ompl_ext.vehicle import Vehicle

DEFAULT_BOUND_FACTOR = 10.0
"""Factor between the nominal value of a parameter and its default bounds."""


SMALL_ANGLE = 0.1
"""Angle up to which its sign is taken to be unknown, rad."""


@dataclass(frozen=True)
class ParameterSpec:
    """Nominal value, bounds and prior of one parameter."""

    name: str
    value: float
    min: float
    max: float
    std: float
    """of the prior, centred at `value`"""
    unit: str
    description: str
    neutral: float | None = None
    """value at which it has no effect"""
    fixed: bool = False
    """whether it is measured or chosen, not identified"""
    variation: float = 0.0
    """standard deviation of its changes during a drive"""

    @property
    def unit_text(self) -> str:
        """Unit after a number: a space and the unit, nothing if there is none."""
        return "" if self.unit in ("", "1") else f" {self.unit}"


@dataclass(frozen=True)
class Parameters:
    """Parameters in the order of the vector rho: `model_size` of the vehicle's model, then the auxiliary ones."""

    vehicle: Vehicle
    specs: tuple[ParameterSpec, ...]
    frozen: frozenset[str]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the components of rho."""
        return tuple(spec.name for spec in self.specs)

    @property
    def model_size(self) -> int:
        """Number of parameters of the model, the first components of rho."""
        return len(self.vehicle.parameters)

    @cached_property
    def auxiliary(self) -> tuple[str, ...]:
        """Names of the auxiliary parameters."""
        return self.names[self.model_size :]

    def index(self, name: str) -> int:
        """Index of a parameter in rho, -1 if it is not in rho."""
        return self.names.index(name) if name in self.names else -1

    def auxiliary_index(self, name: str) -> int:
        """Index of an auxiliary parameter in rho, -1 if it is not in rho or is a parameter of the model."""
        return self.model_size + self.auxiliary.index(name) if name in self.auxiliary else -1

    @cached_property
    def nominal(self) -> Floats:
        """(np,) values before the identification."""
        return np.array([spec.value for spec in self.specs])

    @cached_property
    def low(self) -> Floats:
        """(np,) lower bounds."""
        return np.array([spec.min for spec in self.specs])

    @cached_property
    def high(self) -> Floats:
        """(np,) upper bounds."""
        return np.array([spec.max for spec in self.specs])

    @cached_property
    def std(self) -> Floats:
        """(np,) standard deviations of the priors."""
        return np.array([spec.std for spec in self.specs])

    @cached_property
    def inverse_std(self) -> Floats:
        """(np,) their inverses, 0 of frozen parameters."""
        return np.where(self.free, 1.0 / self.std, 0.0)

    @cached_property
    def free(self) -> Bools:
        """(np,) whether a parameter is estimated."""
        return np.array([spec.name not in self.frozen for spec in self.specs], dtype=bool)

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the estimated parameters, in the order of rho."""
        return tuple(spec.name for spec in self.specs if spec.name not in self.frozen)

    def within_bounds(self, rho: Floats) -> Floats:
        """Values (np,) clipped to the bounds, which rounding errors may exceed: low + (high - low) may exceed high."""
        clipped: Floats = np.minimum(np.maximum(rho, self.low), self.high)
        return clipped

    def model_values(self, rho: Floats) -> Floats:
        """The parameters of the model in rho, at least one number (as `Vehicle.parameter_array`)."""
        return np.ascontiguousarray(rho[: self.model_size]) if self.model_size else np.zeros(1)


def vehicle_of(vehicle: VehicleConfig | Vehicle) -> Vehicle:
    """The vehicle with the parameter values of its file."""
    return configured(vehicle) if isinstance(vehicle, VehicleConfig) else vehicle


def parameters_of(vehicle: VehicleConfig | Vehicle, settings: Settings, auxiliary: tuple[str, ...]) -> Parameters:
    """The parameters of the model and the named auxiliary parameters with their bounds and priors.

    Raises:
        InputError: if a value in the settings is outside the bounds.
    """
    every = [_with_value(spec, settings.values) for spec in parameter_specs(vehicle, auxiliary)]
    ahead = settings.clock_offset or 0.0
    specs = tuple(replace(s, min=max(s.min, min(-ahead, s.value))) if s.name == "delay" else s for s in every)
    frozen = frozenset(spec.name for spec in specs if spec.fixed or spec.name in settings.frozen)
    return Parameters(vehicle_of(vehicle), specs, frozen)


def variation_of(parameters: Parameters, settings: Settings) -> dict[str, float]:
    """Standard deviation between windows of each parameter that varies, of the settings or of the vehicle."""
    stated = {spec.name: settings.variation.get(spec.name, spec.variation) for spec in parameters.specs}
    return {name: std for name, std in stated.items() if std > 0.0}


def parameter_specs(vehicle: VehicleConfig | Vehicle, auxiliary: tuple[str, ...]) -> tuple[ParameterSpec, ...]:
    """The parameters of the model and the named auxiliary parameters, before any setting is applied."""
    model = vehicle_of(vehicle)
    stated = stated_parameters(vehicle)
    units = units_of(vehicle.model) if isinstance(vehicle, VehicleConfig) else {}
    own = (_spec(name, value, stated.get(name), units.get(name, "")) for name, value in model.parameters.items())
    known = auxiliary_parameters(model)
    added = (
        ParameterSpec(e.name, 0.0, e.min, e.max, e.std, e.unit, e.description, neutral=0.0)
        for e in (known[n] for n in auxiliary)
    )
    return (*own, *added)


def without_bounds(vehicle: VehicleConfig | Vehicle) -> tuple[str, ...]:
    """Parameters of the model whose bounds or prior are default ones, because neither file nor code states them."""
    stated = stated_parameters(vehicle)
    return tuple(name for name in vehicle_of(vehicle).parameters if not _is_bounded(stated.get(name)))


def _is_bounded(stated: Parameter | None) -> bool:
    return stated is not None and (stated.fixed or None not in (stated.min, stated.max, stated.std))


def _spec(name: str, value: float, stated: Parameter | None, unit: str) -> ParameterSpec:
    """A parameter of the model, with default bounds and prior where none are stated."""
    low, high = _default_bounds(value, unit if stated is None else stated.unit)
    if stated is None:
        return ParameterSpec(name, value, low, high, high - low, unit, "")
    low = low if stated.min is None else stated.min
    high = high if stated.max is None else stated.max
    if not low <= value <= high:  # one bound is stated, and the nominal value is far beyond the default of the other
        low, high = min(low, value), max(high, value)
    std = stated.std if stated.std is not None else high - low
    return ParameterSpec(
        name, value, low, high, std, stated.unit, stated.description, stated.neutral, stated.fixed, stated.variation
    )


def _default_bounds(value: float, unit: str) -> tuple[float, float]:
    """Default bounds of a value: its sign and magnitude are known, of a small angle or 0 only that they are at most 1.

    An angle may be an offset, whose sign says nothing.
    """
    if value == 0.0 or (unit == "rad" and abs(value) < SMALL_ANGLE):
        return -1.0, 1.0
    ends = sorted((value / DEFAULT_BOUND_FACTOR, value * DEFAULT_BOUND_FACTOR))
    return ends[0], ends[1]


def _with_value(spec: ParameterSpec, values: Mapping[str, float]) -> ParameterSpec:
    if problem := out_of_bounds(spec, values):
        raise InputError([problem])
    return replace(spec, value=float(values.get(spec.name, spec.value)))


def out_of_bounds(spec: ParameterSpec, values: Mapping[str, float]) -> Diagnostic | None:
    """Problem of the argument `values` with the value of a parameter; None if it is within the bounds."""
    value = values.get(spec.name, spec.value)
    if spec.min <= value <= spec.max:
        return None
    expected = f"expected a value from {spec.min:g} to {spec.max:g}{spec.unit_text}"
    return Diagnostic("values", f"is {value:g}", expected, path=spec.name, argument=True)


YAW_RATES = ("omega", "yaw_rate", "r", "w")
"""Names of a state component that is the derivative of theta."""


FRICTION_SHARE_MAX = 0.5
"""Largest friction, as a share of the full throttle."""


DELAY_MIN = -0.1
"""Least delay, s: commands are recorded later than they act if clocks differ, or if each record is of the last one."""


DEAD_BAND_SHARE_MAX = {"throttle": 0.5, "steering": 0.25}
"""Controls that may have a dead band, and the largest dead band as a share of the largest command."""
PLAY_SHARE_MAX = 0.25
"""Largest half of the play of the steering, as a share of the largest command."""


def is_unknown_to_planning(name: str) -> bool:
    """Whether an auxiliary parameter affects the motion and no vehicle file states it: plans are wrong by its effect.

    The delay of all commands is stated, for driving; the others affect only how the vehicle is observed.
    """
    return name.startswith(("delay_", "lag_", "play_", "dead_band_", "friction"))


def speed_index(vehicle: Vehicle) -> int:
    """Index of the speed in the state: the first component that is 0 at rest; -1 if there is none."""
    return vehicle.rest_indices[0] if vehicle.rest and vehicle.rest[0] not in YAW_RATES else -1


def steering_offset(parameters: Parameters) -> int:
    """Index in rho of the wheel angle at steering 0; -1 if there is none, or if a command is not a wheel angle."""
    return parameters.index("phi_diff") if "steer" not in parameters.vehicle.parameters else -1


@dataclass(frozen=True)
class AuxiliaryParameter:
    """A parameter that any model may be extended with; its nominal value is 0, which means no effect."""

    name: str
    unit: str
    min: float
    max: float
    std: float
    """standard deviation of the prior"""
    description: str


def auxiliary_parameters(vehicle: Vehicle) -> dict[str, AuxiliaryParameter]:
    """Auxiliary parameters that apply to a vehicle, by name; none shares a name with a parameter of the model."""
    found = [AuxiliaryParameter("delay", "s", DELAY_MIN, DELAY_MAX, 0.3, "time until a command takes effect")]
    found += [
        AuxiliaryParameter(f"delay_{name}", "s", 0.0, DELAY_MAX, 0.3, f"additional time until {name} takes effect")
        for name in vehicle.controls
    ]
    found += [
        AuxiliaryParameter(f"lag_{name}", "s", 0.0, 2.0, 0.5, f"time constant with which {name} follows its command")
        for name in vehicle.controls
    ]
    full = max(map(abs, vehicle.controls["throttle"])) if "throttle" in vehicle.controls else 0.0
    if full > 0.0 and speed_index(vehicle) >= 0:
        most = FRICTION_SHARE_MAX * full
        found.append(AuxiliaryParameter("friction", "1", 0.0, most, most, "throttle that friction uses up"))
    for name, share in DEAD_BAND_SHARE_MAX.items():
        if name in vehicle.controls:
            most = share * max(map(abs, vehicle.controls[name]))
            unit = "rad" if name == "steering" else "1"
            found.append(AuxiliaryParameter(f"dead_band_{name}", unit, 0.0, most, most, f"{name} without effect"))
    if "steering" in vehicle.controls:
        most = PLAY_SHARE_MAX * max(map(abs, vehicle.controls["steering"]))
        found.append(AuxiliaryParameter("play_steering", "rad", 0.0, most, most, "half of the play of the steering"))
    if vehicle.index("theta") >= 0:
        found += [
            AuxiliaryParameter("lever", "m", -1.0, 1.0, 0.5, "tracked point ahead of the model's point"),
            AuxiliaryParameter("side", "m", -0.5, 0.5, 0.2, "tracked point left of the model's point"),
            AuxiliaryParameter("yaw_offset", "rad", -0.5, 0.5, 0.2, "observed yaw less the model's"),
        ]
    return {parameter.name: parameter for parameter in found if parameter.name not in vehicle.parameters}
