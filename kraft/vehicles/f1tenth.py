"""F1TENTH car: a kinematic bicycle at up to 3 m/s whose wheels turn at a limited rate and whose grip is limited.

State [x, y, theta, v, delta] of the point midway between the axles (m, rad, m/s) with the wheels' angle delta (rad);
controls [throttle, steering] with the steering angle in rad.  Parameters: wheelbase L (m), steering angle when
commanded straight phi_diff (rad), speed at full throttle v_delta (m/s), its time constant tau (s), the largest lateral
acceleration a_grip (m/s^2), near which the car understeers, and the largest yaw acceleration a_yaw (rad/s^2): the front
tyres give the torque that starts and ends a turn, so that the angle delta that acts changes more slowly at high speed.
"""

from __future__ import annotations

from math import sqrt

from ompl_ext.trigonometry import atan, cos, sin, tan
from ompl_ext.vehicle import Footprint, Vehicle, derivative

Values = tuple[float, ...]

STEERING_MAX = 0.4189
"""Limit of the steering angle, rad."""
STEERING_RATE = 3.2
"""Speed of the steering servo, rad/s."""
SERVO_LAG = 0.06
"""Time constant with which the servo approaches the commanded angle, s: integration steps may be 0.1 s."""
REVERSE = -0.4
"""Throttle of strongest braking, and of fastest reverse."""
BRAKING = 0.8
"""Throttle against the motion per speed, s/m."""


@derivative
def actuation(u: Values, p: Values) -> Values:
    """Throttle and steering to target speed (m/s) and wheel angle (rad)."""
    return p[2] * u[0], u[1]


@derivative
def motion(x: Values, u: Values, p: Values) -> Values:
    """Bicycle about its centre; the speed follows with a lag, the wheels with a limited rate."""
    target, steering = u
    _, _, theta, v, delta = x
    beta = atan(0.5 * tan(delta + p[1]))
    wanted = 2.0 * sin(beta) / p[0]  # curvature at walking pace
    demand = v * v * wanted / p[4]
    fourth = demand * demand * demand * demand
    curvature = wanted / sqrt(sqrt(sqrt(1.0 + fourth * fourth)))
    rate = (steering - delta) / SERVO_LAG
    share, turning = rate / STEERING_RATE, rate * v / (p[0] * p[5])
    rate = rate / sqrt(1.0 + share * share + turning * turning)  # smooth, so that its derivatives exist
    return v * cos(theta + beta), v * sin(theta + beta), v * curvature, (target - v) / p[3], rate


@derivative
def brake(x: Values, p: Values, k: int) -> Values:
    """Throttle against the motion, in proportion to the speed near standstill; wheels straight or turned."""
    proportional = -BRAKING * x[3]
    throttle = REVERSE if proportional < REVERSE else (-REVERSE if proportional > -REVERSE else proportional)
    return throttle, (0.0, 0.1, -0.1, 0.25, -0.25)[k]


F1TENTH = Vehicle(
    name="f1tenth",
    derivative=motion,
    actuation=actuation,
    inputs=("target_speed", "wheel_angle"),
    stop=brake,
    manoeuvres=("straight", "left", "right", "hard-left", "hard-right"),
    state=("x", "y", "theta", "v", "delta"),
    controls={"throttle": (REVERSE, 1.0), "steering": (-STEERING_MAX, STEERING_MAX)},
    parameters={"L": 0.33, "phi_diff": 0.0, "v_delta": 3.0, "tau": 0.5, "a_grip": 9.0, "a_yaw": 25.0},
    footprint=Footprint(0.58, 0.31),
    top_speed=3.0,
)
