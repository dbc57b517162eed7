"""Throttle to torque and steering command to wheel angles: what sits between a command and the wheels.

The motor drives all four wheels. Against it stand a damping of each wheel, whose coefficient falls with speed, and a
little rolling friction; the rotor's inertia, reflected through the gears to the wheels, is three times the car's mass.
That inertia and the rolling friction are those of the MuSHR project's own MuJoCo model (armature 0.01 kg m^2 and
friction loss 0.001 N m per wheel). The damping and the map from throttle to force were fitted to measured speeds, rise
times and stopping distance; docs/world.md compares them.
"""

from __future__ import annotations

import math
from typing import Final

from kraft.driving.car_model import interpolate

WHEELBASE: Final = 0.2965
TRACK: Final = 0.23
WHEEL_RADIUS: Final = 0.0488
STEERING_MAX: Final = 0.38
"""Stop of the steering linkage, rad of the equivalent single front wheel."""
STEERING_RATE: Final = 3.2
"""Speed of the steering servo, rad/s."""
LINKAGE: Final = 0.89
"""Angle of the wheels over the angle commanded: a full turn has a radius of 0.86 m, not the bicycle's 0.76 m."""

ROTOR_INERTIA: Final = 0.01
"""Reflected inertia of the drive at each wheel, kg m^2."""
ROLLING_FRICTION: Final = 0.001
"""Torque at each wheel that does not depend on its speed, N m."""
WHEEL_DAMPING: Final = (0.0363, -0.00219, 0.0000614)
"""Torque over speed w of each wheel is d0 + d1 |w| + d2 w^2, in N m s, N m s^2, N m s^3 (per rad)."""
FULL_TORQUE: Final = 0.265
"""Torque at each wheel at full throttle, N m."""
THROTTLE: Final = (0.0, 0.15, 0.3, 0.5, 0.75, 1.0)
TORQUE: Final = (0.0, 0.153, 0.362, 0.593, 0.803, 1.0)
"""Torque over full torque at those throttles, linear between: nearly proportional, and the motor saturates a little."""


def wheel_torque(throttle: float) -> float:
    """Torque at each wheel, N m; `throttle` in [-1, 1] is clamped."""
    size = min(abs(throttle), 1.0)
    return math.copysign(FULL_TORQUE * interpolate(size, THROTTLE, TORQUE), throttle)


def wheel_angles(steering: float) -> tuple[float, float]:
    """Angles of the left and right front wheel, rad, whose axles meet on the rear axle's line (Ackermann)."""
    if steering == 0.0:
        return 0.0, 0.0
    curvature = math.tan(steering) / WHEELBASE
    left, right = 1.0 - curvature * TRACK / 2, 1.0 + curvature * TRACK / 2
    return math.atan(curvature * WHEELBASE / left), math.atan(curvature * WHEELBASE / right)
