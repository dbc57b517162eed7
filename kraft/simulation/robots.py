"""Robots in MuJoCo: what a robot is to the world that simulates it, the car, and robots of MJCF files."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol, TypeAlias

import mujoco
import numpy as np

from kraft.errors import Code, Diagnostic, InputError
from kraft.scenario import Start
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.scenario.truth import VehicleGap
from kraft.simulation import contacts
from kraft.simulation.appearance import add_car_visuals
from kraft.simulation.car import CAR, DRIVE, MARKER, STEERED, WHEELS, CarDesign, add_car
from kraft.simulation.floor_frame import FloorFrame, quaternion, yaw_quaternion, yaw_rotation
from kraft.text import suggestion
from kraft.vehicles import CAR_CONTROLS
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Footprint


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

    def add_visuals(self, spec: Any) -> None:
        """Add what is only there to be seen to the robot."""

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
        add_car(spec, self.design, gap)

    def add_visuals(self, spec: Any) -> None:
        """Add its visual geoms."""
        add_car_visuals(spec, spec.body(CAR), self.design)

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


PREFIX: Final = "robot/"
"""Beginning of all names of the robot in the world."""
FREE: Final = mujoco.mjtJoint.mjJNT_FREE
ProblemAt: TypeAlias = Callable[[str, str, str, Code], Diagnostic]
"""Diagnostic from a key, a problem, what is expected and a code."""


@dataclass(frozen=True)
class MjcfRobot:
    """Robot of an MJCF file.

    Attributes:
        file: path of the file; `digest` is the hash of its content.
        controls: names of the controls, in their order.
        actuators: name of the actuator that receives each of them.
        tracked, base: tracked body, and the body with the free joint, which may be the same.
        geoms: names of the geoms whose contact with an obstacle is a collision.
    """

    file: str
    digest: str
    controls: tuple[str, ...]
    actuators: tuple[str, ...]
    tracked: str
    base: str
    geoms: tuple[str, ...]

    grip: ClassVar[float] = 1.0
    has_plain_contacts: ClassVar[bool] = False

    @property
    def body(self) -> str:
        """Name of the tracked body in the world."""
        return PREFIX + self.tracked

    @property
    def root(self) -> str:
        """Name of the body with the free joint in the world."""
        return PREFIX + self.base

    @property
    def _height(self) -> float:
        """Height of the tracked body above the floor of the file, m."""
        return float(self._as_in_file[1].body(self.tracked).xpos[2])

    @cached_property
    def _as_in_file(self) -> tuple[Any, Any]:
        """MuJoCo's model and data of the whole file, as it stands there."""
        model = mujoco.MjSpec.from_file(self.file).compile()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        return model, data

    def outline(self, below: float) -> Footprint | None:
        """Rectangle around its geoms that count, without those that are wholly above a height (m); None if all are."""
        boxes = [(low, high) for low, high in self._boxes() if low[2] < below]
        if not boxes:
            return None
        rear, right, _ = np.min([low for low, _ in boxes], axis=0)
        front, left, _ = np.max([high for _, high in boxes], axis=0)
        return Footprint(float(front - rear), 2.0 * float(max(left, -right)), float(front + rear) / 2)

    def _boxes(self) -> Iterator[tuple[Floats, Floats]]:
        """Lowest and highest coordinates (3,) of each geom that counts, m: x ahead of the body, z from the floor."""
        model, data = self._as_in_file
        body, base = data.body(self.tracked), model.body(self.base).id
        axes = body.xmat.reshape(3, 3)
        turn = yaw_rotation(-math.atan2(axes[1, 0], axes[0, 0]))
        origin = np.array([*body.xpos[:2], 0.0])
        for k in range(model.ngeom):
            touches = bool(model.geom_contype[k] or model.geom_conaffinity[k])
            if touches and model.body_rootid[model.geom_bodyid[k]] == base and model.geom(k).name in self.geoms:
                rotation, (middle, half) = data.geom_xmat[k].reshape(3, 3), model.geom_aabb[k].reshape(2, 3)
                centre = turn @ (data.geom_xpos[k] + rotation @ middle - origin)
                reach = np.abs(turn @ rotation) @ half
                yield centre - reach, centre + reach

    def add(self, spec: Any, gap: VehicleGap) -> None:
        """Add the robot, without the rest of its file: its floor, its lights, its options."""
        child = mujoco.MjSpec.from_file(self.file)
        body = spec.worldbody.add_frame().attach_body(child.body(self.base), PREFIX, "")
        for geom in body.find_all("geom"):
            if geom.contype or geom.conaffinity:
                counts = geom.name.removeprefix(PREFIX) in self.geoms
                geom.contype = contacts.ALL_BITS if counts else contacts.ALL_BITS & ~contacts.OBSTACLE_BIT
                geom.conaffinity = 0
        tracked = spec.body(self.body)
        tracked.add_site(name=MARKER, pos=[0.0, 0.0, MARKER_HEIGHT - self._height])

    def add_visuals(self, spec: Any) -> None:
        """Add nothing: the file has what is to be seen."""

    def bind(self, model: Any, data: Any) -> MjcfInWorld:
        """Robot in a compiled world."""
        return MjcfInWorld(self, model, data)


