"""What the identified parameters predict, beside what those before them did, on fitted and on held-out logs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from kraft.errors import InputError
from kraft.sysid.comparison import no_better
from kraft.sysid.holdout import Split
from kraft.sysid.prediction import Window, errors_of, windows
from kraft.sysid.result import Identification, PredictionErrors
from kraft.sysid.settings import Settings
from kraft.vehicles.config import VehicleConfig
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log


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
