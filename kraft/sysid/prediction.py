"""Open-loop prediction of the model over windows of 3 s, and its errors after 1, 2 and 3 s.

The prediction of a window uses the commands and the poses up to its beginning; of later poses it uses only the measured
noise.  The first window of a part that begins at rest begins at its first pose, at rest; every other window begins at
the state that the graph, with fixed parameters, estimates from the 3 s before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from kraft.errors import Code, InputError
from kraft.sysid.chains import Segment, segment_between
from kraft.sysid.data import usable_logs
from kraft.sysid.fast_graph import FastGraph
from kraft.sysid.initial_values import smooth_chains
from kraft.sysid.observation import noise_model
from kraft.sysid.optimiser import optimise
from kraft.sysid.parameters import Parameters, auxiliary_parameters, parameters_of, vehicle_of
from kraft.sysid.problem import Problem, assemble, simulated, starting_point
from kraft.sysid.result import PredictionErrors
from kraft.sysid.selection import check_settings
from kraft.sysid.settings import Settings
from kraft.sysid.smoothing import begins_at_rest, constant_motion, measured_noise, thinned
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


WINDOW_LENGTH = 3.0
"""Length of a window, and of the history before it, s."""
HISTORY_PROCESS_FACTOR = 3.0
"""Process noise in the history of a window over that of an identification: the initial state shall follow the poses
even if the parameters are wrong."""
HISTORY_MIN, WINDOW_MIN = 0.5, 0.5
"""Least length of a history and of a window, s."""
RECENT = 0.3
"""Time before a window whose poses show its speed and turning rate, s."""
HORIZONS = (1.0, 2.0, 3.0)
"""Times after the beginning of a window at which errors are evaluated, s."""


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

    Parameters without a value have that of `settings`, else that of the vehicle; auxiliary parameters are 0.

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
    pieces = [(i, before, ahead) for i, _, before, ahead in _all_pieces(usable, settings)]
    problem = _problem([ahead for _, _, ahead in pieces], len(usable), parameters, settings)
    start = _starts(pieces, len(usable), parameters, settings)
    states = simulated(problem, start, problem.actuators.mean(parameters.nominal)[0], parameters.nominal)
    predicted = problem.observation.predict(problem.at_poses(states), parameters.nominal)
    ends = np.cumsum([len(ahead.part.pose_times[ahead.poses]) for _, _, ahead in pieces])[:-1]
    return tuple(
        Window(usable[i].name, ahead.part.pose_times[ahead.poses], ahead.part.poses[ahead.poses], part)
        for (i, _, ahead), part in zip(pieces, np.split(predicted, ends), strict=True)
    )


def constant_windows(
    vehicle: VehicleConfig | Vehicle, logs: Sequence[Log], settings: Settings | None = None
) -> tuple[Window, ...]:
    """Prediction of the windows of `predict_windows` without a model: constant speed and turning rate.

    Raises:
        InputError: if the logs cannot be used.
    """
    usable = usable_logs(vehicle_of(vehicle), logs)
    found = []
    for i, part, before, ahead in _all_pieces(usable, settings or Settings()):
        times, poses = ahead.part.pose_times[ahead.poses], ahead.part.poses[ahead.poses]
        seen = part.pose_times <= times[0] + 1e-9
        x, y, yaw, speed, rate = (
            (*poses[0], 0.0, 0.0)
            if before is None
            else constant_motion(part.pose_times[seen], part.poses[seen], RECENT)
        )
        since = times - times[0]
        middle = yaw + 0.5 * rate * since
        chord = speed * since * np.sinc(0.5 * rate * since / np.pi)
        predicted = np.column_stack([x + chord * np.cos(middle), y + chord * np.sin(middle), yaw + rate * since])
        found.append(Window(usable[i].name, times, poses, predicted))
    return tuple(found)


def _all_pieces(logs: Sequence[Log], settings: Settings) -> list[tuple[int, Part, Segment | None, Segment]]:
    """Log, part with all poses, history and window of each window.

    Raises:
        InputError: if there is none.
    """
    found = [
        (i, part, before, ahead)
        for i, log in enumerate(logs)
        for part in log.parts
        for before, ahead in _pieces(thinned(part, settings.step), i, settings.step)
    ]
    if not found:
        raise InputError.of("logs", "are all shorter than a second", "expected longer ones to predict", Code.DATA)
    return found


def prediction_errors(
    vehicle: VehicleConfig | Vehicle,
    logs: Sequence[Log],
    values: Mapping[str, float] | None = None,
    settings: Settings | None = None,
) -> PredictionErrors:
    """Root mean square errors over all windows of the logs with the parameters `values`, auxiliary ones included.

    Raises:
        InputError: as `windows`.
    """
    return window_errors(predict_windows(vehicle, logs, values, settings))


def window_errors(predicted: Sequence[Window]) -> PredictionErrors:
    """Root mean square errors of predicted windows."""
    since = np.concatenate([w.times - w.times[0] for w in predicted])
    # the pose interval of each window, so that windows with a lower pose rate count too
    interval = np.concatenate([np.full(len(w.times), np.median(np.diff(w.times))) for w in predicted])
    off = np.concatenate([w.predicted - w.poses for w in predicted])
    position, yaw = np.hypot(off[:, 0], off[:, 1]), off[:, 2]
    at = {after: np.abs(since - after) <= 0.75 * interval for after in HORIZONS}
    reached = {after: chosen for after, chosen in at.items() if chosen.any()}
    later = since > 0.0
    return PredictionErrors(
        {after: _rms(position, chosen) for after, chosen in reached.items()},
        {after: _rms(yaw, chosen) for after, chosen in reached.items()},
        _rms(position, later),
        _rms(yaw, later),
        len(predicted),
        int(later.sum()),
    )


def _rms(values: Floats, chosen: Bools) -> float:
    return float(np.sqrt(np.mean(values[chosen] ** 2)))


def _pieces(part: Part, log: int, step: float) -> Iterator[tuple[Segment | None, Segment]]:
    """History of each window (None if it begins at rest), and the window."""
    times = part.pose_times
    resting = begins_at_rest(part)
    begin = times[0] if resting else times[0] + HISTORY_MIN
    while times[-1] - begin >= WINDOW_MIN:
        first = int(np.searchsorted(times, begin - 1e-9))
        last = int(np.searchsorted(times, times[first] + WINDOW_LENGTH + 0.5 * step, side="right"))
        if last - first < 2:
            return
        ahead = segment_between(part, log, step, first, last, resting)
        seen = int(np.searchsorted(times, times[first] - WINDOW_LENGTH))
        if first == 0:
            yield None, ahead
        elif first - seen >= 2:
            yield segment_between(part, log, step, seen, first + 1, resting), ahead
        begin = times[last - 1]


def _problem(segments: list[Segment], logs: int, parameters: Parameters, settings: Settings) -> Problem:
    noise = settings.noise or measured_noise(
        [s.part.pose_times[s.poses] for s in segments], [s.part.poses[s.poses] for s in segments]
    )
    return assemble(segments, logs, parameters, noise_model(parameters.vehicle, settings, noise))


def _starts(
    pieces: Sequence[tuple[int, Segment | None, Segment]],
    logs: int,
    parameters: Parameters,
    settings: Settings,
) -> Matrix:
    """(windows, nx) initial states of the windows."""
    model = parameters.vehicle
    rho = parameters.nominal
    start = np.zeros((len(pieces), len(model.state)))
    histories = [before for _, before, _ in pieces if before is not None]
    if histories:
        problem = _problem(histories, logs, parameters, settings)
        problem = replace(problem, noise=replace(problem.noise, process=HISTORY_PROCESS_FACTOR * problem.noise.process))
        point = starting_point(problem, smooth_chains(problem.chains), rho)
        optimum = optimise(FastGraph(problem), point, settings.iterations)
        moving = np.array([before is not None for _, before, _ in pieces])
        start[moving] = optimum.point.states[problem.chains.first[1:] - 1]
    for row, (_, before, ahead) in zip(start, pieces, strict=True):
        if before is None:
            row[:] = _at_rest(model, parameters, ahead.part.poses[0])
    return start


def _at_rest(model: Vehicle, parameters: Parameters, pose: Floats) -> Floats:
    """State at rest with an observed pose."""
    lever, side, offset = (
        float(parameters.nominal[k]) if (k := parameters.auxiliary_index(name)) >= 0 else 0.0
        for name in ("lever", "side", "yaw_offset")
    )
    yaw = pose[2] - offset
    c, s = np.cos(yaw), np.sin(yaw)
    state = np.zeros(len(model.state))
    found = {"x": pose[0] - lever * c + side * s, "y": pose[1] - lever * s - side * c, "theta": yaw}
    for name, number in found.items():
        if name in model.state:
            state[model.index(name)] = number
    return state
