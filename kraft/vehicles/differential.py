"""Robot with two driven sides, whose wheels, drive and grip are described by terms that identification can switch off.

State [x, y, theta, v, omega]: the pose that is observed (m, rad), of a point `lever` ahead of the middle between the
sides, with a yaw that is `yaw_offset` more than the robot's; the speed of that middle (m/s) and the turning rate
(rad/s).  Controls [left, right] are the commanded speeds of the sides in any unit.

A term is off at the neutral value of its parameter (`neutral` in the vehicle file):

    wheels    speed of a side gain (1 -+ imbalance) times its command less its dead zone (m/s)
    turning   omega (right - left) / track, less by slip v^2; lateral acceleration at most 1 / slide
    losses    scrub: turning on the spot and in curves costs speed
    pose      lever and yaw_offset of what is tracked
    lags      tau of the speed, tau_turn of the turning rate; effort and effort_turn are the inverse of the largest
              acceleration and angular acceleration
"""

from __future__ import annotations

from math import sqrt

from ompl_ext.trigonometry import cos, sin
from ompl_ext.vehicle import Footprint, Vehicle, derivative

Values = tuple[float, ...]

SOFT = 0.02
"""Speed over which the dead zone ends, m/s, so that derivatives exist."""
SPEED_MAX = 2.0
REVERSE = -0.5
"""Speeds between which this model is planned with, m/s: those of a Jackal ahead, and slowly astern."""
BRAKING = 0.25
"""Speed of the sides against the motion over the speed, in emergency manoeuvres."""


@derivative
def positive(value: float) -> float:
    """The value if it is positive, else 0; smooth."""
    return 0.5 * (value + sqrt(value * value + SOFT * SOFT)) - 0.5 * SOFT


@derivative
def actuation(u: Values, p: Values) -> Values:
    """Commands to speeds of the sides, m/s."""
    left, right = p[1] * (1.0 - p[2]) * u[0], p[1] * (1.0 + p[2]) * u[1]
    return positive(left - p[3]) - positive(-left - p[3]), positive(right - p[3]) - positive(-right - p[3])


@derivative
def motion(x: Values, u: Values, p: Values) -> Values:
    """Speed and turning rate follow those of the sides."""
    _, _, theta, v, omega = x
    turning = (u[1] - u[0]) / (p[0] * (1.0 + p[4] * v * v))
    demand = v * turning * p[5]
    turning = turning / sqrt(sqrt(1.0 + demand * demand * demand * demand))
    speed = 0.5 * (u[0] + u[1]) / (1.0 + p[6] * omega * omega)
    rate, turn = (speed - v) / p[7], (turning - omega) / p[8]
    dv = rate / sqrt(1.0 + rate * rate * p[9] * p[9])
    domega = turn / sqrt(1.0 + turn * turn * p[10] * p[10])
    yaw, sideways = theta - p[12], p[11] * omega
    return v * cos(yaw) - sideways * sin(yaw), v * sin(yaw) + sideways * cos(yaw), omega, dv, domega


@derivative
def stop(x: Values, p: Values, k: int) -> Values:
    """Brake; turn no more, or left or right at a rate that fades with the speed."""
    turning = (0.0, 0.3, -0.3)[k] * x[3]
    return (-BRAKING * x[3] - turning) / p[1], (-BRAKING * x[3] + turning) / p[1]


DIFFERENTIAL = Vehicle(
    name="differential",
    derivative=motion,
    actuation=actuation,
    inputs=("left_speed", "right_speed"),
    stop=stop,
    manoeuvres=("straight", "left", "right"),
    state=("x", "y", "theta", "v", "omega"),
    controls={"left": (REVERSE, SPEED_MAX), "right": (REVERSE, SPEED_MAX)},
    rest=("v", "omega"),
    parameters={
        "track": 0.4,
        "gain": 1.0,
        "imbalance": 0.0,
        "dead_zone": 0.0,
        "slip": 0.0,
        "slide": 0.0,
        "scrub": 0.0,
        "tau": 0.2,
        "tau_turn": 0.2,
        "effort": 0.0,
        "effort_turn": 0.0,
        "lever": 0.0,
        "yaw_offset": 0.0,
    },
    footprint=Footprint(0.51, 0.43),
    top_speed=SPEED_MAX,
)
