"""How far the model's open-loop prediction is off after 1, 2 and 3 s.

A window's prediction knows the commands, and the poses up to its beginning, no later ones (but for how noisy they
are).  A part that begins at rest begins its first window there, at its first pose; every other window begins at the
state that the graph, with the parameters held, makes of the three seconds before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.errors import InputError
from kraft.sysid.chains import Stretch, between
from kraft.sysid.data import Split, usable_logs
from kraft.sysid.fast_graph import FastGraph
from kraft.sysid.observation import noise_model
from kraft.sysid.optimiser import optimise
from kraft.sysid.parameters import Parameters, extras_of, parameters_of, vehicle_of
from kraft.sysid.problem import Problem, assemble, simulated, starting_point
from kraft.sysid.result import Identification, PredictionErrors, correlations
from kraft.sysid.selection import check_settings
from kraft.sysid.settings import Settings
from kraft.sysid.smoothing import begins_at_rest, measured_noise
from kraft.sysid.start import smooth
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Bools, Floats, Matrix
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log, Part


LENGTH = 3.0
"""Of a window, s; and of what is seen before it."""
BELIEF = 3.0
"""Process noise of what is seen before a window, in that of an identification: a start shall follow the poses even
where the parameters are wrong."""
LEAST_HISTORY, LEAST_LENGTH = 0.5, 0.5
"""s"""
AFTER = (1.0, 2.0, 3.0)
"""When errors are taken, s after a window's beginning."""


@dataclass(frozen=True, eq=False)
class Window:
    """A stretch of at most 3 s that was predicted from its start."""

    log: str
    times: Floats
    """(n,) of the poses, s, as in the log"""
    poses: Matrix
    """(n, 3) observed"""
    predicted: Matrix
    """(n, 3)"""


def windows(
    vehicle: VehicleConfig | Vehicle,
    logs: Sequence[Log],
    values: Mapping[str, float] | None = None,
    settings: Settings | None = None,
) -> tuple[Window, ...]:
    """Predict every window of the logs with the parameters and extras `values`.

    Those that are not among them have the value that `settings` gives them, else the vehicle's, and extras are nothing.

    Raises:
        InputError: if the logs cannot be used, or `values` has a parameter that does not exist.
    """
    settings = settings or Settings()
    values = {**settings.values, **(values or {})}
    model = vehicle_of(vehicle)
    extras = tuple(name for name in extras_of(model) if values.get(name, 0.0) != 0.0)
    given = replace(settings, values=values, frozen=(*model.parameters, *extras), extras="auto")
    check_settings(vehicle, given)
    parameters = parameters_of(vehicle, given, extras)
    usable = usable_logs(model, logs)
    pieces = [
        (i, before, ahead)
        for i, log in enumerate(usable)
        for part in log.parts
        for before, ahead in _pieces(part, i, settings.step)
    ]
    if not pieces:
        raise InputError.of("logs", "are all shorter than a second", "expected longer ones to predict")
    problem = _problem([ahead for _, _, ahead in pieces], len(usable), parameters, settings)
    start = _starts(pieces, len(usable), parameters, settings)
    states = simulated(problem, start, problem.commands.mean(parameters.nominal)[0], parameters.nominal)
    predicted = problem.observation.predict(problem.between(states), parameters.nominal)
    ends = np.cumsum([len(ahead.part.pose_times[ahead.poses]) for _, _, ahead in pieces])[:-1]
    return tuple(
        Window(usable[i].name, ahead.part.pose_times[ahead.poses], ahead.part.poses[ahead.poses], part)
        for (i, _, ahead), part in zip(pieces, np.split(predicted, ends), strict=True)
    )


def prediction_errors(
    vehicle: VehicleConfig | Vehicle,
    logs: Sequence[Log],
    values: Mapping[str, float] | None = None,
    settings: Settings | None = None,
) -> PredictionErrors:
    """Root mean square errors over all windows of the logs with the parameters and extras `values`.

    Raises:
        InputError: as `windows`.
    """
    return errors_of(windows(vehicle, logs, values, settings))


