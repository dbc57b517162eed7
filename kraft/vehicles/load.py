"""Loading of vehicles: the model from code, its numbers from a YAML file if there is one, and whether the two fit.

What a vehicle file states fits its model in the names of parameters and controls, in units and in the top speed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Final

from kraft.config import bundled
from kraft.config.document import Document, frozen
from kraft.config.schema import check, describe, is_number
from kraft.config.source import Source
from kraft.config.user_code import is_code, split_file
from kraft.config.yaml_reader import read_document
from kraft.errors import Code, Diagnostic, InputError
from kraft.text import suggestion
from kraft.vehicles import is_car
from kraft.vehicles.code import StatedByCode, check_functions, check_stated, vehicle_in_code, vehicle_of
from kraft.vehicles.config import SPEED_EXPECTED, SPEED_MAX, Parameter, VehicleConfig, load_vehicle_config
from kraft.vehicles.identification_record import SpeedPrediction
from kraft.vehicles.reference import VehicleProblem, reference_of, resolve_vehicle
from kraft.vehicles.true_robot import CarDimensions, RobotTruth, with_files
from ompl_ext.vehicle import Footprint, OpenLoopErrors, Vehicle

SPEED_UNIT: Final = "m/s"


def load_vehicle(
    reference: str | Path, folder: str | Path | None = None, parameters: Mapping[str, float] | None = None
) -> Vehicle:
    """Load a bundled vehicle (``mushr``), a YAML file, ``module:attribute`` or ``path/to/file.py:attribute``.

    Args:
        reference: name, path or code; a path is relative to `folder`.
        folder: folder of the file that contains the reference, by default the working directory.
        parameters: values that replace those of the vehicle, in its units.

    Raises:
        InputError: with every problem of the reference, the file, the code or the parameters.
        TypeError: if the reference is neither text nor a path, or the parameters are no mapping.
    """
    if not isinstance(parameters, Mapping | None):
        raise TypeError(f"parameters: expected a mapping of names to values, not {type(parameters).__name__}")
    values: Mapping[str, float] = frozen(parameters or {})
    reference = reference_of(reference)
    resolved = resolved_reference(reference, Path.cwd() if folder is None else Path(folder))
    if is_code(resolved):
        vehicle = with_parameters(vehicle_in_code(resolved, reference), values)
    else:
        config = read_vehicle_file(resolved)
        vehicle = configured(config.with_values(values) if values else config)
    check_functions(vehicle, reference)
    return vehicle


def resolved_reference(reference: str, folder: Path) -> str:
    """Reference as `resolve_vehicle` returns it.

    Raises:
        InputError: if there is no such vehicle; it names the reference.
    """
    try:
        return resolve_vehicle(reference, folder)
    except VehicleProblem as error:
        raise InputError.of(reference, error.problem, error.expected, error.code) from None


def read_vehicle_file(name_or_path: str | Path) -> VehicleConfig:
    """A vehicle file as `load_vehicle_config` reads it.

    Raises:
        InputError: with every problem of the file, and with those of the code that it names and of its names of
            parameters, which are otherwise checked by `configured`.
    """
    try:
        return load_vehicle_config(name_or_path)
    except InputError as error:
        document = read_document(bundled.find("vehicle", name_or_path))
        content = document.data if isinstance(document.data, dict) else {}
        raise InputError([*error.diagnostics, *_code_problems(content, document.source)]) from error


def _code_problems(content: Mapping[str, object], source: Source) -> list[Diagnostic]:
    """Problems of the code that a file names and of what the file states about it."""
    reference = content.get("model")
    if not isinstance(reference, str) or not is_code(reference):
        return []  # that is a problem of the file
    try:
        return fit_problems(_model(reference, source), reference, content, source)
    except InputError as error:
        return list(error.diagnostics)


def configured(config: VehicleConfig) -> Vehicle:
    """Model of a vehicle file with the name, parameters, footprint and top speed of the file.

    Raises:
        InputError: if the model does not load or lacks a parameter that the file names.
    """
    model = _model(config.model, config.source)
    problems = fit_problems(model, config.model, dict(config), config.source)
    problems += [
        config.source.diagnostic(("controls", name), f"is [{low:g}, {high:g}]", "expected the lowest command first")
        for name, (low, high) in config.controls.items()
        if low >= high
    ]
    values = {**model.parameters, **config.values}
    speed = values.get(config.top_speed, 0.0) if isinstance(config.top_speed, str) else config.top_speed
    if not 0.0 < speed <= SPEED_MAX and not problems:
        problem = f"is {speed:g} m/s"
        expected = f"expected a speed greater than 0 and at most {SPEED_MAX:g}"
        problems.append(config.source.diagnostic("top_speed", problem, expected))
    if problems:
        raise InputError(problems)
    shape = config.footprint
    return replace(
        model.with_parameters(config.values),
        name=config.name,
        controls={**model.controls, **config.controls},
        footprint=Footprint(shape.length, shape.width, shape.offset),
        top_speed=speed,
        ranges=config.ranges,
        gravity_share=config.gravity_share,
        delay=None if config.delay is None else (config.delay.value, config.delay.std),
        errors_by_speed=tuple(map(_errors, config.prediction_errors)),
        file=config.source.file,
    )


def _errors(of_speed: SpeedPrediction) -> OpenLoopErrors:
    return OpenLoopErrors(of_speed.speeds, of_speed.after, of_speed.along, of_speed.across, of_speed.yaw)


def natural_robot(vehicle: Vehicle) -> tuple[RobotTruth, Source]:
    """True robot where a scenario states none, with the source of the file that says so.

    It is the one in the vehicle's file, else the MuSHR for a car, and else the vehicle's own model.
    """
    if vehicle.file and (stated := _stated_robot(Path(vehicle.file))) is not None:
        return stated
    return RobotTruth(car=CarDimensions()) if is_car(vehicle) else RobotTruth(), Source(vehicle.file or vehicle.name)


def _stated_robot(path: Path) -> tuple[RobotTruth, Source] | None:
    """True robot that a vehicle file states, with its source; None if it states none."""
    config = load_vehicle_config(path)
    if config.truth is None:
        return None
    files, _ = with_files(config.truth, path.parent, config.source)
    return config.truth.model_copy(update=files), config.source


class RecordedVehicle(StatedByCode):
    """What a recording states of the vehicle that drove: true of that robot, whatever model is identified from it."""

    truth: RobotTruth | None = None
    """the true robot; an `mjcf` by its absolute path, or relative to the folder of the bundled vehicles"""

    @classmethod
    def of(cls, vehicle: Vehicle, true: RobotTruth) -> RecordedVehicle:
        """A vehicle that was driven, and its true robot with absolute paths.

        Raises:
            InputError: if a vehicle file could not state what the vehicle does.
        """
        check_stated(vehicle, vehicle.name)
        if true.kind in (None, "model") and true.model is None:  # the equations of the vehicle itself
            true = true.model_copy(update={"model": vehicle.file or None})
        # those of code without a file have no name by which they are found
        is_stated = true.kind in ("car", "mjcf") or true.model is not None
        files = {"model": _bundled_name(true.model), "mjcf": _in_bundle(true.mjcf)}
        truth = true.model_copy(update=files) if is_stated else None
        return cls.model_validate({**StatedByCode.content(vehicle), "truth": truth})

    @classmethod
    def read(cls, content: Mapping[str, Any], file: Path) -> RecordedVehicle | None:
        """The vehicle that a section of a manifest states, with absolute paths; None if it is not valid."""
        found, _ = check(cls, Document(dict(content), Source(str(file))))
        return None if found is None else found.located()

    def located(self) -> RecordedVehicle:
        """The same with the absolute path of an MJCF file."""
        if self.truth is None or self.truth.mjcf is None:
            return self
        robot = self.truth.model_copy(update={"mjcf": str(bundled.folder("vehicle") / self.truth.mjcf)})
        return self.model_copy(update={"truth": robot})


def _in_bundle(path: str | None) -> str | None:
    """A path, relative to the folder of the bundled vehicles if it is in it: where they are differs by machine."""
    folder = bundled.folder("vehicle")
    return str(Path(path).relative_to(folder)) if path and Path(path).is_relative_to(folder) else path


def _bundled_name(reference: str | None) -> str | None:
    """A reference to a vehicle, by its name if it is the file of a bundled one."""
    path = _in_bundle(reference)
    return Path(path).stem if path and path != reference else reference


def problem_of(vehicle: Vehicle, key: str, problem: str, expected: str, code: Code) -> Diagnostic:
    """Diagnostic at a key of a vehicle's file, or about the vehicle if it has none."""
    if vehicle.file:
        return load_vehicle_config(Path(vehicle.file)).source.diagnostic(key, problem, expected, code=code)
    return Diagnostic(vehicle.name, problem, expected, code=code)


