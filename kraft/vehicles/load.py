"""Loading of vehicles: the model from code, its numbers from a YAML file if there is one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from kraft.config.source import Source
from kraft.errors import Code, Diagnostic, InputError
from kraft.text import suggestion
from kraft.vehicles import is_car
from kraft.vehicles.code import check_functions, vehicle_of
from kraft.vehicles.config import CarDimensions, Robot, VehicleConfig, load_vehicle_config, with_files
from kraft.vehicles.reference import VehicleProblem, is_attribute, resolve_vehicle, split_file
from ompl_ext.vehicle import Footprint, Vehicle


def load_vehicle(reference: str, folder: Path | None = None, parameters: Mapping[str, float] | None = None) -> Vehicle:
    """Load a bundled vehicle (``mushr``), a YAML file, ``module:attribute`` or ``path/to/file.py:attribute``.

    Args:
        reference: name, path or code; a path is relative to `folder`.
        folder: folder of the file that contains the reference, by default the working directory.
        parameters: values that replace those of the vehicle, in its units.

    Raises:
        InputError: with every problem of the reference, the file, the code or the parameters.
    """
    try:
        resolved = resolve_vehicle(reference, folder or Path.cwd())
    except VehicleProblem as error:
        raise InputError.of(reference, error.problem, error.expected, error.code) from None
    if is_attribute(resolved) or split_file(resolved) is not None:
        vehicle = with_parameters(vehicle_of(resolved, reference), parameters or {})
    else:
        vehicle = configured(load_vehicle_config(resolved).with_values(parameters or {}))
    check_functions(vehicle, reference)
    return vehicle


def configured(config: VehicleConfig) -> Vehicle:
    """Model of a vehicle file with the name, parameters, footprint and top speed of the file.

    Raises:
        InputError: if the model does not load or lacks a parameter that the file sets.
    """
    model = _model(config)
    problems = [
        config.source.diagnostic(
            ("parameters", name),
            f"{model.name} has no such parameter",
            suggestion(name, model.parameters, none=f"{model.name} has no parameters"),
            at_key=True,
            code=Code.UNKNOWN,
        )
        for name in config.parameters
        if name not in model.parameters
    ]
    problems += [
        config.source.diagnostic(
            ("controls", name), f"{model.name} has no such control", suggestion(name, model.controls), at_key=True,
            code=Code.UNKNOWN,
        )
        for name in config.controls
        if name not in model.controls
    ]  # fmt: skip
    problems += [
        config.source.diagnostic(("controls", name), f"is [{low:g}, {high:g}]", "expected the lowest command first")
        for name, (low, high) in config.controls.items()
        if low >= high
    ]
    if config.speed_limit <= 0:
        problem = f"is {config.speed_limit:g} m/s"
        problems.append(config.source.diagnostic("top_speed", problem, "expected a speed greater than 0"))
    if problems:
        raise InputError(problems)
    shape = config.footprint
    return replace(
        model.with_parameters(config.values),
        name=config.name,
        controls={**model.controls, **config.controls},
        footprint=Footprint(shape.length, shape.width, shape.offset),
        top_speed=config.speed_limit,
        ranges=config.ranges,
        gravity_share=config.gravity_share,
        delay=None if config.delay is None else (config.delay.value, config.delay.std),
        file=config.source.file,
    )


def natural_robot(vehicle: Vehicle) -> tuple[Robot, Source]:
    """True robot where a scenario states none, with the source of the file that says so.

    It is the one in the vehicle's file, else the MuSHR for a car, and else the vehicle's own model.
    """
    if vehicle.file:
        config = load_vehicle_config(Path(vehicle.file))
        if config.truth is not None:
            files, _ = with_files(config.truth, Path(vehicle.file).parent, config.source)
            return config.truth.model_copy(update=files), config.source
    return Robot(car=CarDimensions()) if is_car(vehicle) else Robot(), Source(vehicle.file or vehicle.name)


def problem_of(vehicle: Vehicle, key: str, problem: str, expected: str, code: Code) -> Diagnostic:
    """Diagnostic at a key of a vehicle's file, or about the vehicle if it has none."""
    if vehicle.file:
        return load_vehicle_config(Path(vehicle.file)).source.diagnostic(key, problem, expected, code=code)
    return Diagnostic(vehicle.name, problem, expected, code=code)


def with_parameters(vehicle: Vehicle, parameters: Mapping[str, float]) -> Vehicle:
    """Same vehicle with other values of some parameters.

    Raises:
        InputError: for parameters that the vehicle does not have.
    """
    unknown = [name for name in parameters if name not in vehicle.parameters]
    if unknown:
        problem, none = f"{vehicle.name} has no such parameter", f"{vehicle.name} has no parameters"
        raise InputError(
            Diagnostic(name, problem, suggestion(name, vehicle.parameters, none=none), code=Code.UNKNOWN)
            for name in unknown
        )
    return vehicle.with_parameters(parameters)


def _model(config: VehicleConfig) -> Vehicle:
    """Model that the file names; a relative path is relative to the file."""
    reference = config.model
    try:
        if split_file(reference) is not None:
            reference = resolve_vehicle(reference, Path(config.source.file).parent)
        return vehicle_of(reference)
    except VehicleProblem as error:
        raise InputError([config.source.diagnostic("model", error.problem, error.expected, code=error.code)]) from None
    except InputError as error:
        raise InputError(
            config.source.diagnostic("model", d.problem, d.expected, code=d.code) for d in error.diagnostics
        ) from error
