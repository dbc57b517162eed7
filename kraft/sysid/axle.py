"""Where the model's point lies: how far ahead of the axle that does not slip sideways."""

from __future__ import annotations

import numpy as np

from kraft.sysid.motion import Motion
from kraft.sysid.parameters import Parameters
from ompl_ext.arrays import Floats

SECONDS, STEP = 3.0, 0.02
SHARE = 0.1
"""Of the full steering: a gentle turn."""


def ahead_of_axle(parameters: Parameters, motion: Motion, rho: Floats) -> float | None:
    """Distance of the model's point ahead of its rear axle, m; None for a vehicle without steering.

    In a steady turn a point b ahead of the axle moves sideways with b times the turning rate.
    """
    vehicle = parameters.vehicle
    controls = list(vehicle.controls)
    if "steering" not in controls or vehicle.index("theta") < 0:
        return None
    control = np.maximum(vehicle.control_bounds[:, 1], 0.0)
    control[controls.index("steering")] *= SHARE
    steps = round(SECONDS / STEP)
    states = motion.simulate(
        np.zeros((1, motion.nx)),
        np.tile(control, (steps, 1, 1)),
        parameters.model_values(rho)[None],
        np.array([STEP]),
    )[-2:, 0]
    dx, dy, turn = np.diff(states, axis=0)[0][[vehicle.index(name) for name in ("x", "y", "theta")]]
    middle = states[0, vehicle.index("theta")] + 0.5 * turn
    sideways = dy * np.cos(middle) - dx * np.sin(middle)
    return float(sideways / turn) if abs(turn) > 1e-6 else None
