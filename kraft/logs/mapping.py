"""The mapping file: names columns and topics, where the guess from their names is wrong or impossible."""

from __future__ import annotations

from collections import abc
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import ConfigDict, Field, PrivateAttr, field_validator, model_validator
from pydantic_core import PydanticCustomError

from kraft.config.schema import NonNegative, Positive, StrictModel, read_model, refuse
from kraft.config.source import KeyPath, Source
from kraft.errors import Code
from kraft.logs.names import ALLOWED, SYNONYMS, Quantity, Unit
from kraft.text import suggestion

Scale = Annotated[float, Field(ge=-1e9, le=1e9)]
_SHORT: Final[dict[str, Any]] = {"type": "string", "description": "its name alone"}


def _or_name(schema: dict[str, Any]) -> None:
    """Allow in the JSON schema what `_name_alone` allows."""
    full = dict(schema)
    schema.clear()
    schema.update(anyOf=[_SHORT, full])


class Column(StrictModel):
    """A column of the table of its family, or a field of a message; a text is its name alone."""

    model_config = ConfigDict(json_schema_extra=_or_name)

    column: str
    """name of the column, or of the field of the message (`drive.steering_angle`)"""
    unit: Unit | None = None
    """unit of its numbers"""
    zero: Scale = 0.0
    """the number that stands for zero, in its unit"""
    scale: Scale = 1.0
    """what its numbers are multiplied with, after `zero` was subtracted"""

    @model_validator(mode="before")
    @classmethod
    def _name_alone(cls, value: object) -> object:
        if isinstance(value, dict) and "table" in value and "table" not in cls.model_fields:
            problem = "is that of one column, which comes from the same table as those beside it"
            raise refuse(problem, "expected the table of all of them, one level up", ("table",))
        return {"column": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.scale == 0:
            raise refuse("is 0", "expected what the numbers are multiplied with", ("scale",))
        return self


class ControlColumn(Column):
    """The column of a control, which may be in a table of its own."""

    table: str | None = None
    """file name or topic, if it is not that of the others"""


def _in(column: Column | None, quantity: Quantity, at: KeyPath = ()) -> Column | None:
    if column is not None and column.unit is not None and column.unit not in ALLOWED[quantity]:
        raise refuse(f"is {column.unit!r}", f"expected one of {', '.join(ALLOWED[quantity])}", (*at, "unit"))
    return column


class Commands(StrictModel):
    """Where the commands are."""

    table: str | None = None
    """file name or topic"""
    time: Column | None = None
    """when a command was given"""
    controls: dict[str, ControlColumn] = Field(default_factory=dict)
    """the column of each control of the vehicle, by the control's name"""

    @field_validator("time")
    @classmethod
    def _time(cls, value: Column | None) -> Column | None:
        return _in(value, "time")

    @field_validator("controls")
    @classmethod
    def _controls(cls, value: dict[str, ControlColumn]) -> dict[str, ControlColumn]:
        for name, column in value.items():
            _in(column, "control", (name,))
        return value


class Poses(StrictModel):
    """Where the poses are."""

    table: str | None = None
    """file name or topic"""
    time: Column | None = None
    """when a pose was measured"""
    x: Column | None = None
    """position forward or east"""
    y: Column | None = None
    """position left or north"""
    yaw: Column | None = None
    """heading, counter-clockwise from x"""
    quaternion: tuple[str, str, str, str] | None = None
    """columns with x, y, z and w of the orientation, instead of `yaw`"""

    @field_validator("time")
    @classmethod
    def _time(cls, value: Column | None) -> Column | None:
        return _in(value, "time")

    @field_validator("x", "y")
    @classmethod
    def _length(cls, value: Column | None) -> Column | None:
        return _in(value, "length")

    @field_validator("yaw")
    @classmethod
    def _angle(cls, value: Column | None) -> Column | None:
        return _in(value, "angle")

    @classmethod
    def across_keys(cls, content: abc.Mapping[str, object]) -> abc.Iterator[PydanticCustomError]:
        """Check that there is one heading."""
        if content.get("yaw") is not None and content.get("quaternion") is not None:
            yield refuse("is given besides yaw", "expected one of the two", ("quaternion",))


class DeadMan(StrictModel):
    """A switch that says when the log counts: the driver holds it while the commands reach the vehicle."""

    column: str
    """name of the column, or of the field of the message (`buttons[4]`)"""
    table: str | None = None
    """file name or topic"""
    time: Column | None = None
    """when the switch was read"""
    above: Scale = 0.5
    """it is held while its number is greater than this"""
    inverted: bool = False
    """it is held while its number is not greater"""
    masks: tuple[str, ...] | None = None
    """controls that are 0 while it is released, the others act; by default the log does not count then"""

    @field_validator("time")
    @classmethod
    def _time(cls, value: Column | None) -> Column | None:
        return _in(value, "time")

    @field_validator("masks")
    @classmethod
    def _masks(cls, value: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if value == ():
            raise refuse("is empty", "expected the controls that the switch acts on, such as [throttle]")
        return value


class Limits(StrictModel):
    """What is a gap and what is a teleport; what is left out is measured from the log itself."""

    pose_gap: Positive | None = None
    """time without poses that ends a part of the log, s"""
    command_gap: Positive | None = None
    """time without commands that ends a part of the log, s"""
    top_speed: Positive | None = None
    """speed that the vehicle cannot exceed: poses that would need more are teleports, m/s"""
    least_motion: NonNegative = 0.05
    """a log in which the vehicle moves less than this is refused, m"""


class Mapping(StrictModel):
    """A mapping file."""

    commands: Commands = Commands()
    """where the commands are"""
    poses: Poses = Poses()
    """where the poses are"""
    dead_man: DeadMan | None = None
    """a switch that says when the log counts"""
    limits: Limits = Limits()
    """what is a gap and what is a teleport"""

    _source: Source = PrivateAttr(default_factory=Source)

    @classmethod
    def across_keys(cls, content: abc.Mapping[str, object]) -> abc.Iterator[PydanticCustomError]:
        """Check that a masked control has a column, if the file names columns of controls: else it is misspelt."""
        commands, dead_man = content.get("commands"), content.get("dead_man")
        named = commands.get("controls") if isinstance(commands, abc.Mapping) else None
        masks = dead_man.get("masks") if isinstance(dead_man, abc.Mapping) else None
        if not (isinstance(named, abc.Mapping) and named and isinstance(masks, list | tuple)):
            return
        known = [*map(str, named), *(name for name in SYNONYMS if name not in named)]
        for i, name in enumerate(masks):
            if isinstance(name, str) and name not in known:
                at = ("dead_man", "masks", i)
                yield refuse(f"{name!r} is not a control of this file", suggestion(name, known), at, Code.UNKNOWN)

    @property
    def source(self) -> Source:
        """Where each value was written."""
        return self._source


def load_mapping(path: str | Path) -> Mapping:
    """Load a mapping file.

    Raises:
        InputError: with every problem of the file.
    """
    mapping, document = read_model(Path(path), Mapping)
    mapping._source = document.source  # frozen fields stay as they are; this is where they came from
    return mapping
