"""Where the numbers of an identified vehicle come from: the `identification` section of a vehicle file.

Nothing of it changes how the vehicle is planned with; it says how well the numbers are known, and what they were made
of, so that making them again can be checked.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from kraft.config.schema import FileModel, NonNegative, Positive, refuse

Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Digest = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]


class Covariance(FileModel):
    """How uncertain the estimated parameters are, and how they depend on each other."""

    names: tuple[str, ...]
    """parameters and extras, in the order of rows and columns"""
    matrix: tuple[tuple[Number, ...], ...]
    """covariance, in the units of the parameters"""

    @model_validator(mode="after")
    def _square(self) -> Self:
        size = len(self.names)
        if len(self.matrix) != size or any(len(row) != size for row in self.matrix):
            raise refuse("has another size than names", f"expected {size} rows of {size} numbers", ("matrix",))
        return self


class Extra(FileModel):
    """A parameter of the logs that the model does not have, such as the delay of the commands."""

    value: Number
    """identified value, in the unit given"""
    unit: str
    """unit, `1` if it has none"""
    std: NonNegative
    """standard deviation of the identified value"""
    description: str = ""
    """what it is"""


class Logged(FileModel):
    """A log that was used."""

    name: str
    """what the log is called"""
    held_out: bool = False
    """whether it was left out of the fit, to test the prediction with"""
    files: Mapping[str, Digest]
    """SHA-256 of each of its files, by path"""


class Prediction(FileModel):
    """Root mean square errors of open-loop prediction over windows of up to 3 s."""

    position: tuple[NonNegative, ...]
    """position after 1, 2 and 3 s, as far as the windows reach, m"""
    yaw: tuple[NonNegative, ...]
    """yaw after the same times, rad"""
    overall_position: NonNegative
    """position over all poses of all windows, m"""
    overall_yaw: NonNegative
    """yaw over all poses of all windows, rad"""


class PoseNoise(FileModel):
    """Standard deviations of one observed pose."""

    position: Positive
    """in x and in y, m"""
    yaw: Positive
    """rad"""
    measured: bool
    """whether it was measured from the logs, rather than stated"""


class IdentificationRecord(FileModel):
    """How the parameters were identified, and how well they are known."""

    started_from: str
    """the vehicle whose model, footprint and initial values were taken"""
    interval: Literal["graph", "sandwich"]
    """what the covariance follows from: the noise of the poses, or how much the logs differ from each other"""
    covariance: Covariance
    """covariance {names, matrix} of what was estimated"""
    extras: Mapping[str, Extra] = Field(default_factory=dict)
    """parameters of the logs beside the model's, which planning does not use"""
    noise: PoseNoise
    """noise of the poses {position, yaw, measured}"""
    fitted: Prediction
    """prediction errors on the logs that were fitted"""
    held_out: Prediction | None = None
    """prediction errors on logs that were held out"""
    held_out_before: Prediction | None = None
    """the same with the values before the identification"""
    warnings: tuple[str, ...] = ()
    """what the identification warned of"""
    logs: tuple[Logged, ...]
    """every log that was used"""
    versions: Mapping[str, str]
    """versions of what shaped the result"""
