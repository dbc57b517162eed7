"""Open-loop prediction of the model over windows of 3 s, its errors after 1, 2 and 3 s, and how they grow.

The prediction of a window uses the commands and the poses up to its beginning; of later poses it uses only the measured
noise.  The first window of a part that begins at rest begins at its first pose, at rest.  Every other window begins at
the state that the graph, with fixed parameters, estimates from the 3 s before; if parameters of the model vary, at the
state, and with their deviations, that fit the poses of these 3 s best without process noise.  Process noise explains
the growth of the error with the time since the beginning (`process_noise`, `error_growth`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from kraft.errors import Code, InputError
from kraft.sysid.chains import Segment, segment_between
from kraft.sysid.data import usable_logs
from kraft.sysid.factor_graph import FastGraph
from kraft.sysid.initial_values import smooth_chains
from kraft.sysid.interface import PredictionErrors, Settings
from kraft.sysid.multistep import MultiStep, fit
from kraft.sysid.optimiser import optimise
from kraft.sysid.parameters import (
    YAW_RATES,
    Parameters,
    auxiliary_parameters,
    parameters_of,
    speed_index,
    variation_of,
    vehicle_of,
)
from kraft.sysid.problem import (
    NoiseModel,
    ObservationModel,
    Point,
    Problem,
    assemble,
    noise_model,
    simulated,
    starting_point,
)
from kraft.sysid.selection import check_settings
from kraft.sysid.smoothing import begins_at_rest, constant_motion, measured_noise, thinned
from kraft.sysid.window_controls import WindowControls
from kraft.sysid.windows import WINDOW_MIN, Variation, windows_of
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.times import SAME_TIME
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


WINDOW_LENGTH = 3.0
"""Length of a window, and of the history before it, s."""
HISTORY_PROCESS_FACTOR = 3.0
"""Process noise in the history of a window over that of an identification: the initial state shall follow the poses
even if the parameters are wrong."""
HISTORY_ITERATIONS, HISTORY_CONVERGED = 15, 1e-3
"""Most iterations of the fit of a history, and the relative decrease of its cost below which it has converged."""
HISTORY_MIN = 0.5
"""Least length of a history, s."""
RECENT = 0.3
"""Time before a window whose poses show its speed and turning rate, s."""
ASTRAY = 30.0
"""Deviation of a fitted history from its recent poses, over their noise and the usual error of the model in that time,
from which the window begins at the poses.

A model that is exact elsewhere is off by far more.  One that is always off by some centimetres is off by less, and its
history makes up for errors of its speed by the place where the window begins."""
HORIZONS = (1.0, 2.0, 3.0)
"""Times after the beginning of a window at which errors are evaluated, s."""
BIN = 0.1
"""Width of a bin of time since a window's beginning, s."""
FARTHEST = 5e5
"""Largest distance in x and in y (m), and turn (rad), of a predicted pose from where its window begins.

A prediction that diverges is there: its error is a number, and larger than all others."""


@dataclass(frozen=True, eq=False)
class Window:
    """A piece of a log of at most 3 s, predicted from its beginning."""

    log: str
    times: Floats
    """(n,) of the poses, s, as in the log"""
    poses: Matrix
    """(n, 3) observed"""
    predicted: Matrix
    """(n, 3)"""


def predict_windows(
    vehicle: VehicleConfig | Vehicle,
    logs: Sequence[Log],
    values: Mapping[str, float] | None = None,
    settings: Settings | None = None,
) -> tuple[Window, ...]:
    """Predict every window of the logs with the parameters `values`, auxiliary ones included.

    Parameters without a value have that of `settings`, else that of the vehicle; auxiliary parameters are 0.  A
    prediction that diverges is `FARTHEST` from where it begins.

    Raises:
        InputError: if the logs cannot be used, or `values` has a parameter that does not exist.
    """
    settings = settings or Settings()
    values = {**settings.values, **(values or {})}
    model = vehicle_of(vehicle)
    auxiliary = tuple(name for name in auxiliary_parameters(model) if values.get(name, 0.0) != 0.0)
    given = replace(settings, values=values, frozen=(*model.parameters, *auxiliary), auxiliary="auto")
    check_settings(vehicle, given)
    parameters = parameters_of(vehicle, given, auxiliary)
    usable = usable_logs(model, logs)
    pieces = pieces_of(usable, settings)
    if varying := variation_of(parameters, settings):
        predicted = _with_deviations(pieces, parameters, settings, varying)
    else:
        predicted = _with_states(pieces, len(usable), parameters, settings)
    found = []
    for piece, poses in zip(pieces, predicted, strict=True):
        part, own = piece.segment.part, piece.ahead
        bounded = _bounded(poses, part.poses[own.start])
        found.append(Window(usable[piece.segment.log].name, part.pose_times[own], part.poses[own], bounded))
    return tuple(found)


