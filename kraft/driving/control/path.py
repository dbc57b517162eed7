"""A reference as paths: where a point of the car is led, sampled evenly, apart for every change of direction."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from kraft.driving.car_model import Model, interpolate
from kraft.driving.messages import Reference
from ompl_ext.arrays import Floats, Matrix

SPACING: Final = 0.02
"""Between samples of a path, m."""
END: Final = 1e-3
"""How near to the end of a path the car is taken to have arrived, m."""
STANDING: Final = 1e-3
"""Speed below which a direction of travel means nothing, m/s."""


@dataclass(frozen=True)
class Place:
    """A point of a path: sample `index` and the car's offset from it.

    `distance` is the length of path before the point (m), beyond the ends of the path along their tangents; `across` is
    how far the car is to the left of the path as the car is headed (m).
    """

    index: int
    distance: float
    across: float


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

    def is_over_at(self, place: Place) -> bool:
        """Whether a place is at or beyond the end."""
        return place.distance >= self.length - END

    def distance_at(self, time: float) -> float:
        """Length of path that is planned to lie behind the car at `time` (s), m."""
        return self.spacing * interpolate(time, self._times, range(len(self._times)))

    @cached_property
    def _times(self) -> list[float]:
        times: list[float] = self.time.tolist()
        return times

    def sample(self, distance: float) -> int:
        """Index of the sample at a length of path (m), the nearest there is."""
        return round(min(max(distance / self.spacing, 0.0), len(self.x) - 1.0)) if self.spacing > 0.0 else 0

    def nearest(self, x: float, y: float, near: int, window: int) -> int:
        """Sample nearest to a point, searched from `near` on: `window` samples to both sides, on while it gets nearer.

        So a path that comes by the same place twice is not cut short, and a car that was moved is found again.
        """
        while True:
            low, high = max(near - window, 0), min(near + window + 1, len(self.x))
            dx, dy = self.x[low:high] - x, self.y[low:high] - y
            found = low + int((dx * dx + dy * dy).argmin())
            if abs(found - near) < window or found in (0, len(self.x) - 1, near):
                return found
            near = found

    def place(self, x: float, y: float, near: int, window: int) -> Place:
        """The point of the path beside (x, y)."""
        k = self.nearest(x, y, near, window)
        ahead, left = self._axes(k)
        dx, dy = x - float(self.x[k]), y - float(self.y[k])
        along = dx * ahead[0] + dy * ahead[1]
        return Place(k, self.spacing * k + along, dx * left[0] + dy * left[1])

    def point(self, distance: float) -> tuple[float, float]:
        """Point (m) at a length of path (m); beyond the ends on their tangents."""
        k = self.sample(distance)
        ahead, _ = self._axes(k)
        rest = distance - self.spacing * k
        return float(self.x[k]) + rest * ahead[0], float(self.y[k]) + rest * ahead[1]

    def _axes(self, k: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Direction of travel at a sample, and the car's left at right angles to it."""
        i, j = max(k - 1, 0), min(k + 1, len(self.x) - 1)
        dx, dy = float(self.x[j] - self.x[i]), float(self.y[j] - self.y[i])
        size = math.hypot(dx, dy)
        if size > 1e-9:
            ahead = dx / size, dy / size
        else:
            ahead = self.direction * math.cos(self.theta[k]), self.direction * math.sin(self.theta[k])
        return ahead, (-self.direction * ahead[1], self.direction * ahead[0])


def paths_of(reference: Reference, model: Model, lead: float) -> tuple[Path, ...]:
    """Paths of the point `lead` m ahead of the centre (behind it where the car backs up), in the order of time."""
    states, times = reference.states, reference.times
    directions = _directions(states[:, model.v])
    cuts = [0, *(int(k) for k in np.flatnonzero(np.diff(directions))), len(times) - 1]
    return tuple(
        _path(reference, model, lead, int(directions[b]), slice(a, b + 1)) for a, b in itertools.pairwise(cuts)
    )


def _directions(speeds: Floats) -> Floats:
    """Direction of each sample, 1 or -1; one that stands has the direction in which it moved last, or will first."""
    signs = np.where(np.abs(speeds) > STANDING, np.sign(speeds), 0.0)
    moving = np.flatnonzero(signs)
    if len(moving) == 0:
        return np.ones(len(speeds))
    before = np.maximum(np.searchsorted(moving, np.arange(len(speeds)), side="right") - 1, 0)
    result: Floats = signs[moving[before]]
    return result


def _path(reference: Reference, model: Model, lead: float, direction: int, part: slice) -> Path:
    states, times = reference.states[part], reference.times[part]
    theta = np.unwrap(states[:, model.theta])
    x = states[:, model.x] + direction * lead * np.cos(theta)
    y = states[:, model.y] + direction * lead * np.sin(theta)
    gone = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    count = max(1, math.ceil(gone[-1] / SPACING)) if gone[-1] > 1e-6 else 0
    even = np.linspace(0.0, gone[-1], count + 1)
    time = np.interp(even, gone, times)
    controls = _controls(reference, time)
    return Path(
        direction=direction,
        spacing=float(gone[-1]) / count if count else 0.0,
        x=np.interp(even, gone, x),
        y=np.interp(even, gone, y),
        theta=np.interp(even, gone, theta),
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


class Guide:
    """The paths of the present reference, the one that is followed, and the car's nearest sample on it.

    The point of the car that is led is `lead` m ahead of its centre, and behind it where the car backs up.
    """

    def __init__(self, model: Model, lead: float, window: int) -> None:
        self._model, self._lead, self._window = model, lead, window
        self._reference: Reference | None = None
        self._paths: tuple[Path, ...] = ()
        self._part = self._near = 0

    def __deepcopy__(self, memo: object) -> Guide:
        """Model, reference and paths are never written to: a copy shares them."""
        return copy.copy(self)

    @property
    def path(self) -> Path:
        """The path that is followed."""
        return self._paths[self._part]

    @property
    def is_last(self) -> bool:
        """Whether nothing follows this path."""
        return self._part == len(self._paths) - 1

    def take(self, reference: Reference, time: float) -> None:
        """Follow a reference; of a new one the part that is planned for `time` (s), from where the car should be."""
        if reference is self._reference:
            return
        self._reference, self._paths = reference, paths_of(reference, self._model, self._lead)
        self._begin(0, time)
        self.keep_time(time)

    def keep_time(self, time: float) -> None:
        """Go on to the part that is planned for `time` (s)."""
        while not self.is_last and time >= self.path.time[-1]:
            self._begin(self._part + 1, time)

    def go_on(self, time: float) -> None:
        """Go on to the next part."""
        self._begin(self._part + 1, time)

    def locate(self, state: Floats) -> Place:
        """The place beside the point of the car that is led, searched from the previous one on."""
        model, lead = self._model, self._lead * self.path.direction
        theta = float(state[model.theta])
        x, y = float(state[model.x]) + lead * math.cos(theta), float(state[model.y]) + lead * math.sin(theta)
        place = self.path.place(x, y, self._near, self._window)
        self._near = place.index
        return place

    def _begin(self, part: int, time: float) -> None:
        self._part = part
        self._near = self.path.sample(self.path.distance_at(time))
