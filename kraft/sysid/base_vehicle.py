"""The vehicle whose parameters are identified: a bundled vehicle, a vehicle file or code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from kraft.errors import InputError
from kraft.vehicles.code import check_functions, vehicle_of
from kraft.vehicles.config import (
    Footprint,
    Parameter,
    VehicleConfig,
    load_vehicle_config,
)
from kraft.vehicles.load import configured
from kraft.vehicles.reference import VehicleProblem, is_attribute, resolve_vehicle, split_file
from ompl_ext.vehicle import Vehicle


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
        """Parameters as in a vehicle file; those of code have a value only."""
        if isinstance(self.definition, VehicleConfig):
            return self.definition.parameters
        return {name: Parameter(value=value, unit="?") for name, value in self.vehicle.parameters.items()}

    @property
    def footprint(self) -> Footprint:
        """Footprint as in a vehicle file."""
        shape = self.vehicle.footprint
        return Footprint(length=shape.length, width=shape.width, offset=shape.offset)

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
    try:
        resolved = resolve_vehicle(reference, Path.cwd())
    except VehicleProblem as error:
        raise InputError.of(reference, error.problem, error.expected) from None
    if is_attribute(resolved) or split_file(resolved) is not None:
        vehicle = vehicle_of(resolved, reference)
        base = BaseVehicle(reference, vehicle, vehicle, resolved)
    else:
        config = load_vehicle_config(resolved)
        model = config.model
        if split_file(model) is not None:
            model = resolve_vehicle(model, Path(config.source.file).parent)
        base = BaseVehicle(reference, config, configured(config), model)
    check_functions(base.vehicle, reference)
    return base
