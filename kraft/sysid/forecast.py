"""What the identified parameters predict, beside what those before them did, on fitted and on held-out logs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from kraft.sysid.holdout import Split
from kraft.sysid.prediction import Window, errors_of, windows
from kraft.sysid.result import Identification, PredictionErrors
from kraft.sysid.settings import Settings
from kraft.vehicle_config import VehicleConfig
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs.log import Log


@dataclass(frozen=True)
class Forecast:
    """Windows of the same logs, predicted with the identified parameters and with those before."""

    after: tuple[Window, ...]
    before: tuple[Window, ...]

    @property
    def errors(self) -> PredictionErrors:
        """Of the identified parameters."""
        return errors_of(self.after)

    @property
    def errors_before(self) -> PredictionErrors:
        """Of those before."""
        return errors_of(self.before)


@dataclass(frozen=True)
class Predicted:
    """Forecasts of the logs that were fitted, and of those held out if there are any."""

    fitted: Forecast
    held_out: Forecast | None


def predicted(vehicle: VehicleConfig | Vehicle, parted: Split, result: Identification, settings: Settings) -> Predicted:
    """Predict every log.

    Raises:
        InputError: if the logs are too short to predict anything.
    """

    def forecast(logs: tuple[Log, ...]) -> Forecast:
        return Forecast(windows(vehicle, logs, result.values, settings), windows(vehicle, logs, {}, settings))

    return Predicted(forecast(parted.fitted), forecast(parted.held_out) if parted.held_out else None)
