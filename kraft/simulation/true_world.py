"""What is true in a trial: the robot that a scenario or a vehicle states, and the world that simulates it.

The world is that of MuJoCo, or one in which a vehicle's own model is true, with other parameters and process noise and
without a physics engine (`ModelWorld`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Protocol

import mujoco
import numpy as np

from kraft.config.source import Source
from kraft.errors import Code, Defect, Diagnostic, InputError
from kraft.planning.workspace import planar_obstacle
from kraft.scenario import Scenario, Start
from kraft.scenario.schema import MARKER_HEIGHT
from kraft.scenario.truth import Truth, VehicleGap
from kraft.simulation import contacts
from kraft.simulation.car import CAR, CarDesign, design_of, design_problem
from kraft.simulation.contacts import Collision
from kraft.simulation.floor_frame import FloorFrame, quaternion, yaw_rotation
from kraft.simulation.robots import MjcfRobot, SimulatedCar, mjcf_robot
from kraft.simulation.scene import build
from kraft.simulation.world import TIMESTEP, World
from kraft.text import suggestion
from kraft.vehicles import CAR_CONTROLS, STEEPEST, check_state, felt_gravity
from kraft.vehicles.load import load_vehicle, natural_robot
from kraft.vehicles.true_robot import CarDimensions, RobotTruth
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.exact import ExactClearance
from ompl_ext.kernels.specialise import kernels
from ompl_ext.names import FORCE
from ompl_ext.obstacles import Workspace
from ompl_ext.vehicle import Vehicle

SUNK_MAX: Final = 0.005
"""Largest depth to which a robot may be in the floor at its start, m."""


class TrueWorld(Protocol):
    """Simulated world of a trial; see `World` and `ModelWorld`."""

    @property
    def dt(self) -> float:
        """Physics step, s."""

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the controls that `apply` takes, in their order."""

    @property
    def frame(self) -> FloorFrame:
        """Pose of the floor in the world."""

    @property
    def model(self) -> Any:
        """MuJoCo's `MjModel` of the world, for drawing."""

    @property
    def data(self) -> Any:
        """MuJoCo's `MjData` of the world as it is, for drawing."""

    @property
    def time(self) -> float:
        """Time since the start, s."""

    @property
    def steps(self) -> int:
        """Physics steps since the start."""

    @property
    def pose(self) -> Floats:
        """Position (m) and heading (rad) in the floor's frame, (3,)."""

    @property
    def speed(self) -> float:
        """Speed along the heading, m/s."""

    @property
    def components(self) -> dict[str, float]:
        """True components of a vehicle's state beside pose and speed, by name, as far as the world knows them."""

    @property
    def gap(self) -> VehicleGap:
        """How the true car differs from its model now."""

    @property
    def marker(self) -> tuple[Floats, Matrix]:
        """Position (3,), m, and rotation (3, 3) of the marker on the roof in the world's frame."""

    @property
    def movable_poses(self) -> Matrix:
        """Centre (m) and heading (rad) of each movable box in the floor's frame, (n, 3)."""

    @property
    def collision(self) -> Collision | None:
        """First contact with an obstacle, at which the world stopped; None without one."""

    @property
    def in_goal(self) -> bool:
        """Whether the true state is in the goal region: position, and what else the goal bounds."""

    def reset(self, start: Start | None = None, run: int | None = None) -> None:
        """Return to time 0 and to `start`, the scenario's if None; noise of the world is that of the run's number."""

    def apply(self, control: Floats) -> None:
        """Hold a control, in the order of `controls`, from now on."""

    def step(self, steps: int) -> None:
        """Advance by `steps` of `dt`, or to the first collision."""


@dataclass(frozen=True)
class TrueRobot:
    """True robot, with the source of the file that states it."""

    robot: RobotTruth
    source: Source

    def problem(self, key: str, problem: str, expected: str, code: Code) -> Diagnostic:
        """Diagnostic at a key of the section `truth`."""
        return self.source.diagnostic(f"truth.{key}" if key else "truth", problem, expected, code=code)


