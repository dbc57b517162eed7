"""Unicycles of dynobench, with the bounds of its models.

First order: state [x, y, theta], controls speed v (m/s) and turning rate omega (rad/s), which change at once.
Second order: state [x, y, theta, v, omega], controls the two accelerations (m/s^2, rad/s^2). Its speeds stay within
their bounds: the accelerations fade where a speed reaches its limit.
"""

from __future__ import annotations

from ompl_ext.trigonometry import cos, sin
from ompl_ext.vehicle import Footprint, Vehicle, derivative

Values = tuple[float, ...]
BODY = Footprint(0.5, 0.25)
SPEED, TURN = 0.5, 0.5
"""Largest speed (m/s) and turning rate (rad/s)."""
ACCELERATION = 0.25
"""Largest acceleration, m/s^2 and rad/s^2."""
APPROACH = 6.0
"""Rate at which a saturating speed approaches its limit, 1/s."""


@derivative
def first_order(x: Values, u: Values, p: Values) -> Values:
    """Unicycle commanded by its speeds."""
    return u[0] * cos(x[2]), u[0] * sin(x[2]), u[1]


@derivative
def limited(acceleration: float, room_up: float, room_down: float) -> float:
    """Acceleration that leads no farther than to the limits of a speed."""
    return max(min(acceleration, APPROACH * room_up), -APPROACH * room_down)


@derivative
def second_order(x: Values, u: Values, p: Values) -> Values:
    """Unicycle commanded by its accelerations."""
    v, omega = x[3], x[4]
    return (
        v * cos(x[2]),
        v * sin(x[2]),
        omega,
        limited(u[0], p[0] - v, p[0] + v),
        limited(u[1], p[1] - omega, p[1] + omega),
    )


@derivative
def stop(x: Values, p: Values, k: int) -> Values:
    """Brake both speeds."""
    return (
        max(min(-APPROACH * x[3], ACCELERATION), -ACCELERATION),
        max(min(-APPROACH * x[4], ACCELERATION), -ACCELERATION),
    )


def _unicycle1(name: str, speed: tuple[float, float], turn: tuple[float, float]) -> Vehicle:
    return Vehicle(
        name=name,
        derivative=first_order,
        state=("x", "y", "theta"),
        controls={"v": speed, "omega": turn},
        footprint=BODY,
        top_speed=SPEED,
        rest=(),
    )


UNICYCLE1_V0 = _unicycle1("unicycle1_v0", (-SPEED, SPEED), (-TURN, TURN))
UNICYCLE1_V1 = _unicycle1("unicycle1_v1", (0.25, SPEED), (-TURN, TURN))
UNICYCLE1_V2 = _unicycle1("unicycle1_v2", (0.25, SPEED), (-0.25, TURN))
UNICYCLE2_V0 = Vehicle(
    name="unicycle2_v0",
    derivative=second_order,
    stop=stop,
    manoeuvres=("straight",),
    state=("x", "y", "theta", "v", "omega"),
    controls={"acceleration": (-ACCELERATION, ACCELERATION), "angular_acceleration": (-ACCELERATION, ACCELERATION)},
    rest=("v", "omega"),
    parameters={"v_max": SPEED, "omega_max": TURN},
    footprint=BODY,
    top_speed=SPEED,
)
