"""Specification, outcome and result of a trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from kraft.driving.messages import Cycle, Observation, Reference, ReferenceKind
from kraft.driving.method import Method, check_vehicle, load_method
from kraft.errors import InputError
from kraft.planning.workspace import vehicle_of_task
from kraft.scenario import Scenario, load_scenario
from kraft.text import finite
from kraft.trial.cause import Cause
from kraft.trial.measures import Measures, Step
from kraft.vehicles import is_car
from kraft.vehicles.load import load_vehicle, natural_robot
from kraft.vehicles.reference import VehicleProblem, resolve_vehicle
from ompl_ext.vehicle import Vehicle


class Outcome(StrEnum):
    """Outcome of a trial."""

    SUCCESS = "success"
    COLLISION = "collision"
    TIMEOUT = "timeout"


def outcome_text(outcome: str, obstacle: str | None = None, time: float | None = None, digits: int = 2) -> str:
    """Outcome in words: ``collision with first box after 3.21 s``; without `time` (s) ``collision with first box``."""
    text = str(outcome)
    text += f" with {obstacle}" if obstacle else ""
    return text + (f" after {time:.{digits}f} s" if time is not None else "")


@dataclass(frozen=True)
class TrialSpec:
    """Specification of a trial; equal specifications give equal results, byte for byte, in any process.

    `vehicle` is the planning model.  With `realtime` the budget of a cycle is its wall-clock time instead of the
    method's iterations, and results are not repeatable.
    """

    scenario: Scenario
    method: Method
    vehicle: Vehicle
    seed: int
    realtime: bool = False

    @classmethod
    def load(
        cls,
        scenario: str | Path,
        method: str | Path = "kraft",
        vehicle: str | None = None,
        seed: int = 0,
        settings: Mapping[str, Any] | None = None,
    ) -> TrialSpec:
        """Load a trial by bundled names or paths.

        `vehicle` replaces the method's and the scenario's, `settings` are values of the scenario's dotted keys.

        Raises:
            InputError: with what is wrong with scenario, settings, method or vehicle.
        """
        loaded, loaded_method = load_scenario(scenario, settings), load_method(method)
        model = planning_vehicle(loaded, loaded_method, vehicle)
        check_robot(loaded, model)
        return cls(loaded, loaded_method, model, seed)


def planning_vehicle(scenario: Scenario, method: Method, vehicle: str | None = None) -> Vehicle:
    """Model of `vehicle_reference`, loaded and checked for the method.

    Raises:
        InputError: if it cannot be loaded, or lacks what the method's estimator needs.
    """
    reference = vehicle_reference(scenario, method, vehicle)
    model = load_planning_vehicle(scenario, reference)
    check_vehicle(method, model, own=reference not in (vehicle, scenario.vehicle))
    return model


def vehicle_reference(scenario: Scenario, method: Method, vehicle: str | None = None) -> str:
    """Reference of the model that the robot plans with: `vehicle`, else the method's own, else the scenario's.

    The method's own is used if it is a model of the robot that the scenario's vehicle is a model of.  A path in a
    method file is relative to that file.

    Raises:
        InputError: if the method's reference is wrong, reported at its line.
    """
    if vehicle is not None or method.planner.vehicle is None:
        return vehicle or scenario.vehicle
    try:
        own = resolve_vehicle(method.planner.vehicle, Path(method.source.file).parent)
    except VehicleProblem as error:
        problem = method.source.diagnostic("planner.vehicle", error.problem, error.expected, code=error.code)
        raise InputError([problem]) from None
    if own == scenario.vehicle or _are_of_one_robot(load_vehicle(own), vehicle_of_task(scenario)):
        return own
    return scenario.vehicle


def _are_of_one_robot(one: Vehicle, other: Vehicle) -> bool:
    """Whether two vehicles are models of the same robot: the same is true of both where a scenario states nothing."""
    (robot, _), (other_robot, _) = natural_robot(one), natural_robot(other)
    return robot == other_robot and sorted(one.controls) == sorted(other.controls)


def load_planning_vehicle(scenario: Scenario, reference: str) -> Vehicle:
    """Model of a `vehicle_reference`; problems with the scenario's own are reported at its line.

    Raises:
        InputError: if it cannot be loaded.
    """
    return vehicle_of_task(scenario) if reference == scenario.vehicle else load_vehicle(reference)


def check_robot(scenario: Scenario, vehicle: Vehicle) -> None:
    """Check that the true robot of a scenario can be simulated there and takes the controls of the planning model.

    Raises:
        InputError: at the line that states the robot, if not.
    """
    kind = scenario.truth.kind or natural_robot(vehicle)[0].kind
    if kind != "car" or not is_car(vehicle):
        from kraft.simulation.true_world import check_world  # loads the simulator

        check_world(scenario, vehicle)


def check_own_robot(vehicle: Vehicle) -> None:
    """Check the robot that a vehicle's file states.

    Raises:
        InputError: at its line, if it cannot be simulated or takes other controls.
    """
    robot, source = natural_robot(vehicle)
    if robot.kind is not None and ("truth",) in source.keys:
        from kraft.simulation.true_world import check_own_truth  # loads the simulator

        check_own_truth(vehicle)


@dataclass(frozen=True)
class TrialResult:
    """Result of a trial.

    `time` is the time of its end (s), `obstacle` that of the collision, and `min_clearance` the smallest true distance
    between the vehicle's footprint and an obstacle at any tick of the controller (m).  `measures` compares what the
    method promised with the true motion.  `cause` is that of a collision or a timeout.  `command_ms` has the measured
    time of each command of the controller; `late_commands` of them took longer than the time between two commands.
    """

    scenario: str
    method: str
    seed: int
    outcome: Outcome
    time: float
    obstacle: str | None
    min_clearance: float
    cycles: tuple[Cycle, ...] = field(repr=False)
    steps: tuple[Step, ...] = field(repr=False)
    observations: tuple[Observation, ...] = field(repr=False, default=())
    measures: Measures = field(repr=False, default_factory=Measures)
    cause: Cause | None = None
    command_ms: tuple[float, ...] = field(repr=False, default=())
    late_commands: int = 0

    @property
    def contingencies(self) -> int:
        """Number of cycles that committed the contingency instead of a plan."""
        return sum(cycle.kind == ReferenceKind.CONTINGENCY for cycle in self.cycles)

    @property
    def missed(self) -> int:
        """Number of cycles that exceeded their planning time."""
        return sum(cycle.missed for cycle in self.cycles)


def cycle_content(cycle: Cycle) -> dict[str, Any]:
    """JSON object of a cycle; infinite values are null."""
    return {
        "number": cycle.number,
        "time": float(cycle.time),
        "speed": float(cycle.speed),
        "kind": str(cycle.kind),
        "reason": cycle.reason,
        "cost_to_goal": finite(cycle.cost_to_goal),
        "clearance": finite(cycle.clearance),
        "iterations": cycle.iterations,
        "nodes": cycle.nodes,
        "retained": cycle.retained,
        "lost": str(cycle.lost),
        "switch_refused": bool(cycle.switch_refused),
        "contingency_origin": None if cycle.contingency_origin is None else str(cycle.contingency_origin),
        "planning_ms": cycle.planning_ms,
        "missed": bool(cycle.missed),
        "delivered": cycle.delivered,
        "switch": finite(cycle.switch),
        "reference": _reference(cycle.reference),
        "contingency": _reference(cycle.contingency),
    }


def _reference(reference: Reference | None) -> dict[str, Any] | None:
    if reference is None:
        return None
    return {
        "kind": str(reference.kind),
        "times": reference.times.tolist(),
        "states": reference.states.tolist(),
        "controls": reference.controls.tolist(),
        "rest": reference.rest.tolist(),
    }