def true_robot(scenario: Scenario, vehicle: Vehicle) -> TrueRobot:
    """True robot: the scenario's, else that of the vehicle."""
    if scenario.truth.kind is not None:
        return TrueRobot(scenario.truth, scenario.source)
    robot, source = natural_robot(vehicle)
    return TrueRobot(robot, source if vehicle.file else scenario.source)


def world_of(
    scenario: Scenario, vehicle: Vehicle, seed: int, visuals: bool = True, check_start: bool = True
) -> World | ModelWorld:
    """World of a trial at its start.

    Args:
        scenario: the scene, and what is true in it.
        vehicle: model that the robot plans with; it says what is true where the scenario does not.
        seed: seed of the trial.
        visuals: whether the world has what is only there to be seen.
        check_start: whether the robot drives from the scenario's start, which then has to be free.

    Raises:
        InputError: if the robot cannot be simulated there, or takes other controls than the vehicle has.
    """
    true = true_robot(scenario, vehicle)
    world: World | ModelWorld
    if true.robot.kind == "car":
        world = World(scenario, SimulatedCar(_car(vehicle, true)), visuals)
    elif true.robot.kind == "mjcf":
        world = _mjcf_world(scenario, vehicle, true, visuals)
    else:
        world = ModelWorld(scenario, _true_model(scenario, vehicle, true), true.robot.process_noise, seed)
    if check_start and world.collision is not None:
        problem, expected = f"the robot touches {world.collision.obstacle!r}", "expected a start that is free"
        raise InputError([scenario.source.diagnostic("start", problem, expected, code=Code.GEOMETRY)])
    return world


def check_world(scenario: Scenario, vehicle: Vehicle) -> None:
    """Check what `world_of` checks, without compiling the equations of a vehicle.

    Raises:
        InputError: as `world_of`.
    """
    true = true_robot(scenario, vehicle)
    if true.robot.kind in ("car", "mjcf"):
        world_of(scenario, vehicle, 0, visuals=False)
    else:
        _true_model(scenario, vehicle, true)


def check_own_truth(vehicle: Vehicle) -> None:
    """Check the robot that a vehicle's file states, apart from any scenario.

    Raises:
        InputError: if it does not load or takes other controls than the vehicle has.
    """
    true = TrueRobot(*natural_robot(vehicle))
    if true.robot.kind == "car":
        _car(vehicle, true)
    elif true.robot.kind == "mjcf":
        _mjcf(vehicle, true)
    else:
        _check_controls(vehicle, tuple(_with_true_parameters(vehicle, true).controls), true)


def _car(vehicle: Vehicle, true: TrueRobot) -> CarDesign:
    """Design of a simulated car, which turns about points beside it."""
    _check_controls(vehicle, CAR_CONTROLS, true)
    design = design_of(true.robot.car or CarDimensions())
    if (found := design_problem(design)) is not None:
        raise InputError([true.problem("car", *found, Code.GEOMETRY)])
    return design


def _mjcf(vehicle: Vehicle, true: TrueRobot) -> MjcfRobot:
    robot = true.robot
    assert robot.mjcf is not None, "it is of this kind"
    return mjcf_robot(robot.mjcf, vehicle.controls, robot.body, robot.actuators, robot.geoms, true.problem)


def _mjcf_world(scenario: Scenario, vehicle: Vehicle, true: TrueRobot, visuals: bool) -> World:
    """World with a robot of an MJCF file, which stands freely on the floor at the start."""
    if scenario.truth.vehicle != VehicleGap() or any(change.vehicle for change in scenario.truth.changes):
        raise InputError([_without_effect(scenario, "vehicle", "a robot of a MuJoCo model")])
    world = World(scenario, _mjcf(vehicle, true), visuals)
    if world.depth_in_floor > SUNK_MAX:
        problem = f"the robot is {1000 * world.depth_in_floor:.0f} mm deep in the floor, which is at height 0"
        raise InputError([true.problem("mjcf", problem, "expected a robot that stands on it", Code.GEOMETRY)])
    return world