def errors_of(predicted: Sequence[Window]) -> PredictionErrors:
    """Root mean square errors of windows that were predicted."""
    since = np.concatenate([w.times - w.times[0] for w in predicted])
    # of each window's own poses, lest those seen less often than most be missed
    interval = np.concatenate([np.full(len(w.times), np.median(np.diff(w.times))) for w in predicted])
    off = np.concatenate([w.predicted - w.poses for w in predicted])
    position, yaw = np.hypot(off[:, 0], off[:, 1]), off[:, 2]
    at = {after: np.abs(since - after) <= 0.75 * interval for after in AFTER}
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


def _pieces(part: Part, log: int, step: float) -> Iterator[tuple[Stretch | None, Stretch]]:
    """What is seen before each window (None: it begins at rest), and the window."""
    times = part.pose_times
    resting = begins_at_rest(part)
    begin = times[0] if resting else times[0] + LEAST_HISTORY
    while times[-1] - begin >= LEAST_LENGTH:
        first = int(np.searchsorted(times, begin - 1e-9))
        last = int(np.searchsorted(times, times[first] + LENGTH + 0.5 * step, side="right"))
        if last - first < 2:
            return
        ahead = between(part, log, step, first, last, resting)
        seen = int(np.searchsorted(times, times[first] - LENGTH))
        if first == 0:
            yield None, ahead
        elif first - seen >= 2:
            yield between(part, log, step, seen, first + 1, resting), ahead
        begin = times[last - 1]


def _problem(stretches: list[Stretch], logs: int, parameters: Parameters, settings: Settings) -> Problem:
    noise = settings.noise or measured_noise(
        [s.part.pose_times[s.poses] for s in stretches], [s.part.poses[s.poses] for s in stretches]
    )
    return assemble(stretches, logs, parameters, noise_model(parameters.vehicle, settings, noise))


def _starts(
    pieces: Sequence[tuple[int, Stretch | None, Stretch]],
    logs: int,
    parameters: Parameters,
    settings: Settings,
) -> Matrix:
    """(windows, nx) states at which the windows begin."""
    model = parameters.vehicle
    rho = parameters.nominal
    start = np.zeros((len(pieces), len(model.state)))
    histories = [before for _, before, _ in pieces if before is not None]
    if histories:
        problem = _problem(histories, logs, parameters, settings)
        problem = replace(problem, noise=replace(problem.noise, process=BELIEF * problem.noise.process))
        point = starting_point(problem, smooth(problem.chains), rho)
        optimum = optimise(FastGraph(problem), point, settings.iterations)
        moving = np.array([before is not None for _, before, _ in pieces])
        start[moving] = optimum.point.states[problem.chains.first[1:] - 1]
    for row, (_, before, ahead) in zip(start, pieces, strict=True):
        if before is None:
            row[:] = _at_rest(model, parameters, ahead.part.poses[0])
    return start


