"""Display of a drive: plan, contingency, footprint and markers on the robot's topics, and everything in a bag."""

from __future__ import annotations

import contextlib
import time as clock
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from kraft.driving.messages import Cycle
from kraft.robot.bag import BagWriter, scene
from kraft.robot.connect import open_transport
from kraft.robot.display import Frames, cycle_messages
from kraft.robot.messages import GRID, MARKERS, PATH, POLYGON, log_line
from kraft.robot.protocol import DriveSpec
from kraft.robot.transport import Transport

KINDS: Final = {"plan": PATH, "contingency": PATH, "footprint": POLYGON, "markers": MARKERS}


class Display:
    """Sends what a viewer shows; a context manager that closes the bag and the transport."""

    def __init__(self, spec: DriveSpec, bag: Path | None) -> None:
        self._spec, self._bag_path = spec, bag
        self._frames = Frames(spec.robot.pose.frame, spec.robot.command.frame)
        self._root = spec.robot.display
        self._transport: Transport | None = None
        self._bag: BagWriter | None = None
        self._stack = contextlib.ExitStack()
        self._epoch: int | None = None

    @property
    def draws_trees(self) -> bool:
        """Whether markers of the planner's tree are sent or written."""
        return bool(self._root) or self._bag_path is not None

    def __enter__(self) -> Self:
        """Open the bag; the transport is opened with the first cycle."""
        if self._bag_path is not None:
            self._bag = self._stack.enter_context(BagWriter(self._bag_path))
            for time, topic, message in scene(self._spec.task, clock.time_ns(), self._frames.map):
                self._bag.write(topic, time, message)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close the transport and the bag."""
        if self._transport is not None:
            self._transport.close()
        self._stack.__exit__(kind, error, at)

    def show(self, cycle: Cycle) -> None:
        """Send a cycle, which was decided now."""
        now = clock.time_ns()
        epoch = now - round(1e9 * cycle.decided)
        transport = self._open()
        for name, message in cycle_messages(cycle, self._spec.vehicle, now, epoch, self._frames):
            if transport is not None:
                transport.publish(f"{self._root}/{name}", message)
            self._write(f"/{name}", now, message)
        if cycle.reason:
            self._write("/rosout", now, log_line(now, f"{cycle.kind}: {cycle.reason}", level=30))

    def _write(self, topic: str, time: int, message: Any) -> None:
        if self._bag is not None:
            self._bag.write(topic, time, message)

    def _open(self) -> Transport | None:
        """Transport with the topics announced; None if nothing is sent."""
        if not self._root:
            return None
        if self._transport is None:
            self._transport = open_transport(self._spec.robot)
            for name, kind in KINDS.items():
                self._transport.advertise(f"{self._root}/{name}", kind)
            for _, topic, message in scene(self._spec.task, clock.time_ns(), self._frames.map):
                kind, name = (GRID, "map") if topic == "/map" else (MARKERS, "scene")
                self._transport.advertise(f"{self._root}/{name}", kind, latched=True)
                self._transport.publish(f"{self._root}/{name}", message)
        return self._transport
