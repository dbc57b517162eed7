"""Specification, outcome and result of a trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from kraft.driving.messages import Cycle, Observation
from kraft.driving.method import Method, check_vehicle, load_method
from kraft.errors import InputError
from kraft.planning.workspace import vehicle_of_task
from kraft.scenario import Scenario, load_scenario
from kraft.trial.measures import Measures, Step
from kraft.vehicles.load import load_vehicle
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
        reference = vehicle_reference(loaded, loaded_method, vehicle)
        model = load_planning_vehicle(loaded, reference)
        check_vehicle(loaded_method, model, own=vehicle is None and loaded_method.planner.vehicle is not None)
        return cls(loaded, loaded_method, model, seed)


def vehicle_reference(scenario: Scenario, method: Method, vehicle: str | None = None) -> str:
    """Reference of the model that the robot plans with: `vehicle`, else the method's own, else the scenario's.

    A path in a method file is relative to that file.

    Raises:
        InputError: if the method's reference is wrong, reported at its line.
    """
    if vehicle is not None or method.planner.vehicle is None:
        return vehicle or scenario.vehicle
    try:
        return resolve_vehicle(method.planner.vehicle, Path(method.source.file).parent)
    except VehicleProblem as error:
        problem = method.source.diagnostic("planner.vehicle", error.problem, error.expected, code=error.code)
        raise InputError([problem]) from None


def load_planning_vehicle(scenario: Scenario, reference: str) -> Vehicle:
    """Model of a `vehicle_reference`; problems with the scenario's own are reported at its line.

    Raises:
        InputError: if it cannot be loaded.
    """
    return vehicle_of_task(scenario) if reference == scenario.vehicle else load_vehicle(reference)


@dataclass(frozen=True)
class TrialResult:
    """Result of a trial.

    `time` is the time of its end (s), `obstacle` that of the collision, and `min_clearance` the smallest true distance
    between the vehicle's footprint and an obstacle at any tick of the controller (m).  `measures` compares what the
    method promised with the true motion.
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

    @property
    def contingencies(self) -> int:
        """Number of cycles that committed the contingency instead of a plan."""
        return sum(cycle.kind == "contingency" for cycle in self.cycles)

    @property
    def missed(self) -> int:
        """Number of cycles that exceeded their planning time."""
        return sum(cycle.missed for cycle in self.cycles)
