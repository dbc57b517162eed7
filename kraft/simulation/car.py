"""Cars in MuJoCo: a sprung chassis, four wheels, Ackermann steering, one motor.

The body frame lies midway between the axles on the floor, x forward, z up: the reference point of the planner's model.
Dimensions and masses of the MuSHR are the real car's. Its collision box (0.439 x 0.265) reaches a little further than
the planner's footprint (0.40 x 0.28) in front and behind, and a little less to the sides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import mujoco

from kraft.driving.car_model import interpolate
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.scenario.truth import VehicleGap
from kraft.simulation import contacts
from kraft.vehicles import GRAVITY
from kraft.vehicles.true_robot import CarDimensions
from ompl_ext.vehicle import Footprint

POSITION: Final = int(mujoco.mjtCtrlInput.mjINPUT_POS)
"""The servos take an angle; by default MuJoCo's would take an angular velocity as well."""

CAR: Final = "car"
MARKER: Final = "marker"
DRIVE: Final = "drive"
WHEELS: Final = ("front left", "front right", "rear left", "rear right")
STEERED: Final = WHEELS[:2]

BOUNCE: Final = 900.0 / 3.54
"""Stiffness of each wheel's spring over the chassis mass, N/m/kg: small cars with soft springs bounce at 5 Hz."""
SWAY: Final = 28.0 / 3.54
"""Damping of each wheel's spring over the chassis mass, N s/m/kg."""


@dataclass(frozen=True)
class CarDesign:
    """Dimensions and drive of a simulated car, by default the MuSHR's; lengths in m, masses in kg.

    Attributes:
        body: block that has the chassis' moments of inertia.
        rear, front, side, bottom, top: limits of the collision box; `bottom` is the ground clearance.
        stiffness, suspension_damping, travel: of each wheel's spring, N/m, N s/m, m.
        servo_stiffness, servo_damping, servo_inertia: of the steering servo at each front wheel, N m/rad, N m s/rad,
            kg m^2; it lags 20 ms behind its own rate limit.
        steering_max: stop of the steering linkage, rad of the equivalent single front wheel.
        steering_rate: speed of the steering servo, rad/s.
        linkage: angle of the wheels over the angle commanded.
        rotor_inertia: reflected inertia of the drive at each wheel, kg m^2.
        rolling_friction: torque at each wheel that does not depend on its speed, N m.
        wheel_damping: torque over speed w of each wheel is d0 + d1 |w| + d2 w^2, in N m s, N m s^2, N m s^3 (per rad).
        full_torque: torque at each wheel at full throttle, N m.
        throttle, torque: torque over full torque at some throttles, linear between.
        tyre_friction: factor on the friction of the floor.
    """

    wheelbase: float = 0.2965
    track: float = 0.23
    wheel_radius: float = 0.0488
    wheel_width: float = 0.041
    wheel_mass: float = 0.5
    chassis_mass: float = 3.54
    centre_of_mass: float = 0.08
    body: tuple[float, float, float] = (0.42, 0.24, 0.12)
    rear: float = -0.22475
    front: float = 0.21415
    side: float = 0.1325
    bottom: float = 0.045
    top: float = 0.221
    stiffness: float = 900.0
    suspension_damping: float = 28.0
    travel: float = 0.015
    servo_stiffness: float = 20.0
    servo_damping: float = 0.4
    servo_inertia: float = 0.002
    steering_max: float = 0.38
    steering_rate: float = 3.2
    linkage: float = 0.89  # a full turn has a radius of 0.86 m, not the bicycle's 0.76 m
    rotor_inertia: float = 0.01
    rolling_friction: float = 0.001
    wheel_damping: tuple[float, float, float] = (0.0363, -0.00219, 0.0000614)
    full_torque: float = 0.265
    throttle: tuple[float, ...] = (0.0, 0.15, 0.3, 0.5, 0.75, 1.0)
    torque: tuple[float, ...] = (0.0, 0.153, 0.362, 0.593, 0.803, 1.0)  # the motor saturates a little
    tyre_friction: float = 1.0

    @property
    def effective_mass(self) -> float:
        """Mass that the drive accelerates, with that which the inertia of the drive acts like, kg."""
        return self.chassis_mass + len(WHEELS) * (self.wheel_mass + self.rotor_inertia / self.wheel_radius**2)

    def wheel_place(self, name: str) -> tuple[float, float, float]:
        """Centre of a wheel in the body frame, m."""
        x = self.wheelbase / 2 if name in STEERED else -self.wheelbase / 2
        return x, self.track / 2 if name.endswith("left") else -self.track / 2, self.wheel_radius

    @property
    def outline(self) -> Footprint:
        """Rectangle around collision box and wheels."""
        wheel = self.wheelbase / 2 + self.wheel_radius
        front, rear = max(self.front, wheel), min(self.rear, -wheel)
        return Footprint(front - rear, max(2 * self.side, self.track + self.wheel_width), (front + rear) / 2)

    @property
    def sharpest_radius(self) -> float:
        """Radius of the sharpest turn of the rear axle's middle, m; negative if wheels turn by more than 90 degrees."""
        return self.wheelbase / math.tan(self.linkage * self.steering_max)

    def sag(self, gap: VehicleGap) -> float:
        """Suspension sag relative to the car without `gap`, m."""
        return (gap.mass_scale - 1.0) * self.chassis_mass * GRAVITY / 4 / self.stiffness

    def inertia(self, gap: VehicleGap) -> tuple[float, list[float]]:
        """Mass (kg) and moments of inertia (kg m^2) of the chassis."""
        mass = self.chassis_mass * gap.mass_scale
        a, b, c = self.body
        return mass, [mass / 12 * (b * b + c * c), mass / 12 * (a * a + c * c), mass / 12 * (a * a + b * b)]

    def wheel_torque(self, throttle: float) -> float:
        """Torque at each wheel, N m; `throttle` in [-1, 1] is clamped."""
        size = min(abs(throttle), 1.0)
        return math.copysign(self.full_torque * interpolate(size, self.throttle, self.torque), throttle)

    def wheel_angles(self, steering: float) -> tuple[float, float]:
        """Angles of the left and right front wheel, rad, whose axles meet on the rear axle's line (Ackermann)."""
        if steering == 0.0:
            return 0.0, 0.0
        curvature = math.tan(steering) / self.wheelbase
        left, right = 1.0 - curvature * self.track / 2, 1.0 + curvature * self.track / 2
        return math.atan(curvature * self.wheelbase / left), math.atan(curvature * self.wheelbase / right)

    def with_drive(self, top_speed: float, time_constant: float) -> CarDesign:
        """Same car with a linear drive: its steady speed at full throttle (m/s), and the time to 63 % of it (s)."""
        damping = self.effective_mass * self.wheel_radius**2 / (len(WHEELS) * time_constant)
        torque = damping * top_speed / self.wheel_radius + self.rolling_friction
        return replace(
            self, wheel_damping=(damping, 0.0, 0.0), full_torque=torque, throttle=(0.0, 1.0), torque=(0.0, 1.0)
        )


