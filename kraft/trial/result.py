"""Specification, outcome and result of a trial, and the cause of a collision or a timeout.

The cause is found in what was recorded of the trial.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from kraft.driving.messages import ContingencyOrigin, Cycle, Observation, Reference, ReferenceKind, as_driven
from kraft.driving.method import Method, check_vehicle, load_method
from kraft.errors import InputError
from kraft.planning.feasibility import check_placement
from kraft.planning.search import check_seed
from kraft.planning.workspace import start_state, vehicle_of_task
from kraft.scenario import Scenario, load_scenario
from kraft.text import counted, finite
from kraft.trial.measures import Measures, Record, Step, farthest_point
from kraft.vehicles import is_car
from kraft.vehicles.load import load_vehicle, natural_robot
from kraft.vehicles.reference import VehicleProblem, resolve_vehicle
from ompl_ext.arrays import Matrix
from ompl_ext.interpolation import interpolated_rows
from ompl_ext.vehicle import Footprint, Vehicle


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
        """Check the seed.

        Raises:
            InputError: if it is negative.
        """
        check_seed(self.seed)

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
            InputError: with what is wrong with scenario, settings, method, vehicle or seed, or with where the start is.
        """
        loaded, loaded_method = load_scenario(scenario, settings), load_method(method)
        model = planning_vehicle(loaded, loaded_method, vehicle)
        check_robot(loaded, model)
        check_placement(loaded, model, start_state(loaded, model))
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


WINDOW: Final = 10.0
"""Time before a timeout over which its cause is looked for, s; a third of the trial if that is longer."""
STANDS: Final = 0.25
"""Extent of the motion within that time up to which a car counts as stuck, m."""


class CauseKind(StrEnum):
    """Kind of a cause and its meaning; the first one that applies is the cause."""

    meaning: str

    def __new__(cls, value: str, meaning: str) -> Self:
        """Make a kind that equals the string `value`."""
        kind = str.__new__(cls, value)
        kind._value_, kind.meaning = value, meaning
        return kind

    MESSAGE_LOST = "message lost", "the car did not get the message of the cycle, or its watchdog had stopped it"
    DEADLINE_MISSED = "deadline missed", "planning took longer than the cycle minus its lead, in a trial by the clock"
    CONTINGENCY_TOO_LATE = (
        "contingency too late",
        "nothing verified the contingency when it was committed, or it was predicted to come too close",
    )
    UNSAFE_PLAN = "unsafe plan", "the car was where it was predicted to be, and the plan itself came too close"
    ESTIMATE_WRONG = (
        "estimate wrong",
        "the car deviated by more, and its estimated pose was wrong by at least half as much",
    )
    DEVIATION = (
        "deviation",
        "the car deviated by more than the clearance δ(v), or than the distance to the obstacle, or "
        "from its plan until the plan's end, though it knew where it was",
    )
    NO_PLAN = "no plan found", "in most cycles before the timeout the planner had no plan"
    PLANS_REFUSED = "plans refused", "in most cycles before the timeout the plan was not safe from the latest estimate"
    STUCK = "stuck", "the car stood before the timeout, though it had plans"
    TOO_SLOW = "too slow", "the car drove on until the timeout"


class Cause(Record):
    """Cause in a word, and with its numbers."""

    kind: CauseKind
    text: str


def collision_cause(
    cycles: Sequence[Cycle], steps: Sequence[Step], footprint: Footprint, pose: Sequence[int], *, realtime: bool
) -> Cause:
    """Cause of a collision right after the last of the `steps`.

    Args:
        cycles: cycles of the trial, at least one.
        steps: its ticks of the controller, at least one.
        footprint: footprint of the planner's vehicle.
        pose: indices of x, y and theta in its state.
        realtime: whether planning was limited by the clock.
    """
    last = steps[-1]
    k = max((k for k, cycle in enumerate(cycles) if cycle.time <= last.time + 1e-9), default=0)
    sent, cycle = cycles[k], as_driven(cycles)[k]
    if last.watchdog:
        return Cause(kind=CauseKind.MESSAGE_LOST, text="the watchdog had stopped the car")
    if not sent.delivered:
        return Cause(kind=CauseKind.MESSAGE_LOST, text=f"the message of cycle {sent.number} was lost")
    if realtime and sent.missed:
        text = f"planning for cycle {sent.number} took {sent.planning_ms:.0f} ms"
        return Cause(kind=CauseKind.DEADLINE_MISSED, text=text)
    contingency = cycle.kind == ReferenceKind.CONTINGENCY
    if contingency and cycle.contingency_origin is ContingencyOrigin.EMERGENCY:
        text = f"cycle {cycle.number} committed a contingency that nothing verified: {cycle.reason}"
        return Cause(kind=CauseKind.CONTINGENCY_TOO_LATE, text=text)
    deviation = _deviation(cycle, last, footprint, pose)
    allowed = _allowed(cycle, last.time)
    if (allowed is not None and deviation <= allowed) or cycle.clearance <= 0.0:
        kind = CauseKind.CONTINGENCY_TOO_LATE if contingency else CauseKind.UNSAFE_PLAN
        near = f"the prediction of cycle {cycle.number} comes within {max(cycle.clearance, 0.0):.3f} m of an obstacle"
        return Cause(kind=kind, text=f"{near}, and the car was {deviation:.3f} m from it")
    error = max(estimate_errors(steps, footprint, pose, since=min(cycle.decided, last.time)), default=0.0)
    text = f"{deviation:.3f} m from the prediction"
    if allowed is not None:
        text += f", {allowed:.3f} m allowed"
    if error >= deviation / 2.0:
        return Cause(kind=CauseKind.ESTIMATE_WRONG, text=f"the estimate was wrong by {error:.3f} m; {text}")
    return Cause(kind=CauseKind.DEVIATION, text=f"{text}; the estimate was wrong by {error:.3f} m")