def with_parameters(vehicle: Vehicle, parameters: Mapping[str, float]) -> Vehicle:
    """Same vehicle with other values of some parameters.

    Raises:
        InputError: for parameters that the vehicle does not have, and values that are no finite numbers.
    """
    problem, none = f"{vehicle.name} has no such parameter", f"{vehicle.name} has no parameters"
    problems = [
        Diagnostic(name, problem, suggestion(name, vehicle.parameters, none=none), code=Code.UNKNOWN)
        for name in parameters
        if name not in vehicle.parameters
    ]
    problems += [
        Diagnostic(name, f"is {describe(value)}", "expected a finite number")
        for name, value in parameters.items()
        if name in vehicle.parameters and not (is_number(value) and math.isfinite(value))
    ]
    if problems:
        raise InputError(problems)
    return vehicle.with_parameters(parameters)


def _model(reference: str, source: Source) -> Vehicle:
    """Model that a file names; a relative path is relative to the file."""
    try:
        if split_file(reference) is not None:
            reference = resolve_vehicle(reference, Path(source.file).parent)
        return vehicle_of(reference)
    except VehicleProblem as error:
        raise InputError([source.diagnostic("model", error.problem, error.expected, code=error.code)]) from None
    except InputError as error:
        raise InputError(
            source.diagnostic("model", d.problem, d.expected, code=d.code) for d in error.diagnostics
        ) from error


