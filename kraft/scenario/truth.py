"""True world, unknown to the planner: the `truth` section of a scenario.

Only the simulation reads it. Code of the planner takes a `kraft.scenario.Task`, which has no ``truth``, so that the
type checker refuses a planner that reads it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, NamedTuple, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from kraft.config.schema import LENGTH_MIN, Angle, Length, Mass, Point, Size, Span, StrictModel, refuse
from kraft.config.source import KeyPath
from kraft.errors import Code
from kraft.vehicles.true_robot import RobotTruth

Friction = Annotated[float, Field(gt=0, le=10)]
Factor = Annotated[float, Field(gt=0, le=10)]
MassFactor = Annotated[float, Field(ge=0.001, le=10)]
SteeringOffset = Annotated[float, Field(ge=-20, le=20)]


class SpeedBump(StrictModel):
    """A ridge on the floor that a car can drive over; touching it is not a collision."""

    center: Point
    """[x, y] of the centre, m"""
    size: Size
    """[length, width] before turning by yaw_deg, m"""
    height: Annotated[float, Field(ge=LENGTH_MIN, le=0.5)]
    """height of the crest, m"""
    yaw_deg: Angle = 0.0
    """rotation, degrees"""

    @property
    def yaw(self) -> float:
        """Rotation, rad."""
        return math.radians(self.yaw_deg)


class FrictionPatch(StrictModel):
    """An axis-aligned part of the floor with another friction."""

    x: Span
    """[low, high], m"""
    y: Span
    """[low, high], m"""
    friction: Friction
    """sliding friction coefficient"""


class MovableBox(StrictModel):
    """A free box that gives way when it is pushed and that nobody knows about."""

    center: Point
    """[x, y] of the centre, m"""
    size: tuple[Length, Length, Length]
    """[length, width, height], m"""
    mass: Mass
    """mass, kg"""
    yaw_deg: Angle = 0.0
    """rotation, degrees"""
    friction: Friction = 0.4
    """sliding friction coefficient, cardboard's by default; at most the floor's, and on a friction patch the patch's"""

    @property
    def yaw(self) -> float:
        """Rotation, rad."""
        return math.radians(self.yaw_deg)


class Tilt(StrictModel):
    """The whole floor, obstacles with it, leans; give `angle` or `angle_deg`."""

    angle: Annotated[float, Field(ge=0, le=0.7)] | None = None
    """angle between the floor and the horizontal, rad"""
    angle_deg: Annotated[float, Field(ge=0, le=40)] | None = None
    """angle between the floor and the horizontal, degrees"""
    uphill_deg: Angle = 90.0
    """direction that leads uphill, degrees from +x (90 is +y)"""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that there is one angle; a key that is unknown may be meant as one, and is reported anyway."""
        angle, degrees = content.get("angle"), content.get("angle_deg")
        expected = "expected angle in rad or angle_deg in degrees"
        if angle is None and degrees is None and set(content) <= set(cls.model_fields):
            yield refuse("needs one of `angle` and `angle_deg`", expected, code=Code.MISSING)
        elif angle is not None and degrees is not None:
            yield refuse("both `angle` and `angle_deg` are given", expected, code=Code.CONFLICT)

    @property
    def slope(self) -> float:
        """Angle between the floor and the horizontal, rad."""
        return self.angle if self.angle is not None else math.radians(self.angle_deg or 0.0)

    @property
    def uphill(self) -> float:
        """Direction that leads uphill, rad from +x."""
        return math.radians(self.uphill_deg)


class VehicleGap(StrictModel):
    """How the true car differs from the one its model was identified on."""

    drive_scale: Factor = 1.0
    """factor on the driving force"""
    steering_scale: Factor = 1.0
    """factor on the steering angle"""
    steering_offset_deg: SteeringOffset = 0.0
    """steering angle when it is commanded straight, degrees"""
    mass_scale: MassFactor = 1.0
    """factor on the chassis mass"""

    @property
    def steering_offset(self) -> float:
        """Steering angle when it is commanded straight, rad."""
        return math.radians(self.steering_offset_deg)


class VehicleChange(StrictModel):
    """Values of the true car from a change on; what is left out stays as it is."""

    drive_scale: Factor | None = None
    """factor on the driving force"""
    steering_scale: Factor | None = None
    """factor on the steering angle"""
    steering_offset_deg: SteeringOffset | None = None
    """steering angle when it is commanded straight, degrees"""
    mass_scale: MassFactor | None = None
    """factor on the chassis mass"""


class Change(StrictModel):
    """A change of the true world during the drive; what is left out stays as it is."""

    time: Annotated[float, Field(gt=0, le=86_400)]
    """time of the drive from which on it holds, s"""
    floor_friction: Friction | None = None
    """sliding friction coefficient of the floor, outside of friction patches"""
    vehicle: VehicleChange | None = None
    """values of the true car {drive_scale, steering_scale, steering_offset_deg, mass_scale}"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.floor_friction is None and not self._of_vehicle:
            raise refuse("changes nothing", "expected floor_friction, or a value of the vehicle", code=Code.MISSING)
        return self

    @property
    def _of_vehicle(self) -> dict[str, float]:
        """Values of the true car that change."""
        return {} if self.vehicle is None else self.vehicle.model_dump(exclude_none=True)

    def applied_to(self, state: WorldState) -> WorldState:
        """State of the world after this change."""
        friction = state.floor_friction if self.floor_friction is None else self.floor_friction
        return WorldState(self.time, friction, state.vehicle.model_copy(update=self._of_vehicle))

    def in_words(self) -> str:
        """Phrase for the change."""
        found = [] if self.floor_friction is None else [f"a floor with friction {self.floor_friction:g}"]
        if values := ", ".join(f"{name} {value:g}" for name, value in self._of_vehicle.items()):
            found.append(f"a car with {values}")
        return f"from {self.time:g} s on {' and '.join(found)}"


