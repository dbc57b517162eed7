"""A drive on the wall clock: this process plans, another one controls, and a third one guards the controller.

The planner's process has a mirror of the controller's estimator, so that the identification, which takes tens of
milliseconds, does not hold up the controller.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Final

from kraft.driving.car_model import model_of
from kraft.driving.control import make_controller, needs_map
from kraft.driving.estimation import make_estimator
from kraft.driving.estimation.adaptive import AdaptiveEstimator
from kraft.driving.messages import Cycle, Estimate, ReferenceKind
from kraft.driving.method import Method, Oracle
from kraft.driving.replanner import Replanner
from kraft.driving.solvers import Solvers
from kraft.errors import Code, Diagnostic, InputError, KraftError
from kraft.files import LineFile
from kraft.planning.feasibility import geodesic_time, goal_hit
from kraft.robot.connect import check_transport
from kraft.robot.control import run_control
from kraft.robot.guard import run_guard
from kraft.robot.journal import add_event
from kraft.robot.maps import run_maps, with_map
from kraft.robot.priority import preferred_planner, process_context, short_collections, shorten_collections
from kraft.robot.protocol import (
    Begin,
    Check,
    Checked,
    DriveSpec,
    Ended,
    Planned,
    PlanRequest,
    Sense,
    Status,
    StopOrder,
    TaskChange,
    TaskTaken,
    moved_goal,
)
from kraft.robot.tracker import warm_up
from kraft.scenario import OccupancyMap, Task
from kraft.trial.result import cycle_content
from ompl_ext.arrays import Floats
from ompl_ext.poses import pose_of
from ompl_ext.signals import STOPPING
from ompl_ext.times import SAME_TIME

LEAD: Final = 0.3
"""Time before a cycle at which it is decided, s: the decision takes a part of it, and travels to the controller."""
JOIN_TIME: Final = 5.0
"""Time to wait for the end of the controller's process, s."""
GUARD_JOIN_TIME: Final = 12.0
"""Time to wait for the end of the brake guard, which stops the vehicle if the controller has ended before, s."""
ABANDON_TIME: Final = 3.0
"""Longest time after the second signal to write and to say what is known, s."""


@dataclass
class Decisions:
    """What is counted of the cycles of a drive: a drive may be long, and the cycles themselves are on the disk.

    `planning_ms` has a value for each cycle, `contingencies` the times at which those begin that keep one, s; `last` is
    the time of the last cycle, s.
    """

    planning_ms: list[float] = field(default_factory=list)
    contingencies: list[float] = field(default_factory=list)
    last: float = 0.0

    def add(self, cycle: Cycle) -> None:
        """Count a cycle."""
        self.planning_ms.append(cycle.planning_ms)
        if cycle.kind is ReferenceKind.CONTINGENCY:
            self.contingencies.append(cycle.time)
        self.last = cycle.time


@dataclass
class Known:
    """What is known of a drive while it is driven: its check list and its decisions so far."""

    checked: Checked = field(default_factory=lambda: Checked((), None))
    decisions: Decisions = field(default_factory=Decisions)


@dataclass(frozen=True)
class DriveResult:
    """Result of a drive; `ended` is None if the drive did not begin."""

    checked: Checked
    ended: Ended | None
    decisions: Decisions = field(default_factory=Decisions)
    unwritten: tuple[str, ...] = ()
    """why some of its files end before the drive"""
    signal: int = 0
    """number of the signal that stopped it, 0 if none did"""


def on_the_clock(method: Method) -> Method:
    """Method that decides early enough for a drive on the wall clock."""
    planner = method.planner
    timing = {"cycle": planner.clock_cycle or planner.cycle, "lead": max(planner.lead, LEAD)}
    return method.model_copy(update={"planner": planner.model_copy(update=timing)})


def check_method(method: Method) -> None:
    """Check that a vehicle on this method is never without a verified way to stop.

    Raises:
        InputError: at the line of the method, if not.
    """
    planner, problems = method.planner, list[Diagnostic]()

    def wrong(key: str, problem: str, expected: str) -> None:
        problems.append(method.source.diagnostic(key, problem, expected, code=Code.CONFLICT))

    if isinstance(method.estimator, Oracle):
        wrong("estimator.kind", "is the truth, which no robot has", "expected another estimator")
    if needs_map(method):
        wrong("controller.kind", f"is {method.controller.kind}, which needs the map", "expected one that tracks plans")
    if planner.mode != "replanning" or planner.on_board != "contingency":
        problem = "leaves the vehicle without a contingency on board"
        wrong(
            "planner.on_board",
            problem,
            "expected `mode: replanning` and `on_board: contingency`",
        )
    key = "cycle" if planner.clock_cycle is None else "clock_cycle"
    cycle = planner.clock_cycle or planner.cycle
    least = max(planner.lead, LEAD) + LEAD
    if cycle < least - SAME_TIME:
        other = ", or a longer `clock_cycle`" if planner.clock_cycle is None else ""
        wrong(f"planner.{key}", f"is {cycle:g} s", f"expected at least {least:g} s on the wall clock{other}")
    if problems:
        raise InputError(problems)


