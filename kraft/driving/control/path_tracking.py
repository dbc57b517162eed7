"""Tracking of the path of a reference by a car: geometric, without time (a baseline of the paper), and kinodynamic.

A reference becomes evenly sampled paths, one per direction of travel, along which the progress of the car is known.
The geometric controller is a PID on the direction to a lookahead point.  The kinodynamic one is Stanley's steering law
with speed and steering fed forward from the plan; it is compiled, because its closed loop is predicted many times in
every cycle.
"""

from __future__ import annotations

import copy
import math
from typing import Final

import numpy as np

from kraft.driving.car_model import CarModel
from kraft.driving.control_settings import Geometric, Kinodynamic
from kraft.driving.messages import Estimate, Reference, ReferenceKind
from ompl_ext.arrays import Floats, Ints, Matrix
from ompl_ext.checker import EdgeChecker
from ompl_ext.kernels import tracking as at
from ompl_ext.kernels.paths import LAID, SPACING, paths
from ompl_ext.kernels.specialise import kernels
from ompl_ext.kernels.tracking import Law, Ticks, Track, tracking


def track_of(reference: Reference, where: Ints, offset: float) -> Track:
    """Paths of the point `offset` m ahead of the centre (behind it in reverse), in the order of time.

    `where` (7,) are the components of states and controls, as `Law` has them.
    """
    times = np.ascontiguousarray(reference.times, dtype=np.float64)
    states = np.ascontiguousarray(reference.states, dtype=np.float64)
    controls = np.ascontiguousarray(reference.controls, dtype=np.float64).reshape(-1, len(reference.rest))
    count = len(times)
    laid, begin, first = np.empty((LAID, 2 * count)), np.empty(count + 2, np.int64), np.empty(count + 2, np.int64)
    direction, spacing = np.empty(count + 1, np.int64), np.empty(count + 1)
    number = paths().lay(states, times, where, offset, laid, begin, first, direction, spacing)
    first, direction, spacing = first[: number + 1], direction[:number], spacing[:number]
    samples = np.empty((at.ROWS, first[-1]))
    paths().sample(laid, begin, first, direction, spacing, times, controls, reference.rest, where, samples)
    stop = reference.stop
    kind = math.inf if stop is None else stop.begin, 0 if stop is None else stop.manoeuvre
    return Track(
        samples=samples,
        first=first,
        direction=direction,
        spacing=spacing,
        times=times,
        controls=controls,
        rest=reference.rest,
        kind=np.array([reference.kind is ReferenceKind.PLAN, *kind], dtype=np.float64),
    )