def _bounded(poses: Matrix, start: Floats) -> Matrix:
    """Poses (n, 3) no farther than `FARTHEST` from the pose `start` (3,); those that are no numbers are as far."""
    off = poses - start
    bounded: Matrix = start + np.clip(np.nan_to_num(off, nan=FARTHEST), -FARTHEST, FARTHEST)
    return np.where(np.abs(off) < FARTHEST, poses, bounded)


def _with_deviations(
    pieces: Sequence[Piece], parameters: Parameters, settings: Settings, varying: Mapping[str, float]
) -> Sequence[Matrix]:
    """Predicted poses of each window, with the deviations of the parameters that its history shows."""
    model = parameters.vehicle
    known = _noise([_between(p, p.ahead.start, p.ahead.stop, settings.step) for p in pieces], model, settings)
    growth = HISTORY_PROCESS_FACTOR * error_growth(model, known.process, WINDOW_LENGTH)
    predictor = Predictor(pieces, parameters, known, growth, varying)
    return [row[own] for row, own in zip(predictor.poses(parameters.nominal), predictor.ahead, strict=True)]


def _with_states(pieces: Sequence[Piece], logs: int, parameters: Parameters, settings: Settings) -> Sequence[Matrix]:
    """Predicted poses of each window from the state that the graph estimates from its history."""
    windows = [_between(p, p.ahead.start, p.ahead.stop, settings.step) for p in pieces]
    problem = _problem(windows, logs, parameters, settings)
    start = _starts(pieces, logs, parameters, settings)
    states = simulated(problem, start, problem.actuators.mean(parameters.nominal)[0], parameters.nominal)
    predicted = problem.observation.predict(problem.at_poses(states), parameters.nominal)
    return np.split(predicted, np.cumsum([p.ahead.stop - p.ahead.start for p in pieces])[:-1])


@dataclass(frozen=True, eq=False)
class Piece:
    """A window of a log, with the history that shows its initial state."""

    segment: Segment
    """history and window"""
    part: Part
    """of the log, with all its poses"""
    known: float
    """time from the beginning of the segment to that of the window, s; 0 if the window begins at rest"""
    ahead: slice
    """poses of the window among those of the segment's part"""