MUSHR: Final = CarDesign()
F1TENTH: Final = CarDesign(
    wheelbase=0.33, track=0.24, wheel_radius=0.05, wheel_width=0.045, wheel_mass=0.2, chassis_mass=2.94,
    centre_of_mass=0.074, body=(0.5, 0.26, 0.1), rear=-0.29, front=0.29, side=0.155, bottom=0.05, top=0.2,
    stiffness=BOUNCE * 2.94, suspension_damping=SWAY * 2.94, steering_max=0.4189, linkage=1.0, rotor_inertia=0.001,
).with_drive(3.0, 0.5)  # fmt: skip
"""F1TENTH car: dimensions, mass and steering of O'Kelly et al., F1TENTH (PMLR 123, 2020); 3 m/s at full throttle."""
PRESETS: Final = {"mushr": MUSHR, "f1tenth": F1TENTH}


def design_of(car: CarDimensions) -> CarDesign:
    """Design of a car with some dimensions of its own.

    The block of inertia scales with the length and width.  Other wheels are those of a car of another scale, see
    `_of_scale`.
    """
    base = PRESETS[car.preset]
    given = {
        "wheelbase": car.wheelbase, "track": car.track, "chassis_mass": car.mass, "wheel_radius": car.wheels.radius,
        "wheel_width": car.wheels.width, "wheel_mass": car.wheels.mass, "linkage": car.servo.linkage,
        "tyre_friction": car.tyres.friction,
    }  # fmt: skip
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if car.servo.angle_max_deg is not None:
        changes["steering_max"] = math.radians(car.servo.angle_max_deg)
    if car.servo.rate_deg is not None:
        changes["steering_rate"] = math.radians(car.servo.rate_deg)
    length, width, height = base.body
    if car.length is not None:
        changes |= {"front": car.length / 2, "rear": -car.length / 2}
        length *= car.length / (base.front - base.rear)
    if car.width is not None:
        changes["side"] = car.width / 2
        width *= car.width / (2.0 * base.side)
    design = _of_scale(replace(base, **changes, body=(length, width, height)), base)
    return design if car.drive is None else design.with_drive(car.drive.top_speed, car.drive.time_constant)


