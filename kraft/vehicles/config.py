"""Schema of a vehicle file: model, parameters, footprint, top speed, true robot, and the record of the identification.

Scenarios state the true robot with the same keys.  Only the simulation reads it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import (
    AfterValidator,
    Field,
    PlainValidator,
    PrivateAttr,
    StringConstraints,
    model_validator,
)
from pydantic_core import PydanticCustomError

from kraft.config import bundled
from kraft.config.schema import Length, Name, NonNegative, Positive, StrictModel, build, describe, read_model, refuse
from kraft.config.yaml_reader import KeyPath, Source
from kraft.errors import Code, Diagnostic, InputError
from kraft.text import suggestion
from kraft.vehicles import DELAY_MAX, FORCE
from kraft.vehicles.reference import VehicleProblem, is_code, resolve_vehicle
from ompl_ext.vehicle import ParameterRange

Symbol = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Quantity = Annotated[float, Field(ge=-1e9, le=1e9)]
Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Text = Annotated[str, StringConstraints(min_length=1)]
Digest = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
SPEED_EXPECTED = "expected a number in m/s, of at most 100, or the name of a parameter"


def _model_reference(text: str) -> str:
    if not is_code(text):
        raise refuse(f"is {text!r}", "expected module:attribute, as in kraft.vehicles.mushr:MUSHR")
    return text


def _speed(value: object) -> float | str:
    if isinstance(value, str):  # `kraft.vehicles.load` checks that the model has such a parameter
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= 100:
        raise refuse(f"is {describe(value)}", SPEED_EXPECTED)
    return float(value)


_SpeedSchema = Annotated[float, Field(gt=0, le=100)] | Symbol


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
    truth: Robot | None = None
    """the true robot in trials whose scenario states none {car} or {mjcf, body, actuators, geoms} or {model}"""
    identification: IdentificationRecord | None = None
    """where the parameters come from, as `kraft sysid` writes it"""

    _source: Source = PrivateAttr(default_factory=Source)

    @model_validator(mode="after")
    def _check(self) -> Self:
        for error in self.across_keys(dict(self)):
            raise error
        return self

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that the parameters which a share of gravity needs are given."""
        parameters = content.get("parameters", {})
        if content.get("gravity_share") is not None and isinstance(parameters, Mapping):
            for name in [name for name in FORCE if name not in parameters]:
                expected = f"expected the parameters {' and '.join(FORCE)} with it"
                yield refuse(f"is given, but there is no {name}", expected, ("gravity_share",), Code.MISSING)

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
        parameters = {
            name: {**dict(parameter), "value": values.get(name, parameter.value)}
            for name, parameter in self.parameters.items()
        }
        try:
            changed = build(VehicleConfig, {**dict(self), "parameters": parameters}, self.name)
        except InputError as error:
            raise InputError([*problems, *error.diagnostics]) from None
        if problems:
            raise InputError(problems)
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
    config, document = read_model(path, VehicleConfig)
    config._source = document.source  # a private attribute, which a frozen model allows to set
    if config.truth is not None and (problems := with_files(config.truth, path.parent, document.source)[1]):
        raise InputError(problems)
    return config


class Parameter(StrictModel):
    """Parameter of a model, with its limits and its prior for identification."""

    value: Quantity
    """nominal value, in the unit given"""
    unit: str
    """unit, `1` if it has none"""
    description: str = ""
    """what it is"""
    min: Quantity | None = None
    """smallest plausible value"""
    max: Quantity | None = None
    """largest plausible value"""
    std: Positive | None = None
    """standard deviation of what is known beforehand"""
    neutral: Quantity | None = None
    """value at which the parameter has no effect: `kraft sysid` chooses by prediction which ones are needed"""
    fixed: bool = False
    """measured or chosen, not identified: poses alone do not show it"""
    variation: Annotated[float, Field(ge=0)] = 0.0
    """standard deviation of its changes during a drive, such as those of a battery, a motor or a linkage"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.min is not None and self.max is not None and self.min >= self.max:
            raise refuse(f"is {self.min:g}, not below max", f"expected less than {self.max:g}", ("min",), Code.CONFLICT)
        if self.min is not None and self.value < self.min:
            raise refuse(f"is {self.value:g}, below min", f"expected at least {self.min:g}", ("value",))
        if self.max is not None and self.value > self.max:
            raise refuse(f"is {self.value:g}, above max", f"expected at most {self.max:g}", ("value",))
        return self


class Footprint(StrictModel):
    """Rectangle that encloses the vehicle."""

    length: Length
    """extent along x, m"""
    width: Length
    """extent along y, m"""
    offset: Annotated[float, Field(ge=-100, le=100)] = 0.0
    """distance of the rectangle's centre ahead of the body frame, m"""