class Predictor:
    """Predictions of some windows with one model, each from what the poses before it show."""

    def __init__(
        self,
        pieces: Sequence[Piece],
        parameters: Parameters,
        noise: NoiseModel,
        growth: Floats,
        variation: Mapping[str, float],
    ) -> None:
        """Prepare the prediction; `variation` is the standard deviation of each parameter that varies."""
        seen = [_until(p.part, p.segment.begin + p.known) for p in pieces]
        known = np.array([p.known for p in pieces])
        segments, fold = [p.segment for p in pieces], np.zeros(len(pieces), dtype=np.int64)
        frozen, varying = replace(parameters, frozen=frozenset(parameters.names)), Variation.independent(variation)
        windows = windows_of(segments, seen, fold, known)
        before = windows_of([_history(p) for p in pieces], seen, fold, known)
        self._windows = MultiStep(WindowControls(windows, frozen), frozen, noise, growth, varying)
        self.graph = MultiStep(WindowControls(before, frozen), frozen, noise, growth, varying)
        self._resting: Bools = known == 0.0
        self._usual: Floats = np.hypot(noise.pose_sigmas, growth * RECENT)
        counts = np.array([len(s.part.pose_times[s.poses]) for s in segments])[:, None]
        self.since: Floats = windows.since - known[:, None]
        """(W, n) time since the beginning of the window, s"""
        self.interval: Floats = np.array([np.median(np.diff(p.segment.part.pose_times[p.ahead])) for p in pieces])
        """(W,) usual time between two poses, s"""
        self.ahead: Bools = (self.since >= -SAME_TIME) & (np.arange(self.since.shape[1]) < counts)
        """(W, n) whether it is a pose of the window"""
        self.observed: Floats = windows.poses
        """(W, n, 3)"""
        self._last: Point | None = None

    def poses(self, rho: Floats) -> Floats:
        """Predicted poses (W, n, 3) with the parameters rho (np,); those of the windows are `ahead` (W, n)."""
        start = self.graph.start(rho)
        if self._last is not None:
            start = min(start, self.graph.with_rho(self._last, rho), key=self.graph.cost)
        self._last = fit(self.graph, start, HISTORY_ITERATIONS, tolerance=HISTORY_CONVERGED).point
        states = self._at_recent_poses(self._last)
        for w in np.flatnonzero(self._resting):
            states[w] = 0.0
            states[w, : self.graph.problem.dynamics.nx] = _at_rest(
                self.graph.problem.parameters, rho, self.observed[w, 0]
            )
        return self._windows.predict(states, rho)

    def _at_recent_poses(self, fitted: Point) -> Matrix:
        """Initial states of the histories, those moved as a whole whose model has gone astray by their end.

        A model that is exact elsewhere follows no history with what it does not explain (tyres that slide, stiction):
        it would begin the window where the car is not.
        """
        history, model = self.graph.windows, self.graph.problem.parameters.vehicle
        x, y, yaw = (model.index(name) for name in ("x", "y", "theta"))
        ahead = history.known[:, None] - history.since
        recent = history.seen & (np.abs(ahead) <= RECENT)
        off, here = (_extrapolated(-ahead, each, recent) for each in (self.graph.residuals(fitted), history.poses))
        off *= np.any(np.abs(off) > ASTRAY * self._usual, axis=1, keepdims=True)
        states, c, s = fitted.states.copy(), np.cos(off[:, 2]), np.sin(off[:, 2])
        dx, dy = states[:, x] - here[:, 0] - off[:, 0], states[:, y] - here[:, 1] - off[:, 1]
        states[:, x], states[:, y] = here[:, 0] + c * dx + s * dy, here[:, 1] - s * dx + c * dy
        states[:, yaw] -= off[:, 2]
        return states


def _extrapolated(times: Floats, values: Floats, chosen: Bools) -> Matrix:
    """Values (W, 3) at time 0 of the lines through the chosen ones of values (W, n, 3) at times (W, n)."""
    count = np.maximum(chosen.sum(axis=1), 1)[:, None]
    middle = (times * chosen).sum(axis=1, keepdims=True) / count
    mean = (values * chosen[..., None]).sum(axis=1) / count
    apart = (times - middle) * chosen
    slope = (apart[..., None] * values).sum(axis=1) / np.maximum((apart**2).sum(axis=1, keepdims=True), 1e-9)
    found: Matrix = mean - slope * middle
    return found


def _history(piece: Piece) -> Segment:
    """The segment of a piece up to its window, on the same steps."""
    segment = piece.segment
    steps = max(1, math.ceil(piece.known / segment.h - 1e-9))
    return replace(segment, steps=steps, poses=slice(segment.poses.start, piece.ahead.start + 1))


def _until(part: Part, time: float) -> Part:
    """The part with its poses up to a time."""
    count = int(np.searchsorted(part.pose_times, time + SAME_TIME, side="right"))
    return replace(part, pose_times=part.pose_times[:count], poses=part.poses[:count])


def constant_windows(
    vehicle: VehicleConfig | Vehicle, logs: Sequence[Log], settings: Settings | None = None
) -> tuple[Window, ...]:
    """Prediction of the windows of `predict_windows` without a model: constant speed and turning rate.

    Raises:
        InputError: if the logs cannot be used.
    """
    usable = usable_logs(vehicle_of(vehicle), logs)
    found = []
    for piece in pieces_of(usable, settings or Settings()):
        times, poses = piece.segment.part.pose_times[piece.ahead], piece.segment.part.poses[piece.ahead]
        seen = _until(piece.part, times[0])
        x, y, yaw, speed, rate = (
            (*poses[0], 0.0, 0.0) if piece.known == 0.0 else constant_motion(seen.pose_times, seen.poses, RECENT)
        )
        since = times - times[0]
        middle = yaw + 0.5 * rate * since
        chord = speed * since * np.sinc(0.5 * rate * since / np.pi)
        predicted = np.column_stack([x + chord * np.cos(middle), y + chord * np.sin(middle), yaw + rate * since])
        found.append(Window(usable[piece.segment.log].name, times, poses, predicted))
    return tuple(found)