def _check_controls(vehicle: Vehicle, controls: tuple[str, ...], true: TrueRobot) -> None:
    """Check that a vehicle has the controls of the true robot."""
    if sorted(vehicle.controls) != sorted(controls):
        problem = f"the true robot takes {', '.join(controls)}, but {vehicle.name} has {', '.join(vehicle.controls)}"
        expected = "expected a vehicle with these controls, or another truth"
        raise InputError([true.problem("", problem, expected, Code.MISMATCH)])


def _true_model(scenario: Scenario, vehicle: Vehicle, true: TrueRobot) -> Vehicle:
    """Model that is true in a scenario, with its true parameters."""
    problems = _unknown_to_a_model(scenario)
    try:
        model = _with_true_parameters(vehicle, true)
    except InputError as error:
        raise InputError([*error.diagnostics, *problems]) from None
    if problems:
        raise InputError(problems)
    _check_controls(vehicle, tuple(model.controls), true)
    return model


def _with_true_parameters(vehicle: Vehicle, true: TrueRobot) -> Vehicle:
    """Model that is true, with its true parameters."""
    robot = true.robot
    base = vehicle if robot.model is None else load_vehicle(robot.model)
    known = {"parameters": (tuple(base.parameters), "parameter"), "process_noise": (base.state, "state component")}
    problems = [] if robot.model is None else _state_problems(base, true)
    problems += [
        true.problem(f"{key}.{name}", f"{base.name} has no such {what}", suggestion(name, names), Code.UNKNOWN)
        for key, (names, what) in known.items()
        for name in getattr(robot, key)
        if name not in names
    ]
    if problems:
        raise InputError(problems)
    model = base.with_parameters(robot.parameters)
    if model.gravity_share is not None and np.linalg.norm(_slope_of(model)) > STEEPEST:
        force = " and ".join(f"{name} {model.parameters[name]:g}" for name in FORCE)
        problem = f"{force} stand for gravity on a floor that is steeper than any"
        raise InputError([true.problem("parameters", problem, "expected a slope of at most 40 degrees", Code.VALUE)])
    return model


def _state_problems(model: Vehicle, true: TrueRobot) -> list[Diagnostic]:
    """What the state of a model that `truth` names lacks for a robot that drives."""
    try:
        check_state(model)
    except InputError as error:
        return [true.problem("model", f"{model.name} {d.problem}", d.expected, d.code) for d in error.diagnostics]
    return []


def _unknown_to_a_model(scenario: Scenario) -> list[Diagnostic]:
    """Features of a world that only a simulated robot feels."""
    default, truth = Truth(), scenario.truth
    keys = ("floor_friction", "friction_patches", "speed_bumps", "tilt", "movable_boxes", "changes")
    found = [key for key in keys if getattr(truth, key) != getattr(default, key)]
    if truth.vehicle != VehicleGap():
        found.append("vehicle")
    return [_without_effect(scenario, key, "a robot whose truth is its own model") for key in found]


def _without_effect(scenario: Scenario, key: str, robot: str) -> Diagnostic:
    problem = f"has no effect on {robot}"
    expected = "expected a simulated car" if key == "vehicle" else "expected a simulated robot: `car` or `mjcf`"
    return scenario.source.diagnostic(("truth", key), problem, expected, code=Code.CONFLICT)


def _floor_of(vehicle: Vehicle, start: Start) -> FloorFrame:
    """Floor on which the force of the vehicle's model is that of gravity, if the model states what share it feels.

    The floor has the height 0 at the start.
    """
    if vehicle.gravity_share is None:
        return FloorFrame.of(None)
    return FloorFrame.rising(_slope_of(vehicle), np.array([start.x, start.y, 0.0]))


def _slope_of(vehicle: Vehicle) -> Floats:
    """Slope (2,), rise per metre along x and y, by which gravity drives the vehicle with the force of its model."""
    return -np.array([vehicle.parameters[name] for name in FORCE]) / felt_gravity(vehicle)


