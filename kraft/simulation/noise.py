"""Measurement errors of a marker's pose: magnitudes, directions and correlation in time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np


@dataclass(frozen=True)
class PowerLaw:
    """Standard deviation as a power law of the distance d to the camera (m): `at_5m` (d / 5 m)^`power`."""

    at_5m: float
    power: float

    @classmethod
    def through(cls, at_3m: float, at_5m: float) -> PowerLaw:
        """Power law through the values at 3 m and at 5 m."""
        return cls(at_5m, math.log(at_5m / at_3m) / math.log(5.0 / 3.0))

    def at(self, distance: float) -> float:
        """Standard deviation at a distance (m), in the unit it was given in."""
        return self.at_5m * math.pow(distance / 5.0, self.power)


@dataclass(frozen=True)
class CameraNoise:
    """Errors of one measuring method; standard deviations in m and rad are those of all frames including the tails.

    `along` is the direction of the camera's line of sight on the floor, `across` is perpendicular to it.  A
    share `tail_share` of the frames has errors `tail_factor` times larger.  `bias` is drawn once (position, heading),
    like an error of the camera's calibration; `correlated` varies with a time constant of `correlation_time` s, like
    light and lens.
    """

    along: PowerLaw
    across: PowerLaw
    heading: PowerLaw
    tail_share: float
    tail_factor: float
    bias: tuple[float, float]
    correlated: tuple[float, float]
    correlation_time: float
    dropout: float

    @property
    def core_scale(self) -> float:
        """Standard deviation of the frames outside the tails, relative to that of all frames."""
        return 1.0 / math.sqrt(1.0 + self.tail_share * (self.tail_factor**2 - 1.0))


DEGREE: Final = math.pi / 180.0
PRESETS: Final[Mapping[Literal["planar", "single-tag"], CameraNoise]] = {
    # Measured with OpenCV on rendered 15 cm ArUco tags.  Single-tag PnP: at 3 m 16 mm across and 42 mm along the line
    # of sight and 3-5 degrees, at 5 m up to 64 mm and 106 mm and 8 degrees, with heavy tails; no detection in 0-4 % of
    # the frames.  In a plane of known height: 0.5-0.9 mm and 1 degree from 3 m to 5 m.  Assumed, not measured: the
    # tails' shape, and offset and wander (a camera calibrated to 0.1 degrees is 9 mm off at 5 m).
    "single-tag": CameraNoise(
        along=PowerLaw.through(0.042, 0.106),
        across=PowerLaw.through(0.016, 0.064),
        heading=PowerLaw.through(4.0 * DEGREE, 8.0 * DEGREE),
        tail_share=0.05,
        tail_factor=3.0,
        bias=(0.010, 0.5 * DEGREE),
        correlated=(0.005, 0.25 * DEGREE),
        correlation_time=5.0,
        dropout=0.04,
    ),
    "planar": CameraNoise(
        along=PowerLaw.through(0.0005, 0.0009),
        across=PowerLaw.through(0.0005, 0.0009),
        heading=PowerLaw(1.0 * DEGREE, 0.0),
        tail_share=0.0,
        tail_factor=1.0,
        bias=(0.003, 0.2 * DEGREE),
        correlated=(0.001, 0.1 * DEGREE),
        correlation_time=5.0,
        dropout=0.0,
    ),
}


class PoseNoise:
    """Draws the errors of the poses of one trial, reproducibly for a seed.

    Every frame uses the same number of random numbers, so a missed frame does not change the errors of the next ones.
    """

    def __init__(self, noise: CameraNoise, dropout: float, scale: float, generator: np.random.Generator) -> None:
        """Draw the constant bias.  `scale` multiplies every error, `dropout` is the share of missed frames."""
        self.noise, self.dropout, self.scale = noise, dropout, scale
        self._generator = generator
        self._correlated_std = _pose(noise.correlated)
        self._bias = [size * draw for size, draw in zip(_pose(noise.bias), self._normal(3), strict=True)]
        self._correlated = [size * draw for size, draw in zip(self._correlated_std, self._normal(3), strict=True)]
        self._time: float | None = None

    def draw(self, time: float, distance: float, sight: float) -> tuple[float, float, float] | None:
        """Error (x, y, theta) of a frame at `time` (s, ascending) or None if there is no detection.

        `distance` to the camera in m, `sight` the direction of the line of sight on the floor, rad.
        """
        missed, tail = self._generator.random(2).tolist()
        normals = self._normal(6)
        draws = normals[:3]
        self._advance(time, normals[3:])
        if missed < self.dropout:
            return None
        size = self.scale * self.noise.core_scale * (self.noise.tail_factor if tail < self.noise.tail_share else 1.0)
        along = size * self.noise.along.at(distance) * draws[0]
        across = size * self.noise.across.at(distance) * draws[1]
        heading = size * self.noise.heading.at(distance) * draws[2]
        c, s = math.cos(sight), math.sin(sight)
        x, y, theta = (self.scale * (fixed + now) for fixed, now in zip(self._bias, self._correlated, strict=True))
        return x + c * along - s * across, y + s * along + c * across, theta + heading

    def _normal(self, count: int) -> list[float]:
        drawn: list[float] = self._generator.standard_normal(count).tolist()
        return drawn

    def _advance(self, time: float, draws: list[float]) -> None:
        """Advance the correlated error to `time`: an Ornstein-Uhlenbeck process of constant variance."""
        kept = math.exp(-max(time - self._time, 0.0) / self.noise.correlation_time) if self._time is not None else 1.0
        new = math.sqrt(1.0 - kept**2)
        self._correlated = [
            kept * old + new * size * draw
            for old, size, draw in zip(self._correlated, self._correlated_std, draws, strict=True)
        ]
        self._time = time


def _pose(sizes: tuple[float, float]) -> tuple[float, float, float]:
    """Standard deviations of x, y and theta from those of position and heading."""
    return sizes[0], sizes[0], sizes[1]
