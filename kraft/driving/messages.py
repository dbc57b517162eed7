"""Messages between sensing, estimation, replanning and control, the record of each cycle, and what controllers are.

An `Observation` becomes an `Estimate`; the replanner commits a `Reference`, which a `Controller` tracks, and records a
`Cycle`.  Times are seconds of the trial, 0 when the first plan is committed.  States are those of the vehicle's model;
poses are (x, y, theta) in the frame of the map (m, rad).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Protocol

import numpy as np

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.exact import ExactClearance
from ompl_ext.obstacles import Polygon, Workspace
from ompl_ext.plan import TreeView
from ompl_ext.times import SAME_TIME
from ompl_ext.vehicle import Footprint


@dataclass(frozen=True)
class Observation:
    """Pose measured by the camera at `time`; it arrives at `arrival`, later by the latency."""

    time: float
    arrival: float
    x: float
    y: float
    theta: float


@dataclass(frozen=True)
class PoseBelief:
    """Mean (3,) and covariance (3, 3) of the pose at the `time` of an observation, after it is processed; m, rad."""

    time: float
    mean: Floats
    covariance: Matrix


@dataclass(frozen=True)
class Uncertainty:
    """Covariance (nx, nx) of an estimated state, and standard deviations of the delay of commands (s) and the drive.

    `acceleration` is the standard deviation of the acceleration that the drive causes, m/s^2.
    """

    state: Matrix
    delay: float = 0.0
    acceleration: float = 0.0


@dataclass(frozen=True)
class Estimate:
    """Estimated state (nx,) at `time`.

    `age` is the age of the newest observation that the estimate rests on (s), infinite before the first one.
    `parameters` are those of the vehicle (np,) if they are estimated too, `uncertainty` is that of an estimator that
    states one.
    """

    time: float
    state: Floats
    age: float
    parameters: Floats | None = None
    uncertainty: Uncertainty | None = None


class ReferenceKind(StrEnum):
    """Kind of a reference: a plan or a contingency manoeuvre."""

    PLAN = "plan"
    CONTINGENCY = "contingency"


class ContingencyOrigin(StrEnum):
    """Origin of a committed contingency."""

    SAFE = "safe"
    """verified from the predicted start of the cycle"""
    IN_HAND = "in hand"
    """verified by an earlier cycle, whose assumptions still hold"""
    PLAN_THEN_STOP = "plan, then stop"
    """the path of a plan for a while, then a manoeuvre, verified from the predicted start of the cycle"""
    CREEPING = "creeping"
    """the path of a plan at low speed, then standstill, verified from the predicted start of the cycle"""
    STANDING = "standing"
    """the vehicle stands, and stays where it is"""
    EMERGENCY = "emergency"
    """verified by nothing"""


class PlanLoss(StrEnum):
    """Reason for which the remainder of a plan was not retained."""

    NONE = "none"
    """it was retained"""
    ESTIMATE = "estimate moved"
    """from the state that the plan predicted it could have been retained"""
    COLLISION = "edge in collision"
    """an edge has less than the required distance to obstacles"""
    UNSAFE = "unsafe"
    """an edge lacks clearance within the coming cycle, or a safe contingency"""


@dataclass(frozen=True)
class Stop:
    """Number of a manoeuvre that stops the vehicle, and the time at which it begins (s)."""

    manoeuvre: int
    begin: float


@dataclass(frozen=True)
class Reference:
    """Trajectory to track: states (m, nx) predicted at `times` (m,), ascending, in seconds of the trial.

    Each of the `controls` (m - 1, nu) is held from one time to the next; `rest` (nu,) is held after the last time.
    `stop` is the manoeuvre that ends a contingency; None for a plan.
    """

    kind: ReferenceKind
    times: Floats
    states: Matrix
    controls: Matrix
    rest: Floats
    stop: Stop | None = None

    @property
    def start(self) -> float:
        """Time at which the reference begins, s."""
        return float(self.times[0])

    @property
    def end(self) -> float:
        """Time at which the reference ends, s."""
        return float(self.times[-1])

    def state_at(self, time: float) -> Floats:
        """State (nx,) at `time` by linear interpolation, constant before the start and after the end."""
        k, share = self._interval(time)
        after = min(k + 1, len(self.states) - 1)
        state: Floats = (1.0 - share) * self.states[k] + share * self.states[after]
        return state

    def control_at(self, time: float) -> Floats:
        """Control (nu,) that is held at `time`."""
        if time >= self.times[-1] or len(self.controls) == 0:
            return self.rest.copy()
        held: Floats = self.controls[self._interval(time)[0]]
        return held.copy()

    def controls_at(self, times: Floats) -> Matrix:
        """Controls (n, nu) that are held at `times` (n,), as `control_at`."""
        if len(self.controls) == 0:
            resting: Matrix = np.tile(self.rest, (len(times), 1))
            return resting
        last = max(len(self.times) - 2, 0)
        held = self.controls[(self.times.searchsorted(times, side="right") - 1).clip(0, last)]
        found: Matrix = np.where((times >= self.times[-1])[:, None], self.rest, held)
        return found

    def _interval(self, time: float) -> tuple[int, float]:
        """Index of the last sample up to `time`, and the elapsed share of the interval after it."""
        if time <= self.times[0] or len(self.times) == 1:
            return 0, 0.0
        if time >= self.times[-1]:
            return len(self.times) - 1, 0.0
        k = int(self.times.searchsorted(time, side="right")) - 1
        return k, float((time - self.times[k]) / (self.times[k + 1] - self.times[k]))


@dataclass(frozen=True)
class Commitment:
    """Message from the replanner to the car: the reference to track and, from `switch` s on, the contingency after it.

    An infinite `switch` leaves the car on the reference.  The message rests on an estimate at time `decided` (s).
    `contingency` is None if the method has none.
    """

    reference: Reference
    switch: float = math.inf
    contingency: Reference | None = None
    decided: float = -math.inf

    def reference_at(self, time: float) -> Reference:
        """Reference to track at `time` (s), if no later message arrives."""  # Theorem 1, case (b)
        if self.contingency is None or time < self.switch - SAME_TIME:
            return self.reference
        return self.contingency


@dataclass(frozen=True)
class PredictedMotion:
    """Predicted states (n + 1, nx) at `times` (n + 1,) s.

    `slack` is a lower bound of the clearance minus the required clearance (m), negative if the motion may violate it.
    `delta` (n + 1,) is the clearance, delta(v) or delta(t, v), that the method asks of each state (m), if it asks any.
    `controls` (n, nu) are those between the states, if they are known.
    """

    times: Floats
    states: Matrix
    slack: float
    delta: Floats | None = None
    controls: Matrix | None = None

    @property
    def final_state(self) -> Floats:
        """The last state."""
        last: Floats = self.states[-1]
        return last


@dataclass(frozen=True)
class Passage:
    """Poses (n, 3) of a vehicle past the obstacles of a workspace."""

    workspace: Workspace
    footprint: Footprint
    poses: Matrix

    @cached_property
    def clearance(self) -> float:
        """Smallest distance to an obstacle (m), measured when it is asked for: of most cycles nobody does."""
        return ExactClearance(self.workspace, self.footprint).least_distance(self.poses)


@dataclass(frozen=True)
class Cycle:
    """One replanning cycle: the committed reference, the reason for a contingency, and the effort of planning.

    `time` is the start of the cycle (s), from which on the controller tracks `reference`.  `cost_to_goal` is the
    predicted time to the goal (s): that of the committed plan, plus the cost-to-go from its end if the plan does not
    reach the goal; without a plan it is infinite.  `predicted` is the predicted motion within the cycle and `passage`
    its poses among the obstacles.  `lost` is why the remainder of the last plan was not retained when this
    plan was made, `switch_refused` whether a better plan that goes another way was refused.  `contingency_origin` is
    None if a plan is committed.  `planning_ms` is measured; all other fields are reproducible.  `tree` is None unless
    trees are kept.

    `parameters` (np,) are those of the vehicle if they are estimated.  `commitment` is the message to the car,
    `delivered` whether it arrives.  `stopping` is the predicted motion of the contingency on board until standstill;
    None if the car stays on the plan.  `proposed` is whether there was a plan to check.  `blocked` are what has blocked
    the vehicle so far, which counts as obstacles beside those of the map; `held` is the time (begin, end; s) in which
    the newest of them has held it, if this cycle found it.
    """

    number: int
    time: float
    speed: float
    reason: str
    cost_to_goal: float
    passage: Passage
    iterations: int
    nodes: int
    retained: int
    planning_ms: float
    missed: bool
    reference: Reference
    contingency: Reference | None
    predicted: PredictedMotion
    lost: PlanLoss = PlanLoss.NONE
    switch_refused: bool = False
    contingency_origin: ContingencyOrigin | None = None
    tree: TreeView | None = None
    switch: float = math.inf
    decided: float = -math.inf
    stopping: PredictedMotion | None = None
    delivered: bool = True
    parameters: Floats | None = None
    proposed: bool = True
    blocked: tuple[Polygon, ...] = ()
    held: tuple[float, float] | None = None

    @property
    def kind(self) -> ReferenceKind:
        """Whether a plan or a contingency is committed."""
        return self.reference.kind

    @property
    def clearance(self) -> float:
        """Smallest distance of the predicted motion within the cycle to an obstacle, m."""
        return self.passage.clearance

    @property
    def commitment(self) -> Commitment:
        """Message to the car."""
        return Commitment(self.reference, self.switch, self.contingency, self.decided)


def cycles_on_board(cycles: Sequence[Cycle]) -> Iterator[Cycle]:
    """For each cycle the one whose message the car drives by: after a lost message the last one that arrived.

    It is the cycle itself if there was none, or if that one has no contingency, whose motion would be known.
    """
    arrived: Cycle | None = None
    for cycle in cycles:
        if cycle.delivered or arrived is None:
            arrived = cycle
        yield cycle if arrived.stopping is None else arrived


def begun_cycles(cycles: Sequence[Cycle], end: float) -> tuple[Cycle, ...]:
    """Cycles that began by the end of the drive (s): the replanner decides ahead, and the last may not have begun."""
    return tuple(cycle for cycle in cycles if cycle.time <= end + SAME_TIME)


def as_driven(cycles: Sequence[Cycle]) -> tuple[Cycle, ...]:
    """Cycles as the car drives them: after a lost message the contingency on board, if there is one."""
    pairs = zip(cycles, cycles_on_board(cycles), strict=True)
    return tuple(cycle if on_board is cycle else _after_loss(cycle, on_board) for cycle, on_board in pairs)


def _after_loss(cycle: Cycle, on_board: Cycle) -> Cycle:
    """A cycle whose message was lost, with the contingency `on_board` and its motion until standstill."""
    contingency, stopping = on_board.contingency, on_board.stopping
    assert contingency is not None, "its motion is known"
    assert stopping is not None, "its motion is known"
    return replace(
        cycle,
        reason="the message was lost",
        reference=contingency,
        contingency=contingency,
        predicted=stopping,
    )


class Controller(Protocol):
    """Tracks a reference; each call may pass a new one."""

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) to send at the estimate's time, within the actuators' bounds."""
