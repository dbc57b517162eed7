"""Acceptance of an identification: open-loop prediction before and after it, and objections to its parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kraft.sysid.prediction import Window, errors_of, windows

if TYPE_CHECKING:
    from kraft.logs.log import Log


from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from kraft.errors import InputError
from kraft.sysid.data import Split
from kraft.sysid.result import Identification, PredictionErrors, correlations
from kraft.sysid.settings import Settings
from kraft.vehicles.config import VehicleConfig
from ompl_ext.vehicle import Vehicle

ALIKE: Final = 1.01
"""Position errors within a hundredth of each other are alike, as when the initial values come from the same logs."""
FAR_WORSE: Final = 1.5
"""Factor from which the initial values are better beyond doubt.  What five logs of the bundled car say, where the
initial values come from forty, is up to 1.2 times worse by chance; a test of the scatter between windows would object
to a difference that does not matter if it is steady, and would need more windows than a few held-out logs have."""
SAME: Final = 0.99
"""Correlation from which two parameters cannot be told apart: the logs show what they do together, neither alone."""


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
