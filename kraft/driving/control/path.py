"""A reference as paths: where a point of the car is led, sampled evenly, apart for every change of direction."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from kraft.driving.car_model import CarModel, interpolate
from kraft.driving.messages import Reference
from ompl_ext.arrays import Floats, Matrix

SPACING: Final = 0.02
"""Between samples of a path, m."""
ARRIVAL_TOLERANCE: Final = 1e-3
"""How near to the end of a path the car is taken to have arrived, m."""
STANDSTILL_SPEED: Final = 1e-3
"""Speed below which a direction of travel means nothing, m/s."""


@dataclass(frozen=True)
class Projection:
    """A point of a path: sample `index` and the car's offset from it.

    `arc_length` is the length of path before the point (m), beyond the ends of the path along their tangents;
    `cross_track` is how far the car is to the left of the path as the car is headed (m).
    """

    index: int
    arc_length: float
    cross_track: float


@dataclass(frozen=True)
class Path:
    """Samples (n,) of a part of a reference that leads in one direction: `direction` 1 forwards, -1 backwards.

    `x`, `y` (m) are those of the point that is led, `theta` (rad, unwrapped) the car's heading, `throttle` and
    `steering` what is planned; `time` (s) ascends. Samples are `spacing` m apart.
    """

    direction: int
    spacing: float
    x: Floats
    y: Floats
    theta: Floats
    time: Floats
    throttle: Floats
    steering: Floats

    @property
    def length(self) -> float:
        """Length, m."""
        return self.spacing * (len(self.x) - 1)

    def is_past_end(self, projection: Projection) -> bool:
        """Whether a place is at or beyond the end."""
        return projection.arc_length >= self.length - ARRIVAL_TOLERANCE

    def arc_length_at(self, time: float) -> float:
        """Length of path that is planned to lie behind the car at `time` (s), m."""
        return self.spacing * interpolate(time, self._time_list, range(len(self._time_list)))

    @cached_property
    def _time_list(self) -> list[float]:
        times: list[float] = self.time.tolist()
        return times

    def index_at(self, arc_length: float) -> int:
        """Index of the sample at a length of path (m), the nearest there is."""
        return round(min(max(arc_length / self.spacing, 0.0), len(self.x) - 1.0)) if self.spacing > 0.0 else 0

    def nearest(self, x: float, y: float, start: int, window: int) -> int:
        """Sample nearest to a point, searched from `start` on: `window` samples to both sides, on while it gets nearer.

        So a path that comes by the same place twice is not cut short, and a car that was moved is found again.
        """
        while True:
            low, high = max(start - window, 0), min(start + window + 1, len(self.x))
            dx, dy = self.x[low:high] - x, self.y[low:high] - y
            found = low + int((dx * dx + dy * dy).argmin())
            if abs(found - start) < window or found in (0, len(self.x) - 1, start):
                return found
            start = found

    def project(self, x: float, y: float, start: int, window: int) -> Projection:
        """The point of the path beside (x, y)."""
        k = self.nearest(x, y, start, window)
        ahead, left = self._directions_at(k)
        dx, dy = x - float(self.x[k]), y - float(self.y[k])
        along = dx * ahead[0] + dy * ahead[1]
        return Projection(k, self.spacing * k + along, dx * left[0] + dy * left[1])

    def point_at(self, arc_length: float) -> tuple[float, float]:
        """Point (m) at a length of path (m); beyond the ends on their tangents."""
        k = self.index_at(arc_length)
        ahead, _ = self._directions_at(k)
        remainder = arc_length - self.spacing * k
        return float(self.x[k]) + remainder * ahead[0], float(self.y[k]) + remainder * ahead[1]

    def _directions_at(self, k: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Direction of travel at a sample, and the car's left at right angles to it."""
        i, j = max(k - 1, 0), min(k + 1, len(self.x) - 1)
        dx, dy = float(self.x[j] - self.x[i]), float(self.y[j] - self.y[i])
        norm = math.hypot(dx, dy)
        if norm > 1e-9:
            ahead = dx / norm, dy / norm
        else:
            ahead = self.direction * math.cos(self.theta[k]), self.direction * math.sin(self.theta[k])
        return ahead, (-self.direction * ahead[1], self.direction * ahead[0])