class IdentificationRecord(StrictModel):
    """How the parameters were identified, and how well they are known."""

    started_from: str
    """the vehicle whose model, footprint and initial values were taken"""
    interval: Literal["graph", "sandwich"]
    """what the covariance follows from: the noise of the poses, or how much the logs differ from each other"""
    covariance: Covariance
    """covariance {names, matrix} of what was estimated"""
    extras: Mapping[str, Extra] = Field(default_factory=dict)
    """parameters of the logs beside the model's, which planning does not use"""
    commands: Mapping[str, CommandScale] | None = None
    """meaning of the numbers of commands in the logs that were converted: (number - neutral) * scale was used"""
    noise: PoseNoise
    """noise of the poses {position, yaw, measured}"""
    fitted: Prediction
    """prediction errors on the logs that were fitted"""
    held_out: Prediction | None = None
    """prediction errors on logs that were held out"""
    held_out_before: Prediction | None = None
    """the same with the values before the identification"""
    by_speed: tuple[SpeedPrediction, ...] = ()
    """prediction errors on logs that were held out, from slow to fast drives; `adaptive-kraft` starts from them"""
    warnings: tuple[str, ...] = ()
    """what the identification warned of"""
    logs: tuple[Logged, ...]
    """every log that was used"""
    versions: Mapping[str, str]
    """versions of what shaped the result"""


class Covariance(StrictModel):
    """How uncertain the estimated parameters are, and how they depend on each other."""

    names: tuple[str, ...]
    """parameters and extras, in the order of rows and columns"""
    matrix: tuple[tuple[Number, ...], ...]
    """covariance, in the units of the parameters"""

    @model_validator(mode="after")
    def _square(self) -> Self:
        size = len(self.names)
        if len(self.matrix) != size or any(len(row) != size for row in self.matrix):
            raise refuse(
                "has another size than names", f"expected {size} rows of {size} numbers", ("matrix",), Code.MISMATCH
            )
        return self


class CommandScale(StrictModel):
    """Meaning of the numbers of a command in logs."""

    neutral: Number
    """number without effect"""
    scale: Number
    """factor of the difference from it"""


class Extra(StrictModel):
    """A parameter of the logs that the model does not have, such as the delay of the commands."""

    value: Number
    """identified value, in the unit given"""
    unit: str
    """unit, `1` if it has none"""
    std: NonNegative
    """standard deviation of the identified value"""
    description: str = ""
    """what it is"""


class Logged(StrictModel):
    """A log that was used."""

    name: str
    """what the log is called"""
    held_out: bool = False
    """whether it was left out of the fit, to test the prediction with"""
    files: Mapping[str, Digest]
    """SHA-256 of each of its files, by path"""


class Prediction(StrictModel):
    """Root mean square errors of open-loop prediction over windows of up to 3 s."""

    position: tuple[NonNegative, ...]
    """position after 1, 2 and 3 s, as far as the windows reach, m"""
    yaw: tuple[NonNegative, ...]
    """yaw after the same times, rad"""
    overall_position: NonNegative
    """position over all poses of all windows, m"""
    overall_yaw: NonNegative
    """yaw over all poses of all windows, rad"""


class SpeedPrediction(StrictModel):
    """Root mean square errors of open-loop prediction at similar speeds, along the vehicle and across it."""

    speeds: tuple[NonNegative, NonNegative]
    """lowest and highest mean speed of the windows, m/s"""
    windows: Annotated[int, Field(ge=1)]
    """number of windows"""
    after: tuple[Positive, ...]
    """times since the beginning of a window, s"""
    along: tuple[NonNegative, ...]
    """position along the vehicle after these times, m"""
    across: tuple[NonNegative, ...]
    """position across it, m"""
    yaw: tuple[NonNegative, ...]
    """yaw, rad"""

    @model_validator(mode="after")
    def _lengths(self) -> Self:
        for name in ("along", "across", "yaw"):
            if len(getattr(self, name)) != len(self.after):
                expected = f"expected one for each of the {len(self.after)} times"
                raise refuse("has another length than after", expected, (name,), Code.MISMATCH)
        return self


class PoseNoise(StrictModel):
    """Standard deviations of one observed pose."""

    position: Positive
    """in x and in y, m"""
    yaw: Positive
    """rad"""
    measured: bool
    """whether it was measured from the logs, rather than stated"""


class Wheels(StrictModel):
    """The four wheels of a simulated car."""

    radius: Length | None = None
    """m"""
    width: Length | None = None
    """m"""
    mass: Positive | None = None
    """of each, kg"""


class Drive(StrictModel):
    """One motor for all wheels, whose torque is proportional to the throttle."""

    top_speed: Annotated[float, Field(gt=0, le=30)]
    """steady speed at full throttle on a flat floor, m/s"""
    time_constant: Annotated[float, Field(ge=0.05, le=60)]
    """time in which the car reaches 63 % of its steady speed, s"""