def drive(
    spec: DriveSpec,
    on_check: Callable[[Checked], None],
    on_cycle: Callable[[Cycle], None],
    on_status: Callable[[Status], None],
    on_sense: Callable[[Sense], None],
    keep_trees: bool = False,
    on_abandon: Callable[[DriveResult], object] | None = None,
) -> DriveResult:
    """Check, and drive until the goal, the time limit, a fault or an interrupt.

    The first SIGINT, SIGTERM or SIGHUP stops the vehicle and ends the drive with its result, the second ends planner
    and controller.  Nothing is returned then: `on_abandon` is called before.

    Args:
        spec: the drive; its method fulfils `check_method`.
        on_check: called with the check list, and before with what it waits for.
        on_cycle: called with each cycle, with its tree if `keep_trees`, after it was sent to the controller.
        on_status: called with the state every second, and with every event.
        on_sense: called with what the controller sensed and sent.
        keep_trees: keep a copy of the planner's tree in each cycle, for `on_cycle`.
        on_abandon: called with what is known at the second signal, in a thread, before this process ends.

    Raises:
        InputError: if the transport cannot be opened.
        MissingDependency: if a package of the transport is missing.
    """
    check_transport(spec.robot)
    warm_up(spec)  # for all processes, where they are forks
    with short_collections():  # which would also copy memory that they share
        return _drive_in_processes(spec, (on_check, on_cycle, on_status, on_sense), keep_trees, on_abandon)


def _drive_in_processes(
    spec: DriveSpec,
    report: tuple[Any, Any, Any, Any],
    keep_trees: bool,
    on_abandon: Callable[[DriveResult], object] | None,
) -> DriveResult:
    """Start controller, brake guard and the process that receives maps, and plan for them."""
    context, has_maps = process_context(), spec.robot.map is not None
    (here, there), (to_guard, to_control) = context.Pipe(), context.Pipe()
    to_maps, from_maps = context.Pipe() if has_maps else (None, None)
    ends = [end for end in (here, there, to_guard, to_control, to_maps, from_maps) if end is not None]

    def others(*own: Connection | None) -> list[Connection]:
        return [end for end in ends if end not in own]

    guard = context.Process(target=run_guard, args=(spec, to_control, others(to_control)), name="kraft guard")
    process = context.Process(
        target=run_control, args=(spec, there, to_guard, to_maps, others(there, to_guard, to_maps)),
        name="kraft controller",
    )  # fmt: skip
    started = [(process, JOIN_TIME), (guard, GUARD_JOIN_TIME)]
    if from_maps is not None:
        maps = context.Process(target=run_maps, args=(spec, from_maps, others(from_maps)), name="kraft map")
        started.append((maps, JOIN_TIME))
    for each, _ in started:
        each.start()
    for end in others(here):
        end.close()
    lock = threading.Lock()

    def send(message: Any) -> None:
        with lock, contextlib.suppress(OSError):  # a controller that has ended is noticed by `_messages`
            here.send(message)

    known = Known()

    def abandon(number: int) -> None:
        process.kill()
        reason = "a second signal ended planner and controller, and the brake guard stops the vehicle"
        unwritten = add_event(spec.folder, known.decisions.last, reason)
        if on_abandon is not None:
            ended = Ended("interrupted", reason, known.decisions.last)
            on_abandon(DriveResult(known.checked, ended, known.decisions, unwritten, signal=number))

    try:
        with preferred_planner(), _interrupts(lambda: send(StopOrder("by a signal")), abandon) as received:
            result = _drive(spec, here, process, send, report, keep_trees, known)
            return replace(result, signal=received[0] if received else 0)
    finally:
        here.close()
        for each, patience in started:
            each.join(patience)
            if each.is_alive():
                each.kill()


