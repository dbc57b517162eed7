"""Choice of a model for the logs of a car: known models and the car with terms, by what they predict of other logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from kraft.errors import InputError, NegativeResult
from kraft.sysid.base_vehicle import BaseVehicle, for_commands, load_base_vehicle, with_speed
from kraft.sysid.data import usable_logs
from kraft.sysid.identify import identify, identify_terms
from kraft.sysid.optimiser import OnIteration, ignore_iteration
from kraft.sysid.prediction import HORIZONS, predict_windows, window_errors
from kraft.sysid.result import Identification, ModelTrial
from kraft.sysid.settings import Settings
from kraft.sysid.smoothing import thinned
from kraft.vehicles.config import VehicleConfig
from ompl_ext.arrays import Floats, Matrix

if TYPE_CHECKING:
    from kraft.logs.log import Log


CARS: Final = ("car-lag", "car")
"""The car with terms, and the same with fewer states."""
KNOWN: Final = ("mushr-drive", "mushr-lag")
"""Models that are compared with it, the simplest last."""
KNOWN_ITERATIONS: Final = 25
"""Iterations within which a model converges on logs of a car that it describes."""


@dataclass(frozen=True)
class CarModel:
    """The chosen model of a car with its parameters, and the models that it was chosen from."""

    base: BaseVehicle
    identification: Identification


@dataclass(frozen=True, eq=False)
class _Candidate:
    model: CarModel
    errors: Matrix
    """(logs, horizons) of logs that it was not fitted to, m"""

    @property
    def scores(self) -> Floats:
        """(logs,) mean of the errors over their time, m/s."""
        scores: Floats = np.nanmean(self.errors / np.array(HORIZONS), axis=1)
        return scores


def models_of_cars() -> tuple[str, ...]:
    """Names of all models that are compared."""
    return (*CARS, *KNOWN)


def identify_car(
    logs: Sequence[Log], settings: Settings | None = None, on_iteration: OnIteration = ignore_iteration
) -> CarModel:
    """Identify a car with the model that predicts logs best that it was not fitted to.

    Args:
        logs: with the commands throttle and steering, in any unit, forward and left positive.
        settings: None for the defaults.
        on_iteration: called after each iteration with the number of iterations and the cost.

    Raises:
        InputError: if the logs cannot be used, or a command never changes in them.
    """
    settings = settings or Settings()
    found = [_with_terms(logs, settings, on_iteration)]
    for name in KNOWN:
        known = _known(name, logs, settings, on_iteration)
        found += [known] if known is not None else []
    judged = [_judged(model, logs, settings) for model in found]
    best = judged[0]
    for other in judged[1:]:
        if other.scores.mean() < best.scores.mean():
            best = other
    models = tuple(_trial(candidate, chosen=candidate is best) for candidate in judged)
    return replace(best.model, identification=replace(best.model.identification, models=models))


def _with_terms(logs: Sequence[Log], settings: Settings, on_iteration: OnIteration) -> CarModel:
    """The car with the terms that the logs need, commands in the range of the logs."""
    cars = [for_commands(load_base_vehicle(name), logs) for name in CARS]
    definitions = [each.definition for each in cars if isinstance(each.definition, VehicleConfig)]
    choice = identify_terms(definitions[0], logs, settings, on_iteration, definitions[1])
    base = next(each for each in cars if each.definition is choice.vehicle)
    return CarModel(with_speed(base, choice.identification, logs), choice.identification)


def _known(name: str, logs: Sequence[Log], settings: Settings, on_iteration: OnIteration) -> CarModel | None:
    """A known model; None if it does not describe the logs, or has other parameters than the settings name."""
    base = load_base_vehicle(name)
    if not {*settings.values, *settings.frozen} <= set(base.vehicle.parameters):
        return None
    less = [replace(log, parts=tuple(thinned(part, settings.step) for part in log.parts)) for log in logs]
    try:
        found = identify(base.definition, less, replace(settings, iterations=KNOWN_ITERATIONS), on_iteration)
    except (InputError, NegativeResult):  # a singular fit: the commands are not in this model's units
        return None
    return CarModel(base, found) if found.converged else None


def _judged(model: CarModel, logs: Sequence[Log], settings: Settings) -> _Candidate:
    """Errors of each log, predicted with the parameters that the others give."""
    identification = model.identification
    settings = identification.predicting(settings)
    values = identification.without_log
    errors = []
    for i, log in enumerate(usable_logs(model.base.vehicle, logs)):
        own = values[i] if len(values) == len(logs) else identification.values
        found = window_errors(predict_windows(model.base.definition, [log], own, settings))
        errors.append([found.position.get(after, np.nan) for after in HORIZONS])
    return _Candidate(model, np.array(errors))


def _trial(candidate: _Candidate, *, chosen: bool) -> ModelTrial:
    errors = dict(zip(HORIZONS, map(float, np.nanmean(candidate.errors, axis=0)), strict=True))
    identification = candidate.model.identification
    on = next((trial.terms for trial in identification.trials if trial.chosen), identification.auxiliary)
    return ModelTrial(candidate.model.base.name, on, "", errors, chosen)
