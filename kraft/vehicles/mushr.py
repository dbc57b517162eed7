"""MuSHR car as a kinematic bicycle about its centre: with a prompt speed, with a lag, with a drive train.

Divisions by parameters are products with their inverses, which are the same for all lanes and computed once.

State [x, y, theta, v] of the point midway between the axles (m, rad, m/s); controls [throttle, steering] with the
throttle in [0, 1] and the steering angle in rad.  Parameters are those of the paper: wheelbase L (m), steering angle
when commanded straight phi_diff (rad), speed at full throttle v_delta (m/s).
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

from ompl_ext.trigonometry import cos, sin, tan
from ompl_ext.vehicle import Footprint, Vehicle, derivative

Values = tuple[float, ...]

STEERING_MAX = 0.38
"""Limit of the steering joint, rad."""
PROMPT_LAG = 0.1
"""Time constant of the prompt speed, s: short compared to a planning cycle, long enough for integration steps of
0.1 s."""
BREAKAWAY = 0.03
"""Speed over which friction rises from 0, m/s: smooth, so that integration steps may cross standstill."""
REVERSE = -0.5
"""Throttle of fastest reverse."""
BRAKING = 2.0
"""Throttle against the motion per speed, s/m."""
TURNS = ("straight", "left", "right", "hard-left", "hard-right")


@derivative
def actuation(u: Values, p: Values) -> Values:
    """Throttle and steering to target speed, cosine and sine of the side-slip angle, curvature over speed."""
    slip = 0.5 * tan(u[1] + p[1])  # tangent of the side-slip angle
    c = 1.0 / sqrt(1.0 + slip * slip)
    return p[2] * u[0], c, slip * c, (2.0 / p[0]) * (slip * c)


@derivative
def bicycle(x: Values, u: Values, tau: float) -> Values:
    """Bicycle about its centre whose speed approaches the target with time constant `tau`."""
    target, c, s, curvature = u
    ct, st = cos(x[2]), sin(x[2])
    return x[3] * (ct * c - st * s), x[3] * (st * c + ct * s), x[3] * curvature, (1.0 / tau) * (target - x[3])


@derivative
def prompt(x: Values, u: Values, p: Values) -> Values:
    """Derivative of the car whose speed follows the throttle with the time constant PROMPT_LAG."""
    return bicycle(x, u, PROMPT_LAG)


@derivative
def lagging(x: Values, u: Values, p: Values) -> Values:
    """Derivative of the car with time constant tau, its fourth parameter."""
    return bicycle(x, u, p[3])


@derivative
def driven(x: Values, u: Values, p: Values) -> Values:
    """Derivative of the car with time constant tau and friction that takes the throttle u_0 to overcome."""
    target, c, s, curvature = u
    ct, st, v = cos(x[2]), sin(x[2]), x[3]
    friction, rate = p[2] * p[4] * v / sqrt(v * v + BREAKAWAY * BREAKAWAY), 1.0 / p[3]
    return (
        v * (ct * c - st * s),
        v * (st * c + ct * s),
        v * curvature,
        rate / (1.0 - p[4]) * (target - friction) - rate * v,
    )


@derivative
def pushed(x: Values, u: Values, p: Values) -> Values:
    """Derivative of the car of `driven` on which a force acts, as on a slope: accelerations a_x, a_y (m/s^2)."""
    dx, dy, turn, dv = driven(x, u, p)
    return dx, dy, turn, dv + p[5] * cos(x[2]) + p[6] * sin(x[2])


@derivative
def stop(x: Values, p: Values, k: int) -> Values:
    """Throttle off, wheels straight, half or fully turned."""
    return 0.0, (0.0, 0.19, -0.19, 0.38, -0.38)[k]


@derivative
def brake(x: Values, p: Values, k: int) -> Values:
    """Throttle against the motion, in proportion to the speed near standstill; wheels as in `stop`."""
    proportional = -BRAKING * x[3]
    throttle = REVERSE if proportional < REVERSE else (-REVERSE if proportional > -REVERSE else proportional)
    return throttle, (0.0, 0.19, -0.19, 0.38, -0.38)[k]


@derivative
def brake_against_force(x: Values, p: Values, k: int) -> Values:
    """Manoeuvres of `brake`, with the throttle that balances the force along the car."""
    force = p[5] * cos(x[2]) + p[6] * sin(x[2])
    throttle = -BRAKING * x[3] - force * p[3] * (1.0 - p[4]) / p[2]
    throttle = REVERSE if throttle < REVERSE else (-REVERSE if throttle > -REVERSE else throttle)
    return throttle, (0.0, 0.19, -0.19, 0.38, -0.38)[k]


MUSHR = Vehicle(
    name="mushr",
    derivative=prompt,
    actuation=actuation,
    inputs=("target_speed", "cos_beta", "sin_beta", "curvature"),
    stop=stop,
    manoeuvres=TURNS,
    state=("x", "y", "theta", "v"),
    controls={"throttle": (0.0, 1.0), "steering": (-STEERING_MAX, STEERING_MAX)},
    parameters={"L": 0.2965, "phi_diff": 0.0, "v_delta": 0.6228},
    footprint=Footprint(0.40, 0.28),
    top_speed=0.6228,
)

MUSHR_LAG = replace(
    MUSHR,
    name="mushr-lag",
    derivative=lagging,
    parameters={"L": 0.2965, "phi_diff": 0.0, "v_delta": 0.6228, "tau": 1.0103},
)

MUSHR_DRIVE = replace(
    MUSHR,
    name="mushr-drive",
    derivative=driven,
    stop=brake,
    controls={"throttle": (REVERSE, 1.0), "steering": (-STEERING_MAX, STEERING_MAX)},
    parameters={"L": 0.3405, "phi_diff": 0.0031, "v_delta": 0.6861, "tau": 0.8813, "u_0": 0.1274},
    footprint=Footprint(0.44, 0.28, -0.005),
    top_speed=0.6861,
)

MUSHR_FORCE = replace(
    MUSHR_DRIVE,
    name="mushr-force",
    derivative=pushed,
    stop=brake_against_force,
    parameters={**MUSHR_DRIVE.parameters, "a_x": 0.0, "a_y": 0.0},
)
