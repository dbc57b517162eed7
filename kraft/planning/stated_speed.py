"""Comparison of the top speed that a vehicle states with the speeds that its model reaches."""

from __future__ import annotations

from typing import Final

import numpy as np

from ompl_ext.motion import motion_of
from ompl_ext.vehicle import Vehicle

TOLERATED: Final = 1.05
"""Ratio of the speed in simulated motions to the stated top speed up to which the two agree."""


def faster_than_stated(vehicle: Vehicle) -> str:
    """What to say of a vehicle whose model drives faster than the top speed that the vehicle states; else empty."""
    ahead, sideways, _ = motion_of(vehicle).twists.T
    fastest = float(np.hypot(ahead, sideways).max(initial=0.0))
    if fastest <= TOLERATED * vehicle.top_speed:
        return ""
    return (
        f"the model of {vehicle.name} reaches {fastest:.3g} m/s, its top_speed is {vehicle.top_speed:.3g} m/s: "
        "the search may find few plans or none, because the cost-to-go relies on top_speed; expected the speed that "
        "the model reaches"
    )
