"""Car whose drive, steering and tyres are described by terms that identification can switch off.

State [x, y, theta, v]: the pose that is observed (m, rad), of a point `lever` ahead of the middle between the rear
wheels, with a yaw that is `yaw_offset` more than the car's; and the speed of that middle (m/s).  The car with lags also
has the wheels' angle delta (rad) and the yaw rate r (rad/s).  Controls [throttle, steering] are in any unit, forward
and left positive; they are divided by `full_throttle` and `full_steering` first.

A term is off at the neutral value of its parameter (`neutral` in the vehicle file, 0 except for `brake` and `reverse`,
which are 1):

    drive     a (1 + progression |u|) u, u the throttle less its dead zone, times `reverse` backwards; times `brake`
              against the motion
    losses    (damping + back_emf |u|) v + drag v |v|, friction against the motion, scrub of turned wheels
    effort    inverse of the largest acceleration by drive, damping and back_emf together: that of a speed controller
    coast     damping at neutral throttle less that under drive; both together are at least 0
    steering  phi_diff + steer (1 +- asymmetry) n / sqrt(1 + (saturation n)^2), n the steering
    tyres     curvature tan(delta) / (L (1 + understeer v^2)); lateral acceleration at most 1 / slide; slip of the body
    pose      lever and yaw_offset of what is tracked
    lags      tau_steer and rate_limit (its inverse) of the wheels, tau_yaw of the yaw rate

At standstill friction holds the car as long as the drive does not exceed it (stiction).
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

from ompl_ext.trigonometry import cos, sin, tan
from ompl_ext.vehicle import Footprint, Vehicle, derivative

Values = tuple[float, ...]

TURNOVER = 0.05
"""Time in which friction alone would cross the speeds over which its sense changes, s.

