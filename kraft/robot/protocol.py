"""What the two processes of a drive tell each other: the planner's, and that of the controller on its clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from kraft.driving.estimation import LevelCamera
from kraft.driving.estimation.adaptive import Learned
from kraft.driving.messages import Commitment, Cycle, Observation
from kraft.driving.method import Method
from kraft.robot.robot_file import Robot
from kraft.scenario import OccupancyMap, Task
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle


@dataclass(frozen=True)
class DriveSpec:
    """A drive: the task, the method, the model with the robot's limits, the robot, and where results go."""

    task: Task
    method: Method
    vehicle: Vehicle
    robot: Robot
    timeout: float
    seed: int = 0
    folder: Path | None = None
    camera: LevelCamera | None = None


@dataclass(frozen=True)
class Check:
    """Result of one check before the drive: ``ok``, ``warning``, or ``problem``, which prevents it."""

    name: str
    state: str
    detail: str


@dataclass(frozen=True)
class Checked:
    """All checks, the pose (x, y, theta) at which the vehicle stands (None without poses), and the robot's map."""

    checks: tuple[Check, ...]
    pose: tuple[float, float, float] | None
    map: OccupancyMap | None = None

    @property
    def passed(self) -> bool:
        """Whether the drive may begin."""
        return all(check.state != "problem" for check in self.checks)


@dataclass(frozen=True)
class Begin:
    """Order to begin: the state (nx,) at the start, and what is on board first."""

    state: Floats
    commitment: Commitment


@dataclass(frozen=True)
class Sense:
    """Observations since the last request, and ticks: time (s), command (nu,), estimated state (nx,); in order.

    `epoch` is time 0 of the drive, ns since 1970.
    """

    epoch: int
    observations: tuple[Observation, ...] = ()
    ticks: tuple[tuple[float, Floats, Floats], ...] = ()


@dataclass(frozen=True)
class PlanRequest:
    """Request for the commitment of cycle `number` at `time` (s): what was sensed since the last one, what is on board.

    `new_goal` (m) and `new_map` hold from the next plan on.
    """

    time: float
    number: int
    sense: Sense
    current: Commitment
    new_goal: tuple[float, float] | None = None
    new_map: OccupancyMap | None = None


@dataclass(frozen=True)
class Planned:
    """Answer to a request: the cycle without its tree, and what the planner's estimator has identified."""

    cycle: Cycle
    learned: Learned | None = None


@dataclass(frozen=True)
class Stop:
    """Order to stop the vehicle and end the drive."""

    reason: str


@dataclass(frozen=True)
class Status:
    """State of the drive, for the terminal."""

    time: float
    pose_age: float
    late_ticks: int
    note: str = ""


@dataclass(frozen=True)
class Ended:
    """End of the drive: outcome, why, its time (s), measures of the controller's clock, and what was sensed last."""

    outcome: str
    reason: str
    time: float
    measures: dict[str, float] = field(default_factory=dict)
    refused: dict[str, int] = field(default_factory=dict)
    stops: int = 0
    sense: Sense | None = None
