"""Specification, outcome and result of a trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from kraft.driving.messages import Cycle, Observation, Reference, ReferenceKind, begun_cycles
from kraft.driving.method import Method, load_method
from kraft.planning.feasibility import check_placement
from kraft.planning.search import check_seed
from kraft.planning.workspace import start_state
from kraft.scenario import Scenario, load_scenario
from kraft.text import finite
from kraft.trial.cause import Cause
from kraft.trial.measures import Measures, Step
from kraft.trial.planning_vehicle import check_robot, planning_vehicle
from kraft.vehicles.reference import reference_of
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

    def __post_init__(self) -> None:
        """Check the seed, which may be a whole number of numpy, and that all else is loaded.

        Raises:
            InputError: if the seed is negative or no whole number.
            TypeError: if the scenario, the method or the vehicle is another thing, such as its name.
        """
        for name, kind in (("scenario", Scenario), ("method", Method), ("vehicle", Vehicle)):
            value = getattr(self, name)
            if not isinstance(value, kind):
                expected = f"expected a {kind.__name__}, not {type(value).__name__}"
                raise TypeError(f"{name}: {expected}; `TrialSpec.load` takes names and paths")
        check_seed(self.seed)
        object.__setattr__(self, "seed", int(self.seed))

    @classmethod
    def load(
        cls,
        scenario: str | Path,
        method: str | Path = "kraft",
        vehicle: str | Path | None = None,
        seed: int = 0,
        settings: Mapping[str, Any] | None = None,
    ) -> TrialSpec:
        """Load a trial by bundled names or paths.

        `vehicle` replaces the method's and the scenario's, `settings` are values of the scenario's dotted keys.

        Raises:
            InputError: with what is wrong with scenario, settings, method, vehicle or seed, or with where the start is.
            TypeError: if one of them is neither a name nor a path.
        """
        loaded, loaded_method = load_scenario(scenario, settings), load_method(method)
        model = planning_vehicle(loaded, loaded_method, None if vehicle is None else reference_of(vehicle))
        check_robot(loaded, model)
        check_placement(loaded, model, start_state(loaded, model))
        return cls(loaded, loaded_method, model, seed)


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
    def begun(self) -> tuple[Cycle, ...]:
        """Cycles that began before the trial ended; the last of the `cycles` may have been decided for later."""
        return begun_cycles(self.cycles, self.time)

    @property
    def contingencies(self) -> int:
        """Number of cycles that began with the contingency instead of a plan."""
        return sum(cycle.kind is ReferenceKind.CONTINGENCY for cycle in self.begun)

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
