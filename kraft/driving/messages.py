"""What passes between sensing, estimation, replanning and control while a vehicle drives.

Times are seconds of the trial, 0 when the first plan is committed.  States are those of the vehicle's model; poses
are (x, y, theta) in the frame of the map (m, rad).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from ompl_ext.arrays import Floats, Matrix
from ompl_ext.plan import TreeView


@dataclass(frozen=True)
class Observation:
    """A pose as the camera measured it at `time`; it arrives at `arrival`, later by the latency."""

    time: float
    arrival: float
    x: float
    y: float
    theta: float


@dataclass(frozen=True)
class Estimate:
    """State (nx,) that the vehicle is believed to be in at `time`.

    `age` is how old the newest observation behind it is (s), infinite before the first one.
    """

    time: float
    state: Floats
    age: float


class ReferenceKind(StrEnum):
    """What a reference is: part of a plan, or a contingency manoeuvre."""

    PLAN = "plan"
    CONTINGENCY = "contingency"


@dataclass(frozen=True)
class Reference:
    """The trajectory to track: states (m, nx) predicted at `times` (m,), ascending, in seconds of the trial.

    `controls` (m - 1, nu) are held from each time to the next, and `rest` (nu,) after the last one.
    """

    kind: ReferenceKind
    times: Floats
    states: Matrix
    controls: Matrix
    rest: Floats

    @property
    def start(self) -> float:
        """When it begins, s."""
        return float(self.times[0])

    @property
    def end(self) -> float:
        """When it is over, s."""
        return float(self.times[-1])

    def state_at(self, time: float) -> Floats:
        """State (nx,) at `time` by linear interpolation; the first before it begins and the last after it ends."""
        k, share = self._interval(time)
        after = min(k + 1, len(self.states) - 1)
        state: Floats = (1.0 - share) * self.states[k] + share * self.states[after]
        return state

    def control_at(self, time: float) -> Floats:
        """Control (nu,) held at `time`."""
        if time >= self.times[-1] or len(self.controls) == 0:
            return self.rest.copy()
        held: Floats = self.controls[self._interval(time)[0]]
        return held.copy()

    def _interval(self, time: float) -> tuple[int, float]:
        """Index of the sample before `time` and the share of the interval that has passed."""
        if time <= self.times[0] or len(self.times) == 1:
            return 0, 0.0
        if time >= self.times[-1]:
            return len(self.times) - 1, 0.0
        k = int(self.times.searchsorted(time, side="right")) - 1
        return k, float((time - self.times[k]) / (self.times[k + 1] - self.times[k]))


@dataclass(frozen=True)
class PredictedMotion:
    """Predicted states (n + 1, nx) at `times` (n + 1,) s.

    `slack` is a lower bound of the clearance beyond what is asked for (m), negative if the motion may collide.
    """

    times: Floats
    states: Matrix
    slack: float

    @property
    def final_state(self) -> Floats:
        """The last state."""
        last: Floats = self.states[-1]
        return last


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
    predicted: PredictedMotion
    tree: TreeView | None = None
