"""What is true in a trial: the robot that a scenario or a vehicle states, and the world that simulates it.

The world is that of MuJoCo, or one in which a vehicle's own model is true, with other parameters and process noise and
without a physics engine (`kraft.simulation.model_world`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np

from kraft.config.source import Source
from kraft.errors import Code, Diagnostic, InputError
from kraft.scenario import Scenario, Start
from kraft.scenario.truth import Truth, VehicleGap
from kraft.simulation.car import CarDesign, design_of, design_problem
from kraft.simulation.contacts import Collision
from kraft.simulation.floor_frame import FloorFrame
from kraft.simulation.model_world import ModelWorld, slope_of
from kraft.simulation.robots import MjcfRobot, SimulatedCar, mjcf_robot
from kraft.simulation.world import World
from kraft.text import suggestion
from kraft.vehicles import CAR_CONTROLS, STEEPEST, check_state
from kraft.vehicles.load import load_vehicle, natural_robot
from kraft.vehicles.true_robot import CarDimensions, RobotTruth
from ompl_ext.arrays import Floats, Matrix
from ompl_ext.names import FORCE
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
    if model.gravity_share is not None and np.linalg.norm(slope_of(model)) > STEEPEST:
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
