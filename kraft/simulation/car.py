"""The MuSHR in MuJoCo: a sprung chassis, four wheels, Ackermann steering, one motor; and its drivetrain.

The body frame lies midway between the axles on the floor, x forward, z up: the reference point of the planner's model.
Dimensions and masses are the real car's. The collision box (0.439 x 0.265) reaches a little further than the
planner's footprint (0.40 x 0.28) in front and behind, and a little less to the sides.
"""

from __future__ import annotations

import math
from typing import Any, Final

import mujoco

from kraft.driving.car_model import interpolate
from kraft.scenario.truth import VehicleGap
from kraft.simulation import contacts

POSITION: Final = int(mujoco.mjtCtrlInput.mjINPUT_POS)
"""The servos take an angle; by default MuJoCo's would take an angular velocity as well."""

CAR: Final = "car"
MARKER: Final = "marker"
DRIVE: Final = "drive"
WHEELS: Final = ("front left", "front right", "rear left", "rear right")
STEERED: Final = WHEELS[:2]

WHEEL_WIDTH: Final = 0.041
WHEEL_MASS: Final = 0.5
CHASSIS_MASS: Final = 3.54
CENTRE_OF_MASS: Final = (0.0, 0.0, 0.08)
CHASSIS_BODY: Final = (0.42, 0.24, 0.12)
"""The block (m) that has the chassis' moments of inertia."""

REAR, FRONT, SIDE, BOTTOM, TOP = -0.22475, 0.21415, 0.1325, 0.045, 0.221
"""Limits of the collision box, m. It is 0.045 m above the floor: a real car's ground clearance."""

MARKER_HEIGHT: Final = 0.2
"""Height of the marker above the floor while the car stands, m."""

STIFFNESS: Final = 900.0
"""Of each wheel's spring, N/m: the chassis bounces at 5 Hz and sits 10 mm deep, as small cars with soft springs do."""
SUSPENSION_DAMPING: Final = 28.0
TRAVEL: Final = 0.015
GRAVITY: Final = 9.81

SERVO_STIFFNESS, SERVO_DAMPING, SERVO_INERTIA = 20.0, 0.4, 0.002
"""Of the steering servo at each front wheel, N m/rad, N m s/rad, kg m^2: it lags 20 ms behind its own rate limit."""

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
EFFECTIVE_MASS: Final = CHASSIS_MASS + len(WHEELS) * (WHEEL_MASS + ROTOR_INERTIA / WHEEL_RADIUS**2)
"""Mass that the drive accelerates, with that which the inertia of the drive acts like, kg."""
ROLLING_FRICTION: Final = 0.001
"""Torque at each wheel that does not depend on its speed, N m."""
WHEEL_DAMPING: Final = (0.0363, -0.00219, 0.0000614)
"""Torque over speed w of each wheel is d0 + d1 |w| + d2 w^2, in N m s, N m s^2, N m s^3 (per rad)."""
FULL_TORQUE: Final = 0.265
"""Torque at each wheel at full throttle, N m."""
THROTTLE: Final = (0.0, 0.15, 0.3, 0.5, 0.75, 1.0)
TORQUE: Final = (0.0, 0.153, 0.362, 0.593, 0.803, 1.0)
"""Torque over full torque at those throttles, linear between: nearly proportional, and the motor saturates a little."""


def wheel_place(name: str) -> tuple[float, float, float]:
    """Centre of a wheel in the body frame, m."""
    x = WHEELBASE / 2 if name in STEERED else -WHEELBASE / 2
    return x, TRACK / 2 if name.endswith("left") else -TRACK / 2, WHEEL_RADIUS


def sag(gap: VehicleGap) -> float:
    """Suspension sag relative to the nominal car, m."""
    return (gap.mass_scale - 1.0) * CHASSIS_MASS * GRAVITY / 4 / STIFFNESS


def chassis_inertia(gap: VehicleGap) -> tuple[float, list[float]]:
    """Mass (kg) and moments of inertia (kg m^2) of the chassis."""
    mass = CHASSIS_MASS * gap.mass_scale
    a, b, c = CHASSIS_BODY
    return mass, [mass / 12 * (b * b + c * c), mass / 12 * (a * a + c * c), mass / 12 * (a * a + b * b)]


def add_car(spec: Any, gap: VehicleGap) -> Any:
    """Add the car at the origin of the world; returns its body."""
    body = spec.worldbody.add_body(name=CAR)
    body.add_freejoint(name=CAR)
    body.sleep = mujoco.mjtSleepPolicy.mjSLEEP_NEVER  # a standing car must still respond to commands
    body.explicitinertial = True
    body.ipos = CENTRE_OF_MASS
    body.mass, body.inertia = chassis_inertia(gap)
    body.add_geom(
        name="chassis",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[(FRONT + REAR) / 2, 0.0, (TOP + BOTTOM) / 2],
        size=[(FRONT - REAR) / 2, SIDE, (TOP - BOTTOM) / 2],
        group=3,
        mass=0.0,
        **contacts.settings(**contacts.CHASSIS),
    )
    body.add_site(name=MARKER, pos=[0.0, 0.0, MARKER_HEIGHT])
    for name in WHEELS:
        _add_wheel(body, name)
    _add_motor(spec)
    for name in STEERED:
        servo = spec.add_actuator(name=f"{name} servo", target=f"{name} steering", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_pid(kp=SERVO_STIFFNESS, kv=SERVO_DAMPING, slewmax=STEERING_RATE, ctrlspec=POSITION)
    return body


def _add_wheel(body: Any, name: str) -> None:
    wheel = body.add_body(name=name, pos=wheel_place(name))
    nominal_load = CHASSIS_MASS * GRAVITY / 4
    wheel.add_joint(
        name=f"{name} suspension",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0.0, 0.0, 1.0],
        stiffness=[STIFFNESS, 0.0, 0.0],
        damping=[SUSPENSION_DAMPING, 0.0, 0.0],
        springref=-nominal_load / STIFFNESS,
        range=[-TRAVEL, TRAVEL],
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
    )
    if name in STEERED:
        wheel.add_joint(
            name=f"{name} steering", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, 0.0, 1.0], armature=SERVO_INERTIA
        )
    wheel.add_joint(
        name=f"{name} spin",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0.0, 1.0, 0.0],
        armature=ROTOR_INERTIA,
        damping=WHEEL_DAMPING,
        frictionloss=ROLLING_FRICTION,
    )
    wheel.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,  # a cylinder's edge would chatter
        size=[WHEEL_RADIUS, WHEEL_WIDTH / 2, WHEEL_RADIUS],
        mass=WHEEL_MASS,
        friction=contacts.friction(0.0),
        group=3,
        **contacts.settings(**contacts.WHEEL),
    )


def _add_motor(spec: Any) -> None:
    """Add one motor; the differentials distribute its torque equally to the wheels at any wheel speeds."""
    shaft = spec.add_tendon(name=DRIVE)
    for name in WHEELS:
        shaft.wrap_joint(f"{name} spin", 1.0)
    motor = spec.add_actuator(name=DRIVE, target=DRIVE, trntype=mujoco.mjtTrn.mjTRN_TENDON)
    motor.set_to_motor()


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