def paths_of(reference: Reference, model: CarModel, offset: float) -> tuple[Path, ...]:
    """Paths of the point `offset` m ahead of the centre (behind it where the car backs up), in the order of time."""
    states, times = reference.states, reference.times
    directions = _travel_directions(states[:, model.v])
    cuts = [0, *(int(k) for k in np.flatnonzero(np.diff(directions))), len(times) - 1]
    return tuple(
        _path(reference, model, offset, int(directions[b]), slice(a, b + 1)) for a, b in itertools.pairwise(cuts)
    )


def _travel_directions(speeds: Floats) -> Floats:
    """Direction of each sample, 1 or -1; one that stands has the direction in which it moved last, or will first."""
    signs = np.where(np.abs(speeds) > STANDSTILL_SPEED, np.sign(speeds), 0.0)
    moving = np.flatnonzero(signs)
    if len(moving) == 0:
        return np.ones(len(speeds))
    before = np.maximum(np.searchsorted(moving, np.arange(len(speeds)), side="right") - 1, 0)
    result: Floats = signs[moving[before]]
    return result


def _path(reference: Reference, model: CarModel, offset: float, direction: int, part: slice) -> Path:
    states, times = reference.states[part], reference.times[part]
    theta = np.unwrap(states[:, model.theta])
    x = states[:, model.x] + direction * offset * np.cos(theta)
    y = states[:, model.y] + direction * offset * np.sin(theta)
    arc_lengths = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    count = max(1, math.ceil(arc_lengths[-1] / SPACING)) if arc_lengths[-1] > 1e-6 else 0
    even_lengths = np.linspace(0.0, arc_lengths[-1], count + 1)
    time = np.interp(even_lengths, arc_lengths, times)
    controls = _controls(reference, time)
    return Path(
        direction=direction,
        spacing=float(arc_lengths[-1]) / count if count else 0.0,
        x=np.interp(even_lengths, arc_lengths, x),
        y=np.interp(even_lengths, arc_lengths, y),
        theta=np.interp(even_lengths, arc_lengths, theta),
        time=time,
        throttle=controls[:, model.throttle],
        steering=controls[:, model.steering],
    )


def _controls(reference: Reference, times: Floats) -> Matrix:
    """Planned controls (n, nu) at `times`; at the very end those that lead there."""
    if len(reference.controls) == 0:
        return np.tile(reference.rest, (len(times), 1))
    k = np.searchsorted(reference.times, times, side="right") - 1
    held: Matrix = reference.controls[np.clip(k, 0, len(reference.controls) - 1)]
    return held


class PathTracker:
    """The paths of the present reference, the one that is followed, and the car's nearest sample on it.

    The point of the car that is led is `offset` m ahead of its centre, and behind it where the car backs up.
    """

    def __init__(self, model: CarModel, offset: float, window: int) -> None:
        self._model, self._offset, self._window = model, offset, window
        self._reference: Reference | None = None
        self._paths: tuple[Path, ...] = ()
        self._path_index = self._nearest_index = 0

    def __deepcopy__(self, memo: object) -> PathTracker:
        """Model, reference and paths are never written to: a copy shares them."""
        return copy.copy(self)

    @property
    def path(self) -> Path:
        """The path that is followed."""
        return self._paths[self._path_index]

    @property
    def is_last(self) -> bool:
        """Whether nothing follows this path."""
        return self._path_index == len(self._paths) - 1

    def set_reference(self, reference: Reference, time: float) -> None:
        """Follow a reference; of a new one the part that is planned for `time` (s), from where the car should be."""
        if reference is self._reference:
            return
        self._reference, self._paths = reference, paths_of(reference, self._model, self._offset)
        self._select(0, time)
        self.advance_to(time)

    def advance_to(self, time: float) -> None:
        """Go on to the part that is planned for `time` (s)."""
        while not self.is_last and time >= self.path.time[-1]:
            self._select(self._path_index + 1, time)

    def next_path(self, time: float) -> None:
        """Go on to the next part."""
        self._select(self._path_index + 1, time)

    def project(self, state: Floats) -> Projection:
        """The place beside the point of the car that is led, searched from the previous one on."""
        model, offset = self._model, self._offset * self.path.direction
        theta = float(state[model.theta])
        x, y = float(state[model.x]) + offset * math.cos(theta), float(state[model.y]) + offset * math.sin(theta)
        projection = self.path.project(x, y, self._nearest_index, self._window)
        self._nearest_index = projection.index
        return projection

    def _select(self, part: int, time: float) -> None:
        self._path_index = part
        self._nearest_index = self.path.index_at(self.path.arc_length_at(time))
