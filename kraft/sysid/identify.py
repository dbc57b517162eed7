"""Identify a vehicle from logs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from kraft.errors import Defect
from kraft.sysid.result import Identification
from kraft.sysid.settings import Settings
from kraft.vehicle_config import VehicleConfig
from ompl_ext.vehicle import Vehicle

if TYPE_CHECKING:
    from kraft.logs import Log


def identify(vehicle: VehicleConfig | Vehicle, logs: Sequence[Log], settings: Settings | None = None) -> Identification:
    """Estimate the parameters of a vehicle from logs.

    Args:
        vehicle: a vehicle file, whose parameters have bounds and priors, or a vehicle from code, which gets wide ones.
        logs: what `kraft.logs.read_logs` returns; the sandwich interval treats them as independent of each other.
        settings: by default what suits most logs.

    Raises:
        InputError: if the logs cannot be used (no motion, controls that the vehicle does not have), or a setting names
            a parameter that does not exist.
    """
    raise Defect("identify is not written yet")