class Servo(StrictModel):
    """The servo that steers the front wheels."""

    angle_max_deg: Annotated[float, Field(gt=0, le=60)] | None = None
    """stop of the linkage to either side, degrees"""
    rate_deg: Annotated[float, Field(gt=0, le=10_000)] | None = None
    """speed, degrees per second"""
    linkage: Annotated[float, Field(gt=0, le=2)] | None = None
    """angle of the wheels over the angle commanded"""


class Tyres(StrictModel):
    """The tyres of a simulated car."""

    friction: Annotated[float, Field(gt=0, le=10)] = 1.0
    """factor on the friction of the floor"""


class CarDimensions(StrictModel):
    """A simulated car; keys that are left out are those of `preset`."""

    preset: Literal["mushr", "f1tenth"] = "mushr"
    """car whose dimensions it has where no others are given"""
    length: Length | None = None
    """of the collision box, whose middle is midway between the axles, m"""
    width: Length | None = None
    """of the collision box, m"""
    wheelbase: Length | None = None
    """distance between the axles, m"""
    track: Length | None = None
    """distance between the left and the right wheels, m"""
    mass: Positive | None = None
    """of the chassis without wheels, kg"""
    wheels: Wheels = Wheels()
    """{radius, width, mass}"""
    drive: Drive | None = None
    """{top_speed, time_constant}"""
    servo: Servo = Servo()
    """{angle_max_deg, rate_deg, linkage}"""
    tyres: Tyres = Tyres()
    """{friction}"""


KINDS: Final = ("car", "mjcf", "model")


class Robot(StrictModel):
    """What drives: a simulated `car`, a MuJoCo model `mjcf`, or the equations of a vehicle, `model`."""

    car: CarDimensions | None = None
    """simulated car {preset, length, width, wheelbase, track, mass, wheels, drive, servo, tyres}"""
    mjcf: Text | None = None
    """file with a MuJoCo model of the robot, relative to this file"""
    body: Text | None = None
    """body of `mjcf` whose pose, x forward, is that of the robot; the first one if left out"""
    actuators: Mapping[Symbol, Text] | None = None
    """actuator of `mjcf` that receives each control {control: actuator}; the ones of the same name if left out"""
    geoms: tuple[Text, ...] | None = None
    """geoms of `mjcf` whose contact with an obstacle is a collision; all that can touch something if left out"""
    model: Text | None = None
    """vehicle whose equations are true: a name, a YAML file or code; the planning vehicle's own if left out"""
    parameters: Mapping[Symbol, Quantity] = Field(default_factory=dict)
    """true values of parameters of the model, in its units"""
    process_noise: Mapping[Symbol, NonNegative] = Field(default_factory=dict)
    """standard deviation that a state component of the model gains in one second of motion, in its unit"""

    @model_validator(mode="after")
    def _check_robot(self) -> Self:
        kinds = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(kinds) > 1:
            raise refuse(
                f"is given beside `{kinds[0]}`", "expected one of car, mjcf, model", (kinds[1],), Code.CONFLICT
            )
        for key in ("body", "actuators", "geoms"):
            if getattr(self, key) is not None and self.mjcf is None:
                raise refuse("is given without `mjcf`", "expected the MuJoCo model too", (key,), Code.CONFLICT)
        for key in ("parameters", "process_noise"):
            if getattr(self, key) and (self.car is not None or self.mjcf is not None):
                problem, expected = f"is given beside `{kinds[0]}`", "expected it for `model` alone"
                raise refuse(problem, expected, (key,), Code.CONFLICT)
        return self

    def __hash__(self) -> int:
        return hash(self.model_dump_json())

    @property
    def kind(self) -> Literal["car", "mjcf", "model"] | None:
        """Which of the three it is; None if it is not stated."""
        if self.car is not None:
            return "car"
        if self.mjcf is not None:
            return "mjcf"
        return "model" if self.model is not None or self.parameters or self.process_noise else None


def with_files(robot: Robot, folder: Path, source: Source) -> tuple[dict[str, str], list[Diagnostic]]:
    """Absolute references of the files that a `truth` section names, and what is wrong with them.

    Paths are relative to `folder`, or to where a replaced value was given.
    """
    found: dict[str, str] = {}
    if robot.model is not None:
        try:
            found["model"] = resolve_vehicle(robot.model, _folder(source, ("truth", "model"), folder))
        except VehicleProblem as error:
            return found, [source.diagnostic("truth.model", error.problem, error.expected, code=error.code)]
    if robot.mjcf is not None:
        path = _folder(source, ("truth", "mjcf"), folder) / robot.mjcf
        if not os.path.isfile(path):
            expected = "expected the path of a MuJoCo model (MJCF), relative to this file"
            problem = f"there is no file {path}"
            return found, [source.diagnostic("truth.mjcf", problem, expected, code=Code.NOT_FOUND)]
        found["mjcf"] = str(path.resolve())
    return found, []


def _folder(source: Source, path: KeyPath, folder: Path) -> Path:
    place = source.replacement(path)
    return folder if place is None else place.folder or Path.cwd()
