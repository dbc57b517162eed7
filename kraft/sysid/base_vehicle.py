"""The vehicle whose parameters are identified: a bundled vehicle, a vehicle file or code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kraft.sysid.dynamics import DiscreteModel
from kraft.sysid.interface import Identification
from kraft.sysid.smoothing import high_speed
from kraft.vehicles.code import check_functions, vehicle_of
from kraft.vehicles.config import (
    Footprint,
    Parameter,
    VehicleConfig,
)
from kraft.vehicles.load import configured, read_vehicle_file, resolved_reference, units_of
from kraft.vehicles.reference import is_code, resolve_vehicle, split_file
from ompl_ext.kernels.specialise import are_steps_cached
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log


SPEED_SETTLING, SPEED_STEP = 20.0, 0.05
"""Time after which full throttle has led to the top speed, and step of the simulation, s."""


@dataclass(frozen=True)
class BaseVehicle:
    """The vehicle whose parameters are identified.

    Attributes:
        reference: name, file or code as the user gave it.
        definition: the vehicle file, with bounds and priors, or the vehicle from code.
        vehicle: the same vehicle as the planner uses it.
        model: reference to the code; the path of a file is absolute.
    """

    reference: str
    definition: VehicleConfig | Vehicle
    vehicle: Vehicle
    model: str

    @property
    def name(self) -> str:
        """Name of the vehicle."""
        return self.vehicle.name

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Parameters of the model as in a vehicle file; those that no file states have a value and a unit only."""
        stated = self.definition.parameters if isinstance(self.definition, VehicleConfig) else {}
        units = units_of(self.model)
        return {
            name: stated.get(name) or Parameter(value=value, unit=units.get(name, "1"))
            for name, value in self.vehicle.parameters.items()
        }

    @property
    def footprint(self) -> Footprint:
        """Footprint as in a vehicle file."""
        shape = self.vehicle.footprint
        return Footprint(length=shape.length, width=shape.width, offset=shape.offset)

    @property
    def controls(self) -> Mapping[str, tuple[float, float]]:
        """Limits of the controls where they differ from those of the model's code."""
        return self.definition.controls if isinstance(self.definition, VehicleConfig) else {}

    @property
    def top_speed(self) -> float | str:
        """Top speed, m/s, or the name of the parameter that is the top speed."""
        return (
            self.definition.top_speed if isinstance(self.definition, VehicleConfig) else float(self.vehicle.top_speed)
        )


def load_base_vehicle(reference: str) -> BaseVehicle:
    """Load a bundled vehicle, a vehicle file, or code.

    Raises:
        InputError: with everything that is wrong with it.
    """
    resolved = resolved_reference(reference, Path.cwd())
    if is_code(resolved):
        vehicle = vehicle_of(resolved, reference)
        base = BaseVehicle(reference, vehicle, vehicle, resolved)
    else:
        config = read_vehicle_file(resolved)
        model = config.model
        if split_file(model) is not None:
            model = resolve_vehicle(model, Path(config.source.file).parent)
        base = BaseVehicle(reference, config, configured(config), model)
    if not (base.vehicle.source and are_steps_cached(base.vehicle)):  # they were checked before they were compiled
        check_functions(base.vehicle, reference)
    return base


COMMANDS_OF = {"throttle": "full_throttle", "steering": "full_steering"}
"""Parameters of `kraft.vehicles.car` that state what command counts as full."""


def for_commands(base: BaseVehicle, logs: Sequence[Log]) -> BaseVehicle:
    """The car with the commands of the logs: their limits, and the largest ones as the full ones."""
    config = base.definition
    assert isinstance(config, VehicleConfig)  # a vehicle file with terms
    values, limits = {}, {}
    for name, full in COMMANDS_OF.items():
        column = [part.commands[:, log.controls.index(name)] for log in logs for part in log.parts]
        low, high = (float(edge) for edge in (min(c.min() for c in column), max(c.max() for c in column)))
        largest = max(abs(low), abs(high))
        if largest > 0.0:
            values[full], limits[name] = largest, (low, high)
        if name == "throttle" and low < 0.0:
            values["full_reverse"] = -low / largest
    if "steering" in limits:  # a car turns as far to one side as to the other unless the logs show otherwise
        reach = values["full_steering"]
        limits["steering"] = (-reach, reach)
    changed = config.with_values(values).with_controls(limits)
    return replace(base, definition=changed, vehicle=configured(changed))


def with_recorded_commands(
    base: BaseVehicle, identification: Identification, scales: Mapping[str, float]
) -> tuple[BaseVehicle, Identification]:
    """The car and its identification with commands as they were recorded: those of the fit are `scales` times them."""
    config = base.definition
    assert isinstance(config, VehicleConfig)  # a vehicle file with terms
    values = {full: base.vehicle.parameters[full] / scales[name] for name, full in COMMANDS_OF.items()}
    limits = {name: (low / scales[name], high / scales[name]) for name, (low, high) in base.controls.items()}
    changed = config.with_values(values).with_controls(limits)
    parameters = {
        name: replace(p, value=values[name], initial=values[name], ci95=(values[name], values[name]))
        if name in values
        else p
        for name, p in identification.parameters.items()
    }
    scale = np.array([scales[name] for name in base.vehicle.controls])
    logs = tuple(
        replace(log, parts=tuple(replace(part, controls=part.controls / scale) for part in log.parts))
        for log in identification.logs
    )
    car = replace(base, definition=changed, vehicle=configured(changed))
    return car, replace(identification, parameters=parameters, logs=logs)


def with_speed(base: BaseVehicle, identification: Identification, logs: Sequence[Log]) -> BaseVehicle:
    """The car with a top speed: that which full throttle leads to, or the highest in the logs if it is higher."""
    model, values = base.vehicle, identification.values
    car = model.with_parameters({name: values[name] for name in model.parameters})
    steps = round(SPEED_SETTLING / SPEED_STEP)
    controls = np.zeros((steps, 1, len(model.controls)))
    controls[:, 0, list(model.controls).index("throttle")] = model.controls["throttle"][1]
    states = DiscreteModel(car).simulate(
        np.zeros((1, len(model.state))), controls, car.parameter_array[None], np.array([SPEED_STEP])
    )
    steady = float(np.abs(states[:, 0, model.index("v")]).max())
    seen = max(high_speed(part) for log in logs for part in log.parts)
    config = base.definition
    assert isinstance(config, VehicleConfig)
    changed = config.with_top_speed(float(f"{max(steady, seen):.3g}"))
    return replace(base, definition=changed, vehicle=configured(changed))