def pieces_of(logs: Sequence[Log], settings: Settings, length: float = WINDOW_LENGTH) -> list[Piece]:
    """Windows of at most `length` s, one after the other, each with the history of at most that length before it.

    Raises:
        InputError: if there is none.
    """
    found = [piece for i, log in enumerate(logs) for piece in _pieces_of_log(log, i, settings, length)]
    if not found and all(part.duration < HISTORY_MIN + WINDOW_MIN for log in logs for part in log.parts):
        raise InputError.of("logs", "are all shorter than a second", "expected longer ones to predict", Code.DATA)
    if not found:
        problem = f"never have three poses within {length:g} s, from which windows are predicted"
        raise InputError.of("logs", problem, "expected more poses a second", Code.DATA)
    return found


def is_predictable(log: Log, settings: Settings) -> bool:
    """Whether a log has a window that can be predicted."""
    return next(_pieces_of_log(log, 0, settings, WINDOW_LENGTH), None) is not None


def _pieces_of_log(log: Log, number: int, settings: Settings, length: float) -> Iterator[Piece]:
    for part in log.parts:
        yield from _pieces(part, thinned(part, settings.step), number, settings.step, length)


def prediction_errors(
    vehicle: VehicleConfig | Vehicle,
    logs: Sequence[Log],
    values: Mapping[str, float] | None = None,
    settings: Settings | None = None,
) -> PredictionErrors:
    """Root mean square errors over all windows of the logs with the parameters `values`, auxiliary ones included.

    Raises:
        InputError: as `predict_windows`.
    """
    return window_errors(predict_windows(vehicle, logs, values, settings))


def window_errors(predicted: Sequence[Window]) -> PredictionErrors:
    """Root mean square errors of predicted windows."""
    since = np.concatenate([w.times - w.times[0] for w in predicted])
    # the pose interval of each window, so that windows with a lower pose rate count too
    interval = np.concatenate([np.full(len(w.times), np.median(np.diff(w.times))) for w in predicted])
    off = np.concatenate([w.predicted - w.poses for w in predicted])
    position, yaw = np.hypot(off[:, 0], off[:, 1]), off[:, 2]
    later = since > 0.0  # the first pose of a window is known, not predicted
    at = {after: later & (np.abs(since - after) <= 0.75 * interval) for after in HORIZONS}
    reached = {after: chosen for after, chosen in at.items() if chosen.any()}
    return PredictionErrors(
        {after: _rms(position, chosen) for after, chosen in reached.items()},
        {after: _rms(yaw, chosen) for after, chosen in reached.items()},
        _rms(position, later),
        _rms(yaw, later),
        len(predicted),
        int(later.sum()),
    )


def error_over_time(windows: Sequence[Window], columns: Sequence[int]) -> tuple[Floats, Floats]:
    """Time since the start of the windows (s), and the root mean square error of pose columns at it."""
    since = np.concatenate([window.times - window.times[0] for window in windows])
    off = np.concatenate([(window.predicted - window.poses)[:, list(columns)] for window in windows])
    squared = np.sum(off**2, axis=1)
    bins = np.round(since / BIN).astype(int)
    known = np.unique(bins[bins > 0])
    return known * BIN, np.sqrt([float(np.mean(squared[bins == k])) for k in known])


def most_turning_log(windows: Sequence[Window]) -> str:
    """Name of the log that turns most: its headings change most, in sum, from beginning to end of its windows."""
    turns: dict[str, float] = {}
    for window in windows:
        yaw = np.unwrap(window.poses[:, 2])
        turns[window.log] = turns.get(window.log, 0.0) + abs(float(yaw[-1] - yaw[0]))
    return max(turns, key=lambda name: turns[name])


def _rms(values: Floats, chosen: Bools) -> float:
    return float(np.sqrt(np.mean(values[chosen] ** 2)))