STANDSTILL: Final = 0.01
"""Velocities below which the vehicle stands, and no noise moves it, m/s or rad/s."""
ROUNDING: Final = 1e-5
"""Largest error of a measured distance, m."""


class ModelWorld:
    """Simulated world of a scenario; the same commands and seed give the same bytes, in a new world or after `reset`.

    `dt` is the integration step, s.
    """

    dt: Final = TIMESTEP

    def __init__(self, scenario: Scenario, vehicle: Vehicle, process_noise: Mapping[str, float], seed: int) -> None:
        """Put the vehicle at the start.

        Args:
            scenario: obstacles, start and goal.
            vehicle: the true model, with its true parameters; its footprint is that of the true robot.
            process_noise: standard deviation that a component of the state gains in one second of motion, in its unit.
            seed: of the noise.
        """
        self.truth, self.controls = vehicle, tuple(vehicle.controls)
        self.gap: Final = VehicleGap()
        self.frame: Final = _floor_of(vehicle, scenario.start)
        self.movable_poses: Final[Matrix] = np.zeros((0, 3))
        self._scenario, self._seed = scenario, seed
        self._advance, self._parameters = kernels(vehicle).advance, vehicle.parameter_array
        self._pose = [vehicle.index(name) for name in ("x", "y", "theta")]
        self._velocities = list(vehicle.rest_indices)
        self._sigma = np.array([process_noise.get(name, 0.0) for name in vehicle.state]) * math.sqrt(self.dt)
        self._low, self._high = vehicle.control_bounds.T
        self._obstacles = _Obstacles(scenario, vehicle)
        self.reset()

    def reset(self, start: Start | None = None, run: int | None = None) -> None:
        """Return to time 0 and to `start` (the scenario's if None), with zero controls and the noise of a run."""
        start = self._scenario.start if start is None else start
        self._state = np.zeros(len(self.truth.state))
        self._state[self._pose] = start.x, start.y, start.heading
        self._state[self._velocities[0]] = start.speed
        numbers = [self._seed, 0x4015E] if run is None else [self._seed, run, 0x4015E]
        self._generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(numbers)))
        self._steps = 0
        self.apply(np.zeros(len(self.controls)))
        self._obstacles.forget()
        self._collision = self._obstacles.hit(self.pose, 0.0)

    def apply(self, control: Floats | Sequence[float]) -> None:
        """Hold a control (nu,) from now on, clamped to the bounds of the model."""
        self._control = np.ascontiguousarray(np.clip(control, self._low, self._high), dtype=np.float64)

    def step(self, steps: int) -> None:
        """Advance by `steps` of `dt`, or to the first collision; after that nothing moves.

        Raises:
            Defect: the model diverged.
        """
        state, noisy = self._state, bool(self._sigma.any())
        for _ in range(steps):
            if self._collision is not None:
                return
            self._advance(state, self._control, self._parameters, self.dt, state)
            if noisy and np.abs(state[self._velocities]).max() > STANDSTILL:
                state += self._sigma * self._generator.standard_normal(len(state))
            self._steps += 1
            self._collision = self._obstacles.hit(self.pose, self.time)
        if not np.isfinite(state).all():
            raise Defect(f"the model of {self.truth.name} diverged before t = {self.time:.3f} s")

    @property
    def time(self) -> float:
        """Time since the start, s."""
        return self._steps * self.dt

    @property
    def steps(self) -> int:
        """Integration steps since the start."""
        return self._steps

    @property
    def pose(self) -> Floats:
        """Position (m) and heading (rad), (3,)."""
        x, y, theta = self._state[self._pose].tolist()
        return np.array([x, y, math.remainder(theta, math.tau)])

    @property
    def speed(self) -> float:
        """Speed, m/s."""
        return float(self._state[self._velocities[0]])

    @property
    def components(self) -> dict[str, float]:
        """True components of the state, by name."""
        return dict(zip(self.truth.state, self._state.tolist(), strict=True))

    @property
    def marker(self) -> tuple[Floats, Matrix]:
        """Position (3,), m, and rotation (3, 3) of the marker on the roof."""
        x, y, theta = self._state[self._pose].tolist()
        frame = self.frame
        return frame.to_world(np.array([x, y, MARKER_HEIGHT])), frame.rotation @ yaw_rotation(theta)

    @property
    def collision(self) -> Collision | None:
        """First contact with an obstacle, at which the world stopped; None without one."""
        return self._collision

    @property
    def in_goal(self) -> bool:
        """Whether the true state is in the goal region."""
        x, y, theta = self._state[self._pose].tolist()
        return self._scenario.goal.contains(x, y, theta, self.components)

    @cached_property
    def model(self) -> Any:
        """MuJoCo's model of the scene with a block as the vehicle, compiled when it is first drawn."""
        return build(self._scenario, self.frame, self.dt, self._add_body, self._add_block)

    @property
    def data(self) -> Any:
        """MuJoCo's data of the present pose, for drawing."""
        x, y, theta = self._state[self._pose].tolist()
        rotation = self.frame.rotation @ yaw_rotation(theta)
        self._drawn.qpos[:] = *self.frame.to_world(np.array([x, y, 0.0])), *quaternion(rotation)
        mujoco.mj_forward(self.model, self._drawn)
        return self._drawn

    @cached_property
    def _drawn(self) -> Any:
        return mujoco.MjData(self.model)

    def _add_body(self, spec: Any) -> None:
        """Add a body for the vehicle."""
        body = spec.worldbody.add_body(name=CAR)
        body.add_freejoint()
        body.explicitinertial, body.mass, body.inertia = True, 1.0, [1.0, 1.0, 1.0]

    def _add_block(self, spec: Any) -> None:
        """Add the footprint as a block, with a stripe at its front."""
        shape, body = self.truth.footprint, spec.body(CAR)
        back, front = shape.ends
        parts = (("paint", back, 0.0), ("lamp", front - 0.1 * shape.length, 0.001))
        for material, rear, inset in parts:  # the stripe is a little larger, so that it is in front
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[(front + rear) / 2, 0.0, MARKER_HEIGHT / 2],
                size=[(front - rear) / 2 + inset, shape.width / 2 + inset, MARKER_HEIGHT / 2 + inset],
                material=material,
                **contacts.VISUAL,
            )


