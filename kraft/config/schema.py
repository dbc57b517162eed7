"""Base class of all schemas of files, and the types of their numbers and names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, ClassVar, Final, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints
from pydantic_core import PydanticCustomError

from kraft.config.source import KeyPath
from kraft.errors import Code


class StrictModel(BaseModel):
    """Mapping in a file: frozen, without unknown keys, without conversions between types."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    synonyms: ClassVar[Mapping[str, str]] = {}
    """Keys for unknown ones that mean the same, for suggestions."""

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Problems between keys, see `refuse`; checked even if single keys are wrong, where pydantic checks nothing.

        `content` is the mapping as it was written, with values of any type.
        """
        yield from ()


def refuse(problem: str, expected: str, at: KeyPath = (), code: Code = Code.VALUE) -> PydanticCustomError:
    """Error for a validator to raise; ``at`` is its place relative to the validated value."""
    context = {"problem": problem, "expected": expected, "at": at, "code": code}
    return PydanticCustomError("kraft", "{problem}; {expected}", context)


def _ascending(interval: tuple[float, float]) -> tuple[float, float]:
    low, high = interval
    if low >= high:
        raise refuse(f"the interval [{low:g}, {high:g}] is empty or inverted", "expected [low, high] with low < high")
    if high - low < LENGTH_MIN:
        raise refuse(f"the interval [{low:g}, {high:g}] is too short", f"expected at least {LENGTH_MIN:g} m")
    return interval


LENGTH_MIN: Final = 0.001
"""Metres. No robot and no map resolves less, and products of tiny lengths underflow to 0."""
LENGTH_MAX: Final = 10_000.0
"""Metres. A larger workspace is a typing mistake, and grids over it would not fit into memory."""

NAME: Final = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,99}$"
"""Pattern of the name of what a file defines."""
Name: TypeAlias = Annotated[str, StringConstraints(pattern=NAME)]
Coordinate: TypeAlias = Annotated[float, Field(ge=-LENGTH_MAX, le=LENGTH_MAX)]
Length: TypeAlias = Annotated[float, Field(ge=LENGTH_MIN, le=LENGTH_MAX)]
Angle: TypeAlias = Annotated[float, Field(ge=-1e6, le=1e6)]
Positive: TypeAlias = Annotated[float, Field(gt=0, le=1e6)]
NonNegative: TypeAlias = Annotated[float, Field(ge=0, le=1e6)]
Probability: TypeAlias = Annotated[float, Field(ge=0, le=1)]
Point: TypeAlias = tuple[Coordinate, Coordinate]
Size: TypeAlias = tuple[Length, Length]
Span: TypeAlias = Annotated[tuple[Coordinate, Coordinate], AfterValidator(_ascending)]
