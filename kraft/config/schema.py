"""What every configuration file's schema is made of: a strict frozen model and the numbers it holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Final, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

from kraft.config.source import KeyPath
from kraft.errors import Code


class StrictModel(BaseModel):
    """One mapping of a configuration file: frozen, no unknown keys, no conversions between types."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """What is wrong between keys, see `refuse`; asked also where a key is wrong by itself, which pydantic does not.

        `content` is the mapping as it was written: of what it holds nothing is certain.
        """
        yield from ()


def refuse(problem: str, expected: str, at: KeyPath = (), code: Code = Code.VALUE) -> PydanticCustomError:
    """Make the error that a validator raises; ``at`` is where, relative to what is being validated."""
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
"""Metres. Shorter than any part of a scene that a robot or a map resolves; products of tiny lengths vanish."""
LENGTH_MAX: Final = 10_000.0
"""Metres. Beyond it a workspace is a typing mistake, and grids over it would not fit into memory."""

Coordinate: TypeAlias = Annotated[float, Field(ge=-LENGTH_MAX, le=LENGTH_MAX)]
Length: TypeAlias = Annotated[float, Field(ge=LENGTH_MIN, le=LENGTH_MAX)]
Angle: TypeAlias = Annotated[float, Field(ge=-1e6, le=1e6)]
Positive: TypeAlias = Annotated[float, Field(gt=0, le=1e6)]
NonNegative: TypeAlias = Annotated[float, Field(ge=0, le=1e6)]
Probability: TypeAlias = Annotated[float, Field(ge=0, le=1)]
Point: TypeAlias = tuple[Coordinate, Coordinate]
Size: TypeAlias = tuple[Length, Length]
Span: TypeAlias = Annotated[tuple[Coordinate, Coordinate], AfterValidator(_ascending)]