class WorldState(NamedTuple):
    """What can change during the drive, from `time` (s) on."""

    time: float
    floor_friction: float
    vehicle: VehicleGap


class Truth(RobotTruth):
    """Everything the planner's model leaves out; the default is a flat floor with good grip."""

    floor_friction: Friction = 1.0
    """sliding friction coefficient of the floor"""
    friction_patches: tuple[FrictionPatch, ...] = ()
    """parts of the floor with another friction"""
    speed_bumps: tuple[SpeedBump, ...] = ()
    """ridges on the floor"""
    tilt: Tilt | None = None
    """lean of the whole floor"""
    movable_boxes: tuple[MovableBox, ...] = ()
    """free boxes"""
    vehicle: VehicleGap = VehicleGap()
    """how the true car differs from its model"""
    changes: tuple[Change, ...] = ()
    """changes during the drive, in the order of their times"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for error in misordered([change.time for change in self.changes], ("changes",)):
            raise error
        return self

    @property
    def states(self) -> tuple[WorldState, ...]:
        """State at the beginning of the drive, and after each change."""
        first = WorldState(0.0, self.floor_friction, self.vehicle)
        return tuple(itertools.accumulate(self.changes, lambda state, change: change.applied_to(state), initial=first))

    def in_words(self) -> tuple[str, ...]:
        """Phrase for each kind of feature unknown to the planner; none for a flat floor with good grip."""
        found = []
        if self.floor_friction != 1.0:
            found.append(f"a floor with friction {self.floor_friction:g}")
        if self.friction_patches:
            values = ", ".join(f"{patch.friction:g}" for patch in self.friction_patches)
            found.append(f"{_count(len(self.friction_patches), 'patch', 'patches')} with friction {values}")
        if self.speed_bumps:
            highest = 100 * max(bump.height for bump in self.speed_bumps)
            found.append(f"{_count(len(self.speed_bumps), 'bump', 'bumps')} of up to {highest:g} cm")
        if self.tilt is not None:
            found.append(f"a floor that leans {math.degrees(self.tilt.slope):.3g} degrees")
        if self.movable_boxes:
            found.append(_count(len(self.movable_boxes), "box that can be pushed", "boxes that can be pushed"))
        if self.vehicle != VehicleGap():
            found.append("a car that differs from its model")
        if self.process_noise:
            found.append("noise of the motion")
        if self.parameters:
            found.append(f"{_count(len(self.parameters), 'other parameter', 'other parameters')}")
        return (*found, *(change.in_words() for change in self.changes))


def misordered(times: Sequence[object], at: KeyPath) -> Iterator[PydanticCustomError]:
    """Problems of the order of changes with these times, as they were written; `at` is the place of the list."""
    last: float | None = None
    for k, time in enumerate(times):
        if isinstance(time, bool) or not isinstance(time, int | float):
            continue
        if last is not None and time <= last:
            problem = f"is {time:g}, not later than the change before it"
            yield refuse(problem, f"expected a time after {last:g}", (*at, k, "time"))
        else:
            last = time


def _count(count: int, one: str, many: str) -> str:
    return f"one {one}" if count == 1 else f"{count} {many}"
