"""The controller of a drive, in a process of its own: it holds a plan with its contingency and drives it on a clock.

It waits for nobody.  Poses and messages of the planner are taken when they are there; without them it drives the plan
that it has to its end and stops with the contingency, or the watchdog stops it.  If the planner's process ends it does
the same, and the process ends when the vehicle stands.
"""

from __future__ import annotations

import csv
import gc
import math
import os
import queue
import signal
import sys
import threading
import time as clock
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np

from kraft.driving.car_model import model_of
from kraft.driving.control import make_controller
from kraft.driving.estimation import make_estimator
from kraft.driving.estimation.adaptive import AdaptiveEstimator
from kraft.driving.messages import Commitment, Estimate, Observation, Reference, ReferenceKind
from kraft.driving.method import Oracle
from kraft.driving.on_board import OnBoard
from kraft.planning.workspace import pose_of
from kraft.robot.checklist import Checklist
from kraft.robot.command import CommandCodec
from kraft.robot.connect import open_transport
from kraft.robot.inputs import Inputs
from kraft.robot.messages import to_cdr
from kraft.robot.poses import Clocks, PoseGuard
from kraft.robot.priority import prefer_this_process
from kraft.robot.protocol import Begin, Checked, DriveSpec, Ended, Planned, PlanRequest, Sense, Status, Stop
from kraft.robot.transport import Transport
from kraft.scenario import Goal
from ompl_ext.arrays import Floats
from ompl_ext.query import Safety
from ompl_ext.vehicle import Vehicle

LEAD_IN: Final = 0.6
"""Time between the order to begin and time 0 of the drive, s."""
LATE: Final = 0.003
"""Time after which a tick counts as late, s."""
STATUS_PERIOD: Final = 1.0
"""Time between two reports of the state, s."""
STOPPED: Final = 1.0
"""Time for which the vehicle is commanded to stand before the drive ends, s."""
STOPPING_MAX: Final = 6.0
"""Longest time in which a vehicle that stops at the end of a drive comes to rest, s."""
PEERS_PERIOD: Final = 1.0
"""Time between two looks for a second publisher of commands, s."""
RECENT: Final = 5
"""Number of decisions whose duration tells how early the next one has to be asked for."""
HURRY: Final = 1.3
"""How much earlier than the slowest of them it is asked for."""
LEAD_MAX: Final = 0.6
"""Share of a cycle before its beginning that is the earliest time to ask."""
GOAL_TICKS: Final = 3
"""Number of ticks in a row for which the estimate is in the goal region before the goal counts as reached."""
GOAL_MARGIN: Final = 0.05
"""Distance by which the estimate is inside the goal region then, m."""


def run_control(spec: DriveSpec, connection: Connection) -> None:
    """Main function of the process: check, drive, and write what is driven as it is driven."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the planner's process tells when to stop
    sys.setswitchinterval(0.0005)
    prefer_this_process()
    mailbox = Mailbox(connection)
    transport = open_transport(spec.robot)
    try:
        inputs = Inputs(spec.robot, transport)
        found = Checklist(spec.robot, transport, inputs).run(spec, lambda: mailbox.closed)
        mailbox.send(found)
        order = mailbox.wait()
        if isinstance(order, Begin) and found.passed:
            with Journal(spec.folder, spec) as journal:
                mailbox.send(Control(spec, transport, inputs, mailbox, journal, order, found).run())
    finally:
        transport.close()


class Mailbox:
    """Messages of the planner's process, taken without waiting; `closed` when it has ended."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._outgoing: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.closed = False
        for task in (self._receive, self._send):
            threading.Thread(target=task, name="planner's messages", daemon=True).start()

    def _receive(self) -> None:
        while True:
            try:
                self._arrived.put(self._connection.recv())
            except (EOFError, OSError):
                self.closed = True
                self._arrived.put(Stop("the planner's process has ended"))
                return

    def _send(self) -> None:
        while True:
            message, sent = self._outgoing.get()
            try:
                self._connection.send(message)
            except OSError:
                self.closed = True
            sent.set()

    def send(self, message: Any) -> threading.Event:
        """Hand over a message; the event is set when it is sent."""
        sent = threading.Event()
        self._outgoing.put((message, sent))
        return sent

    def take(self) -> list[Any]:
        """Messages that have arrived."""
        found = []
        while not self._arrived.empty():
            found.append(self._arrived.get())
        return found

    def wait(self) -> Any:
        """The next message."""
        return self._arrived.get()


