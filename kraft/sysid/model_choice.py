"""Choice of a car's model among known ones and the car with terms, by errors on logs that each was not fitted to."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.errors import InputError, NegativeResult
from kraft.sysid.base_vehicle import (
    BaseVehicle,
    for_commands,
    for_turns,
    for_wheelbase,
    load_base_vehicle,
    with_backward_commands,
    with_coasting,
    with_speed,
)
from kraft.sysid.checks import SteeringInMotion
from kraft.sysid.data import check_any, usable_logs
from kraft.sysid.fit_progress import OnIteration, ignore_iteration
from kraft.sysid.identify import identify
from kraft.sysid.interface import Identification, ModelTrial, Settings
from kraft.sysid.parallel import begin, in_parallel
from kraft.sysid.parameters import auxiliary_parameters
from kraft.sysid.prediction import HORIZONS, is_predictable, predict_windows, window_errors
from kraft.sysid.selection import candidates_of
from kraft.sysid.smoothing import thinned
from kraft.sysid.structure_choice import CLEARLY_WORSE
from kraft.sysid.terms import check_controls, errors_of_all_terms, identify_terms
from kraft.text import MessageSink, counted, no_messages
from kraft.vehicles import CAR_CONTROLS, WHEELBASE
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Log


CARS: Final = ("car-lag", "car")
"""The car with terms, and the same with fewer states."""
KNOWN: Final = ("mushr-drive", "mushr-lag")
"""Models that are compared with it, the simplest last."""
MODELS: Final = 1 + len(KNOWN)
"""Number of the models that are compared."""
SCREENING_LOGS: Final = 2
"""Least number of logs that a known model is first fitted to, and number of others that it then predicts."""
SCREENING_TIME: Final = 60.0
"""Least duration of the logs that it is first fitted to, s."""
SCREENING_PIECE: Final = 10.0
"""Length of the pieces of a long log that it is first fitted to, s."""
SCREENING_FACTOR: Final = 4.0
"""Error of these predictions over that of the car with terms from which a known model is not fitted to all logs."""
KNOWN_ITERATIONS, SCREENING_ITERATIONS = 25, 12
"""Iterations within which a model converges on logs of a car that it describes, and within which it nearly does."""


@dataclass(frozen=True)
class IdentifiedCar:
    """The chosen model of a car with its parameters, and the models that it was chosen from."""

    base: BaseVehicle
    identification: Identification


@dataclass(frozen=True, eq=False)
class _Candidate:
    model: IdentifiedCar
    errors: Matrix
    """(logs, horizons) of logs that it was not fitted to, m; NaN where a log is too short to predict"""
    on_fitted: bool = False
    """whether they are of the logs that it was fitted to instead"""

    def score(self, logs: Sequence[int] | slice = slice(None)) -> float:
        """Mean of the errors of some logs over their time, m/s; infinite if none of them was predicted."""
        rates = self.errors[logs] / np.array(HORIZONS)
        rates = rates[~np.isnan(rates).all(axis=1)]
        return float(np.nanmean(rates, axis=1).mean()) if len(rates) else math.inf


def models_of_cars() -> tuple[str, ...]:
    """Names of all models that are compared."""
    return (*CARS, *KNOWN)


def identify_car(
    logs: Sequence[Log],
    settings: Settings | None = None,
    on_iteration: OnIteration = ignore_iteration,
    on_stage: MessageSink = no_messages,
) -> IdentifiedCar:
    """Identify a car with the model that predicts logs best that it was not fitted to.

    Args:
        logs: with the commands throttle and steering, in any unit, forward and left positive.
        settings: None for the defaults.
        on_iteration: called after each iteration of each fit.
        on_stage: called before each stage with what is fitted: which model of how many, and of the car with terms what
            is chosen.

    Raises:
        InputError: if the logs cannot be used, or a command never changes in them.
    """
    settings = settings or Settings()
    check_any(logs)
    check_controls(logs, SteeringInMotion.of(logs))
    screening = begin(lambda names: [_screened(name, logs, settings) for name in names], KNOWN)
    car = _with_terms(logs, settings, on_iteration, on_stage)
    judged, refused, missing = [_judged(car, logs, settings)], list[_Candidate](), list[str]()
    comparable = len(judged[0].errors) == len(logs)  # else the car has no errors of the logs that tell
    for number, (name, screened) in enumerate(zip(KNOWN, screening.result(), strict=True), 2):
        if comparable and screened is not None and screened.score() > SCREENING_FACTOR * judged[0].score(_tests(logs)):
            refused.append(screened)
            continue
        on_stage(f"model {number} of {MODELS}, {name}")
        known = _known(name, logs, replace(settings, iterations=KNOWN_ITERATIONS), on_iteration)
        if isinstance(known, str):
            missing.append(f"{name} is not among the compared models: {known}")
        else:
            judged.append(_judged(known, logs, settings))
    best = judged[0]
    for other in judged[1:]:
        if other.score() < best.score():
            best = other
    models = tuple(_trial(candidate, chosen=candidate is best) for candidate in (*judged, *refused))
    found = best.model.identification
    return replace(best.model, identification=replace(found, models=models, notes=(*found.notes, *missing)))


def _by_variety(logs: Sequence[Log]) -> list[int]:
    """Indices of the logs, those first whose commands vary most: straight drives show nothing of the steering."""
    columns = [[log.controls.index(name) for name in CAR_CONTROLS] for log in logs]
    joined = [np.concatenate([p.commands[:, own] for p in log.parts]) for log, own in zip(logs, columns, strict=True)]
    full = np.maximum(np.std(np.concatenate(joined), axis=0), 1e-9)
    variety = [float(np.min(np.std(commands, axis=0) / full)) for commands in joined]
    return sorted(range(len(logs)), key=lambda k: -variety[k])


def _fits(logs: Sequence[Log]) -> list[int]:
    """Indices of the logs that known models are first fitted to; none if they would be more than a third of all."""
    order = _by_variety(logs)
    time = np.cumsum([logs[k].duration for k in order])
    count = max(SCREENING_LOGS, int(np.searchsorted(time, SCREENING_TIME)) + 1)
    return order[:count] if 3 * count <= len(logs) else []


def _tests(logs: Sequence[Log]) -> list[int]:
    """Indices of the logs that they then predict."""
    first = len(_fits(logs))
    return _by_variety(logs)[first : first + SCREENING_LOGS]


def _screened(name: str, logs: Sequence[Log], settings: Settings) -> _Candidate | None:
    """A known model fitted to few logs, and its errors on others; None if there are few, or if it does not fit.

    All of its auxiliary parameters are on: which of them are needed makes little difference to predictions.
    """
    first = _fits(logs)
    fitted = [_sampled(logs[k], SCREENING_TIME / len(first)) for k in first]
    every = candidates_of(load_base_vehicle(name).vehicle, settings)
    less = replace(settings, auxiliary=every, iterations=SCREENING_ITERATIONS)
    if not fitted:
        return None
    known = _known(name, fitted, less, ignore_iteration, converged=False)
    if isinstance(known, str):
        return None
    identification = replace(known.identification, without_log=())
    try:
        judged = _judged(replace(known, identification=identification), [logs[k] for k in _tests(logs)], settings)
    except InputError:  # nothing moves in these logs
        return None
    return replace(judged, on_fitted=False)  # they are others


def _sampled(log: Log, seconds: float) -> Log:
    """Pieces of a long log, evenly spread, of `seconds` s together; a shorter log as it is."""
    share = seconds / max(log.duration, 1e-9)
    if share >= 1.0:
        return log
    pieces = []
    for part in log.parts:
        count = max(1, round(share * part.duration / SCREENING_PIECE))
        apart = part.duration / count
        for k in range(count):
            begin = part.pose_times[0] + (k + 0.5 - 0.5 * share) * apart
            own = slice(*np.searchsorted(part.pose_times, (begin, begin + share * apart)))
            pieces.append(replace(part, pose_times=part.pose_times[own].copy(), poses=part.poses[own].copy()))
    return replace(log, parts=tuple(piece for piece in pieces if len(piece.pose_times)))


def _with_terms(
    logs: Sequence[Log], settings: Settings, on_iteration: OnIteration, on_stage: MessageSink
) -> IdentifiedCar:
    """The car with the terms that the logs need, commands in the range of the logs."""
    cars = [for_commands(load_base_vehicle(name), logs) for name in CARS]
    if WHEELBASE in settings.values:
        cars = [for_wheelbase(each, settings.values[WHEELBASE]) for each in cars]
    else:
        on_stage(f"model 1 of {MODELS}, {CARS[0]}, its wheelbase")
        cars = with_wheelbase(cars, logs, settings, on_iteration)
    definitions = _definitions(cars)
    on_stage(f"model 1 of {MODELS}, {CARS[0]}, the terms that the logs need")
    choice = identify_terms(definitions[0], logs, settings, on_iteration, definitions[1])
    base = next(each for each in cars if each.definition is choice.vehicle)
    return IdentifiedCar(with_coasting(with_speed(base, choice.identification, logs)), choice.identification)


def with_wheelbase(
    cars: Sequence[BaseVehicle],
    logs: Sequence[Log],
    settings: Settings,
    on_iteration: OnIteration = ignore_iteration,
) -> list[BaseVehicle]:
    """The cars with the wheelbase that suits the turns of the logs, or as they are if they predict clearly better.

    Understeer and lags make turns wide.  A wheelbase that is chosen for wide turns is too long, and then the tangent
    of the wheel angle bends where that of the car does not.  To predict clearly better is to do so in all folds
    together and in most of them: what the other folds say of a term is to first order, and in one it may be far off.
    """
    suited = [for_turns(each, logs) for each in cars]
    if all(each is before for each, before in zip(suited, cars, strict=True)):
        return list(cars)
    stated, chosen = (
        errors_of_all_terms(_definitions(each)[0], logs, settings, on_iteration) for each in (cars, suited)
    )
    better = np.nanmean(stated) / np.nanmean(chosen), np.nanmedian(stated / chosen)
    return list(cars) if max(better) < 1.0 - CLEARLY_WORSE else suited


def _definitions(cars: Sequence[BaseVehicle]) -> list[VehicleConfig]:
    """Vehicle files of the cars."""
    return [each.definition for each in cars if isinstance(each.definition, VehicleConfig)]


def _known(
    name: str, logs: Sequence[Log], settings: Settings, on_iteration: OnIteration, *, converged: bool = True
) -> IdentifiedCar | str:
    """A known model, fitted; the reason if that is impossible, or with `converged` if its fit does not converge."""
    base = load_base_vehicle(name)
    own = {*base.vehicle.parameters, *auxiliary_parameters(base.vehicle)}
    if others := [each for each in dict.fromkeys((*settings.values, *settings.frozen)) if each not in own]:
        return f"it has no parameter {', '.join(others)}"
    less = [replace(log, parts=tuple(thinned(part, settings.step) for part in log.parts)) for log in logs]
    try:
        found = identify(base.definition, less, settings, on_iteration)
    except (InputError, NegativeResult) as error:  # a singular fit: the commands are not in this model's units
        return f"its fit failed: {'; '.join(each.problem for each in error.diagnostics) or error}"
    if converged and not found.converged:
        return f"its fit did not converge within {counted(settings.iterations, 'iteration')}"
    return IdentifiedCar(with_backward_commands(base, logs), found)


def _judged(model: IdentifiedCar, logs: Sequence[Log], settings: Settings) -> _Candidate:
    """Errors of each usable log, predicted with the parameters that the others give; NaN of one too short for that.

    Where there are too few logs for that, it is predicted with the parameters that all of them give.
    """
    identification = model.identification
    settings = identification.predicting(settings)
    usable = usable_logs(model.base.vehicle, logs)
    others = identification.without_log
    on_fitted = len(others) != len(usable)
    values = [identification.values] * len(usable) if on_fitted else others

    def errors(log: Log, own: Mapping[str, float]) -> list[float]:
        found: Mapping[float, float] = {}
        if is_predictable(log, settings):
            found = window_errors(predict_windows(model.base.definition, [log], own, settings)).position
        return [found.get(after, np.nan) for after in HORIZONS]

    found = np.array(in_parallel(lambda each: errors(*each), zip(usable, values, strict=True)))
    return _Candidate(model, found, on_fitted)


def _trial(candidate: _Candidate, *, chosen: bool) -> ModelTrial:
    errors = {
        after: float(np.nanmean(of_logs))
        for after, of_logs in zip(HORIZONS, candidate.errors.T, strict=True)
        if not np.isnan(of_logs).all()
    }
    identification = candidate.model.identification
    on = next((trial.terms for trial in identification.trials if trial.chosen), identification.auxiliary)
    return ModelTrial(candidate.model.base.name, on, "", errors, chosen, on_fitted=candidate.on_fitted)
