"""Vehicle models, each a derivative over tuples, and their loading; parameters are in `configs/vehicles/`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from ompl_ext.vehicle import Vehicle

CAR_CONTROLS: Final = ("throttle", "steering")


def is_car(vehicle: Vehicle) -> bool:
    """Whether the controls of a vehicle are throttle and steering."""
    return sorted(vehicle.controls) == sorted(CAR_CONTROLS)
