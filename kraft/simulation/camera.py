"""Camera that measures the pose of the marker on the car's roof, assuming a flat and level floor, and its errors.

The errors of a measured pose have magnitudes, directions and correlation in time.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from operator import mul
from typing import Final, Literal, Protocol

import numpy as np

from kraft.driving.estimation.camera_model import PowerLaw
from kraft.driving.messages import Observation
from kraft.errors import Code, InputError
from kraft.scenario import Sensing
from ompl_ext.arrays import Floats, Matrix

HALF_MARKER = 0.075
"""Half the side of the marker, m."""


class Camera(Protocol):
    """Takes frames and measures the pose of the marker."""

    def expose(self, time: float, position: Floats, rotation: Matrix) -> Observation | None:
        """Observation from a frame at `time` (s, ascending), None if the marker is not detected."""


class MarkerCamera:
    """Measures the pose of a marker; the robot gets no other information about the truth.

    The measured position is the intersection of the true line of sight with the plane in which the marker moves on a
    flat, level floor.  On a tilted floor or on a bump this position is wrong.
    """

    def __init__(self, sensing: Sensing, marker_height: float, seed: int) -> None:
        """Set up the camera of one trial.

        Args:
            sensing: preset, place and rate of the camera.
            marker_height: height of the marker above a flat floor, m.
            seed: seed of the errors; the same seed and exposures give the same observations.

        Raises:
            InputError: if the camera is not above the marker.
        """
        if sensing.camera[2] <= marker_height:
            raise InputError.of(
                "sensing.camera",
                f"is {sensing.camera[2]:g} m high",
                f"expected more than the marker's {marker_height:g} m",
                Code.GEOMETRY,
            )
        assert sensing.preset != "rendered", "RenderedCamera renders"
        preset = PRESETS[sensing.preset]
        dropout = preset.dropout if sensing.dropout is None else sensing.dropout
        generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 0xCA3E7A])))
        self.camera = np.array(sensing.camera)
        self._camera_position = tuple(float(value) for value in sensing.camera)
        self.latency = sensing.latency
        self.marker_height = marker_height
        self._noise = PoseNoise(preset, dropout, sensing.noise_scale, generator, sensing.correlation_time)

    def expose(self, time: float, position: Floats, rotation: Matrix) -> Observation | None:
        """Observation from a frame at `time` (s, ascending), None if the marker is not detected.

        `position` (3,) m and `rotation` (3, 3) of the marker are true, in the world's frame with z vertical; the
        marker's x axis points forward.
        """
        x, y, z = position.tolist()
        dx, dy, dz = (HALF_MARKER * part for part in rotation[:, 0].tolist())
        centre = self._on_plane(x, y, z)
        pose = x, y, math.atan2(dy, dx)
        error = self._noise.draw(time, self._sight(x, y, z), pose)
        if centre is None or error is None:
            return None
        front, rear = self._on_plane(x + dx, y + dy, z + dz), self._on_plane(x - dx, y - dy, z - dz)
        if front is None or rear is None:
            return None
        heading = math.atan2(front[1] - rear[1], front[0] - rear[0]) + error[2]
        return Observation(
            time=time,
            arrival=time + self.latency,
            x=centre[0] + error[0],
            y=centre[1] + error[1],
            theta=math.remainder(heading, math.tau),
        )

    def _on_plane(self, px: float, py: float, pz: float) -> tuple[float, float] | None:
        """Intersection of the line of sight to a point with the assumed plane, m; None for a point above the camera."""
        x, y, z = self._camera_position
        below = z - pz
        if below <= 0.0:
            return None
        share = (z - self.marker_height) / below
        return x + share * (px - x), y + share * (py - y)

    def _sight(self, px: float, py: float, pz: float) -> tuple[float, float, float]:
        """Line of sight to a point: length (m), angle from the vertical direction on the floor (rad)."""
        x, y, z = self._camera_position
        away = math.hypot(px - x, py - y)
        return math.hypot(away, z - pz), math.atan2(away, z - pz), math.atan2(py - y, px - x)


@dataclass(frozen=True)
class ErrorPart:
    """Share of an error's variance that decays over `length` m of travel or over `time` s; without both, white.

    A part with a length depends on the place: while the marker stands it repeats, however long one looks.
    """

    share: float
    length: float | None = None
    time: float | None = None

    def kept(self, travelled: float, elapsed: float) -> float:
        """Correlation after `travelled` m and `elapsed` s."""
        if self.length is not None:
            return math.exp(-travelled / self.length)
        return math.exp(-elapsed / self.time) if self.time else 0.0


NO_MEAN: Final = PowerLaw(0.0)


@dataclass(frozen=True)
class ErrorModel:
    """Error along one direction: a mean and a random deviation from it, in m or rad.

    The deviation is Tukey's g-and-h distribution, standardised: its variance does not depend on `skew` and `tail`.

    Attributes:
        size: standard deviation of a frame's deviation, its tails included.
        parts: of the deviation; their shares add up to 1.
        skew: Tukey's g; positive for more large errors away from the camera, or to the left.
        tail: Tukey's h, at least 0 and below 1/2; with 0 and without skew the distribution is normal.
        mean: systematic error.
        standing: factor on mean and deviation while the marker stands, without motion blur.
    """

    size: PowerLaw
    parts: tuple[ErrorPart, ...]
    skew: float = 0.0
    tail: float = 0.0
    mean: PowerLaw = NO_MEAN
    standing: float = 1.0

    def error(self, normal: float, distance: float, phi: float, blur: float) -> float:
        """Error at a value of the standard normal distribution; see `PowerLaw` for distance and phi.

        `blur` is 0 for a marker that stands and 1 for one that moves.
        """
        error = self.mean.at(distance, phi) + self.size.at(distance, phi) * self.deviation(normal)
        return (self.standing + (1.0 - self.standing) * blur) * error

    def deviation(self, normal: float) -> float:
        """Deviation, in units of `size`, at a value of the standard normal distribution."""
        z, (mean, deviation) = min(max(normal, -NORMAL_MAX), NORMAL_MAX), self._moments
        return (self._skewed(z) * math.exp(0.5 * self.tail * z * z) - mean) / deviation

    def _skewed(self, z: float) -> float:
        return math.expm1(self.skew * z) / self.skew if self.skew else z

    @functools.cached_property
    def _moments(self) -> tuple[float, float]:
        """Mean and standard deviation of g-and-h before standardisation."""
        g, h = self.skew, self.tail
        if not g:
            return 0.0, (1.0 - 2.0 * h) ** -0.75
        mean = math.expm1(g * g / (2.0 - 2.0 * h)) / (g * math.sqrt(1.0 - h))
        twice = 1.0 - 2.0 * h
        square = (math.exp(2.0 * g * g / twice) - 2.0 * math.exp(0.5 * g * g / twice) + 1.0) / (
            g * g * math.sqrt(twice)
        )
        return mean, math.sqrt(square - mean * mean)


@dataclass(frozen=True)
class CameraNoise:
    """Errors of one measuring method.

    `along` is the direction of the camera's line of sight on the floor, `across` is perpendicular to it.  `bias`
    (standard deviations of position and heading) is drawn once per trial, like an error of the camera's calibration.
    `dropout` is the share of missed frames.
    """

    along: ErrorModel
    across: ErrorModel
    heading: ErrorModel
    bias: tuple[float, float]
    dropout: float

    def position_error(self, distance: float, phi: float) -> float:
        """Root mean square error of a frame's position without the bias, m; see `PowerLaw` for distance and phi."""
        along = self.along.mean.at(distance, phi), self.along.size.at(distance, phi)
        return math.hypot(*along, self.across.size.at(distance, phi))


