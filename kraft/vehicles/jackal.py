"""Differential-drive robot of the size of a Jackal, commanded by the speeds of its two sides.

State [x, y, theta, v, omega] of the point between the driven wheels (m, rad, m/s, rad/s); controls [left, right], the
speeds of the sides (m/s).  Parameters: effective distance between the sides (m), time constants of the speed tau and of
the turning rate tau_turn (s), and the share of the commanded speed that the wheels reach, gain.
"""

from __future__ import annotations

from ompl_ext.trigonometry import cos, sin
from ompl_ext.vehicle import Footprint, Vehicle, derivative

Values = tuple[float, ...]

SPEED_MAX = 2.0
"""Largest commanded speed of a side, m/s."""
REVERSE = -0.5
"""Lowest commanded speed of a side, m/s: with less, the wheels would slip in turns and when it brakes."""
BRAKING = 0.25
"""Commanded speed against the motion over the speed."""


@derivative
def motion(x: Values, u: Values, p: Values) -> Values:
    """Speed and turning rate follow those of the sides."""
    _, _, theta, v, omega = x
    left, right = u
    dv = (0.5 * p[3] * (left + right) - v) / p[1]
    domega = (p[3] * (right - left) / p[0] - omega) / p[2]
    return v * cos(theta), v * sin(theta), omega, dv, domega


@derivative
def stop(x: Values, p: Values, k: int) -> Values:
    """Brake; turn no more, or left or right at a rate that fades with the speed."""
    turning = (0.0, 0.3, -0.3)[k] * x[3]
    return -BRAKING * x[3] - turning, -BRAKING * x[3] + turning


JACKAL = Vehicle(
    name="jackal",
    derivative=motion,
    stop=stop,
    manoeuvres=("straight", "left", "right"),
    state=("x", "y", "theta", "v", "omega"),
    controls={"left": (REVERSE, SPEED_MAX), "right": (REVERSE, SPEED_MAX)},
    rest=("v", "omega"),
    parameters={"track": 0.376, "tau": 0.4, "tau_turn": 0.4, "gain": 1.0},
    footprint=Footprint(0.51, 0.43),
    top_speed=SPEED_MAX,
)
