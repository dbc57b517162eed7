"""Evenly sampled paths of a reference, one per direction of travel, and the progress of the car along them."""

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
"""Distance between samples of a path, m."""
ARRIVAL_TOLERANCE: Final = 1e-3
"""Distance to the end of a path below which the car has arrived, m."""
STANDSTILL_SPEED: Final = 1e-3
"""Speed below which there is no direction of travel, m/s."""


@dataclass(frozen=True)
class Projection:
    """Projection of the car onto a path; `index` is the nearest sample.

    `arc_length` is the length of the path up to the projection (m), measured along the tangents beyond the ends;
    `cross_track` is the offset of the car to the left of the path, left as seen by the car (m).
    """

    index: int
    arc_length: float
    cross_track: float


@dataclass(frozen=True)
class Path:
    """Samples (n,) of a part of a reference with one direction of travel: `direction` is 1 forwards, -1 backwards.

    `x`, `y` (m) are the positions of the tracked point, `theta` (rad, unwrapped) the car's headings, `throttle` and
    `steering` the planned controls; `time` (s) ascends.  Samples are `spacing` m apart.
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
        """Whether a projection is at or beyond the end."""
        return projection.arc_length >= self.length - ARRIVAL_TOLERANCE

    def arc_length_at(self, time: float) -> float:
        """Planned arc length at `time` (s), m."""
        return self.spacing * interpolate(time, self._time_list, range(len(self._time_list)))

    @cached_property
    def _time_list(self) -> list[float]:
        times: list[float] = self.time.tolist()
        return times

    def index_at(self, arc_length: float) -> int:
        """Index of the sample nearest to an arc length (m)."""
        return round(min(max(arc_length / self.spacing, 0.0), len(self.x) - 1.0)) if self.spacing > 0.0 else 0

    def nearest(self, x: float, y: float, start: int, window: int) -> int:
        """Index of the sample nearest to a point, by local search from `start` within `window` samples to each side.

        The search repeats while it finds nearer samples.  It does not skip a loop of a path that crosses itself, and it
        recovers after the car was moved.
        """
        while True:
            low, high = max(start - window, 0), min(start + window + 1, len(self.x))
            dx, dy = self.x[low:high] - x, self.y[low:high] - y
            found = low + int((dx * dx + dy * dy).argmin())
            if abs(found - start) < window or found in (0, len(self.x) - 1, start):
                return found
            start = found

    def project(self, x: float, y: float, start: int, window: int) -> Projection:
        """Project (x, y) onto the path."""
        k = self.nearest(x, y, start, window)
        ahead, left = self._directions_at(k)
        dx, dy = x - float(self.x[k]), y - float(self.y[k])
        along = dx * ahead[0] + dy * ahead[1]
        return Projection(k, self.spacing * k + along, dx * left[0] + dy * left[1])

    def point_at(self, arc_length: float) -> tuple[float, float]:
        """Point (m) at an arc length (m), on the tangents beyond the ends."""
        k = self.index_at(arc_length)
        ahead, _ = self._directions_at(k)
        remainder = arc_length - self.spacing * k
        return float(self.x[k]) + remainder * ahead[0], float(self.y[k]) + remainder * ahead[1]

    def _directions_at(self, k: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Unit vectors at a sample: direction of travel, and the car's left perpendicular to it."""
        i, j = max(k - 1, 0), min(k + 1, len(self.x) - 1)
        dx, dy = float(self.x[j] - self.x[i]), float(self.y[j] - self.y[i])
        norm = math.hypot(dx, dy)
        if norm > 1e-9:
            ahead = dx / norm, dy / norm
        else:
            ahead = self.direction * math.cos(self.theta[k]), self.direction * math.sin(self.theta[k])
        return ahead, (-self.direction * ahead[1], self.direction * ahead[0])


def paths_of(reference: Reference, model: CarModel, offset: float) -> tuple[Path, ...]:
    """Paths of the point `offset` m ahead of the centre (behind it in reverse), in the order of time."""
    states, times = reference.states, reference.times
    directions = _travel_directions(states[:, model.v])
    cuts = [0, *(int(k) for k in np.flatnonzero(np.diff(directions))), len(times) - 1]
    return tuple(
        _path(reference, model, offset, int(directions[b]), slice(a, b + 1)) for a, b in itertools.pairwise(cuts)
    )


def _travel_directions(speeds: Floats) -> Floats:
    """Direction of travel of each sample, 1 or -1; at standstill the last direction before, or else the first after."""
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
    """Planned controls (n, nu) at `times`; at the end of the reference its last control."""
    if len(reference.controls) == 0:
        return np.tile(reference.rest, (len(times), 1))
    k = np.searchsorted(reference.times, times, side="right") - 1
    held: Matrix = reference.controls[np.clip(k, 0, len(reference.controls) - 1)]
    return held


class PathTracker:
    """Paths of the present reference, the current path, and the nearest sample of it to the car.

    The tracked point is `offset` m ahead of the car's centre, and behind it in reverse.
    """

    def __init__(self, model: CarModel, offset: float, window: int) -> None:
        self._model, self._offset, self._window = model, offset, window
        self._reference: Reference | None = None
        self._paths: tuple[Path, ...] = ()
        self._path_index = self._nearest_index = 0

    def __deepcopy__(self, memo: object) -> PathTracker:
        """Copy the indices and share model, reference and paths, which are immutable."""
        return copy.copy(self)

    @property
    def path(self) -> Path:
        """The current path."""
        return self._paths[self._path_index]

    @property
    def is_last(self) -> bool:
        """Whether the current path is the last one."""
        return self._path_index == len(self._paths) - 1

    def set_reference(self, reference: Reference, time: float) -> None:
        """Set the reference; for a new one, select the path and the sample that are planned for `time` (s)."""
        if reference is self._reference:
            return
        self._reference, self._paths = reference, paths_of(reference, self._model, self._offset)
        self._select(0, time)
        self.advance_to(time)

    def advance_to(self, time: float) -> None:
        """Advance to the path that is planned for `time` (s)."""
        while not self.is_last and time >= self.path.time[-1]:
            self._select(self._path_index + 1, time)

    def next_path(self, time: float) -> None:
        """Advance to the next path."""
        self._select(self._path_index + 1, time)

    def project(self, state: Floats) -> Projection:
        """Project the tracked point onto the current path, searching from the last nearest sample on."""
        model, offset = self._model, self._offset * self.path.direction
        theta = float(state[model.theta])
        x, y = float(state[model.x]) + offset * math.cos(theta), float(state[model.y]) + offset * math.sin(theta)
        projection = self.path.project(x, y, self._nearest_index, self._window)
        self._nearest_index = projection.index
        return projection

    def _select(self, part: int, time: float) -> None:
        self._path_index = part
        self._nearest_index = self.path.index_at(self.path.arc_length_at(time))
