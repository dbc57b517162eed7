"""Robots with two driven sides: a second-order unicycle, commanded by its two accelerations, and the Jackal.

The unicycle:

State [x, y, theta, v, omega] of the point between the wheels (m, rad, m/s, rad/s); controls [acceleration,
angular_acceleration] as fractions of the largest ones.  As in a motor controller, the speed saturates: it stays in
[0, v_max], the turning rate in [-omega_max, omega_max], both approached with a short time constant.  The accelerations
fade smoothly, because ten Runge-Kutta steps an edge would not follow a kink.

The Jackal is commanded by the speeds of its sides: state as above, controls [left, right] (m/s).  Parameters: effective
distance between the sides (m), time constants of the speed tau and of the turning rate tau_turn (s), and the share of
the commanded speed that the wheels reach, gain.
"""

from __future__ import annotations

from ompl_ext.trigonometry import cos, sin
from ompl_ext.vehicle import Footprint, Vehicle, derivative

Values = tuple[float, ...]

APPROACH = 6.0
"""Rate at which a saturating speed approaches its limit, 1/s."""
SPEED_MAX = 2.0
"""Largest commanded speed of a side, m/s."""
REVERSE = -0.5
"""Lowest commanded speed of a side, m/s: with less, the wheels would slip in turns and when it brakes."""
SIDES_BRAKING = 0.25
"""Commanded speed against the motion over the speed."""
TINY = 1e-300
"""Summand that avoids 0 / 0 where the acceleration is 0."""


@derivative
def clamped(value: float, low: float, high: float) -> float:
    """`value`, moved into [low, high]."""
    above = low if value < low else value
    return high if above > high else above


@derivative
def fading(acceleration: float, quarter: float, room: float) -> float:
    """Non-negative acceleration, faded where its speed is within `room` of the limit.

    Close to the limit it is APPROACH * room; a parabola leads over to it.  Beyond the limit it leads back.
    `quarter` is 1 / (4 acceleration).
    """
    r = min(APPROACH * room, 2.0 * acceleration)
    t = max(r, 0.0)
    return r - t * t * quarter


@derivative
def actuation(u: Values, p: Values) -> Values:
    """Fractions to acceleration (m/s^2), angular acceleration (rad/s^2), and their `quarter` for `fading`."""
    a, alpha = p[0] * u[0], p[1] * u[1]
    return a, alpha, 1.0 / (4.0 * abs(a) + TINY), 1.0 / (4.0 * abs(alpha) + TINY)


@derivative
def motion(x: Values, u: Values, p: Values) -> Values:
    """Unicycle whose accelerations fade where a speed reaches its limit."""
    v, omega = x[3], x[4]
    dv = fading(max(u[0], 0.0), u[2], p[2] - v) - fading(max(-u[0], 0.0), u[2], v)
    domega = fading(max(u[1], 0.0), u[3], p[3] - omega) - fading(max(-u[1], 0.0), u[3], p[3] + omega)
    return v * cos(x[2]), v * sin(x[2]), omega, dv, domega


@derivative
def stop(x: Values, p: Values, k: int) -> Values:
    """Brake fully; turn no more, or left or right at a rate that fades with the speed."""
    turn = (0.0, 0.5, -0.5)[k] * p[3] * x[3] / p[2]
    return -1.0, clamped(APPROACH * (turn - x[4]) / p[1], -1.0, 1.0)


UNICYCLE2 = Vehicle(
    name="unicycle2",
    derivative=motion,
    actuation=actuation,
    inputs=("acceleration", "angular_acceleration", "quarter", "angular_quarter"),
    stop=stop,
    manoeuvres=("straight", "left", "right"),
    state=("x", "y", "theta", "v", "omega"),
    controls={"acceleration": (-1.0, 1.0), "angular_acceleration": (-1.0, 1.0)},
    rest=("v", "omega"),
    parameters={"a_max": 1.0, "alpha_max": 4.0, "v_max": 0.6, "omega_max": 2.0},
    footprint=Footprint(0.36, 0.30),
    top_speed=0.6,
)


@derivative
def sides(x: Values, u: Values, p: Values) -> Values:
    """Speed and turning rate follow those of the sides."""
    _, _, theta, v, omega = x
    left, right = u
    dv = (0.5 * p[3] * (left + right) - v) / p[1]
    domega = (p[3] * (right - left) / p[0] - omega) / p[2]
    return v * cos(theta), v * sin(theta), omega, dv, domega


@derivative
def stop_sides(x: Values, p: Values, k: int) -> Values:
    """Brake; turn no more, or left or right at a rate that fades with the speed."""
    turning = (0.0, 0.3, -0.3)[k] * x[3]
    return -SIDES_BRAKING * x[3] - turning, -SIDES_BRAKING * x[3] + turning


JACKAL = Vehicle(
    name="jackal",
    derivative=sides,
    stop=stop_sides,
    manoeuvres=("straight", "left", "right"),
    state=("x", "y", "theta", "v", "omega"),
    controls={"left": (REVERSE, SPEED_MAX), "right": (REVERSE, SPEED_MAX)},
    rest=("v", "omega"),
    parameters={"track": 0.376, "tau": 0.4, "tau_turn": 0.4, "gain": 1.0},
    footprint=Footprint(0.51, 0.43),
    top_speed=SPEED_MAX,
)