def _pieces(whole: Part, part: Part, log: int, step: float, length: float) -> Iterator[Piece]:
    """Windows of a part, thinned from a whole one."""
    times = part.pose_times
    resting = begins_at_rest(part)
    begin = times[0] if resting else times[0] + HISTORY_MIN
    while times[-1] - begin >= WINDOW_MIN:
        first = int(np.searchsorted(times, begin - SAME_TIME))
        last = int(np.searchsorted(times, times[first] + length + 0.5 * step, side="right"))
        if last - first < 2:
            return
        seen = int(np.searchsorted(times, times[first] - length))
        if first == 0 or first - seen >= 2:
            segment = segment_between(part, log, step, seen, last, resting)
            yield Piece(segment, whole, float(times[first] - times[seen]), slice(first, last))
        begin = times[last - 1]


def _problem(segments: list[Segment], logs: int, parameters: Parameters, settings: Settings) -> Problem:
    return assemble(segments, logs, parameters, _noise(segments, parameters.vehicle, settings))


def _noise(segments: list[Segment], model: Vehicle, settings: Settings) -> NoiseModel:
    """Noise that the settings state, that of the poses measured from them if they do not."""
    noise = settings.noise or measured_noise(
        [s.part.pose_times[s.poses] for s in segments], [s.part.poses[s.poses] for s in segments]
    )
    return noise_model(model, settings, noise)


def _starts(
    pieces: Sequence[Piece],
    logs: int,
    parameters: Parameters,
    settings: Settings,
) -> Matrix:
    """(windows, nx) initial states of the windows."""
    model = parameters.vehicle
    rho = parameters.nominal
    start = np.zeros((len(pieces), len(model.state)))
    moving = np.array([p.known > 0.0 for p in pieces])
    histories = [_between(p, p.segment.poses.start, p.ahead.start + 1, settings.step) for p in pieces if p.known > 0.0]
    if histories:
        problem = _problem(histories, logs, parameters, settings)
        problem = replace(problem, noise=replace(problem.noise, process=HISTORY_PROCESS_FACTOR * problem.noise.process))
        point = starting_point(problem, smooth_chains(problem.chains), rho)
        optimum = optimise(FastGraph(problem), point, settings.iterations)
        start[moving] = optimum.point.states[problem.chains.first[1:] - 1]
    for k in np.flatnonzero(~moving):
        start[k] = _at_rest(parameters, rho, pieces[int(k)].segment.part.poses[0])
    return start


def _between(piece: Piece, first: int, last: int, step: float) -> Segment:
    """Segment of the piece's part from pose `first` to the pose before `last`."""
    segment = piece.segment
    return segment_between(segment.part, segment.log, step, first, last, segment.resting)


def _at_rest(parameters: Parameters, rho: Floats, pose: Floats) -> Floats:
    """State at rest with an observed pose."""
    model = parameters.vehicle
    lever, side, offset = ObservationModel(parameters).offsets(rho)
    yaw = pose[2] - offset
    c, s = np.cos(yaw), np.sin(yaw)
    state = np.zeros(len(model.state))
    found = {"x": pose[0] - lever * c + side * s, "y": pose[1] - lever * s - side * c, "theta": yaw}
    for name, number in found.items():
        if name in model.state:
            state[model.index(name)] = number
    return state


def process_noise(vehicle: Vehicle, growth: Floats, horizon: float) -> dict[str, float]:
    """Random walks of speed and turning, by component, that make errors as large as the model's at the horizon."""
    found = {}
    per_rate = math.sqrt(3.0 / horizon)  # a random walk of a rate, integrated: q sqrt(t^3 / 3)
    if (k := speed_index(vehicle)) >= 0:
        found[vehicle.state[k]] = float(growth[0]) * per_rate
    for name in vehicle.state:
        if name in YAW_RATES:
            found[name] = float(growth[2]) * per_rate
    if "theta" in vehicle.state and not set(YAW_RATES) & set(vehicle.state):
        found["theta"] = float(growth[2]) * math.sqrt(horizon)
    return found


def error_growth(vehicle: Vehicle, process: Floats, horizon: float) -> Floats:
    """(3,) growth of the error in x, y and yaw that process noise (nx,) leads to: the inverse of `process_noise`."""
    named = dict(zip(vehicle.state, map(float, process), strict=True))
    per_rate, per_position = math.sqrt(3.0 / horizon), math.sqrt(horizon)
    speed = speed_index(vehicle)
    moving = [float(process[speed]) / per_rate] if speed >= 0 else [named[k] / per_position for k in ("x", "y")]
    turning = [named[k] / per_rate for k in YAW_RATES if k in named] or [named.get("theta", 0.0) / per_position]
    return np.array([max(moving), max(moving), max(turning)])
