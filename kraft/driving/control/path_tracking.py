"""Tracking of the path of a reference by a car: geometric, without time (a baseline of the paper), and kinodynamic.

A reference becomes evenly sampled paths, one per direction of travel, along which the progress of the car is known.
The geometric controller is a PID on the direction to a lookahead point.  The kinodynamic one is Stanley's steering law
with speed and steering fed forward from the plan.

Hoffmann, Tomlin, Montemerlo, Thrun: Autonomous Automobile Trajectory Tracking for Off-Road Driving: Controller Design,
Experimental Validation and Racing. ACC 2007.
"""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from kraft.driving.control_settings import Geometric, Kinodynamic
from kraft.driving.messages import Estimate, Reference, ReferenceKind
from kraft.driving.vehicle_model import CarModel, interpolate, stop_control
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


INTEGRAL_LIMIT: Final = 0.5
"""Limit of the integral part, as a share of the largest steering (anti-windup)."""
DERIVATIVE_TIME_CONSTANT: Final = 0.25
"""Time constant of the filtered derivative, s; with the gains of the paper's authors also that of the response."""


class GeometricController:
    """Steers to the point `lookahead` m beyond the nearest one; the throttle grows with the distance to that point."""

    def __init__(self, settings: Geometric, model: CarModel) -> None:
        self._settings, self._model = settings, model
        self._tracker = PathTracker(model, 0.0, settings.window)
        self._integral_limit = INTEGRAL_LIMIT * float(min(-model.low[model.steering], model.high[model.steering]))
        self._integral = 0.0
        self._filtered_error = 0.0
        self._time: float | None = None

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time; past the end of the path the rest control of the reference."""
        tracker, model, time = self._tracker, self._model, estimate.time
        tracker.set_reference(reference, time)
        projection = tracker.project(estimate.state)
        while not tracker.is_last and tracker.path.is_past_end(projection):
            tracker.next_path(time)
            projection = tracker.project(estimate.state)
        path = tracker.path
        if path.is_past_end(projection):
            return model.clamped(reference.rest)
        dx, dy = self._to_lookahead_point(estimate.state, path, projection)
        heading = float(estimate.state[model.theta]) + (0.0 if path.direction > 0 else math.pi)
        error = math.remainder(math.atan2(dy, dx) - heading, math.tau)
        steering = path.direction * self._pid(time, error)
        if reference.kind is ReferenceKind.CONTINGENCY:
            return model.command(float(reference.control_at(time)[model.throttle]), steering)
        share = math.hypot(dx, dy) / self._settings.lookahead
        return model.command(self._planned_throttle(path, projection) * share, steering)

    def _to_lookahead_point(self, state: Floats, path: Path, projection: Projection) -> tuple[float, float]:
        """Vector from the car to the lookahead point (m), which lies on the tangent beyond the end of the path."""
        x, y = path.point_at(projection.arc_length + self._settings.lookahead)
        return x - float(state[self._model.x]), y - float(state[self._model.y])

    def _pid(self, time: float, error: float) -> float:
        """Output of the PID (rad) for an error (rad)."""
        proportional, integral, derivative = self._settings.gains
        if self._time is None:
            self._time, self._filtered_error = time, error
        step = min(max(time - self._time, 0.0), 2.0 / self._settings.rate_hz)  # a pause must not be integrated
        self._time = time
        change = math.remainder(error - self._filtered_error, math.tau)
        self._filtered_error += change * (1.0 - math.exp(-step / DERIVATIVE_TIME_CONSTANT))
        self._integral += integral * error * step
        self._integral = min(max(self._integral, -self._integral_limit), self._integral_limit)
        return proportional * error + self._integral + derivative * change / DERIVATIVE_TIME_CONSTANT

    def _planned_throttle(self, path: Path, projection: Projection) -> float:
        """Throttle for the mean planned speed on the way to the lookahead point."""
        last = path.index_at(projection.arc_length + self._settings.lookahead)
        first = max(last - max(1, round(self._settings.lookahead / SPACING)), 0)
        duration = float(path.time[last] - path.time[first])
        if duration <= 0.0:
            return float(path.throttle[last])
        return self._model.throttle_for(path.direction * path.spacing * (last - first) / duration)


K_HOLD: Final = 3.0
"""Throttle per metre that a car which is held has drifted, 1/m."""
MOVING: Final = 0.01
"""Speed above which a car is braked, m/s."""
WINDOW: Final = 25
"""Samples to each side of the last nearest one among which the next one is searched."""


class KinodynamicController:
    """Steers the front axle onto the path of the planned front axle, and controls the progress along it.

    The cross-track error decides the steering.  The difference between the planned and the actual progress along the
    path decides the throttle.  In reverse the controller steers the rear axle onto its path instead.
    """

    def __init__(self, settings: Kinodynamic, model: CarModel) -> None:
        self._settings, self._model = settings, model
        self._tracker = PathTracker(model, 0.5 * model.wheelbase, WINDOW)

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time; past the end of the path the rest control of the reference."""
        tracker = self._tracker
        tracker.set_reference(reference, estimate.time)
        tracker.advance_to(estimate.time + self._settings.look)
        projection, path = tracker.project(estimate.state), tracker.path
        if tracker.is_last and path.is_past_end(projection):
            held, throttle = self._held(reference, path, projection), self._model.throttle
            held[throttle] = self._limited(float(held[throttle]), estimate, reference, path)
            return self._model.clamped(held)
        speed = abs(float(estimate.state[self._model.v]))
        ahead = path.index_at(projection.arc_length + self._settings.look * speed)
        steering = float(path.steering[ahead]) + self._feedback(estimate.state, speed, path, projection)
        return self._model.command(self._throttle(estimate, reference, path, projection), steering)

    def _feedback(self, state: Floats, speed: float, path: Path, projection: Projection) -> float:
        """Feedback added to the planned steering, rad (Hoffmann et al. 2007, eq. 5, with a softened denominator).

        The front axle moves in the direction theta + steering.  Its heading error relative to its path is therefore the
        heading error of the car plus the planned steering, which is fed forward.  In reverse, steering turns the car
        the other way, so the heading error changes its sign; the cross-track error does not.
        """
        settings = self._settings
        heading = math.remainder(float(path.theta[projection.index] - state[self._model.theta]), math.tau)
        cross_track_term = math.atan2(settings.k_path * projection.cross_track, speed + settings.softening)
        return path.direction * settings.k_heading * heading - cross_track_term

    def _held(self, reference: Reference, path: Path, projection: Projection) -> Floats:
        """Rest control (nu,); one that holds the car against a force is corrected by the way it has drifted."""
        held, throttle = reference.rest.copy(), self._model.throttle
        if held[throttle] != 0.0:
            held[throttle] += path.direction * K_HOLD * (path.length - projection.arc_length)
        return held

    def _throttle(self, estimate: Estimate, reference: Reference, path: Path, projection: Projection) -> float:
        """Planned throttle plus feedback on the progress; a contingency never gets more throttle than planned.

        The planned throttle is that of the present time, not of the present position: otherwise a car that is a little
        ahead of a slow part of the plan would get the throttle of a later, faster part and get further ahead.
        """
        time = estimate.time
        behind = path.arc_length_at(time) - projection.arc_length
        planned = float(reference.control_at(time + self._settings.look)[self._model.throttle])
        throttle = planned + path.direction * self._settings.k_along * behind
        if reference.kind is ReferenceKind.PLAN:
            return throttle
        if time >= reference.end:
            throttle = planned = float(self._held(reference, path, projection)[self._model.throttle])
        return self._limited(_slower(path, throttle, planned), estimate, reference, path)

    def _limited(self, throttle: float, estimate: Estimate, reference: Reference, path: Path) -> float:
        """At most the throttle with which the manoeuvre brakes the car at its present speed, as soon as it has begun.

        A car that is faster than planned would otherwise coast on where the planned throttle fades.
        """
        stop, speed = reference.stop, path.direction * float(estimate.state[self._model.v])
        if stop is None or estimate.time + self._settings.look < stop.begin or speed <= MOVING:
            return throttle
        braking = float(stop_control(self._model.vehicle, estimate.state, stop.manoeuvre)[self._model.throttle])
        return _slower(path, throttle, braking)


def _slower(path: Path, one: float, other: float) -> float:
    """The one of two throttles that drives less along a path."""
    return min(one, other) if path.direction > 0 else max(one, other)