Half a step of the planner: longer, the car rolls out too far; shorter, steps of 0.1 s ring about standstill.
"""
REVERSAL = 0.2
"""Share by which the drive exceeds friction from which on the sense of friction changes at once: the car reverses."""
LEAST_WIDTH = 0.01
"""Least speed over which the sense of friction changes, m/s, so that derivatives exist without friction too."""
SOFT_THROTTLE = 0.008
"""Share of full throttle over which the dead zone ends, so that derivatives exist."""
COASTING = 0.005
"""Throttle beyond the dead zone, as a share of the full one, at which half of `coast` acts."""
CORNER = 0.045
"""Share of the largest acceleration to either side of it within which the limit is smooth: 1.1 % less at the corner."""
SOFT_SIDE = 0.05
"""Share of full steering over which one side's gain changes to the other's."""
BRAKING = 1.0
"""Throttle against the motion over speed in emergency manoeuvres, s/m."""


@derivative
def positive(value: float) -> float:
    """The value if it is positive, else 0; smooth."""
    return 0.5 * (value + sqrt(value * value + SOFT_THROTTLE * SOFT_THROTTLE)) - 0.5 * SOFT_THROTTLE


@derivative
def actuation(u: Values, p: Values) -> Values:
    """Throttle and steering to throttle beyond the dead zone (share), wheel angle (rad)."""
    throttle, steering = u[0] / p[0], u[1] / p[1]
    effective = positive(throttle - p[9]) - p[23] * positive(-throttle - p[9])
    side = steering / sqrt(steering * steering + SOFT_SIDE * SOFT_SIDE)
    turned = steering / sqrt(1.0 + p[7] * p[7] * steering * steering)
    return effective, p[4] + p[5] * turned * (1.0 + p[6] * side)


@derivative
def limited(demand: float) -> float:
    """Share of a demand that is reached; `demand` is a multiple of the largest one."""
    square = demand * demand
    return 1.0 / sqrt(sqrt(1.0 + square * square))


@derivative
def clipped(demand: float) -> float:
    """The same with a sharp limit, as controllers have it: smooth within `CORNER` of it, exact elsewhere."""
    size = demand if demand > 0.0 else -demand
    beyond = size - (1.0 - CORNER)
    bent = size - beyond * beyond / (4.0 * CORNER) if beyond < 2.0 * CORNER else 1.0
    return bent / size if beyond > 0.0 else 1.0


@derivative
def acceleration(v: float, effective: float, lateral: float, turned: float, sliding: float, p: Values) -> float:
    """Acceleration along the car (m/s^2), `lateral` its lateral acceleration, `turned` the tangent of the angle."""
    size = effective if effective > 0.0 else -effective
    contrary = -effective * v
    opposed = contrary / sqrt(contrary * contrary + 1e-6) if contrary > 0.0 else 0.0
    wanted = p[8] * effective * (1.0 + p[10] * size) * (1.0 + (p[11] - 1.0) * opposed)
    damping = p[13] + p[12] * size
    share = clipped(p[24] * (wanted - damping * v))
    pushed = share * wanted
    drag = lateral * turned
    brake = p[14] + p[16] * (drag if drag > 0.0 else -drag) + p[20] * (sliding if sliding > 0.0 else -sliding)
    beyond = (pushed - brake if pushed > brake else 0.0) + (pushed + brake if pushed < -brake else 0.0)
    left = brake - (pushed if pushed > 0.0 else -pushed)  # friction that the drive does not use up
    reversing = 1.0 + (left / (REVERSAL * brake + 1e-9) if left < 0.0 else 0.0)
    width = TURNOVER * brake * (reversing if reversing > 0.0 else 0.0)
    held = v * left / sqrt(width * width + v * v) if left > 0.0 else 0.0  # less than friction
    square, wide = v * v, width * width + LEAST_WIDTH * LEAST_WIDTH
    root = sqrt(square * square + wide * wide)
    moving, sense = square / root, v / sqrt(root)
    along = pushed if pushed * v > 0.0 else 0.0  # a car that drives away has its full friction at once
    used = brake if along > brake else (-brake if along < -brake else along)
    against = brake * sense + (1.0 - (sense if sense > 0.0 else -sense)) * used
    driven = moving * (pushed - against) + (1.0 - moving) * (beyond - held)
    beside = size * size / (COASTING * COASTING)
    losing = share * damping + p[25] / (1.0 + beside * beside)
    coasting = losing * v if losing > 0.0 else 0.0
    return driven - coasting - p[15] * v * (v if v > 0.0 else -v)


@derivative
def curvature(v: float, turned: float, p: Values) -> float:
    """Curvature of the path (1/m) with wheels turned by an angle of the given tangent."""
    wanted = turned / (p[3] * (1.0 + p[17] * v * v))
    return wanted * limited(v * v * wanted * p[18])


@derivative
def velocity(theta: float, v: float, r: float, p: Values) -> Values:
    """Velocity of the tracked point (m/s), observed with the yaw `theta`, at the speed `v` and the yaw rate `r`."""
    yaw = theta - p[22]
    heading, round_axle = yaw - p[19] * v * r, p[21] * r
    return v * cos(heading) - round_axle * sin(yaw), v * sin(heading) + round_axle * cos(yaw)


@derivative
def prompt(x: Values, u: Values, p: Values) -> Values:
    """Derivative of the car whose wheels and yaw rate follow without lag."""
    _, _, theta, v = x
    turned = tan(u[1])
    bend = curvature(v, turned, p)
    turning = v * bend
    sliding = v * turning * (turned - p[3] * bend)
    vx, vy = velocity(theta, v, turning, p)
    return vx, vy, turning, acceleration(v, u[0], v * turning, turned, sliding, p)


@derivative
def lagging(x: Values, u: Values, p: Values) -> Values:
    """Derivative of the car whose wheels and yaw rate follow with a lag."""
    _, _, theta, v, delta, r = x
    turned = tan(delta)
    rate = (u[1] - delta) / p[26]
    turning = rate / sqrt(1.0 + rate * rate * p[28] * p[28])
    bend = curvature(v, turned, p)
    sliding = v * r * (turned - p[3] * bend)
    vx, vy = velocity(theta, v, r, p)
    return vx, vy, r, acceleration(v, u[0], v * r, turned, sliding, p), turning, (v * bend - r) / p[27]


@derivative
def stop(x: Values, p: Values, k: int) -> Values:
    """Throttle against the motion, down to `full_reverse` of the full one; wheels straight, half or fully turned."""
    share = -BRAKING * x[3]
    share = -p[2] if share < -p[2] else (p[2] if share > p[2] else share)
    return p[0] * share, p[1] * (0.0, 0.5, -0.5, 1.0, -1.0)[k]


CAR = Vehicle(
    name="car",
    derivative=prompt,
    actuation=actuation,
    inputs=("throttle", "wheel_angle"),
    stop=stop,
    manoeuvres=("straight", "left", "right", "hard-left", "hard-right"),
    state=("x", "y", "theta", "v"),
    controls={"throttle": (-1.0, 1.0), "steering": (-1.0, 1.0)},
    parameters={
        "full_throttle": 1.0,
        "full_steering": 1.0,
        "full_reverse": 0.0,
        "L": 0.3,
        "phi_diff": 0.0,
        "steer": 0.35,
        "asymmetry": 0.0,
        "saturation": 0.0,
        "a_drive": 4.0,
        "dead_zone": 0.0,
        "progression": 0.0,
        "brake": 1.0,
        "back_emf": 0.0,
        "damping": 1.0,
        "friction": 0.0,
        "drag": 0.0,
        "scrub": 0.0,
        "understeer": 0.0,
        "slide": 0.0,
        "slip": 0.0,
        "skid": 0.0,
        "lever": 0.0,
        "yaw_offset": 0.0,
        "reverse": 1.0,
        "effort": 0.0,
        "coast": 0.0,
    },
    footprint=Footprint(0.45, 0.28, 0.13),
    top_speed=5.0,
)

CAR_LAG = replace(
    CAR,
    name="car-lag",
    derivative=lagging,
    state=("x", "y", "theta", "v", "delta", "r"),
    parameters={**CAR.parameters, "tau_steer": 0.08, "tau_yaw": 0.08, "rate_limit": 0.0},
)
