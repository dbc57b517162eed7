"""Display of a drive: plan, contingency, footprint and markers on the robot's topics, and everything in a bag.

It has a process of its own, because making these messages takes as long as a part of a plan.
"""

from __future__ import annotations

import contextlib
import queue
import sys
import threading
import time as clock
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from kraft.driving.messages import Cycle
from kraft.errors import KraftError
from kraft.robot.bag import BagWriter, scene
from kraft.robot.command import CommandCodec
from kraft.robot.connect import open_transport
from kraft.robot.display import Frames, cycle_messages
from kraft.robot.messages import (
    GRID,
    MARKERS,
    PATH,
    POLYGON,
    TF,
    log_line,
    make,
    odometry,
    stamped_pose,
    transform,
)
from kraft.robot.priority import leave_signals_to_planner, name_this_process, process_context
from kraft.robot.protocol import DriveSpec, Sense
from kraft.robot.transport import Transport
from ompl_ext.poses import pose_of

KINDS: Final = {"plan": PATH, "contingency": PATH, "footprint": POLYGON, "markers": MARKERS}


class Display:
    """Hands what is driven to the display's process; at the exit of the context the bag is complete."""

    def __init__(self, spec: DriveSpec, bag: Path | None) -> None:
        self._is_wanted = bool(spec.robot.display) or bag is not None
        context = process_context()
        self._theirs, self._ours = context.Pipe(duplex=False)
        self._process = context.Process(
            target=run_display, args=(spec, bag, self._theirs, self._ours), name="kraft display"
        )
        self._waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._feeder = threading.Thread(target=self._send, name="display", daemon=True)
        self._has_ended = False
        self.problem = ""
        """why the bag, or what is displayed, is not complete"""

    @property
    def draws_trees(self) -> bool:
        """Whether markers of the planner's tree are sent or written."""
        return self._is_wanted

    def __enter__(self) -> Self:
        """Start the process, if anything is displayed or written."""
        if self._is_wanted:
            self._process.start()
            self._theirs.close()  # so that each end sees when the other process ends
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Wait until everything is written."""
        if self._is_wanted:
            self._feed(None)
            self._feeder.join()
            self._ours.close()
            self._process.join()
            if self._process.exitcode != 0:
                code = self._process.exitcode
                self.problem = f"the process that shows the drive and writes its bag ended early, with exit code {code}"

    def _feed(self, message: Any) -> None:
        """Hand over a message, in a thread: the planner does not wait for the display.

        The thread starts with the first message, when all processes of the drive have been started.
        """
        if self._has_ended:
            return
        self._waiting.put(message)
        if self._feeder.ident is None:
            self._feeder.start()

    def _send(self) -> None:
        while (message := self._waiting.get()) is not None:
            try:
                self._ours.send(message)
            except OSError:  # the display has ended, and the drive goes on, which may be long
                self._has_ended = True
                while not self._waiting.empty():
                    self._waiting.get()
                return

    def sensed(self, sense: Sense) -> None:
        """Write what the controller sensed and sent into the bag."""
        if self._is_wanted:
            self._feed(sense)

    def show(self, cycle: Cycle) -> None:
        """Show a cycle; what was sensed before it tells the time."""
        if self._is_wanted:
            self._feed(cycle)


def run_display(spec: DriveSpec, bag: Path | None, arrived: Connection, other: Connection) -> None:
    """Main function of the display's process, until `other`, the end of the planner's process, is closed everywhere."""
    other.close()
    name_this_process("kraft display")
    leave_signals_to_planner()
    try:
        with _Sender(spec, bag) as sender:
            while (message := _received(arrived)) is not None:
                if isinstance(message, Sense):
                    sender.sensed(message)
                else:
                    sender.show(message)
    except (OSError, KraftError) as error:  # the drive goes on, and is told at its end
        raise SystemExit(f"kraft display: {error}") from error


def _received(arrived: Connection) -> Any:
    """The next message; None after the last one."""
    try:
        return arrived.recv()
    except (EOFError, OSError):
        return None


class _Sender:
    """Sends what a viewer shows; a context manager that closes the bag and the transport."""

    def __init__(self, spec: DriveSpec, bag: Path | None) -> None:
        self._spec, self._bag_path = spec, bag
        self._frames = Frames(spec.robot.pose.frame, spec.robot.command.frame)
        self._root = spec.robot.display
        self._transport: Transport | None = None
        self._bag: BagWriter | None = None
        self._stack = contextlib.ExitStack()
        self._codec = CommandCodec(spec.robot, spec.vehicle)
        self._epoch = 0  # time 0 of the drive, which the first message tells

    def __enter__(self) -> Self:
        """Bag and transport are opened with the first message: a drive that does not begin replaces no bag."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close the transport and the bag."""
        if self._transport is not None:
            self._transport.close()
        self._stack.__exit__(kind, error, at)

    def sensed(self, sense: Sense) -> None:
        """Write what the controller sensed and sent into the bag."""
        self._epoch = sense.epoch
        bag = self._open_bag()
        if bag is None:
            return
        frames, vehicle, epoch = self._frames, self._spec.vehicle, sense.epoch
        for each in sense.observations:
            arrived, taken = (epoch + round(1e9 * time) for time in (each.arrival, each.time))
            bag.write("/pose", arrived, stamped_pose(taken, frames.map, (each.x, each.y, each.theta)))
        for time, command, state in sense.ticks:
            now, pose = epoch + round(1e9 * time), pose_of(state, vehicle)
            bag.write(self._spec.robot.command.topic, now, self._codec.message(now, command))
            speed = float(state[vehicle.rest_indices[0]])
            bag.write("/odometry/filtered", now, odometry(now, frames.map, frames.body, pose, speed))
            bag.write("/tf", now, make(TF, transforms=[transform(now, frames.map, frames.body, pose)]))

    def show(self, cycle: Cycle) -> None:
        """Send a cycle."""
        epoch = self._epoch
        now = epoch + round(1e9 * cycle.decided)
        transport = self._open()
        for name, message in cycle_messages(cycle, self._spec.vehicle, now, epoch, self._frames):
            if transport is not None:
                transport.publish(f"{self._root}/{name}", message)
            self._write(f"/{name}", now, message)
        if cycle.reason:
            self._write("/rosout", now, log_line(now, f"{cycle.kind}: {cycle.reason}", level=30))

    def _write(self, topic: str, time: int, message: Any) -> None:
        bag = self._open_bag()
        if bag is not None:
            bag.write(topic, time, message)

    def _open_bag(self) -> BagWriter | None:
        """The bag, with the scene in it; None if none is written."""
        if self._bag is None and self._bag_path is not None:
            self._bag = self._stack.enter_context(BagWriter(self._bag_path, keeps=True))
            for time, topic, message in scene(self._spec.task, clock.time_ns(), self._frames.map):
                self._bag.write(topic, time, message)
        return self._bag

    def _open(self) -> Transport | None:
        """Transport with the topics announced; None if nothing is sent, or nobody answers: the bag goes on without."""
        if not self._root:
            return None
        if self._transport is None:
            try:
                self._transport = open_transport(self._spec.robot)
            except (OSError, KraftError) as error:
                self._root = ""  # asked once: a bag does not wait in every cycle for an address that does not answer
                bag = "" if self._bag_path is None else "; the bag is written all the same"
                print(f"kraft display: plans are not shown: {error}{bag}", file=sys.stderr, flush=True)
                return None
            for name, kind in KINDS.items():
                self._transport.advertise(f"{self._root}/{name}", kind)
            for _, topic, message in scene(self._spec.task, clock.time_ns(), self._frames.map):
                kind, name = (GRID, "map") if topic == "/map" else (MARKERS, "scene")
                self._transport.advertise(f"{self._root}/{name}", kind, latched=True)
                self._transport.publish(f"{self._root}/{name}", message)
        return self._transport