DEGREE: Final = math.pi / 180.0
NORMAL_MAX: Final = 4.0
"""Largest value of the normal distribution that `ErrorModel` accepts, which bounds its tails."""
BLURRED_SPEED: Final = 0.1
"""Speed of the marker from which on its errors are those of a moving one, m/s."""
TURNING_RADIUS: Final = 0.1
"""Travel of the marker's corners for each radian of turn, m."""
PLANAR_POSITION: Final = PowerLaw.through(0.0011, 0.0013)
PLANAR_PARTS: Final = (ErrorPart(0.55, time=5.0), ErrorPart(0.45))
PRESETS: Final[Mapping[Literal["planar", "single-tag"], CameraNoise]] = {
    # Fitted to rendered frames (python -m benchmarks sensing): 3 to 7.6 m and up to 35 degrees from the vertical,
    # most of them at 4.7 to 6.2 m.
    "single-tag": CameraNoise(
        along=ErrorModel(
            PowerLaw(0.0290, 2.0, 1.1),
            (ErrorPart(0.12, length=0.4), ErrorPart(0.45, length=0.005), ErrorPart(0.43)),
            skew=0.6,
            mean=PowerLaw(0.0116, 2.8, 1.65),
            standing=0.84,
        ),
        across=ErrorModel(
            PowerLaw(0.030, 1.3, -4.7), (ErrorPart(0.25, length=1.0), ErrorPart(0.2, length=0.005), ErrorPart(0.55))
        ),
        heading=ErrorModel(
            PowerLaw(0.0178, 2.1, 1.9),
            (ErrorPart(0.41, length=0.5), ErrorPart(0.13, length=0.005), ErrorPart(0.46)),
            tail=0.2,
            standing=0.76,
        ),
        bias=(0.012, 0.1 * DEGREE),
        dropout=0.02,
    ),
    # In a plane of known height: 0.5-0.9 mm and 1 degree from 3 m to 5 m, measured with OpenCV on rendered 15 cm tags.
    # Assumed, not measured: the bias, and a drift of 1 mm and 0.1 degrees in 5 s, like that of light and lens.
    "planar": CameraNoise(
        along=ErrorModel(PLANAR_POSITION, PLANAR_PARTS),
        across=ErrorModel(PLANAR_POSITION, PLANAR_PARTS),
        heading=ErrorModel(PowerLaw(1.005 * DEGREE), (ErrorPart(0.01, time=5.0), ErrorPart(0.99))),
        bias=(0.003, 0.2 * DEGREE),
        dropout=0.0,
    ),
}