class MjcfInWorld:
    """Robot of an MJCF file in a compiled world."""

    def __init__(self, robot: MjcfRobot, model: Any, data: Any) -> None:
        self._model, self._data, self._velocity = model, data, np.empty(6)
        self._body = model.body(robot.body).id
        joint = model.joint(model.body(robot.root).jntadr[0])
        self._position, self._speed = int(joint.qposadr[0]), int(joint.dofadr[0])
        numbers = [model.actuator(PREFIX + name).id for name in robot.actuators]
        self._inputs = [int(model.actuator_ctrladr[k]) for k in numbers]
        limited = [bool(model.actuator_ctrllimited[k]) for k in numbers]
        unlimited = (-math.inf, math.inf)
        ranges = [model.actuator_ctrlrange[k] if has else unlimited for k, has in zip(numbers, limited, strict=True)]
        self._low, self._high = np.array(ranges, dtype=float).T

    def apply(self, control: Sequence[float], gap: VehicleGap) -> None:
        """Hold the inputs of the actuators from now on, clamped to their ranges."""
        self._data.ctrl[self._inputs] = np.clip(control, self._low, self._high)

    def place(self, start: Start, frame: FloorFrame, gap: VehicleGap) -> None:
        """Move the robot as it stands in its file so that the tracked body is at the start, with its speed."""
        model, data, at = self._model, self._data, self._position
        mujoco.mj_kinematics(model, data)
        place, axes = data.xpos[self._body].copy(), data.xmat[self._body].reshape(3, 3)
        turn = start.heading - math.atan2(axes[1, 0], axes[0, 0])
        about_z = yaw_rotation(turn)
        offset = data.qpos[at : at + 3] - np.array([place[0], place[1], 0.0])
        data.qpos[at : at + 3] = frame.to_world(about_z @ offset + np.array([start.x, start.y, 0.0]))
        turned = quaternion(frame.rotation @ about_z)
        mujoco.mju_mulQuat(data.qpos[at + 3 : at + 7], turned, data.qpos[at + 3 : at + 7].copy())
        ahead = np.array([math.cos(start.heading), math.sin(start.heading), 0.0])
        data.qvel[self._speed : self._speed + 3] = start.speed * frame.rotation @ ahead

    def change(self, gap: VehicleGap) -> None:
        """Nothing: only a car has a gap."""

    @property
    def velocity(self) -> Floats:
        """Velocity of the tracked body in the world's frame, (3,), m/s."""
        mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_XBODY, self._body, self._velocity, 0)
        return self._velocity[3:]


def mjcf_robot(
    file: str,
    controls: Iterable[str],
    body: str | None,
    actuators: Mapping[str, str] | None,
    geoms: Sequence[str] | None,
    problem_at: ProblemAt,
) -> MjcfRobot:
    """Robot of an MJCF file, after a check that it loads and has what a trial needs.

    Args:
        file: path of the MJCF file.
        controls: names of the vehicle's controls.
        body: body whose pose is the robot's; by default the first one.
        actuators: actuator for each control; by default those with the names of the controls.
        geoms: geoms whose contact with an obstacle is a collision; by default all that can touch something.
        problem_at: makes the diagnostic of a problem of a key.

    Raises:
        InputError: with every problem of the file and of these names.
    """
    try:
        spec = mujoco.MjSpec.from_file(file)
        spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        problem = f"{file} does not load: {reason}"
        raise InputError([problem_at("mjcf", problem, "expected a MuJoCo model", Code.CODE)]) from None
    names = tuple(controls)
    chosen = {name: name for name in names} if actuators is None else dict(actuators)
    problems = [*_bad_actuators(spec, chosen, names, actuators is None, problem_at)]
    bodies = [each.name for each in spec.bodies[1:]]
    tracked = body if body is not None else next(iter(bodies), "")
    if tracked not in bodies:
        key, expected = "mjcf" if body is None else "body", suggestion(tracked, bodies, none="expected a body")
        problems.append(problem_at(key, f"{file} has no body {tracked!r}", expected, Code.UNKNOWN))
        raise InputError(problems)
    base = _root_of(spec, tracked)
    touching = [geom.name for geom in base.find_all("geom") if geom.contype or geom.conaffinity]
    if base.first_joint() is None or base.first_joint().type != FREE:
        problem = f"body {base.name!r}, at the root of {tracked!r}, has no free joint"
        expected = "expected a robot that moves freely: <freejoint/> in it"
        problems.append(problem_at("mjcf" if body is None else "body", problem, expected, Code.MISSING))
    for k, name in enumerate(geoms or ()):
        if name not in touching:
            problem, none = f"the robot has no geom {name!r} that can touch something", "it has none"
            problems.append(problem_at(f"geoms[{k}]", problem, suggestion(name, touching, none=none), Code.UNKNOWN))
    if problems:
        raise InputError(problems)
    return MjcfRobot(
        file, hashlib.sha256(Path(file).read_bytes()).hexdigest(), names, tuple(chosen[name] for name in names),
        tracked, base.name, tuple(touching if geoms is None else geoms),
    )  # fmt: skip


def _bad_actuators(
    spec: Any, chosen: Mapping[str, str], controls: Sequence[str], by_default: bool, problem_at: ProblemAt
) -> Iterator[Diagnostic]:
    known = [actuator.name for actuator in spec.actuators]
    for control in controls:
        if control not in chosen:
            problem = f"names no actuator for the control {control}"
            yield problem_at("actuators", problem, "expected one for each control", Code.MISSING)
    for control, actuator in chosen.items():
        if control not in controls:
            problem = f"the vehicle has no control {control!r}"
            yield problem_at(f"actuators.{control}", problem, suggestion(control, controls), Code.UNKNOWN)
        elif actuator not in known:
            key = "mjcf" if by_default else f"actuators.{control}"
            expected = suggestion(actuator, known, none="expected an actuator, and it has none")
            yield problem_at(key, f"the robot has no actuator {actuator!r}", expected, Code.UNKNOWN)


def _root_of(spec: Any, name: str) -> Any:
    """Body of the tree of a body that is next to the world."""
    body = spec.body(name)
    while body.parent.name != "world":
        body = body.parent
    return body
