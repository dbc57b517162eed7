"""A drive on the wall clock: this process plans, another one controls, and a third one guards the controller."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Final, NamedTuple

from kraft.config.user_code import failure_in_code
from kraft.driving.control import needs_map
from kraft.driving.estimator_settings import Oracle
from kraft.driving.messages import Cycle, ReferenceKind
from kraft.driving.method import Method
from kraft.errors import Code, Diagnostic, InputError, UserCodeError
from kraft.files import LineFile
from kraft.robot.connect import check_transport
from kraft.robot.control_process import run_control
from kraft.robot.drive_tables import add_event
from kraft.robot.guard import run_guard
from kraft.robot.maps import run_maps
from kraft.robot.own_code_watch import OwnCodeWatch
from kraft.robot.planner import Planner
from kraft.robot.planner_thread import PlannerThread
from kraft.robot.priority import preferred_planner, process_context, short_collections, shorten_collections
from kraft.robot.protocol import (
    Check,
    Checked,
    DecisionRequest,
    DriveSpec,
    Ended,
    PlannerFailed,
    Sense,
    Status,
    StopOrder,
    TaskChange,
)
from kraft.robot.tracker import warm_up
from kraft.trial.result import cycle_content
from ompl_ext.signals import STOPPING
from ompl_ext.times import SAME_TIME

LEAD: Final = 0.3
"""Time before a cycle at which it is decided, s: the decision takes a part of it, and travels to the controller."""
JOIN_TIME: Final = 5.0
"""Time to wait for the end of the controller's process, s."""
GUARD_JOIN_TIME: Final = 40.0
"""Time to wait for the end of the brake guard, which stops the vehicle if the controller has ended before, s."""
LOOK: Final = 0.5
"""Longest time between two looks for what does not return, s."""
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


@dataclass(frozen=True)
class _Callbacks:
    """Functions that a drive calls, see `drive`."""

    on_check: Callable[[Checked], None]
    on_cycle: Callable[[Cycle], None]
    on_status: Callable[[Status], None]
    on_sense: Callable[[Sense], None]


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
        kind = method.controller.kind
        what = "code with set_map" if kind == "code" else kind
        wrong("controller.kind", f"is {what}, which needs the map", "expected a controller that tracks plans")
    if planner.mode != "replanning" or not planner.car_switches:
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
        return _drive_in_processes(spec, _Callbacks(on_check, on_cycle, on_status, on_sense), keep_trees, on_abandon)


def _drive_in_processes(
    spec: DriveSpec,
    tell: _Callbacks,
    keep_trees: bool,
    on_abandon: Callable[[DriveResult], object] | None,
) -> DriveResult:
    """Start controller, brake guard and the process that receives maps, and plan for them."""
    here, others, process, processes = _processes(spec)
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

    started = list[tuple[BaseProcess, float]]()
    unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)  # a signal waits until it stops all processes
    try:
        for child, patience in processes:
            child.start()
            started.append((child, patience))
        for end in others:
            end.close()
        with preferred_planner(), _interrupts(lambda: send(StopOrder("by a signal")), abandon) as received:
            signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
            result = _drive(spec, here, process, send, tell, keep_trees, known)
            return replace(result, signal=received[0] if received else 0)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
        here.close()
        for each, patience in started:
            each.join(patience)
            if each.is_alive():
                each.kill()


class _Processes(NamedTuple):
    """Processes of a drive, not started.

    Attributes:
        here: the planner's end of the pipe to the controller.
        others: the ends of pipes that are not the planner's.
        controller: the controller's process.
        all: all of them, each with the time in which it ends by itself, s.
    """

    here: Connection
    others: list[Connection]
    controller: BaseProcess
    all: list[tuple[BaseProcess, float]]


def _processes(spec: DriveSpec) -> _Processes:
    """Controller, brake guard and, of a robot with a map, the process that receives it."""
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
    processes: list[tuple[BaseProcess, float]] = [(process, JOIN_TIME), (guard, GUARD_JOIN_TIME)]
    if from_maps is not None:
        maps = context.Process(target=run_maps, args=(spec, from_maps, others(from_maps)), name="kraft map")
        processes.append((maps, JOIN_TIME))
    return _Processes(here, others(here), process, processes)


