"""The brake guard: a process that drives the vehicle to a standstill when the controller sends no commands any more.

It knows what the controller knows: every tick the controller tells it the command, the observations, and what is on
board.  When no such message arrives for longer than two commands should be apart, the guard receives the poses itself
and goes on from there: the remainder of the plan on board, then its contingency, both verified, with feedback.  It
brakes at once if the dead man is released, or if a controller of the user's own tracks the plan, and it stops driving
as soon as the controller drives again.  It is in a session of its own, so that signals to the group of the other
processes, such as Ctrl-Z in a terminal, do not reach it, and it outlives them until the vehicle stands.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Final

from kraft.driving.messages import ReferenceKind
from kraft.robot.connect import open_transport
from kraft.robot.drive_tables import DriveTables
from kraft.robot.inputs import Inputs
from kraft.robot.priority import (
    leave_signals_to_planner,
    lock_memory,
    name_this_process,
    prefer_this_process,
    shorten_collections,
)
from kraft.robot.protocol import (
    Beat,
    BeginOrder,
    DriveSpec,
    Guarded,
    Guarding,
    Halting,
    Mailbox,
    Ready,
    Reconnected,
    Released,
    StopOrder,
)
from kraft.robot.tracker import Tracker, warm_up

SILENCE: Final = 0.03
"""Time after a command is due when the guard sends its own, s."""
STANDS: Final = 1.0
"""Time for which the guard commands the vehicle to stand, s."""
LONGEST: Final = 8.0
"""Longest time for which the guard drives after what is on board has ended, s."""


def run_guard(spec: DriveSpec, connection: Connection, others: Sequence[Connection]) -> None:
    """Main function of the process, until the controller has ended; `others` are ends that it does not need."""
    for each in others:
        each.close()
    os.setsid()
    leave_signals_to_planner()
    name_this_process("kraft guard")
    prefer_this_process()
    lock_memory()
    mailbox = Mailbox(connection, "the controller")
    begin = mailbox.wait()
    if not isinstance(begin, BeginOrder):
        return  # the check list failed
    warm_up(spec)
    transport = open_transport(spec.robot)
    try:
        inputs = Inputs(spec.robot, transport)
        transport.advertise(spec.robot.command.topic, spec.robot.command.type)
        while not inputs.clock.is_running and not mailbox.closed:
            time.sleep(0.01)
        shorten_collections()
        mailbox.send(Ready())
        headings = {"guard": ["time", *(f"estimate_{name}" for name in spec.vehicle.state),
                              *(f"command_{name}" for name in spec.vehicle.controls)]}  # fmt: skip
        with DriveTables(spec.folder, headings) as tables:
            Guard(spec.period, Tracker(spec, begin, transport, inputs), inputs, mailbox, tables).run()
    finally:
        transport.close()


class Guard:
    """Watches the ticks of a controller, and drives when they stay away."""

    def __init__(self, period: float, tracker: Tracker, inputs: Inputs, mailbox: Mailbox, tables: DriveTables) -> None:
        self._period, self._tracker, self._inputs = period, tracker, inputs
        self._mailbox, self._tables = mailbox, tables
        self._since: float | None = None  # the beginning of its own driving
        self._stood, self._is_late = 0.0, False
        self._connections = tracker.connections
        self._last_message = 0.0  # when the controller sent something, by the monotonic clock, s

    def run(self) -> None:
        """Watch until the controller releases the guard, or has ended and the vehicle stands."""
        due: float | None = None  # time of the drive when the guard acts, while it has to
        while True:
            message = self._mailbox.wait(None if due is None else self._pause(due))
            if isinstance(message, Released):
                return
            if isinstance(message, Guarding):
                self._tracker.start(message.clocks)
            elif isinstance(message, Beat):
                self._mirror(message)
                due, self._last_message = message.time + self._period + SILENCE, time.monotonic()
            elif isinstance(message, Halting):
                self._last_message = time.monotonic()
            elif isinstance(message, StopOrder) and (due is None or self._is_done):
                return  # the controller has ended before the drive, or while the vehicle stood
            elif message is None and self._tracker.clock_trouble:
                if self._halt():
                    if self._mailbox.closed:
                        return
                    due = None
            elif message is None and due is not None and self._tracker.now >= due:
                now = self._tracker.now
                self._drive(now)
                due = now + self._period
                if self._is_done:
                    if self._mailbox.closed:
                        return
                    due = None  # until the controller goes on

    def _pause(self, due: float) -> float:
        """How long to wait for a message until another look at the clock, s; `due` is a time of the drive, s."""
        if self._tracker.clock_trouble:
            return self._period
        return self._tracker.wall(max(0.0, due - self._tracker.now))

    def _halt(self) -> bool:
        """Command the vehicle to stand if the controller does not, while the clock stands; whether that was enough."""
        silence = time.monotonic() - self._last_message
        if silence > self._period + SILENCE:
            self._tracker.publish(self._tracker.last_sent, self._tracker.halt)
        return silence > SILENCE + STANDS

    def _mirror(self, beat: Beat) -> None:
        """Do what the controller did."""
        tracker = self._tracker
        tracker.drop_poses()  # the controller has them
        if tracker.connections != self._connections:
            self._connections = tracker.connections
            self._mailbox.send(Reconnected())
        self._since, self._stood = None, 0.0
        for observation in beat.observations:
            tracker.observe(observation)
        tracker.learn(beat.learned)
        if beat.commitment is not None:
            tracker.on_board.mirror(beat.commitment, beat.time)
        if beat.time >= tracker.last_sent:
            tracker.commanded(beat.time, beat.command)

    def _drive(self, now: float) -> None:
        """Send a command instead of the controller, and tell it."""
        tracker = self._tracker
        self._since = now if self._since is None else self._since
        tracker.take_poses(now)
        estimate = tracker.estimate(now)
        # the user's own command may be what holds up the controller, and would hold up this process too
        must_stop = bool(self._inputs.trouble) or tracker.has_own_code
        if now >= 0.0 and must_stop and not tracker.on_board.is_stopping:
            tracker.on_board.stop(estimate)
        command, reference = tracker.command(now, estimate)
        tracker.publish(now, command)
        tracker.commanded(now, command)
        self._mailbox.send(Guarded(now, command))
        self._tables.row("guard", f"{now:.6f}", *map(float, estimate.state), *map(float, command))
        stands = now < 0.0 or (reference.kind is ReferenceKind.CONTINGENCY and now >= reference.end)
        self._stood = self._stood + self._period if stands else 0.0
        self._is_late = now - max(self._since, tracker.on_board.end) > LONGEST

    @property
    def _is_done(self) -> bool:
        """Whether the guard has stopped the vehicle."""
        return self._since is not None and (self._stood >= STANDS or self._is_late)
