"""Sensing and time limits of a trial: the `sensing` and `trial` sections of a scenario."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from kraft.config.schema import Coordinate, Probability, StrictModel, refuse
from kraft.errors import Code

Delay = Annotated[float, Field(ge=0, le=10)]
Timeout = Annotated[float, Field(gt=0, le=86_400)]


class Sensing(StrictModel):
    """Camera and marker that the pose comes from, and the radio that commands go through."""

    preset: Literal["planar", "single-tag", "rendered"] = "single-tag"
    """noise of the marker pose: `planar` knows the marker's height, `single-tag` does not; `rendered` renders frames"""
    camera: tuple[Coordinate, Coordinate, Coordinate] = (1.0, 3.0, 5.0)
    """[x, y, z] of the camera, m"""
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 30.0
    """poses per second"""
    latency: Delay = 0.0
    """age of a pose when it arrives, s"""
    dropout: Probability | None = None
    """fraction of poses that never arrive; the preset's own if not given"""
    noise_scale: Annotated[float, Field(ge=0, le=100)] = 1.0
    """factor on all of the preset's errors"""
    correlation_time: Annotated[float, Field(ge=0, le=1000)] | None = None
    """time constant of a frame's errors, s; 0 for independent frames; the preset's own correlation if not given"""
    communication_delay: Delay = 0.0
    """time that a plan or a contingency takes from the replanner to the vehicle's controller, s"""
    message_loss: Probability = 0.0
    """share of the messages from the replanner to the vehicle's controller that never arrive, except the first one"""
    command_delay: Delay = 0.0
    """time between a command of the controller and its effect, s"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.preset == "rendered":
            given = {"dropout": self.dropout is not None, "noise_scale": self.noise_scale != 1.0}
            given["correlation_time"] = self.correlation_time is not None
            for key in (key for key, is_given in given.items() if is_given):
                problem = "is given, but the errors of rendered frames are not drawn"
                raise refuse(problem, "expected no such key, or another preset", (key,), Code.CONFLICT)
        return self


class Trial(StrictModel):
    """When a trial counts as timed out."""

    timeout: Timeout = 60.0
    """time limit of methods that replan, s"""
    oneshot_timeout: Timeout = 30.0
    """time limit of methods that plan once, s"""
