"""Vehicle models, each a derivative over tuples, and their loading; parameters are in `configs/vehicles/`.

Here is what all of them have in common: whether a vehicle is a car, the units of controls where it states them, the
longest delay of commands, and the force by a slope of the floor.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from kraft.errors import Code, InputError

if TYPE_CHECKING:
    from ompl_ext.vehicle import Vehicle

DELAY_MAX: Final = 0.5
"""Longest delay of commands that a vehicle may state and that is estimated, s."""
CAR_CONTROLS: Final = ("throttle", "steering")
WHEELBASE: Final = "L"
"""Parameter of the bundled cars, m."""


def is_car(vehicle: Vehicle) -> bool:
    """Whether the controls of a vehicle are throttle and steering."""
    return sorted(vehicle.controls) == sorted(CAR_CONTROLS)


SHARE: Final = "share of the largest"
"""Unit of a control whose largest value is 1."""
_UNITS: Final = {"steering": "rad", "v": "m/s", "omega": "rad/s", "left": "m/s", "right": "m/s"}
_SHARES: Final = ("throttle", "steering", "acceleration", "angular_acceleration")


def control_unit(vehicle: Vehicle, name: str) -> str | None:
    """Unit of a control; None where it is not known, as of a model that takes commands in any unit."""
    largest = vehicle.controls[name][1]
    full = vehicle.parameters.get(f"full_{name}")
    if name in _SHARES and largest == 1.0 and full in (None, 1.0):
        return SHARE
    return None if full is not None else _UNITS.get(name)


def control_title(vehicle: Vehicle, name: str) -> str:
    """Name of a control in words, with its unit where that is known."""
    words, unit = name.replace("_", " "), control_unit(vehicle, name)
    return f"{words}, {unit}" if unit else words


GRAVITY: Final = 9.81
"""Acceleration of a free fall, m/s^2."""
STEEPEST: Final = math.sin(math.radians(40.0))
"""Largest slope of a floor, rise per metre of it; a force that stands for a larger one has another cause."""


def felt_gravity(vehicle: Vehicle) -> float:
    """Force per mass by a slope of 1, m/s^2, on a vehicle that states its share of gravity."""
    assert vehicle.gravity_share is not None, "a slope drives only a vehicle that states its share"
    return GRAVITY * vehicle.gravity_share


def check_state(vehicle: Vehicle) -> None:
    """Check that the state of a vehicle has x, y, theta and a speed.

    Raises:
        InputError: if it lacks one of them.
    """
    missing = [name for name in ("x", "y", "theta") if vehicle.index(name) < 0]
    if missing or not vehicle.rest:
        lacks = (
            f"has no {' and no '.join(missing)} in its state" if missing else "names no speed in its rest components"
        )
        raise InputError.of(vehicle.name, lacks, "expected a state with x, y, theta and a speed", Code.MISMATCH)