class PathTracker:
    """Paths of the present reference, the current path, and the nearest sample of it to the car.

    The tracked point is `offset` m ahead of the car's centre, and behind it in reverse.  `where` (2,) are the number of
    the current path and of the sample in it; `law` is what kernels read beside the paths.
    """

    track: Track

    def __init__(self, model: CarModel, offset: float, window: int, settings: Kinodynamic | None = None) -> None:
        """`settings` are those of a kinodynamic law; its nearest sample is searched within `window` of the last one."""
        self._model, self._offset = model, offset
        self._reference: Reference | None = None
        self.where = np.zeros(2, np.int64)
        gain = np.zeros(at.GAINS)
        gain[[at.OFFSET, at.RADIAN, at.FULL_THROTTLE]] = offset, model.steering_per_radian, model.full_throttle
        if settings is not None:
            gain[[at.K_PATH, at.K_HEADING, at.K_ALONG]] = settings.k_path, settings.k_heading, settings.k_along
            gain[[at.SOFTENING, at.LOOK]] = settings.softening, settings.look
        self.law = Law(
            gain=gain,
            where=np.array([*model.pose, model.v, model.throttle, model.steering, window]),
            low=model.low,
            high=model.high,
            parameters=model.parameters,
            functions=kernels(model.vehicle).functions,
        )
        tracking(), paths()  # loaded here, before the vehicle drives

    def __deepcopy__(self, memo: object) -> PathTracker:
        """Copy the indices and share model, reference and paths, which are immutable."""
        result = PathTracker.__new__(PathTracker)  # `copy.copy` takes longer than the motion that is predicted
        vars(result).update(vars(self), where=self.where.copy())
        return result

    @property
    def path(self) -> int:
        """Number of the current path."""
        return int(self.where[at.PATH])

    @property
    def is_last(self) -> bool:
        """Whether the current path is the last one."""
        return self.path == len(self.track.direction) - 1

    @property
    def samples(self) -> Matrix:
        """Samples (8, n) of the current path, see `Track`."""
        first, end = self.track.first[self.path : self.path + 2]
        samples: Matrix = self.track.samples[:, first:end]
        return samples

    def set_reference(self, reference: Reference, time: float) -> None:
        """Set the reference; for a new one, select the path and the sample that are planned for `time` (s)."""
        if reference is not self._reference:
            self._reference, self.track = reference, track_of(reference, self.law.where, self._offset)
            tracking().begin(self.track, self.where, time)

    def next_path(self, time: float) -> None:
        """Advance to the next path."""
        tracking().select(self.track, self.where, self.path + 1, time)

    def project(self, state: Floats) -> float:
        """Arc length (m) of the tracked point on the current path, searching from the last nearest sample on."""
        arc_length, _ = tracking().project(self.track, self.where, self.law, np.ascontiguousarray(state))
        return arc_length


INTEGRAL_LIMIT: Final = 0.5
"""Limit of the integral part, as a share of the largest steering (anti-windup)."""
DERIVATIVE_TIME_CONSTANT: Final = 0.25
"""Time constant of the filtered derivative, s; with the gains of the paper's authors also that of the response."""