class PoseNoise:
    """Draws the errors of the poses of one trial, reproducibly for a seed.

    Every frame uses the same number of random numbers, so a missed frame does not change the errors of the next ones.
    """

    def __init__(
        self, noise: CameraNoise, dropout: float, scale: float, generator: np.random.Generator,
        correlation_time: float | None = None,
    ) -> None:  # fmt: skip
        """Draw the constant bias.

        Args:
            noise: errors of the camera.
            dropout: share of missed frames.
            scale: factor on every error.
            generator: source of all draws.
            correlation_time: time constant of the whole deviation instead of the parts of `noise`, s; 0 makes the
                deviations of frames independent.  The spread of a frame, its mean and the bias remain.
        """
        self.noise, self.dropout, self.scale = noise, dropout, scale
        self._generator = generator
        models = (noise.along, noise.across, noise.heading)
        only = None if correlation_time is None else (ErrorPart(1.0, time=correlation_time),)
        self._models = [(model, model.parts if only is None else only) for model in models]
        self._weights = [[math.sqrt(part.share) for part in parts] for _, parts in self._models]
        bias = noise.bias[0], noise.bias[0], noise.bias[1]
        self._bias = [size * draw for size, draw in zip(bias, self._normal(3), strict=True)]
        self._parts = [[0.0] * len(parts) for _, parts in self._models]
        self._draws = sum(len(parts) for parts in self._parts)
        self._blur = 0.0
        self._last: tuple[float, float, float, float] | None = None

    def draw(
        self, time: float, sight: tuple[float, float, float], pose: tuple[float, float, float]
    ) -> tuple[float, float, float] | None:
        """Error (x, y, theta) of a frame at `time` (s, ascending) or None if there is no detection.

        Args:
            time: of the frame, s.
            sight: length of the line of sight (m), its angle from the vertical and its direction on the floor (rad).
            pose: true x, y (m) and heading (rad) of the marker.
        """
        missed = float(self._generator.random())
        self._advance(time, pose)
        if missed < self.dropout:
            return None
        distance, phi, direction = sight
        along, across, heading = [
            model.error(sum(map(mul, weights, values)), distance, phi, self._blur)
            for (model, _), weights, values in zip(self._models, self._weights, self._parts, strict=True)
        ]
        c, s = math.cos(direction), math.sin(direction)
        x, y, theta = self._bias
        error = x + c * along - s * across, y + s * along + c * across, theta + heading
        return self.scale * error[0], self.scale * error[1], self.scale * error[2]

    def _normal(self, count: int) -> list[float]:
        drawn: list[float] = self._generator.standard_normal(count).tolist()
        return drawn

    def _advance(self, time: float, pose: tuple[float, float, float]) -> None:
        """Advance every part to `time` and `pose`: autoregressive, of variance 1."""
        last, self._last = self._last, (time, *pose)
        travelled = elapsed = math.inf
        if last is not None:
            turned = math.remainder(pose[2] - last[3], math.tau)
            travelled = math.hypot(pose[0] - last[1], pose[1] - last[2]) + TURNING_RADIUS * abs(turned)
            elapsed = max(time - last[0], 0.0)
            self._blur = min(travelled / (BLURRED_SPEED * elapsed), 1.0) if elapsed > 0.0 else self._blur
        draws = iter(self._normal(self._draws))
        for (_, parts), values in zip(self._models, self._parts, strict=True):
            for k, part in enumerate(parts):
                kept = part.kept(travelled, elapsed)
                values[k] = kept * values[k] + math.sqrt(1.0 - kept * kept) * next(draws)
