"""What the processes of a drive tell each other: the planner's, the controller's and that of the brake guard."""

from __future__ import annotations

import queue
import threading
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from kraft.driving.control_settings import ControllerSettings
from kraft.driving.estimation import CameraModel
from kraft.driving.estimation.adaptive import Learned
from kraft.driving.messages import Commitment, Cycle, Observation
from kraft.driving.method import Method
from kraft.planning.workspace import start_state
from kraft.robot.poses import Clocks, Pose
from kraft.robot.robot_file import Robot
from kraft.scenario import Goal, OccupancyMap, Task
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
    camera: CameraModel | None = None

    @property
    def controller(self) -> ControllerSettings:
        """Settings of the method's controller, at the rate of the robot's commands if the robot file states one."""
        own, rate = self.method.controller, self.robot.rate_hz
        return own if rate is None else own.model_copy(update={"rate_hz": rate})

    @property
    def period(self) -> float:
        """Time from one command to the next, s."""
        return 1.0 / self.controller.rate_hz

    @property
    def other_goals(self) -> tuple[Goal, ...]:
        """A goal with a heading if the robot may send such and the task has none, or the other way round."""
        if self.robot.goal is None or (self.robot.goal.heading_tolerance is None) == (self.task.goal.heading is None):
            return ()
        tolerance = self.robot.goal.heading_tolerance
        heading = None if tolerance is None else 0.0
        return (NewGoal(self.task.goal.center, heading, tolerance).moved(self.task.goal),)

    def at_rest(self, pose: Pose) -> Floats:
        """State (nx,) of the vehicle that stands at a pose."""
        state = start_state(self.task, self.vehicle)
        state[list(self.vehicle.rest_indices)] = 0.0
        for name, value in zip(("x", "y", "theta"), pose, strict=True):
            if self.vehicle.index(name) >= 0:
                state[self.vehicle.index(name)] = value
        return state


@dataclass(frozen=True)
class Check:
    """Result of one check before the drive: ``ok``, ``warning``, or ``problem``, which prevents it.

    With ``waiting`` it is what the check waits for.
    """

    name: str
    state: str
    detail: str


@dataclass(frozen=True)
class Checked:
    """All checks, and what was seen: the pose (x, y, theta) at which the vehicle stands (None without poses), the
    rate of the poses (Hz), and the robot's map.
    """

    checks: tuple[Check, ...]
    pose: Pose | None
    pose_rate: float = 0.0
    map: OccupancyMap | None = None

    @property
    def passed(self) -> bool:
        """Whether the drive may begin."""
        return all(check.state != "problem" for check in self.checks)


@dataclass(frozen=True)
class BeginOrder:
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
class DecisionRequest:
    """Request for the commitment of cycle `number` at `time` (s): what was sensed since the last, what is on board."""

    time: float
    number: int
    sense: Sense
    current: Commitment


@dataclass(frozen=True)
class NewGoal:
    """Place (m) of a new goal, and its heading and the tolerance of it (rad), which are None if any heading will do."""

    center: tuple[float, float]
    heading: float | None = None
    heading_tolerance: float | None = None

    def moved(self, goal: Goal) -> Goal:
        """The region of a goal of before, at this place and with this heading."""
        return replace(goal, center=self.center, heading=self.heading, heading_tolerance=self.heading_tolerance)


@dataclass(frozen=True)
class TaskChange:
    """A new goal, or a new map, for the next commitment and for all plans after it."""

    goal: NewGoal | None
    map: OccupancyMap | None


@dataclass(frozen=True)
class TaskTaken:
    """Answer to a change: the goal that holds from now on if it is new.

    `problem` is why the goal that holds cannot be reached, `refused` why the new one was not taken; `seconds` is the
    time that the change took.
    """

    goal: NewGoal | None
    problem: str = ""
    refused: str = ""
    seconds: float = 0.0


@dataclass(frozen=True)
class MapNews:
    """What the process that receives maps has received: a usable map, as far as it is near the bounds, or a problem.

    `map` is None if it is the last usable one, `size` says how large the whole one is, `problem` why it cannot be used.
    """

    map: OccupancyMap | None
    size: str = ""
    problem: str = ""


