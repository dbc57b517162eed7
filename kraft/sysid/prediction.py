"""How far the model's open-loop prediction is off after 1, 2 and 3 s, from poses up to a window's start only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from kraft.errors import Defect
from kraft.sysid.result import PredictionErrors
from kraft.sysid.settings import Settings
from kraft.vehicle_config import VehicleConfig
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs import Log


@dataclass(frozen=True)
class Window:
    """A stretch of at most 3 s that was predicted from its start."""

    log: str
    times: Floats
    """(n,) of the poses, s, as in the log"""
    poses: Floats
    """(n, 3) observed"""
    predicted: Floats
    """(n, 3)"""


def windows(
    vehicle: VehicleConfig | Vehicle, logs: Sequence[Log], values: Mapping[str, float], settings: Settings | None = None
) -> tuple[Window, ...]:
    """Predict every window of the logs with the parameters and extras `values` (by default the vehicle's)."""
    raise Defect("windows is not written yet")


def prediction_errors(
    vehicle: VehicleConfig | Vehicle, logs: Sequence[Log], values: Mapping[str, float], settings: Settings | None = None
) -> PredictionErrors:
    """Root mean square errors over all windows of the logs with the parameters and extras `values`."""
    raise Defect("prediction_errors is not written yet")
