"""Schema of a vehicle file: model, parameters, footprint, top speed, true robot, record of the identification."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Final

from pydantic import AfterValidator, Field, PlainValidator, PrivateAttr
from pydantic_core import PydanticCustomError

from kraft.config import bundled
from kraft.config.document import read_bytes
from kraft.config.schema import (
    Length,
    Name,
    Number,
    ParameterValue,
    Positive,
    StrictModel,
    Symbol,
    build,
    describe,
    is_number,
    refuse,
    valid,
)
from kraft.config.source import Source
from kraft.config.user_code import is_code
from kraft.config.yaml_reader import parse_document
from kraft.errors import Code, Diagnostic, InputError
from kraft.text import suggestion
from kraft.vehicles import DELAY_MAX
from kraft.vehicles.identification_record import IdentificationRecord, SpeedPrediction
from kraft.vehicles.true_robot import RobotTruth, with_files
from ompl_ext.names import FORCE
from ompl_ext.vehicle import ParameterRange, Vehicle

SPEED_MAX: Final = 100.0
"""Largest top speed, m/s."""
SPEED_EXPECTED = f"expected a number in m/s, of at most {SPEED_MAX:g}, or the name of a parameter"


def _model_reference(text: str) -> str:
    if not is_code(text):
        raise refuse(f"is {text!r}", "expected module:attribute, as in kraft.vehicles.mushr:MUSHR")
    return text


def _speed(value: object) -> float | str:
    if isinstance(value, str):  # `kraft.vehicles.load` checks that the model has such a parameter
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= SPEED_MAX:
        raise refuse(f"is {describe(value)}", SPEED_EXPECTED)
    return float(value)


_SpeedSchema = Annotated[float, Field(gt=0, le=SPEED_MAX)] | Symbol


class Delay(StrictModel):
    """Delay of commands, as far as it is known before a drive."""

    value: Annotated[float, Field(ge=0, le=DELAY_MAX)]
    """time until a command takes effect, s"""
    std: Positive
    """standard deviation, with what may change from day to day, s"""


class VehicleConfig(StrictModel):
    """Vehicle file. The parameters have the order of the model."""

    name: Name
    """short name of letters, digits, - and _"""
    description: str = ""
    """one sentence for `kraft list vehicles`"""
    model: Annotated[str, AfterValidator(_model_reference)]
    """the model's code, module:attribute or file.py:attribute (relative to this file)"""
    parameters: Mapping[Symbol, Parameter] = Field(default_factory=dict)
    """{symbol: {value, unit, min, max, std}}"""
    controls: Mapping[Symbol, tuple[Number, Number]] = Field(default_factory=dict)
    """{control: [lowest, highest]} command, where the limits differ from those of the model's code"""
    footprint: Footprint
    """{length, width, offset}"""
    top_speed: Annotated[float | str, PlainValidator(_speed, json_schema_input_type=_SpeedSchema)]
    """speed that the vehicle never exceeds, m/s, or the parameter that is that speed"""
    gravity_share: Annotated[float, Field(gt=0, le=1)] | None = None
    """share of gravity along a slope that accelerates the vehicle; the rest the inertia of the drive takes"""
    delay: Delay | None = None
    """delay of commands {value, std}, from which estimators start that estimate it"""
    truth: RobotTruth | None = None
    """the true robot in trials whose scenario states none {car} or {mjcf, body, actuators, geoms} or {model}"""
    errors_by_speed: tuple[SpeedPrediction, ...] = ()
    """open-loop prediction errors on drives, from slow to fast ones, in place of those of the `identification`"""
    identification: IdentificationRecord | None = None
    """where the parameters come from, as `kraft sysid` writes it"""

    _source: Source = PrivateAttr(default_factory=Source)

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that the parameters which a share of gravity needs are given."""
        parameters = content.get("parameters", {})
        if content.get("gravity_share") is not None and isinstance(parameters, Mapping):
            for name in [name for name in FORCE if name not in parameters]:
                expected = f"expected the parameters {' and '.join(FORCE)} with it"
                yield refuse(f"is given, but there is no {name}", expected, ("gravity_share",), Code.MISSING)

    @property
    def prediction_errors(self) -> tuple[SpeedPrediction, ...]:
        """Prediction errors by speed that the file states, or those of its identification."""
        recorded = () if self.identification is None else self.identification.by_speed
        return self.errors_by_speed or recorded

    @property
    def source(self) -> Source:
        """Position of each value in the file."""
        return self._source

    @property
    def values(self) -> dict[str, float]:
        """Nominal value of each parameter, in the model's order."""
        return {name: parameter.value for name, parameter in self.parameters.items()}

    @property
    def ranges(self) -> dict[str, ParameterRange]:
        """Range of each parameter for which the file states min, max and std.

        That of a fixed parameter, and of a term at its neutral value, which is off, is its value: both are known.
        """
        found = {}
        for name, p in self.parameters.items():
            if p.fixed or p.value == p.neutral:
                found[name] = ParameterRange(p.value, p.value, 0.0, p.unit)
            elif p.min is not None and p.max is not None and p.std is not None:
                found[name] = ParameterRange(p.min, p.max, p.std, p.unit)
        return found

    def with_values(self, values: Mapping[str, float]) -> VehicleConfig:
        """Same vehicle with other nominal values of some parameters.

        Raises:
            InputError: for parameters that the vehicle does not have and values outside their limits.
        """
        problems = [
            Diagnostic(name, f"{self.name} has no such parameter", suggestion(name, self.parameters), code=Code.UNKNOWN)
            for name in values
            if name not in self.parameters
        ]
        stated = {name: {"value": value} for name, value in values.items() if name in self.parameters}
        try:
            changed = self.with_stated(stated)
        except InputError as error:
            raise InputError([*problems, *error.diagnostics]) from None
        if problems:
            raise InputError(problems)
        return changed

    def with_stated(self, stated: Mapping[str, Mapping[str, float]]) -> VehicleConfig:
        """Same vehicle with other values of some keys of some of its parameters, such as their limits.

        Raises:
            InputError: for values outside their limits.
        """
        parameters = {name: {**dict(each), **stated.get(name, {})} for name, each in self.parameters.items()}
        changed = build(VehicleConfig, {**dict(self), "parameters": parameters}, self.name)
        changed._source = self._source
        return changed

    def with_controls(self, limits: Mapping[str, tuple[float, float]]) -> VehicleConfig:
        """Same vehicle with other limits of some controls."""
        return self.model_copy(update={"controls": {**self.controls, **limits}})

    def with_top_speed(self, speed: float) -> VehicleConfig:
        """Same vehicle with another top speed, m/s."""
        return self.model_copy(update={"top_speed": speed})