def fit_problems(model: Vehicle, reference: str, content: Mapping[str, object], source: Source) -> list[Diagnostic]:
    """Problems of the content of a vehicle file, as far as that is valid, beside its model.

    Args:
        model: the model.
        reference: reference of the file to the model's code.
        content: values of the file by key, of any type.
        source: positions in the file.
    """
    parameters, controls = _mapping(content.get("parameters")), _mapping(content.get("controls"))
    units = units_of(reference)
    problems = []
    for name, stated in parameters.items():
        if name not in model.parameters:
            expected = suggestion(name, model.parameters, none=f"{model.name} has no parameters")
            problem = f"{model.name} has no such parameter"
            problems.append(source.diagnostic(("parameters", name), problem, expected, at_key=True, code=Code.UNKNOWN))
        elif name in units and (unit := _unit(stated)) not in (None, units[name]):
            problem, expected = f"is {unit!r}", f"expected {units[name]!r}, the unit of the model"
            problems.append(source.diagnostic(("parameters", name, "unit"), problem, expected, code=Code.MISMATCH))
    for name in controls:
        if name not in model.controls:
            problem, expected = f"{model.name} has no such control", suggestion(name, model.controls)
            problems.append(source.diagnostic(("controls", name), problem, expected, at_key=True, code=Code.UNKNOWN))
    speed = content.get("top_speed")
    if isinstance(speed, str) and speed not in model.parameters:
        problems.append(source.diagnostic("top_speed", f"is the text {speed!r}", SPEED_EXPECTED, code=Code.UNKNOWN))
    elif isinstance(speed, str) and units.get(speed, SPEED_UNIT) != SPEED_UNIT:
        problem = f"is the parameter {speed}, in {units[speed]}"
        problems.append(source.diagnostic("top_speed", problem, SPEED_EXPECTED, code=Code.MISMATCH))
    return problems


def units_of(reference: str) -> Mapping[str, str]:
    """Units of the parameters of a model that has a bundled file; none for other code, which states no units."""
    return _bundled_units().get(reference, {}) if reference.startswith("kraft.") else {}


@cache
def _bundled_units() -> dict[str, dict[str, str]]:
    """Units of the parameters of all bundled vehicles, by the reference to their code."""
    found: dict[str, dict[str, str]] = {}
    for name in bundled.names("vehicle"):
        data = _mapping(read_document(bundled.folder("vehicle") / f"{name}.yaml").data)
        stated = {key: _unit(parameter) for key, parameter in _mapping(data.get("parameters")).items()}
        found[str(data.get("model"))] = {key: unit for key, unit in stated.items() if unit is not None}
    return found


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


def _unit(parameter: object) -> str | None:
    unit = parameter.unit if isinstance(parameter, Parameter) else _mapping(parameter).get("unit")
    return unit if isinstance(unit, str) else None