def _drive(
    spec: DriveSpec, here: Connection, process: Any, send: Callable[[Any], None], report: tuple[Any, Any, Any, Any],
    keep_trees: bool, known: Known,
) -> DriveResult:  # fmt: skip
    on_check, on_cycle, on_status, on_sense = report
    planner = Planner(spec, keep_trees)
    checked, decisions = known.checked, known.decisions
    cycles = CycleFile(spec.folder)
    for message in _messages(here, process):
        if isinstance(message, KraftError):
            raise message
        if isinstance(message, Check):
            on_check(Checked((message,), None))
        elif isinstance(message, Checked):
            checked = known.checked = message
            on_check(checked)
            if not checked.passed or checked.pose is None:
                send(StopOrder("the check list failed"))
                return DriveResult(checked, None)
            send(planner.begin(checked.pose, checked.map))
            shorten_collections()
        elif isinstance(message, PlanRequest):
            answer, tree = planner.decide(message)
            send(answer)
            decisions.add(answer.cycle)
            if problem := cycles.append(answer.cycle):
                on_status(Status(answer.cycle.time, math.nan, 0, 0, f"the drive goes on, but {problem}"))
            planner.prepare()
            on_sense(message.sense)
            on_cycle(replace(answer.cycle, tree=tree))
        elif isinstance(message, TaskChange):
            send(planner.change(message))
        elif isinstance(message, Status):
            on_status(message)
        elif isinstance(message, Ended):
            if message.sense is not None:
                on_sense(message.sense)
            unwritten = tuple(dict.fromkeys(each for each in (cycles.problem, message.unwritten) if each))
            return DriveResult(checked, message, decisions, unwritten)
    reason = f"the controller's process ended with {process.exitcode}"
    unwritten = (cycles.problem,) if cycles.problem else ()
    return DriveResult(checked, Ended("stopped", reason, decisions.last), decisions, unwritten)


def _messages(here: Connection, process: Any) -> Iterator[Any]:
    """Messages of the controller until its process ends."""
    while True:
        ready = wait([here, process.sentinel])
        if here in ready:
            try:
                yield here.recv()
            except (EOFError, ConnectionResetError):
                process.join(JOIN_TIME)
                return
        elif process.sentinel in ready:
            process.join(JOIN_TIME)
            return


class CycleFile:
    """Cycles as they are decided: they are in the file whatever ends the process.

    The drive goes on if they cannot be written any more: `problem` says why.
    """

    def __init__(self, folder: Path | None) -> None:
        """Write nothing if there is no folder."""
        self._path = None if folder is None else folder / "cycles.jsonl"
        self._file: LineFile | None = None
        self.problem = ""

    def append(self, cycle: Cycle) -> str:
        """Write a cycle; why it could not be written, the first time, else empty."""
        if self._path is None or self.problem:
            return ""
        try:
            self._file = self._file or LineFile(self._path)
            self._file.append(json.dumps(cycle_content(cycle)).encode())
        except InputError as error:
            self.problem = str(error)
        return self.problem


