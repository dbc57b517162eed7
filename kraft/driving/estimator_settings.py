"""Settings of the estimators, by `kind`: where the vehicle is believed to be."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from kraft.config.schema import NonNegative, Probability, StrictModel
from kraft.driving.control_settings import Deviation, Seconds


class Latest(StrictModel):
    """The newest observed pose, predicted forward with the model; the speed is the model's response to the commands."""

    kind: Literal["latest"]
    """which estimator"""
    replanning_window: NonNegative = 0.3
    """time before the newest pose: replanning takes the mean of the poses in it, each predicted to now, s"""


class Filter(StrictModel):
    """A Kalman filter over the model and all observed poses, which doubts outliers."""

    kind: Literal["filter"]
    """which estimator"""
    position_noise: Deviation = 0.1
    """standard deviation of an observed position, m"""
    heading_noise_deg: Deviation = 8.0
    """standard deviation of an observed heading, degrees"""
    start_position_noise: Deviation = 0.02
    """standard deviation of the start that the scenario gives, m"""
    start_heading_noise_deg: Deviation = 2.0
    """standard deviation of the start's heading, degrees"""
    drift: Deviation = 0.03
    """standard deviation of the position that the model loses in one second, m"""
    heading_drift_deg: Deviation = 5.0
    """standard deviation of the heading that the model loses in one second, degrees"""
    speed_drift: Deviation = 0.2
    """standard deviation of the speed that the model loses in one second, m/s"""
    confidence: Annotated[Probability, Field(gt=0.5, lt=1)] = 0.997
    """an observation that is farther off than this share of them is given less weight"""


class Adaptive(StrictModel):
    """A Kalman filter that knows correlated pose errors, and online identification of car, delay and noise."""

    kind: Literal["adaptive"]
    """which estimator"""
    identify: bool = True
    """estimate the parameters of the vehicle"""
    compensate: bool = True
    """estimate the delay of commands and make up for it"""
    correlated: bool = True
    """take a share of the pose error as correlated in time"""
    window: Annotated[Seconds, Field(ge=1, le=60)] = 10.0
    """moving time from which parameters and delay are identified, s"""
    step: Annotated[Seconds, Field(ge=0.02, le=0.5)] = 0.1
    """time between two states of the identification, s"""
    iterations: Annotated[int, Field(ge=1, le=50)] = 2
    """largest number of iterations of the identification in a cycle; each cycle begins at the result of the last one"""
    delay_std: Deviation = 0.15
    """standard deviation of the prior of the delay, s"""
    position_noise: Deviation = 0.04
    """standard deviation of an observed position before residuals are known, m"""
    heading_noise_deg: Deviation = 2.0
    """standard deviation of an observed heading before residuals are known, degrees"""
    correlated_share: Probability = 0.6
    """share of the pose error's variance that is correlated, before residuals are known"""
    correlation_time: Seconds = 1.0
    """time constant of the correlated pose error, s"""
    position_offset: Deviation = 0.03
    """standard deviation of the camera's offset, which differs from place to place, m"""
    heading_offset_deg: Deviation = 0.5
    """the same of the heading, degrees"""
    offset_time: Seconds = 4.0
    """time in which the vehicle comes to a place with another offset, s"""
    start_position_noise: Deviation = 0.02
    """standard deviation of the start that the scenario gives, m"""
    start_heading_noise_deg: Deviation = 2.0
    """standard deviation of the start's heading, degrees"""
    drift: Deviation = 0.01
    """standard deviation of the position that the model loses in one second, m"""
    heading_drift_deg: Deviation = 1.5
    """standard deviation of the heading that the model loses in one second, degrees"""
    speed_drift: Deviation = 0.06
    """standard deviation of the speed that the model loses in one second, m/s"""
    control_share: Probability = 0.015
    """standard deviation of an applied control from its command, as a share of its range"""
    confidence: Annotated[Probability, Field(gt=0.5, lt=1)] = 0.997
    """an observation that is farther off than this share of them is given less weight"""


class Oracle(StrictModel):
    """The truth: true state, true car, known delay of commands.  It shows what is possible; no robot has it."""

    kind: Literal["oracle"]
    """which estimator"""


EstimatorSettings = Annotated[Latest | Filter | Adaptive | Oracle, Field(discriminator="kind")]
