"""A drive for tests and benchmarks: `kraft drive`, and the simulated robot, whose messages can be spoilt."""

from __future__ import annotations

import contextlib
import csv
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from benchmarks.drive_server import DriveProcess
from kraft.planning.workspace import vehicle_of_task
from kraft.robot.connect import open_transport
from kraft.robot.priority import prefer_this_process
from kraft.robot.robot_file import load_robot
from kraft.robot.transport import Peers, Receive, Refused, Transport
from kraft.robot.world import RobotWorld, WorldResult
from kraft.scenario import load_scenario

ROBOT = """name: rig
transport: {transport}
pose: {{topic: /pf/pose/odom, type: nav_msgs/msg/Odometry, rate_hz: 30, level_camera: true}}
command: {{topic: /drive, type: ackermann_msgs/msg/AckermannDriveStamped}}
watchdog: {{give_up: {give_up}}}
{more}
"""
Spoil = Callable[[str, Any], Any]
REST_SPEED = 0.02  # up to which a car stands (m/s)
CREEPING = 0.05  # up to which one stands that still settles after a fault (m/s)


def free_port() -> int:
    """Port of this machine that nobody listens to."""
    with socket.socket() as opened:
        opened.bind(("localhost", 0))
        return int(opened.getsockname()[1])


class SpoiltTransport:
    """Transport that hands each message of the robot, and each command to it, to `spoil`; None loses it."""

    problem, connections = "", 1

    def __init__(self, inner: Transport) -> None:
        self.inner = inner
        self.spoil: Spoil = lambda _, message: message

    def advertise(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Announce messages."""
        self.inner.advertise(topic, kind, latched=latched)

    def publish(self, topic: str, message: Any) -> None:
        """Send what is left of a message."""
        spoilt = self.spoil(topic, message)
        if spoilt is not None:
            self.inner.publish(topic, spoilt)

    def subscribe(
        self, topic: str, kind: str, receive: Receive, *, latched: bool = False, reliable: bool = True,
        refused: Refused | None = None,
    ) -> None:  # fmt: skip
        """Receive what is left of messages."""

        def arrived(message: Any, arrival: int) -> None:
            spoilt = self.spoil(topic, message)
            if spoilt is not None:
                receive(spoilt, arrival)

        self.inner.subscribe(topic, kind, arrived, latched=latched, reliable=reliable, refused=refused)

    def peers(self, topic: str) -> Peers:
        """Publishers and subscribers of a topic."""
        return self.inner.peers(topic)

    def close(self) -> None:
        """Close the transport."""
        self.inner.close()


class DriveOverError(Exception):
    """A drive that was over before what it was for."""


@dataclass
class Rig:
    """A drive of a scenario in the folder `folder`, `speed` times as fast as real time."""

    folder: Path
    scenario: str = "boxes"
    transport: str = ""
    seed: int = 0
    more: str = ""
    give_up: float = 4.0
    speed: float = 1.0
    arguments: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    others: list[BaseProcess] = field(default_factory=list)  # that end with the drive

    def __enter__(self) -> Rig:
        self.url = f"ws://localhost:{free_port()}"
        transport = self.transport or f'{{kind: rosbridge, url: "{self.url}"}}'
        more = self.more if self.speed == 1.0 else f"{self.more}\nclock: {{topic: /clock}}"
        self.file = self.folder / "robot.yaml"
        self.file.write_text(ROBOT.format(transport=transport, more=more, give_up=self.give_up), encoding="utf-8")
        self.result: WorldResult | None = None
        self._pids: dict[str, int] = {}
        self._opened = threading.Event()
        self._thread = threading.Thread(target=self._simulate, name="world")
        self._thread.start()
        assert self._opened.wait(60.0)
        overrides = [f"--set={key}={value}" for key, value in self.settings.items()]
        self.process = DriveProcess(
            ["drive", self.scenario, "--robot", str(self.file), "--json", "--out", str(self.folder / "out"),
             "--seed", str(self.seed), *overrides, *self.arguments],
            self.folder, session=True,
        )  # fmt: skip
        return self

    def __exit__(self, *_: object) -> None:
        self.world.cancelled = True
        for process in self.others:
            process.kill()
        self._find_processes()
        for pid in (*self._pids.values(), self.process.pid):
            try:
                os.kill(pid, signal.SIGCONT)
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue  # it has ended by itself
        self.process.communicate()
        self._thread.join()
        self.link.close()

    def _simulate(self) -> None:
        prefer_this_process()  # this thread, and those of the transport
        robot, scenario = load_robot(self.file), load_scenario(self.scenario, self.settings)
        self.link = SpoiltTransport(open_transport(robot, "robot"))
        self.world = RobotWorld(scenario, vehicle_of_task(scenario), robot, self.link, self.seed)
        self._opened.set()
        self.result = self.world.run(patience=120.0, speed=self.speed)

    def pid(self, name: str) -> int:
        """Process ``control``, ``guard`` or ``display`` of the drive, also after the planner's process has ended."""
        self._find_processes()
        return self._pids[f"kraft {name}"]

    def _find_processes(self) -> None:
        ended = contextlib.suppress(FileNotFoundError, ProcessLookupError)  # a thread or process has just ended
        for children in Path("/proc").glob(f"{self.process.pid}/task/*/children"):
            with ended:
                for pid in map(int, children.read_text(encoding="ascii").split()):
                    with ended:
                        self._pids[Path(f"/proc/{pid}/comm").read_text(encoding="ascii").strip()] = pid

    def _knows_processes(self) -> bool:
        self._find_processes()
        return {"kraft control", "kraft guard"} <= set(self._pids)

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Whether a condition comes true in time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if condition():
                return True
            time.sleep(0.005)
        return condition()

    def drive_until(self, moment: float) -> None:
        """Wait for a time of the drive (s) at which the car moves.

        Raises:
            DriveOverError: if the drive ends before, as a drive on an overloaded computer may.
        """
        begun = self.until(lambda: self.world.world.time >= moment or self.is_over, 180.0)
        assert begun
        assert self.until(lambda: abs(self.world.world.speed) > 0.15 or self.is_over, 150.0)
        assert self.until(lambda: self._knows_processes() or self.is_over, 10.0), self._pids
        self.check_drive()

    def check_drive(self) -> None:
        """Check that the drive goes on.

        Raises:
            DriveOverError: if not, with what it said.
        """
        if self.is_over:
            said = self.process.communicate() if self.process.poll() is not None else ""
            raise DriveOverError(f"{said}, {self.result}, {self.events[-2:]}")

    @property
    def is_over(self) -> bool:
        """Whether the drive, or the simulation of the robot, has ended."""
        return self.result is not None or self.process.poll() is not None

    def stands(self, seconds: float) -> bool:
        """Whether the car stands for half a second within a time, without a collision."""
        return self.until(self.standstill(), seconds) and self.world.world.collision is None

    def standstill(self, slow: float = REST_SPEED) -> Callable[[], bool]:
        """Condition, to be asked often: whether the car was at most `slow` (m/s) for half a second since this call."""
        since, stood = time.monotonic(), False

        def has_stood() -> bool:
            nonlocal since, stood
            if abs(self.world.world.speed) > slow:
                since = time.monotonic()
            stood = stood or time.monotonic() - since > 0.5
            return stood

        return has_stood

    @property
    def events(self) -> list[str]:
        """What the controller wrote about what happened."""
        return [row[1] for row in self.rows("events")]

    def rows(self, name: str) -> list[list[str]]:
        """Rows of a table of the drive, without its heading; none as long as nothing was to be written."""
        path = self.folder / "out" / f"{name}.csv"
        if not path.exists():
            return []
        with path.open(encoding="utf-8", newline="") as file:
            return list(csv.reader(file))[1:]