class _Obstacles:
    """Exact collision test of the footprint with the obstacles, with few distance queries.

    No point of the footprint moves farther than its centre moves plus its reach times the turn.  After a distance is
    measured, no obstacle can therefore be touched before the vehicle has moved that far.
    """

    def __init__(self, scenario: Scenario, vehicle: Vehicle) -> None:
        self._bounds, self._footprint = (scenario.bounds.x, scenario.bounds.y), vehicle.footprint
        self._solid = tuple(planar_obstacle(obstacle) for obstacle in scenario.obstacles)
        self._exact = ExactClearance(Workspace(self._bounds, self._solid), self._footprint)
        self._labels = scenario.obstacle_labels
        self._reach = self._footprint.reach
        self.forget()

    def forget(self) -> None:
        """Forget the measured distance, because the vehicle was moved."""
        self._left, self._last = -1.0, (0.0, 0.0, 0.0)

    def hit(self, pose: Floats, time: float) -> Collision | None:
        """Collision at a pose (3,), None if it is free."""
        x, y, theta = pose.tolist()
        x0, y0, theta0 = self._last
        self._last = x, y, theta
        self._left -= math.hypot(x - x0, y - y0) + self._reach * abs(math.remainder(theta - theta0, math.tau))
        if self._left > 0.0:
            return None
        distance = self._exact.distance(x, y, theta)
        self._left = distance - ROUNDING
        if distance > 0.0:
            return None
        touched = next(k for k in range(len(self._solid)) if self._touches(k, x, y, theta))
        return Collision(time, self._labels[touched], (x, y, 0.0))

    def _touches(self, k: int, x: float, y: float, theta: float) -> bool:
        return ExactClearance(Workspace(self._bounds, (self._solid[k],)), self._footprint).distance(x, y, theta) <= 0.0