def design_problem(design: CarDesign) -> tuple[str, str] | None:
    """What keeps a car from being simulated, and what is expected; None if nothing does."""
    if not design.sharpest_radius > design.track / 2:
        angle = math.degrees(design.linkage * design.steering_max)
        problem = f"turns its wheels by up to {angle:.0f} degrees, about a point between those of the rear axle"
        return problem, "expected a smaller servo.angle_max_deg, servo.linkage or track, or a longer wheelbase"
    if not (2 * design.wheel_radius < design.wheelbase and design.wheel_width < design.track):
        wheels = f"{design.wheel_radius:g} m in radius and {design.wheel_width:g} m wide"
        axles = f"a wheelbase of {design.wheelbase:g} m and a track of {design.track:g} m"
        expected = "expected smaller ones, `wheels: {radius: ..., width: ..., mass: ...}`, or axles farther apart"
        return f"has wheels, {wheels}, that overlap at {axles}", expected
    return None


def _of_scale(car: CarDesign, base: CarDesign) -> CarDesign:
    """The car with what nobody states of its size.

    Heights and travel scale with the radius of the wheels, and the springs so that the chassis sags by as large a share
    of the travel, with the same damping ratio.  Servo and motor scale with the moment of inertia of the wheels, so that
    they keep their time constants.
    """
    size, load = car.wheel_radius / base.wheel_radius, car.chassis_mass / base.chassis_mass
    inertia = size**2 * car.wheel_mass / base.wheel_mass
    length, width, height = car.body
    d0, d1, d2 = base.wheel_damping
    return replace(
        car,
        centre_of_mass=base.centre_of_mass * size,
        body=(length, width, height * size),
        bottom=base.bottom * size,
        top=base.top * size,
        stiffness=base.stiffness * load / size,
        suspension_damping=base.suspension_damping * load / math.sqrt(size),
        travel=base.travel * size,
        servo_stiffness=base.servo_stiffness * inertia,
        servo_damping=base.servo_damping * inertia,
        servo_inertia=base.servo_inertia * inertia,
        rotor_inertia=base.rotor_inertia * inertia,
        rolling_friction=base.rolling_friction * inertia,
        wheel_damping=(d0 * inertia, d1 * inertia, d2 * inertia),
        full_torque=base.full_torque * inertia,
    )


def add_car(spec: Any, design: CarDesign, gap: VehicleGap) -> None:
    """Add a car at the origin of the world."""
    body = spec.worldbody.add_body(name=CAR)
    body.add_freejoint(name=CAR)
    body.sleep = mujoco.mjtSleepPolicy.mjSLEEP_NEVER  # a standing car must still respond to commands
    body.explicitinertial = True
    body.ipos = (0.0, 0.0, design.centre_of_mass)
    body.mass, body.inertia = design.inertia(gap)
    body.add_geom(
        name="chassis",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[(design.front + design.rear) / 2, 0.0, (design.top + design.bottom) / 2],
        size=[(design.front - design.rear) / 2, design.side, (design.top - design.bottom) / 2],
        group=3,
        mass=0.0,
        **contacts.settings(**contacts.CHASSIS),
    )
    body.add_site(name=MARKER, pos=[0.0, 0.0, MARKER_HEIGHT])
    for name in WHEELS:
        _add_wheel(body, design, name)
    _add_motor(spec)
    for name in STEERED:
        servo = spec.add_actuator(name=f"{name} servo", target=f"{name} steering", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_pid(
            kp=design.servo_stiffness, kv=design.servo_damping, slewmax=design.steering_rate, ctrlspec=POSITION
        )


def _add_wheel(body: Any, design: CarDesign, name: str) -> None:
    wheel = body.add_body(name=name, pos=design.wheel_place(name))
    nominal_load = design.chassis_mass * GRAVITY / 4
    wheel.add_joint(
        name=f"{name} suspension",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0.0, 0.0, 1.0],
        stiffness=[design.stiffness, 0.0, 0.0],
        damping=[design.suspension_damping, 0.0, 0.0],
        springref=-nominal_load / design.stiffness,
        range=[-design.travel, design.travel],
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
    )
    if name in STEERED:
        wheel.add_joint(
            name=f"{name} steering",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0.0, 0.0, 1.0],
            armature=design.servo_inertia,
        )
    wheel.add_joint(
        name=f"{name} spin",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0.0, 1.0, 0.0],
        armature=design.rotor_inertia,
        damping=design.wheel_damping,
        frictionloss=design.rolling_friction,
    )
    wheel.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,  # a cylinder's edge would chatter
        size=[design.wheel_radius, design.wheel_width / 2, design.wheel_radius],
        mass=design.wheel_mass,
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