def load_vehicle_config(name_or_path: str | Path) -> VehicleConfig:
    """Load a bundled vehicle (``mushr``) or a vehicle file.

    Raises:
        InputError: with every problem of the file, or if there is no such name or file.
    """
    path = bundled.find("vehicle", name_or_path)
    config = _config_of(read_bytes(path), str(path))
    if config.truth is not None and (problems := with_files(config.truth, path.parent, config.source)[1]):
        raise InputError(problems)
    return config


@lru_cache(maxsize=16)  # by its content: every row of an evaluation asks for it
def _config_of(content: bytes, file: str) -> VehicleConfig:
    document = parse_document(content, file)
    config = valid(VehicleConfig, document)
    config._source = document.source  # a private attribute, which a frozen model allows to set
    return config


class Parameter(StrictModel):
    """Parameter of a model, with its limits and its prior for identification."""

    value: ParameterValue
    """nominal value, in the unit given"""
    unit: str
    """unit, `1` if it has none"""
    description: str = ""
    """what it is"""
    min: ParameterValue | None = None
    """smallest plausible value"""
    max: ParameterValue | None = None
    """largest plausible value"""
    std: Positive | None = None
    """standard deviation of what is known beforehand"""
    neutral: ParameterValue | None = None
    """value at which the parameter has no effect: `kraft sysid` chooses by prediction which ones are needed"""
    fixed: bool = False
    """measured or chosen, not identified: poses alone do not show it"""
    variation: Annotated[float, Field(ge=0)] = 0.0
    """standard deviation of its changes during a drive, such as those of a battery, a motor or a linkage"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that the bounds are in order and that the value is within them."""
        value, low, high = (content.get(name) for name in ("value", "min", "max"))
        if is_number(low) and is_number(high) and low >= high:
            yield refuse(f"is {low:g}, not below max", f"expected less than {high:g}", ("min",), Code.CONFLICT)
        elif is_number(value) and is_number(low) and value < low:
            yield refuse(f"is {value:g}, below min", f"expected at least {low:g}", ("value",))
        elif is_number(value) and is_number(high) and value > high:
            yield refuse(f"is {value:g}, above max", f"expected at most {high:g}", ("value",))


class Footprint(StrictModel):
    """Rectangle that encloses the vehicle."""

    length: Length
    """extent along x, m"""
    width: Length
    """extent along y, m"""
    offset: Annotated[float, Field(ge=-100, le=100)] = 0.0
    """distance of the rectangle's centre ahead of the body frame, m"""


def stated_parameters(vehicle: VehicleConfig | Vehicle) -> Mapping[str, Parameter]:
    """Parameters as a vehicle file states them, or as the `ranges` of code do."""
    if isinstance(vehicle, VehicleConfig):
        return vehicle.parameters
    return {name: _of_code(vehicle.parameters[name], allowed) for name, allowed in vehicle.ranges.items()}


def _of_code(value: float, allowed: ParameterRange) -> Parameter:
    """A parameter with its range, which includes its value."""
    unit = allowed.unit or "1"
    if allowed.is_known:
        return Parameter(value=value, unit=unit, fixed=True)
    low, high = min(allowed.low, value), max(allowed.high, value)
    return Parameter(value=value, unit=unit, min=low, max=high, std=allowed.std)
