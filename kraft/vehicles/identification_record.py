"""Record of an identification in a vehicle file: its logs, how well parameters are known, and what they predict."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, StringConstraints, model_validator
from pydantic_core import PydanticCustomError

from kraft.config.schema import NonNegative, Number, Positive, StrictModel, is_number, refuse
from kraft.errors import Code

ROUNDING: Final = 1e-3
"""Largest difference between the two entries of a covariance for the same parameters, as a share of them."""
Digest = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]


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

    @classmethod
    def across_keys(cls, content: Mapping[str, object]) -> Iterator[PydanticCustomError]:
        """Check that the names differ and that the matrix is a covariance of them."""
        names, matrix = _items(content.get("names")), _items(content.get("matrix"))
        if names is None or matrix is None:
            return
        for k, name in enumerate(names):
            if name in names[:k]:
                yield refuse(f"repeats names[{names.index(name)}]", "expected each once", ("names", k), Code.DUPLICATE)
        rows = [row for row in map(_items, matrix) if row is not None and all(map(is_number, row))]
        if len(rows) != len(matrix):
            return
        size = len(names)
        if len(rows) != size or any(len(row) != size for row in rows):
            expected = f"expected {size} rows of {size} numbers"
            yield refuse("has another size than names", expected, ("matrix",), Code.MISMATCH)
            return
        values = np.array(rows, dtype=np.float64).reshape(size, size)
        for i in np.flatnonzero(np.diag(values) < 0.0).tolist():
            yield refuse(f"is the variance {values[i, i]:g}", "expected at least 0", ("matrix", i, i))
        for i, j in np.argwhere(np.tril(~np.isclose(values, values.T, rtol=ROUNDING, atol=0.0))).tolist():
            expected = f"expected that of row {j}, column {i}: {values[j, i]:g}"
            yield refuse(f"is {values[i, j]:g}, not symmetric", expected, ("matrix", i, j), Code.MISMATCH)


def _items(value: object) -> Sequence[object] | None:
    return value if isinstance(value, list | tuple) else None


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


def _lowest_first(interval: tuple[float, float]) -> tuple[float, float]:
    if interval[0] > interval[1]:
        raise refuse(f"is [{interval[0]:g}, {interval[1]:g}]", "expected the lowest speed first")
    return interval


def _ascending(times: tuple[float, ...]) -> tuple[float, ...]:
    if any(later <= earlier for earlier, later in pairwise(times)):
        raise refuse("is not ascending", "expected each time once, the earliest first")
    return times


class SpeedPrediction(StrictModel):
    """Root mean square errors of open-loop prediction at similar speeds, along the vehicle and across it."""

    speeds: Annotated[tuple[NonNegative, NonNegative], AfterValidator(_lowest_first)]
    """lowest and highest mean speed of the windows, m/s"""
    windows: Annotated[int, Field(ge=1)]
    """number of windows"""
    after: Annotated[tuple[Positive, ...], Field(min_length=1), AfterValidator(_ascending)]
    """times since the beginning of a window, s, ascending"""
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