@dataclass(frozen=True)
class MapLink:
    """Why the process that receives maps is not connected to the robot; `problem` is empty if it is."""

    problem: str


@dataclass(frozen=True)
class Planned:
    """Answer to a request: the cycle without its tree, and what the planner's estimator has identified."""

    cycle: Cycle
    learned: Learned | None = None


@dataclass(frozen=True)
class StopOrder:
    """Order to stop the vehicle and end the drive."""

    reason: str


@dataclass(frozen=True)
class PlannerFailed:
    """Order to stop the vehicle at once and end the drive, because the planner cannot go on."""

    reason: str


@dataclass(frozen=True)
class Status:
    """State of the drive at `time`, for the terminal: age of the newest pose (s), what was late, and what happened.

    `missed` is the number of commitments that came too late for their cycle.
    """

    time: float
    pose_age: float
    late_ticks: int
    missed: int
    note: str = ""


@dataclass(frozen=True)
class Ended:
    """End of the drive: outcome, why, its time (s), measures of the controller's clock, and what was sensed last.

    `unwritten` says why the tables end before the drive; it is empty if they do not.  `own_code` is whether the user's
    own controller has failed, which has ended the drive.
    """

    outcome: str
    reason: str
    time: float
    measures: dict[str, float] = field(default_factory=dict)
    refused: dict[str, int] = field(default_factory=dict)
    stops: int = 0
    sense: Sense | None = None
    unwritten: str = ""
    own_code: bool = False


@dataclass(frozen=True)
class Beat:
    """What the controller did in a tick at `time` (s), for the brake guard: its command (nu,) and its observations.

    `commitment` is what is on board, and `learned` what was identified, if that has changed since the last beat.
    """

    time: float
    command: Floats
    observations: tuple[Observation, ...]
    commitment: Commitment | None = None
    learned: Learned | None = None


@dataclass(frozen=True)
class Ready:
    """The brake guard can send commands."""


@dataclass(frozen=True)
class Reconnected:
    """The brake guard has connected to the robot again, perhaps by another name."""


@dataclass(frozen=True)
class Guarding:
    """The drive begins: from now on the brake guard watches the controller, by the clocks of the drive."""

    clocks: Clocks


@dataclass(frozen=True)
class Halting:
    """The controller commands the vehicle to stand, because the clock of the drive does not go on."""


@dataclass(frozen=True)
class Guarded:
    """A command (nu,) that the brake guard sent at `time` (s) instead of the controller."""

    time: float
    command: Floats


@dataclass(frozen=True)
class Released:
    """The controller has ended the drive, and the vehicle stands: the brake guard may end."""


class Mailbox:
    """Messages of another process, taken without waiting; `closed` when it has ended."""

    def __init__(self, connection: Connection, peer: str) -> None:
        """Exchange messages with `peer`; its end arrives as a `StopOrder`."""
        self._connection, self._peer = connection, peer
        self._arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._outgoing: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.closed = False
        for task in (self._receive, self._send):
            threading.Thread(target=task, name=f"messages of {peer}", daemon=True).start()

    def _receive(self) -> None:
        while True:
            try:
                self._arrived.put(self._connection.recv())
            except (EOFError, OSError):
                self.closed = True
                self._arrived.put(StopOrder(f"{self._peer} has ended"))
                return

    def _send(self) -> None:
        while True:
            message, sent = self._outgoing.get()
            try:
                self._connection.send(message)
            except OSError:
                self.closed = True
            sent.set()

    @property
    def unsent(self) -> int:
        """Number of messages that wait to be sent: the other process does not take them."""
        return self._outgoing.qsize()

    def send(self, message: Any) -> threading.Event:
        """Hand over a message; the event is set when it is sent."""
        sent = threading.Event()
        self._outgoing.put((message, sent))
        return sent

    @property
    def is_empty(self) -> bool:
        """Whether no message waits to be taken."""
        return self._arrived.empty()

    def take(self) -> list[Any]:
        """Messages that have arrived."""
        found = []
        while not self._arrived.empty():
            found.append(self._arrived.get())
        return found

    def wait(self, seconds: float | None = None) -> Any:
        """The next message; None if none arrives in a time (s)."""
        try:
            return self._arrived.get(timeout=seconds)
        except queue.Empty:
            return None
