"""Robots in MuJoCo: what a robot is to the world that simulates it, and the car."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import mujoco
import numpy as np

from kraft.scenario import Start
from kraft.scenario.truth import VehicleGap
from kraft.simulation.car import CAR, DRIVE, STEERED, WHEELS, CarDesign, add_car
from kraft.simulation.car_visuals import add_car_visuals
from kraft.simulation.floor_frame import FloorFrame, quaternion, yaw_quaternion
from kraft.vehicles import CAR_CONTROLS
from ompl_ext.arrays import Floats


class SimulatedRobot(Protocol):
    """Robot that can be added to a world; equal robots make equal worlds.  `body` has its pose, `root` its joint."""

    def __hash__(self) -> int:
        """Hash: worlds are compiled once per robot."""

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of its controls, in their order."""

    @property
    def body(self) -> str:
        """Name of the body whose pose is the robot's."""

    @property
    def root(self) -> str:
        """Name of the body with its free joint."""

    @property
    def grip(self) -> float:
        """Factor of its tyres on the friction of the floor."""

    @property
    def has_plain_contacts(self) -> bool:
        """Whether collisions show in the number of rows of the solver, see `contacts`."""

    def add(self, spec: Any, gap: VehicleGap) -> None:
        """Add the robot to a `mujoco.MjSpec`, with its marker; `gap` is how it differs from its model."""

    def bind(self, model: Any, data: Any) -> RobotInWorld:
        """Robot in a compiled world."""


class RobotInWorld(Protocol):
    """Robot in a compiled world, which it moves; `gap` is how it differs from its model at that time."""

    def apply(self, control: Sequence[float], gap: VehicleGap) -> None:
        """Hold a control (nu,) from now on."""

    def place(self, start: Start, frame: FloorFrame, gap: VehicleGap) -> None:
        """Place the robot on the floor, with its speed."""

    def change(self, gap: VehicleGap) -> None:
        """Change what the compiled model has of the robot."""

    @property
    def velocity(self) -> Floats:
        """Velocity of the body in the world's frame, (3,), m/s."""


@dataclass(frozen=True)
class SimulatedCar:
    """A car, by its dimensions."""

    design: CarDesign

    controls: ClassVar[tuple[str, ...]] = CAR_CONTROLS
    body: ClassVar[str] = CAR
    root: ClassVar[str] = CAR
    has_plain_contacts: ClassVar[bool] = True

    @property
    def grip(self) -> float:
        """Factor of its tyres on the friction of the floor."""
        return self.design.tyre_friction

    def add(self, spec: Any, gap: VehicleGap) -> None:
        """Add the car."""
        add_car_visuals(spec, add_car(spec, self.design, gap), self.design)

    def bind(self, model: Any, data: Any) -> CarInWorld:
        """Car in a compiled world."""
        return CarInWorld(self.design, model, data)


class CarInWorld:
    """Car in a compiled world."""

    def __init__(self, design: CarDesign, model: Any, data: Any) -> None:
        self._design, self._model, self._data = design, model, data
        self._joint = data.joint(CAR)
        self.velocity: Floats = self._joint.qvel[:3]  # a view, as all that MuJoCo's objects hand out
        inputs = model.actuator_ctrladr
        self._motor = inputs[model.actuator(DRIVE).id]
        self._servos = [inputs[model.actuator(f"{name} servo").id] for name in STEERED]

    def apply(self, control: Sequence[float], gap: VehicleGap) -> None:
        """Hold throttle and steering from now on, clamped to [-1, 1] and to the stop of the linkage."""
        (throttle, steering), design = control, self._design
        stop = design.steering_max
        commanded = min(max(steering, -stop), stop)
        true = commanded * gap.steering_scale + gap.steering_offset
        left, right = design.wheel_angles(design.linkage * min(max(true, -stop), stop))
        inputs = self._data.ctrl
        inputs[self._motor] = gap.drive_scale * design.wheel_torque(throttle)
        inputs[self._servos[0]], inputs[self._servos[1]] = left, right

    def place(self, start: Start, frame: FloorFrame, gap: VehicleGap) -> None:
        """Place the car on the floor, with its speed and the spin of its wheels."""
        rotation, sunk = frame.rotation, self._design.sag(gap)
        upright = np.empty(4)
        mujoco.mju_mulQuat(upright, quaternion(rotation), np.array(yaw_quaternion(start.heading)))
        self._joint.qpos[:3] = frame.to_world(np.array([start.x, start.y, -sunk]))
        self._joint.qpos[3:] = upright
        direction = np.array([math.cos(start.heading), math.sin(start.heading), 0.0])
        self._joint.qvel[:3] = start.speed * rotation @ direction
        for name in WHEELS:
            self._data.joint(f"{name} suspension").qpos[:] = sunk
            self._data.joint(f"{name} spin").qvel[:] = start.speed / self._design.wheel_radius

    def change(self, gap: VehicleGap) -> None:
        """Change the mass of the chassis."""
        chassis = self._model.body(CAR)
        chassis.mass[:], chassis.inertia[:] = self._design.inertia(gap)
