"""True robot, as vehicle files and scenarios state it; only the simulation reads it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from kraft.config.schema import Length, Mass, NonNegative, ParameterValue, StrictModel, Symbol, refuse
from kraft.config.source import KeyPath, Source
from kraft.errors import Code, Diagnostic
from kraft.files import path_from
from kraft.vehicles.reference import VehicleProblem, resolve_vehicle

Text = Annotated[str, StringConstraints(min_length=1)]
KINDS: Final = ("car", "mjcf", "model")
CAR_SIZES: Final = {"mushr": (0.44, 0.27), "f1tenth": (0.58, 0.31)}
"""Length and width of the simulated car of each preset, with its wheels, m."""


class Wheels(StrictModel):
    """The four wheels of a simulated car."""

    radius: Length | None = None
    """m"""
    width: Length | None = None
    """m"""
    mass: Annotated[float, Field(ge=1e-4, le=1e6)] | None = None
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
    mass: Mass | None = None
    """of the chassis without wheels, kg"""
    wheels: Wheels = Wheels()
    """{radius, width, mass}"""
    drive: Drive | None = None
    """{top_speed, time_constant}"""
    servo: Servo = Servo()
    """{angle_max_deg, rate_deg, linkage}"""
    tyres: Tyres = Tyres()
    """{friction}"""

    @property
    def is_preset(self) -> bool:
        """Whether it has nothing of its own."""
        return self == CarDimensions(preset=self.preset)


class RobotTruth(StrictModel):
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
    parameters: Mapping[Symbol, ParameterValue] = Field(default_factory=dict)
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


def with_files(robot: RobotTruth, folder: Path, source: Source) -> tuple[dict[str, str], list[Diagnostic]]:
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
        path = path_from(_folder(source, ("truth", "mjcf"), folder), robot.mjcf)
        if not os.path.isfile(path):
            expected = "expected the path of a MuJoCo model (MJCF), relative to this file"
            problem = f"there is no file {path}"
            return found, [source.diagnostic("truth.mjcf", problem, expected, code=Code.NOT_FOUND)]
        found["mjcf"] = str(path.resolve())
    return found, []


def _folder(source: Source, path: KeyPath, folder: Path) -> Path:
    place = source.replacement(path)
    return folder if place is None else place.folder or Path.cwd()
