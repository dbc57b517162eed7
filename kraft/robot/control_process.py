"""The controller's process of a drive: it checks the robot, drives when the planner says so, and tells how it ended."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Final

from kraft.config.user_code import failure_in_code
from kraft.errors import KraftError
from kraft.robot.checklist import Checklist
from kraft.robot.connect import open_transport
from kraft.robot.control import ControlLoop
from kraft.robot.drive_tables import DriveTables, headings
from kraft.robot.health import Health
from kraft.robot.inputs import Inputs
from kraft.robot.peers import wait_for_another
from kraft.robot.priority import leave_signals_to_planner, lock_memory, name_this_process, prefer_this_process
from kraft.robot.protocol import BeginOrder, DriveSpec, Ended, Mailbox, Ready, Released, StopOrder
from kraft.robot.task_inputs import TaskInputs
from kraft.robot.tracker import Tracker, warm_up
from kraft.robot.transport import Transport

GUARD_TIME: Final = 10.0
"""Longest time to wait until the brake guard can send commands, s."""
REPORT_TIME: Final = 5.0
"""Longest time in which a planner that is busy takes the result of the drive, s."""


def run_control(
    spec: DriveSpec, planner: Connection, guard: Connection, maps: Connection | None, others: Sequence[Connection]
) -> None:
    """Main function of the process: check, drive, and write what is driven as it is driven.

    `planner`, `guard` and `maps` lead to the other processes; `others` are ends that this one does not need.
    """
    for each in others:
        each.close()
    leave_signals_to_planner()
    name_this_process("kraft control")
    sys.setswitchinterval(0.0005)
    prefer_this_process()
    lock_memory()
    mailbox, guard_mail = Mailbox(planner, "the planner's process"), Mailbox(guard, "the brake guard")
    try:
        transport = open_transport(spec.robot)
    except KraftError as error:  # the planner's process raises it
        mailbox.send(error).wait(REPORT_TIME)
        return
    try:
        inputs = Inputs(spec.robot, transport)
        tasks = TaskInputs(spec.robot, transport, Mailbox(maps, "the process of the maps") if maps else None)
        found = Checklist(spec.robot, transport, inputs, tasks).run(spec, lambda: not mailbox.is_empty, mailbox.send)
        if mailbox.is_empty:  # otherwise an order to stop has cut the check list short
            mailbox.send(found)
        order = mailbox.wait()
        if isinstance(order, StopOrder):
            ended = Ended("stopped" if mailbox.closed else "interrupted", order.reason, 0.0)
            mailbox.send(ended).wait(REPORT_TIME)
        elif isinstance(order, BeginOrder) and found.passed:
            before = transport.peers(spec.robot.command.topic).publishers
            guard_mail.send(order)
            warm_up(spec)
            tracker = Tracker(spec, order, transport, inputs)
            _wait_for_guard(spec, transport, guard_mail, before)
            health = Health(spec.robot.watchdog, min(found.pose_rate, spec.robot.pose.rate_hz), spec.period)
            with DriveTables(spec.folder, headings(spec.vehicle)) as tables:
                loop = ControlLoop(spec, transport, inputs, tasks, mailbox, guard_mail, tables, tracker, health)
                released = None
                try:
                    ended = loop.run()
                    released = guard_mail.send(Released())  # before the tables are written, which may take long
                except Exception as error:  # the functions of a user's vehicle raise anywhere
                    if (failure := failure_in_code(error)) is None:
                        raise
                    ended = loop.failed(failure)
            if released is not None:
                released.wait(1.0)
            mailbox.send(replace(ended, unwritten=tables.problem)).wait(REPORT_TIME)
    finally:
        transport.close()


def _wait_for_guard(spec: DriveSpec, transport: Transport, guard: Mailbox, before: frozenset[str] | None) -> None:
    """Wait until the brake guard is ready and listed beside the publishers `before`, where the transport can tell."""
    if not isinstance(guard.wait(GUARD_TIME), Ready):
        raise RuntimeError("the brake guard has not started")
    wait_for_another(transport, spec.robot.command.topic, before, GUARD_TIME)