class Planner:
    """The replanner with a mirror of the controller's estimator."""

    def __init__(self, spec: DriveSpec, keep_trees: bool = False) -> None:
        self._spec, self._keep_trees = spec, keep_trees
        self._task = spec.task
        self._replanner: Replanner | None = None

    def begin(self, pose: tuple[float, float, float], grid: OccupancyMap | None = None) -> Begin:
        """Plan the first cycle from where the vehicle stands, around the robot's map too."""
        spec = self._spec
        self._task = changed(self._task, None, grid)
        method, vehicle = spec.method, spec.vehicle
        assert not isinstance(method.estimator, Oracle), "it was checked"
        state = self._state = spec.at_rest(pose)
        self._model = model_of(vehicle)
        self._estimator = make_estimator(method.estimator, self._model, state, spec.camera)
        self._solvers = Solvers.of(self._task, vehicle, method.planner)
        self._replanner = self._new_replanner()
        self._warm_up(state)
        return Begin(state, self._replanner.begin(state, self._estimator.uncertainty(0.0)))

    def _warm_up(self, state: Floats) -> None:
        """Decide and plan once in vain: the first time takes longer, because compiled functions are loaded."""
        assert self._replanner is not None, "it is there"
        commitment, moving = self._replanner.begin(state), state.copy()
        moving[self._model.v] = 0.5 * self._model.vehicle.top_speed
        self._replanner.decide(Estimate(0.0, moving, 0.0), commitment)
        self._replanner = self._new_replanner()

    def _new_replanner(self) -> Replanner:
        spec = self._spec
        method = spec.method
        return Replanner(
            self._solvers, method.planner, make_controller(method.controller, self._model), spec.seed,
            period=spec.period, delay=self._estimator.horizon, realtime=True, keep_trees=self._keep_trees,
            command_timeout=spec.robot.command.timeout,
        )  # fmt: skip

    def decide(self, request: PlanRequest) -> tuple[Planned, Any]:
        """Answer a request, without the tree; and the tree."""
        assert self._replanner is not None, "it has begun"
        estimator, sense = self._estimator, request.sense
        observations = deque(sense.observations)
        for time, command, _ in sense.ticks:
            while observations and observations[0].arrival <= time:
                estimator.observe(observations.popleft())
            estimator.commanded(time, command)
        for observation in observations:
            estimator.observe(observation)
        self._replanner.skip_to(request.number)
        estimate = estimator.replanning_estimate(request.time)
        self._replanner.set_delay(estimator.horizon)
        cycle = self._replanner.decide(estimate, request.current)
        if cycle.held is not None:
            estimator.leave_out(*cycle.held)
        self._state = estimate.state
        learned = estimator.learned if isinstance(estimator, AdaptiveEstimator) else None
        return Planned(replace(cycle, tree=None), learned), cycle.tree

    def prepare(self) -> None:
        """Plan for the next cycle."""
        assert self._replanner is not None, "it has begun"
        self._replanner.prepare()

    def change(self, change: TaskChange) -> TaskTaken:
        """Decide and plan for a new goal or map from now on.

        What was planned for the next cycle stays; it is checked against the new map before it is committed.  A new goal
        that cannot be reached is not taken: the last one stays.
        """
        assert self._replanner is not None, "it has begun"
        task, goal = changed(self._task, change.goal, change.map), change.goal
        if problem := self._goal_problem(task):
            if goal is not None:
                x, y = self._task.goal.center
                problem, goal = f"{problem}: the last one, ({x:g}, {y:g}), stays", None
            task = changed(self._task, None, change.map)
        self._task = task
        blocked = self._replanner.blocked if change.map is None else ()  # a new map has it, or it is gone
        self._solvers = Solvers.of(self._task, self._spec.vehicle, self._spec.method.planner, blocked)
        self._solvers.load(self._state)
        self._replanner.set_solvers(self._solvers, blocked)
        return TaskTaken(goal, problem)

    def _goal_problem(self, task: Task) -> str:
        """Why the vehicle cannot get to the goal of a task; empty if nothing is known against it."""
        vehicle, (x, y) = self._spec.vehicle, task.goal.center
        if hit := goal_hit(task, vehicle):
            return f"the goal ({x:g}, {y:g}) {hit}"
        here, there, _ = pose_of(self._state, vehicle)
        moved = replace(task, start=replace(task.start, x=here, y=there))
        if math.isinf(geodesic_time(moved, vehicle)):
            return f"the goal ({x:g}, {y:g}) is unreachable: no path to it is wide enough for the vehicle"
        return ""


def changed(task: Task, goal: tuple[float, float] | None, grid: OccupancyMap | None) -> Task:
    """Task with a new goal, and with a new map instead of the last one of the same name."""
    if goal is not None:
        task = replace(task, goal=moved_goal(task.goal, goal))
    return with_map(task, grid)


@contextlib.contextmanager
def _interrupts(stop: Callable[[], None], abandon: Callable[[int], None]) -> Iterator[list[int]]:
    """Stop the vehicle at the first signal of STOPPING, also while a kernel computes; at the second end this process.

    `abandon` is called with the number of the second one before, in a thread.

    The list gets their numbers.  A signal that is ignored already, as SIGHUP with nohup, stays so.

    Signals are seen by a thread through a pipe, because Python itself sees them only between two of its instructions.
    """
    if threading.current_thread() is not threading.main_thread():
        yield []
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    received = list[int]()
    heeded = [number for number in STOPPING if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, lambda *_: None) for number in heeded}
    woken = signal.set_wakeup_fd(writer)

    def watch() -> None:
        while (byte := os.read(reader, 1)) and byte[0] != 0:
            if byte[0] in heeded:
                received.append(byte[0])
                if len(received) > 1:
                    # in a thread, as a disk or a terminal that does not answer must not keep this process
                    last = threading.Thread(target=abandon, args=(byte[0],), name="abandoned drive", daemon=True)
                    last.start()
                    last.join(ABANDON_TIME)
                    os._exit(128 + byte[0])
                stop()

    watcher = threading.Thread(target=watch, name="interrupts", daemon=True)
    watcher.start()
    try:
        yield received
    finally:
        signal.set_wakeup_fd(woken)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.write(writer, b"\0")
        watcher.join()
        os.close(reader)
        os.close(writer)