def timeout_cause(
    cycles: Sequence[Cycle], steps: Sequence[Step], footprint: Footprint, pose: Sequence[int], *, realtime: bool
) -> Cause:
    """Cause of a timeout right after the last of the `steps`; see `collision_cause`."""
    end = steps[-1].time
    since = end - max(WINDOW, end / 3.0)
    late = [cycle for cycle in cycles if cycle.time >= since]
    if not late:  # one shot
        return _unfinished_plan(cycles[-1], steps, footprint, pose)
    of = f"of the last {len(late)} cycles"
    lost = sum(not cycle.delivered for cycle in late)
    if 2 * lost > len(late):
        return Cause(kind=CauseKind.MESSAGE_LOST, text=f"the messages of {lost} {of} were lost")
    missed = sum(cycle.missed for cycle in late) if realtime else 0
    if 2 * missed > len(late):
        return Cause(kind=CauseKind.DEADLINE_MISSED, text=f"planning for {missed} {of} took too long")
    stopped = [cycle for cycle in late if cycle.kind == ReferenceKind.CONTINGENCY]
    if 2 * len(stopped) > len(late):
        refused = sum(cycle.proposed for cycle in stopped)
        if 2 * refused > len(stopped):
            text = f"{refused} {of} had a plan that was not safe: {stopped[-1].reason}"
            return Cause(kind=CauseKind.PLANS_REFUSED, text=text)
        text = f"{len(stopped) - refused} {of} had no plan: {stopped[-1].reason}"
        return Cause(kind=CauseKind.NO_PLAN, text=text)
    track = np.array([step.pose[:2] for step in steps if step.time >= since])
    extent = float(np.hypot(*np.ptp(track, axis=0)))
    if extent < STANDS:
        planned = counted(len(late), "cycle")
        text = f"moved {extent:.2f} m in the last {end - max(since, 0.0):.3g} s, with plans in {planned}"
        return Cause(kind=CauseKind.STUCK, text=text)
    left = late[-1].cost_to_goal
    text = f"the last plan needed {left:.1f} s more" if np.isfinite(left) else "still driving at the end"
    return Cause(kind=CauseKind.TOO_SLOW, text=text)


def estimate_errors(
    steps: Sequence[Step], footprint: Footprint, pose: Sequence[int], since: float = -np.inf
) -> list[float]:
    """Largest distance of a point of the car between its estimated and its true pose, from time `since` on, m.

    An estimate that is ahead of its tick is compared with the true pose at its own time.
    """
    times = np.array([step.time for step in steps])
    true = _unwrapped(np.array([step.pose for step in steps]))
    own = times + np.array([step.ahead for step in steps])
    kept = (own >= since) & (own <= times[-1] + 1e-9)
    if not kept.any():
        kept = own == own[0]
    there = interpolated_rows(own[kept], times, true)
    estimated = np.array([step.estimate[list(pose)] for step in steps])[kept]
    errors: list[float] = farthest_point(there, estimated, footprint).tolist()
    return errors


def _unfinished_plan(cycle: Cycle, steps: Sequence[Step], footprint: Footprint, pose: Sequence[int]) -> Cause:
    """Cause of the timeout of a plan that is followed to its end, without others after it."""
    if cycle.kind == ReferenceKind.CONTINGENCY:
        return Cause(kind=CauseKind.NO_PLAN, text=cycle.reason)
    after = next((step for step in steps if step.time >= cycle.reference.end), steps[-1])
    expected = cycle.reference.state_at(after.time)[list(pose)]
    off = float(farthest_point(np.array([after.pose]), expected[None, :], footprint)[0])
    return Cause(kind=CauseKind.DEVIATION, text=f"{off:.3f} m from the plan at its end, {after.time:.1f} s")


def _deviation(cycle: Cycle, step: Step, footprint: Footprint, pose: Sequence[int]) -> float:
    """Largest distance of a point of the car from where a cycle predicts it, m; from its reference after that."""
    predicted = cycle.predicted
    if step.time <= predicted.times[-1] + 1e-9:
        expected = interpolated_rows(step.time, predicted.times, predicted.states[:, list(pose)])
    else:
        expected = cycle.reference.state_at(step.time)[list(pose)]
    return float(farthest_point(np.array([step.pose]), expected[None, :], footprint)[0])


def _allowed(cycle: Cycle, time: float) -> float | None:
    """Clearance delta(v) of a cycle at a time, m; without one the distance of its prediction to the obstacles.

    None after the prediction and in a scene without obstacles.
    """
    predicted = cycle.predicted
    if time > predicted.times[-1] + 1e-9:
        return None
    if predicted.delta is not None:
        return float(np.interp(time, predicted.times, predicted.delta))
    return finite(cycle.clearance)


def _unwrapped(poses: Matrix) -> Matrix:
    """Poses (n, 3) whose headings have no jumps by a whole turn."""
    poses = poses.copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    return poses
