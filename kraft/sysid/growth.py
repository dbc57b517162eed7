"""Growth of a model's prediction error, and the process noise that explains it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from kraft.sysid.parameters import YAW_RATES, speed_index
from ompl_ext.arrays import Floats

if TYPE_CHECKING:
    from ompl_ext.vehicle import Vehicle


def process_noise(vehicle: Vehicle, growth: Floats, horizon: float) -> dict[str, float]:
    """Random walks of speed and turning, by component, that make errors as large as the model's at the horizon."""
    found = {}
    per_rate = math.sqrt(3.0 / horizon)  # a random walk of a rate, integrated: q sqrt(t^3 / 3)
    if (k := speed_index(vehicle)) >= 0:
        found[vehicle.state[k]] = float(growth[0]) * per_rate
    for name in vehicle.state:
        if name in YAW_RATES:
            found[name] = float(growth[2]) * per_rate
    if "theta" in vehicle.state and not set(YAW_RATES) & set(vehicle.state):
        found["theta"] = float(growth[2]) * math.sqrt(horizon)
    return found


def error_growth(vehicle: Vehicle, process: Floats, horizon: float) -> Floats:
    """(3,) growth of the error in x, y and yaw that process noise (nx,) leads to: the inverse of `process_noise`."""
    named = dict(zip(vehicle.state, map(float, process), strict=True))
    per_rate, per_position = math.sqrt(3.0 / horizon), math.sqrt(horizon)
    speed = speed_index(vehicle)
    moving = [float(process[speed]) / per_rate] if speed >= 0 else [named[k] / per_position for k in ("x", "y")]
    turning = [named[k] / per_rate for k in YAW_RATES if k in named] or [named.get("theta", 0.0) / per_position]
    return np.array([max(moving), max(moving), max(turning)])