def _drive(
    spec: DriveSpec, here: Connection, process: BaseProcess, send: Callable[[Any], None], tell: _Callbacks,
    keep_trees: bool, known: Known,
) -> DriveResult:  # fmt: skip
    planner, thread = Planner(spec, keep_trees), PlannerThread()
    watch = OwnCodeWatch(spec, thread, process, tell.on_status)
    checked, decisions = known.checked, known.decisions
    cycles = CycleFile(spec.folder)
    for message in _messages(here, process, thread, watch):
        if isinstance(message, BaseException):
            _stop_or_raise(message, send, drives=watch.has_begun)
        elif isinstance(message, Check):
            tell.on_check(Checked((message,), None))
        elif isinstance(message, Checked):
            checked = known.checked = message
            tell.on_check(checked)
            if not checked.passed or checked.pose is None:
                send(StopOrder("the check list failed"))
                return DriveResult(checked, None)
            thread.call(partial(_begin, planner, checked, send))
        elif isinstance(message, _Begun):
            watch.begin(message.command_seconds)
            shorten_collections()
        elif isinstance(message, DecisionRequest):
            thread.call(partial(_decide, planner, message, send))
            thread.call(planner.prepare)  # apart, so that the decision is written before
        elif isinstance(message, TaskChange):
            thread.call(partial(_change, planner, message, send))
        elif isinstance(message, _Decided):
            decisions.add(message.cycle)
            _tell_decision(message, cycles, tell)
        elif isinstance(message, Status):
            tell.on_status(message)
        elif isinstance(message, Ended):
            if message.sense is not None:
                tell.on_sense(message.sense)
            unwritten = tuple(dict.fromkeys(each for each in (cycles.problem, message.unwritten) if each))
            ended = replace(message, measures={**message.measures, **watch.measures})
            return DriveResult(checked, ended, decisions, unwritten)
    reason = watch.killed or f"the controller's process ended with {process.exitcode}"
    unwritten = (cycles.problem,) if cycles.problem else ()
    return DriveResult(checked, Ended("stopped", reason, decisions.last), decisions, unwritten)


@dataclass(frozen=True)
class _Begun:
    """The controller has the order to begin; a command of the user's own takes `command_seconds`, s."""

    command_seconds: float


@dataclass(frozen=True)
class _Decided:
    """A cycle that was decided, with its tree, and what had been sensed before."""

    cycle: Cycle
    sense: Sense


def _begin(planner: Planner, checked: Checked, send: Callable[[Any], None]) -> _Begun:
    assert checked.pose is not None, "it was checked"
    order = planner.begin(checked.pose, checked.map)
    seconds = planner.command_seconds(order.commitment)
    send(order)
    return _Begun(seconds)


def _decide(planner: Planner, request: DecisionRequest, send: Callable[[Any], None]) -> _Decided:
    answer, tree = planner.decide(request)
    send(answer)
    return _Decided(replace(answer.cycle, tree=tree), request.sense)


def _change(planner: Planner, change: TaskChange, send: Callable[[Any], None]) -> None:
    send(planner.change(change))


def _tell_decision(decided: _Decided, cycles: CycleFile, tell: _Callbacks) -> None:
    cycle = decided.cycle
    if problem := cycles.append(cycle):
        tell.on_status(Status(cycle.time, math.nan, 0, 0, f"the drive goes on, but {problem}"))
    tell.on_sense(decided.sense)
    tell.on_cycle(cycle)


def _stop_or_raise(error: BaseException, send: Callable[[Any], None], *, drives: bool) -> None:
    """Stop a vehicle that drives because of an error in the user's code; raise any other error."""
    own = error if isinstance(error, UserCodeError) else failure_in_code(error)
    if own is None or not drives:
        raise error
    send(PlannerFailed(str(own)))


def _messages(here: Connection, process: BaseProcess, thread: PlannerThread, watch: OwnCodeWatch) -> Iterator[Any]:
    """Messages of the controller, and results of the planner, until the controller's process ends."""
    while True:
        ready = wait([here, process.sentinel, thread.ready], LOOK)
        watch.look()
        if thread.ready in ready:
            yield thread.result()
        if here in ready:
            try:
                message = here.recv()
            except (EOFError, ConnectionResetError):
                process.join(JOIN_TIME)
                return
            watch.note_message(message)
            yield message
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
