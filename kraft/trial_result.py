"""What a trial is, and what is kept of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from kraft.driving import Motion, Observation, Reference
from kraft.method import Method
from kraft.scenario import Scenario
from ompl_ext.arrays import Floats
from ompl_ext.plan import TreeView
from ompl_ext.vehicle import Vehicle


class Outcome(StrEnum):
    """How a trial ends."""

    SUCCESS = "success"
    COLLISION = "collision"
    TIMEOUT = "timeout"


@dataclass(frozen=True)
class TrialSpec:
    """One trial; the same spec gives the same result, byte for byte, in any process.

    `vehicle` is the model of itself that the robot plans with.  With `realtime` a cycle's budget is its wall-clock
    time instead of the method's iterations, and nothing repeats.
    """

    scenario: Scenario
    method: Method
    vehicle: Vehicle
    seed: int
    realtime: bool = False


@dataclass(frozen=True)
class Step:
    """One tick of the controller: truth, belief and command."""

    time: float
    pose: tuple[float, float, float]
    speed: float
    estimate: Floats
    command: Floats
    cycle: int


@dataclass(frozen=True)
class Cycle:
    """One replanning cycle: what was committed at `time`, why, and what it cost to find.

    `time` is when the cycle begins (s): what was committed for it is tracked from then on.  `cost_to_goal` is the
    predicted time to the goal (s) of the committed plan, with the cost-to-go from its end if it does not lead there,
    and infinite without a plan.  `predicted` is what the robot expects to do within the cycle and `clearance` the
    smallest distance to an obstacle that it passes (m).  `planning_ms` is measured and everything else repeats.
    `tree` is kept only when asked for.
    """

    number: int
    time: float
    speed: float
    kind: str
    reason: str
    cost_to_goal: float
    clearance: float
    iterations: int
    nodes: int
    retained: int
    planning_ms: float
    missed: bool
    reference: Reference
    contingency: Reference | None
    predicted: Motion
    tree: TreeView | None = None


@dataclass(frozen=True)
class TrialResult:
    """What came of a trial.

    `time` is when it ended (s), `obstacle` what was hit; `min_clearance` is the smallest true distance between the
    vehicle's footprint and an obstacle at any tick of the controller (m).
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

    @property
    def contingencies(self) -> int:
        """Cycles in which the contingency was committed instead of a plan."""
        return sum(cycle.kind == "contingency" for cycle in self.cycles)

    @property
    def missed(self) -> int:
        """Cycles whose planning took longer than there was time."""
        return sum(cycle.missed for cycle in self.cycles)