class GeometricController:
    """Steers to the point `lookahead` m beyond the nearest one; the throttle grows with the distance to that point."""

    def __init__(self, settings: Geometric, model: CarModel) -> None:
        self._settings, self._model = settings, model
        self._tracker = PathTracker(model, 0.0, settings.window)
        self._per_radian = model.steering_per_radian
        largest = float(min(-model.low[model.steering], model.high[model.steering])) / self._per_radian
        self._integral_limit = INTEGRAL_LIMIT * largest
        self._integral = 0.0
        self._filtered_error = 0.0
        self._time: float | None = None

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time; past the end of the path the rest control of the reference."""
        tracker, model, time = self._tracker, self._model, estimate.time
        tracker.set_reference(reference, time)
        arc_length = tracker.project(estimate.state)
        while not tracker.is_last and self._is_past_end(arc_length):
            tracker.next_path(time)
            arc_length = tracker.project(estimate.state)
        if self._is_past_end(arc_length):
            return model.clamped(reference.rest)
        direction, aimed_at = int(tracker.track.direction[tracker.path]), arc_length + self._settings.lookahead
        dx, dy = self._vector_to(aimed_at, estimate.state)
        heading = float(estimate.state[model.theta]) + (0.0 if direction > 0 else math.pi)
        error = math.remainder(math.atan2(dy, dx) - heading, math.tau)
        steering = direction * self._per_radian * self._pid(time, error)
        if reference.kind is ReferenceKind.CONTINGENCY:
            return model.command(float(reference.control_at(time)[model.throttle]), steering)
        share = math.hypot(dx, dy) / self._settings.lookahead
        return model.command(self._planned_throttle(aimed_at) * share, steering)

    def _is_past_end(self, arc_length: float) -> bool:
        """Whether an arc length (m) is at or beyond the end of the current path."""
        tracker = self._tracker
        length = float(tracker.track.spacing[tracker.path]) * (tracker.samples.shape[1] - 1)
        return arc_length >= length - at.ARRIVAL_TOLERANCE

    def _index_at(self, arc_length: float) -> int:
        """Index of the sample of the current path nearest to an arc length (m)."""
        spacing, last = float(self._tracker.track.spacing[self._tracker.path]), self._tracker.samples.shape[1] - 1.0
        if not (spacing > 0.0 and arc_length > 0.0):  # also of a state that is not a number
            return 0
        return round(min(arc_length / spacing, last))

    def _vector_to(self, arc_length: float, state: Floats) -> tuple[float, float]:
        """Vector (m) from the car to the point at an arc length (m), which lies on the tangents beyond the ends."""
        k = self._index_at(arc_length)
        remainder = arc_length - float(self._tracker.track.spacing[self._tracker.path]) * k
        x, y, ahead_x, ahead_y = self._tracker.samples[[at.X, at.Y, at.AHEAD_X, at.AHEAD_Y], k].tolist()
        dx, dy = x + remainder * ahead_x, y + remainder * ahead_y
        return dx - float(state[self._model.x]), dy - float(state[self._model.y])

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

    def _planned_throttle(self, arc_length: float) -> float:
        """Throttle for the mean planned speed on the way to the lookahead point, which is at an arc length (m)."""
        tracker, last = self._tracker, self._index_at(arc_length)
        first = max(last - max(1, round(self._settings.lookahead / SPACING)), 0)
        duration = float(tracker.samples[at.TIME, last] - tracker.samples[at.TIME, first])
        if duration <= 0.0:
            return float(tracker.samples[at.THROTTLE, last])
        direction, spacing = int(tracker.track.direction[tracker.path]), float(tracker.track.spacing[tracker.path])
        return self._model.throttle_for(direction * spacing * (last - first) / duration)


WINDOW: Final = 25
"""Samples to each side of the last nearest one among which the next one is searched."""


class KinodynamicController:
    """Steers the front axle onto the path of the planned front axle, and controls the progress along it.

    The cross-track error decides the steering.  The difference between the planned and the actual progress along the
    path decides the throttle.  In reverse the controller steers the rear axle onto its path instead.  The law is
    `ompl_ext.kernels.tracking.command`.
    """

    def __init__(self, settings: Kinodynamic, model: CarModel) -> None:
        self._tracker = PathTracker(model, 0.5 * model.wheelbase, WINDOW, settings)
        self._size = len(model.low)

    def __deepcopy__(self, memo: dict[int, object]) -> KinodynamicController:
        """Copy where it is on the path."""
        result = KinodynamicController.__new__(KinodynamicController)
        vars(result).update(vars(self), _tracker=copy.deepcopy(self._tracker, memo))
        return result

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time; past the end of the path the rest control of the reference."""
        tracker, control = self._tracker, np.empty(self._size)
        tracker.set_reference(reference, estimate.time)
        state = np.ascontiguousarray(estimate.state, dtype=np.float64)
        tracking().command(tracker.track, tracker.where, tracker.law, estimate.time, state, control)
        return control

    def drive(
        self, checker: EdgeChecker, reference: Reference, state: Floats, ticks: Ticks, until: float = math.inf
    ) -> tuple[Matrix, Matrix, float]:
        """Track a reference from `state` (nx,) with the model of `checker`, one command a tick.

        It ends early at standstill at or after `until` (s).  Returns the states (n + 1, nx), the controls (n, nu), and
        the least slack (m), infinite without a tick.
        """
        tracker, vehicle, count = self._tracker, checker.vehicle, len(ticks.time)
        states, controls = np.empty((count + 1, len(state))), np.empty((count, self._size))
        states[0] = state
        if count == 0:
            return states, controls, math.inf
        tracker.set_reference(reference, float(ticks.time[0]))
        done, slack = tracking().closed_loop(
            tracker.track, tracker.where, tracker.law, checker.problem, checker.work, ticks, until,
            np.array(vehicle.rest_indices), checker.safety.rest_speeds(vehicle), states, controls,
        )  # fmt: skip
        return states[: done + 1], controls[:done], slack