class Journal:
    """Files of a drive that are complete up to the last moments, whatever ends the process."""

    def __init__(self, folder: Path | None, spec: DriveSpec) -> None:
        self._folder, self._spec = folder, spec
        self._rows: queue.SimpleQueue[tuple[str, Sequence[Any]] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="journal", daemon=True)

    def __enter__(self) -> Journal:
        """Open the files."""
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Write what waits and close the files."""
        self._rows.put(None)
        self._thread.join()

    def row(self, name: str, *values: Any) -> None:
        """Write a row of a table: steps, observations, events."""
        self._rows.put((name, values))

    def _write(self) -> None:
        vehicle = self._spec.vehicle
        headings = {
            "steps": ["time", *(f"estimate_{name}" for name in vehicle.state),
                      *(f"command_{name}" for name in vehicle.controls), "cycle", "stopping", "pose_age",
                      "late", "work"],
            "observations": ["time", "arrival", "x", "y", "theta"],
            "events": ["time", "event"],
        }  # fmt: skip
        if self._folder is None:
            while self._rows.get() is not None:
                pass
            return
        writers, files = {}, {}
        for name, heading in headings.items():
            files[name] = (self._folder / f"{name}.csv").open("w", encoding="utf-8", newline="")
            writers[name] = csv.writer(files[name], lineterminator="\n")
            writers[name].writerow(heading)
        while (row := self._rows.get()) is not None:
            writers[row[0]].writerow(row[1])
            files[row[0]].flush()
        for file in files.values():
            os.fsync(file.fileno())
            file.close()


class Control:
    """One drive of the controller."""

    def __init__(
        self, spec: DriveSpec, transport: Transport, inputs: Inputs, mailbox: Mailbox, journal: Journal,
        begin: Begin, found: Checked,
    ) -> None:  # fmt: skip
        robot, method, vehicle = spec.robot, spec.method, spec.vehicle
        assert not isinstance(method.estimator, Oracle), "no robot has it"
        self._spec, self._transport, self._inputs, self._mailbox, self._journal = (
            spec,
            transport,
            inputs,
            mailbox,
            journal,
        )
        self._codec = CommandCodec(robot, vehicle)
        self._model = model_of(vehicle)
        self._controller = make_controller(method.controller, self._model)
        self._estimator = make_estimator(method.estimator, self._model, begin.state, spec.camera)
        settings = method.planner.model_copy(
            update={"watchdog": min(robot.watchdog.pose_age, method.planner.watchdog or math.inf)}
        )
        self._on_board = OnBoard(settings, Safety(cycle=settings.cycle), self._model, begin.commitment)
        self._settings, self._lead = settings, settings.lead
        self.period = 1.0 / (robot.rate_hz or method.controller.rate_hz)
        self._warm_up(begin)
        self._clocks = Clocks(0, 0)  # until the drive begins
        self._guard = PoseGuard(robot, self._clocks)
        self._open_loop = np.array(begin.state, dtype=float)
        self._cycle, self._waiting = 0, False
        self._planned: deque[Planned] = deque()
        self._observations: list[Observation] = []
        self._commands: list[tuple[float, Floats, Floats]] = []
        self._in_goal, self._goal = 0, spec.task.goal
        self._ending: tuple[str, str] | None = None
        self._rested = 0.0
        self._lateness: list[float] = []
        self._late = self._missed = self._ticks = 0
        self._worst_late = 0.0
        self._reply_delays: deque[float] = deque(maxlen=1000)
        self._last_tick = self._last_sent = -LEAD_IN
        self._requested = self._ended_at = 0.0
        self._next = 0
        self._last_command = self._model.rest.copy()
        self._next_status = 0.0
        self._foreign = self._why = ""
        self._since_stop: float | None = None
        self._alive = True

    def run(self) -> Ended:
        """Drive until the goal, the time limit, an order, or a fault that does not go away."""
        gc.collect()
        gc.freeze()  # so that a collection looks at little
        lead_in = round(1e9 * LEAD_IN)
        self._clocks = Clocks(clock.time_ns() + lead_in, clock.monotonic_ns() + lead_in, self._inputs.latency)
        self._guard = PoseGuard(self._spec.robot, self._clocks)
        self._inputs.take_poses()  # those of the check list
        threading.Thread(target=self._watch_peers, name="peers", daemon=True).start()
        number = math.ceil(-LEAD_IN / self.period) + 1
        while True:
            due = number * self.period
            self._sleep_until(due)
            now = self._now
            if self._tick(now, now - due):
                break
            number = max(number + 1, math.floor(self._now / self.period) + 1)
        self._alive = False
        assert self._ending is not None, "only then it ends"
        outcome, reason = self._ending
        measures = {
            "ticks": self._ticks, "late_ticks": self._late, "worst_late_ms": 1000 * self._worst_late,
            "missed_commitments": self._missed,
            "decision_ms": 1000 * float(np.median(self._reply_delays)) if self._reply_delays else math.nan,
        }  # fmt: skip
        self._event(self._ended_at, f"{outcome}: {reason}" if reason else outcome)
        refused, stops = dict(self._guard.refused), self._on_board.stops
        return Ended(outcome, reason, self._ended_at, measures, refused, stops, self._sensed())

    def _warm_up(self, begin: Begin) -> None:
        """Do once what a tick does: the first time takes a second, because compiled functions are loaded."""
        spec, model, state = self._spec, self._model, np.array(begin.state, dtype=float)
        assert not isinstance(spec.method.estimator, Oracle), "no robot has it"
        estimator = make_estimator(spec.method.estimator, model, state, spec.camera)
        controller = make_controller(spec.method.controller, model)
        x, y, theta = pose_of(state, model.vehicle)
        for k in range(1, 4):
            estimator.observe(Observation(0.1 * k, 0.1 * k, x, y, theta))
            moving = estimator.estimate(0.1 * k).state
            moving[model.v] = 0.5 * model.vehicle.top_speed
            estimate = Estimate(0.1 * k, moving, 0.0)
            board = OnBoard(self._settings, Safety(cycle=self._settings.cycle), model, begin.commitment)
            board.receive(Commitment(replace(begin.commitment.reference, kind=ReferenceKind.PLAN)), estimate)
            board.stop(estimate)
            command = controller.command(estimate, board.reference(estimate))
            estimator.commanded(0.1 * k, command)
            to_cdr(self._codec.message(0, command))

    @property
    def _now(self) -> float:
        return 1e-9 * (clock.monotonic_ns() - self._clocks.monotonic)

    def _sleep_until(self, due: float) -> None:
        left = due - self._now
        if left > 0.0:
            clock.sleep(left)

    def _tick(self, now: float, late: float) -> bool:
        """One tick of the controller; True if the drive is over."""
        self._measure(late)
        self._hold_up(now)
        self._take_messages(now)
        self._take_poses(now)
        self._adopt(now)
        estimate = self._estimator.estimate(now)
        self._check_faults(now, estimate)
        reference = self._on_board.reference(estimate)
        if self._on_board.is_stopping and self._since_stop is None and self._ending is None:
            self._stopped(now, self._why_blind(estimate))
        command = self._model.clamped(self._controller.command(estimate, reference))
        if now < 0.0 or (self._is_blind(estimate) and now >= reference.end):
            command = self._model.rest.copy()  # what holds a vehicle on a slope is not known any more
        self._send(now, command, estimate)
        if now >= 0.0:
            self._journal.row(
                "steps", f"{now:.6f}", *map(float, estimate.state), *map(float, command), self._cycle,
                int(self._on_board.is_stopping), f"{estimate.age:.4f}", f"{late:.6f}",
                f"{self._now - now:.6f}",
            )  # fmt: skip
        self._request(now)
        self._report(now, estimate)
        return self._is_over(now, estimate, reference)

    def _is_blind(self, estimate: Estimate) -> bool:
        return min(estimate.age, estimate.time) > (self._settings.watchdog or math.inf)

    def _measure(self, late: float) -> None:
        self._ticks += 1
        self._late += late > LATE
        self._worst_late = max(self._worst_late, late)

    def _hold_up(self, now: float) -> None:
        """After a pause of this process: the robot's multiplexer has stopped the vehicle meanwhile."""
        gap, timeout = now - self._last_tick, self._spec.robot.command.timeout
        if gap > timeout + self.period:
            halted = self._last_tick + timeout
            self._command(halted, self._model.rest.copy(), self._estimator.estimate(max(halted, 0.0)))
            self._on_board.stop(self._estimator.estimate(now))
            self._stopped(now, f"the controller was held up for {gap:.2f} s")
        self._last_tick = now

    def _take_messages(self, now: float) -> None:
        for message in self._mailbox.take():
            if isinstance(message, Planned):
                self._waiting = False
                self._reply_delays.append(now - self._requested)
                slowest = HURRY * max(list(self._reply_delays)[-RECENT:])
                self._lead = min(max(self._settings.lead, slowest), LEAD_MAX * self._settings.cycle)
                self._planned.append(message)
            elif isinstance(message, Stop):
                self._end(now, "interrupted" if not self._mailbox.closed else "stopped", message.reason)

    def _take_poses(self, now: float) -> None:
        for pose in self._inputs.take_poses():
            estimate = self._estimator.estimate(now)
            predicted = pose_of(estimate.state, self._model.vehicle)
            observation = self._guard.observation(
                pose, predicted, float(self._open_loop[self._model.v]), min(estimate.age, now + LEAD_IN)
            )
            if observation is not None:
                self._estimator.observe(observation)
                self._observations.append(observation)
                self._journal.row(
                    "observations",
                    *map(
                        float, (observation.time, observation.arrival, observation.x, observation.y, observation.theta)
                    ),
                )

    def _adopt(self, now: float) -> None:
        """Take on board what the planner committed, when its cycle begins; what arrives later than that is lost."""
        while self._planned:
            planned, horizon = self._planned[0], self._estimator.horizon
            estimator, learned = self._estimator, planned.learned
            if isinstance(estimator, AdaptiveEstimator) and learned is not None and learned is not estimator.learned:
                estimator.learn(learned)
            cycle = planned.cycle
            if cycle.time > now + horizon + 1e-9:
                return
            self._planned.popleft()
            self._cycle = cycle.number
            if now + horizon > cycle.time + 1.5 * self.period:
                self._missed += 1
                self._event(now, f"the commitment of cycle {cycle.number} came {now + horizon - cycle.time:.2f} s late")
                continue
            if self._ending is None and not self._trouble:
                self._on_board.receive(cycle.commitment, self._estimator.estimate(now))
                if not self._on_board.is_stopping:
                    self._since_stop = None

    @property
    def _trouble(self) -> str:
        """Why the vehicle must not drive now; empty if it may."""
        if self._foreign:
            return self._foreign
        return self._inputs.trouble or self._transport.problem

    def _check_faults(self, now: float, estimate: Estimate) -> None:
        if now < 0.0 or self._ending is not None:
            return
        if (trouble := self._trouble) and self._since_stop is None:
            self._on_board.stop(estimate)
            self._stopped(now, trouble)

    def _why_blind(self, estimate: Estimate) -> str:
        if self._guard.reason:
            return f"the watchdog stopped the vehicle: {self._guard.reason}"
        if self._is_blind(estimate):
            return f"the watchdog stopped the vehicle: no pose for {estimate.age:.2f} s"
        return "the watchdog stopped the vehicle: no message of the planner"

    def _send(self, now: float, command: Floats, estimate: Estimate) -> None:
        self._transport.publish(self._spec.robot.command.topic, self._codec.message(self._clocks.stamp(now), command))
        self._command(now, command, estimate)

    def _command(self, time: float, command: Floats, estimate: Estimate) -> None:
        """Tell estimators and the model what the vehicle is commanded from `time` (s) on."""
        self._open_loop = self._model.advance(self._open_loop, self._last_command, max(0.0, time - self._last_sent))
        self._last_command, self._last_sent = command, time
        if time >= 0.0:
            self._estimator.commanded(time, command)
            self._commands.append((time, command, estimate.state))

    def _request(self, now: float) -> None:
        """Ask for the next commitment when it is due, unless the planner still works on the last one."""
        lead, cycle = self._lead, self._settings.cycle
        if now < self._next * cycle - lead or self._waiting or self._mailbox.closed or self._ending is not None:
            return
        number = max(self._next, math.ceil((now + 0.5 * lead) / cycle))  # what cannot be decided in time is left out
        sense = self._sensed()
        self._waiting, self._requested = True, now
        goal, grid = self._inputs.take_goal(), self._inputs.take_map()
        if goal is not None:
            self._goal = replace(self._goal, center=goal, heading=None, heading_tolerance=None)
        self._mailbox.send(PlanRequest(now, number, sense, self._on_board.commitment, goal, grid))
        self._next = number + 1

    def _sensed(self) -> Sense:
        """What was sensed since the last call."""
        sense = Sense(self._clocks.wall, tuple(self._observations), tuple(self._commands))
        self._observations, self._commands = [], []
        return sense

    def _report(self, now: float, estimate: Estimate) -> None:
        if now >= self._next_status and not self._mailbox.closed:
            self._next_status = now + STATUS_PERIOD
            self._mailbox.send(Status(now, estimate.age, self._late, ""))

    def _is_over(self, now: float, estimate: Estimate, reference: Reference) -> bool:
        if self._ending is None:
            self._look_for_end(now, estimate)
            return False
        resting = reference.kind is ReferenceKind.CONTINGENCY and now >= reference.end
        self._rested = self._rested + self.period if resting else 0.0
        return self._rested >= STOPPED or now - self._ended_at > STOPPING_MAX + STOPPED

    def _look_for_end(self, now: float, estimate: Estimate) -> None:
        reached = now > 0.0 and in_goal(self._goal, self._model.vehicle, estimate.state)
        self._in_goal = self._in_goal + 1 if reached else 0
        watchdog = self._spec.robot.watchdog
        if self._in_goal >= GOAL_TICKS:
            self._end(now, "success", "")
        elif now >= self._spec.timeout:
            self._end(now, "timeout", f"the goal was not reached in {self._spec.timeout:g} s")
        elif self._since_stop is not None and now - self._since_stop > watchdog.give_up:
            self._end(now, "stopped", self._why)
        elif min(estimate.age, now) > watchdog.give_up:
            self._end(now, "stopped", self._why_blind(estimate))

    def _end(self, now: float, outcome: str, reason: str) -> None:
        """Stop the vehicle, with the manoeuvre of the contingency on board."""
        if self._ending is None:
            self._ending, self._ended_at = (outcome, reason), max(now, 0.0)
            if now >= 0.0 and not self._mailbox.closed:
                self._on_board.stop(self._estimator.estimate(now))

    def _stopped(self, now: float, why: str) -> None:
        """Note since when and why the vehicle stops by itself."""
        self._since_stop, self._why = now, why
        self._event(now, why)

    def _event(self, now: float, text: str) -> None:
        """Write what happened, and tell it."""
        self._journal.row("events", f"{now:.3f}", text)
        self._mailbox.send(Status(now, math.nan, self._late, text))

    def _watch_peers(self) -> None:
        """Look for a second publisher of commands now and then."""
        topic = self._spec.robot.command.topic
        usual = self._transport.peers(topic).publishers or frozenset()
        while self._alive:
            clock.sleep(PEERS_PERIOD)
            there = self._transport.peers(topic).publishers
            if there is not None and (others := there - usual):
                self._foreign = f"somebody else publishes commands on {topic} ({', '.join(sorted(others))})"
            elif there is not None:
                self._foreign = ""


def in_goal(goal: Goal, vehicle: Vehicle, state: Floats) -> bool:
    """Whether an estimated state (nx,) is inside the goal region by a margin."""
    x, y, theta = pose_of(state, vehicle)
    if math.dist((x, y), goal.center) > goal.radius - min(GOAL_MARGIN, 0.25 * goal.radius):
        return False
    values = {name: float(state[k]) for k, name in enumerate(vehicle.state)}
    if not all(low <= values.get(name, low) <= high for name, (low, high) in goal.limits.items()):
        return False
    if goal.heading is None or goal.heading_tolerance is None:
        return True
    return abs(math.remainder(theta - goal.heading, math.tau)) <= goal.heading_tolerance