def _at_rest(model: Vehicle, parameters: Parameters, pose: Floats) -> Floats:
    """State at rest that shows an observed pose."""
    lever, side, offset = (
        float(parameters.nominal[k]) if (k := parameters.extra(name)) >= 0 else 0.0
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


@dataclass(frozen=True)
class Forecast:
    """Windows of the same logs, predicted with the identified parameters and with those before."""

    after: tuple[Window, ...]
    before: tuple[Window, ...]

    @cached_property
    def errors(self) -> PredictionErrors:
        """Of the identified parameters."""
        return errors_of(self.after)

    @cached_property
    def errors_before(self) -> PredictionErrors:
        """Of those before."""
        return errors_of(self.before)


@dataclass(frozen=True)
class Predicted:
    """Forecasts of the logs that were fitted, and of those held out if there are any that can be predicted.

    Attributes:
        fitted: of the logs that were fitted.
        held_out: of those held out, None if there are none or none can be predicted.
        warnings: that the initial values predict better, which held-out logs cannot be predicted, and why.
    """

    fitted: Forecast
    held_out: Forecast | None
    warnings: tuple[str, ...] = ()


def predicted(vehicle: VehicleConfig | Vehicle, parted: Split, result: Identification, settings: Settings) -> Predicted:
    """Predict every log.

    Held-out logs that cannot be predicted leave the fit as it is: that it could not be tested is a warning.

    Raises:
        InputError: if the fitted logs are too short to predict anything.
    """

    def forecast(logs: tuple[Log, ...]) -> Forecast:
        return Forecast(windows(vehicle, logs, result.values, settings), windows(vehicle, logs, {}, settings))

    fitted = forecast(parted.fitted)
    if not parted.held_out:
        return Predicted(fitted, None)
    try:
        unseen = forecast(parted.held_out)
    except InputError as error:
        why = "; ".join(f"{problem.file} {problem.problem}" for problem in error.diagnostics)
        said = f"the fit is not tested: the {len(parted.held_out)} held out cannot be predicted ({why})"
        return Predicted(fitted, None, (said,))
    return Predicted(fitted, unseen, (*no_better(unseen), *_missed(parted.held_out, unseen)))


def _missed(logs: tuple[Log, ...], forecast: Forecast) -> tuple[str, ...]:
    """That some logs are too short for a window, if there are such."""
    predicted = {window.log for window in forecast.after}
    missed = [log.name for log in logs if log.name not in predicted]
    return (f"held out, but too short to be predicted: {', '.join(missed)}",) if missed else ()


ALIKE: Final = 1.01
"""Position errors within a hundredth of each other are alike, as when the initial values come from the same logs."""
FAR_WORSE: Final = 1.5
"""Factor from which the initial values are better beyond doubt.  What five logs of the bundled car say, where the
initial values come from forty, is up to 1.2 times worse by chance; a test of the scatter between windows would object
to a difference that does not matter if it is steady, and would need more windows than a few held-out logs have."""


def no_better(forecast: Forecast) -> tuple[str, ...]:
    """The warning that the initial values predict better, if they do."""
    if _ratio(forecast) <= ALIKE:
        return ()
    return (
        f"the identified values predict held-out logs no better than the initial values do ({_errors(forecast)}): "
        "look for logs of another floor, slope, load or car and leave them out, record more logs, or choose "
        "a model that has what these lack; --plot shows the prediction",
    )


def far_worse(forecast: Forecast) -> tuple[str, ...]:
    """The objection that the initial values predict far better, as part of a sentence, if they do."""
    if _ratio(forecast) < FAR_WORSE:
        return ()
    return (f"held-out logs are predicted far better with the initial values ({_errors(forecast)})",)


def _ratio(forecast: Forecast) -> float:
    """Position error of the identified values in that of the initial ones."""
    after, before = forecast.errors.overall_position, forecast.errors_before.overall_position
    return after / max(before, 1e-12)


def _errors(forecast: Forecast) -> str:
    after, before = forecast.errors.overall_position, forecast.errors_before.overall_position
    return f"position {100 * after:.2f} cm identified, {100 * before:.2f} cm initial"


SAME: Final = 0.99
"""Correlation from which two parameters cannot be told apart: the logs show what they do together, neither alone."""


def objections(identification: Identification, predicted: Predicted) -> tuple[str, ...]:
    """Why the parameters are not identified, as parts of a sentence; nothing if they are."""
    found = [] if identification.converged else ["the fit did not converge"]
    if not identification.names:
        found.append("every parameter that is left is frozen, and the data show no other")
    hidden = [name for name in identification.unidentified if name not in identification.extras]
    if hidden:
        found.append(f"the logs do not show {', '.join(hidden)}")
    found += [f"{a} and {b} cannot be told apart" for a, b in _pairs(identification)]
    return (*found, *(() if predicted.held_out is None else far_worse(predicted.held_out)))


def _pairs(identification: Identification) -> list[tuple[str, str]]:
    """Pairs of parameters that are one by the stated noise; how far the logs differ says nothing about that."""
    names, alike = identification.names, np.abs(correlations(identification.graph_covariance)) > SAME
    rows, columns = np.nonzero(np.triu(alike, 1))
    return [(names[i], names[j]) for i, j in zip(rows, columns, strict=True)]
