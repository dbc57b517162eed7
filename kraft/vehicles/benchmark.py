"""Vehicle for comparing planners: its constants are fixed, so that costs stay comparable between versions."""

from __future__ import annotations

from ompl_ext.trigonometry import atan, cos, sin, tan
from ompl_ext.vehicle import Footprint, Vehicle, derivative

Values = tuple[float, ...]


@derivative
def actuation(u: Values, p: Values) -> Values:
    """Throttle and steering to target speed and side-slip angle's cosine and sine (constant along an edge)."""
    beta = atan(0.5 * tan(p[2] * u[1]))
    return p[0] * u[0], cos(beta), sin(beta)


@derivative
def motion(x: Values, u: Values, p: Values) -> Values:
    """Bicycle about its centre with a first-order speed response."""
    target, c, s = u
    ct, st = cos(x[2]), sin(x[2])
    return x[3] * (ct * c - st * s), x[3] * (st * c + ct * s), 2.0 * x[3] * s / p[3], p[1] * (target - x[3])


@derivative
def stop(x: Values, p: Values, k: int) -> Values:
    """Throttle off, wheels straight, half or fully turned."""
    return 0.0, (0.0, 0.5, -0.5, 1.0, -1.0)[k]


BENCHMARK = Vehicle(
    name="benchmark",
    derivative=motion,
    actuation=actuation,
    inputs=("target_speed", "cos_beta", "sin_beta"),
    stop=stop,
    manoeuvres=("straight", "left", "right", "hard-left", "hard-right"),
    state=("x", "y", "theta", "v"),
    controls={"throttle": (0.0, 1.0), "steering": (-1.0, 1.0)},
    parameters={"gain": 0.6228, "rate": 0.9898, "steering_max": 0.4203, "wheelbase": 0.2965},
    footprint=Footprint(0.40, 0.28),
    top_speed=0.6228,
)
