"""A second-order unicycle: a robot with two driven wheels, commanded by its two accelerations.

State [x, y, theta, v, omega] of the point between the wheels (m, rad, m/s, rad/s); controls [acceleration,
angular_acceleration] as fractions of the largest ones.  As in a motor controller, the speed saturates: it stays in
[0, v_max], the turning rate in [-omega_max, omega_max], both approached with a short time constant.
"""

from __future__ import annotations

from ompl_ext.trigonometry import cos, sin
from ompl_ext.vehicle import Footprint, Vehicle, derivative

Values = tuple[float, ...]

APPROACH = 10.0
"""Rate at which a saturating speed approaches its limit, 1/s."""


@derivative
def clamped(value: float, low: float, high: float) -> float:
    """`value`, moved into [low, high]."""
    above = low if value < low else value
    return high if above > high else above


@derivative
def actuation(u: Values, p: Values) -> Values:
    """Fractions to acceleration (m/s^2) and angular acceleration (rad/s^2)."""
    return p[0] * u[0], p[1] * u[1]


@derivative
def motion(x: Values, u: Values, p: Values) -> Values:
    """Unicycle whose accelerations fade where a speed reaches its limit."""
    v, omega = x[3], x[4]
    dv = clamped(u[0], -APPROACH * v, APPROACH * (p[2] - v))
    domega = clamped(u[1], -APPROACH * (p[3] + omega), APPROACH * (p[3] - omega))
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
    inputs=("acceleration", "angular_acceleration"),
    stop=stop,
    manoeuvres=("straight", "left", "right"),
    state=("x", "y", "theta", "v", "omega"),
    controls={"acceleration": (-1.0, 1.0), "angular_acceleration": (-1.0, 1.0)},
    rest=("v", "omega"),
    parameters={"a_max": 1.0, "alpha_max": 4.0, "v_max": 0.6, "omega_max": 2.0},
    footprint=Footprint(0.36, 0.30),
    top_speed=0.6,
)
