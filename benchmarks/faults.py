"""Faults in the middle of a drive: whether the car stands without a collision, says why, and what is on the disk."""

from __future__ import annotations

import copy
import math
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.effort import Effort
from benchmarks.report import Report, Target, row
from benchmarks.rig import CREEPING, DriveOverError, Rig, Spoil
from kraft.robot.messages import make, nanoseconds_of

POSES: Final = "/pf/pose/odom"


def drop_poses(topic: str, message: Any) -> Any:
    """Lose the poses."""
    return None if topic == POSES else message


def freeze() -> Spoil:
    """The first pose again and again, with new stamps."""
    first: list[Any] = []

    def spoil(topic: str, message: Any) -> Any:
        if topic != POSES:
            return message
        first.append(message)
        frozen = copy.deepcopy(first[0])
        frozen.header.stamp = message.header.stamp
        return frozen

    return spoil


def jump(topic: str, message: Any) -> Any:
    """Move the poses by 2 m."""
    if topic == POSES:
        message.pose.pose.position.x += 2.0
    return message


def no_number(topic: str, message: Any) -> Any:
    """Make the poses no numbers."""
    if topic == POSES:
        message.pose.pose.position.y = math.nan
    return message


def clock_jump(seconds: int) -> Spoil:
    """Put the clock of the poses on or back."""

    def spoil(topic: str, message: Any) -> Any:
        if topic == POSES:
            time = nanoseconds_of(message.header.stamp) + seconds * 10**9
            message.header.stamp = make("builtin_interfaces/msg/Time", sec=time // 10**9, nanosec=time % 10**9)
        return message

    return spoil


def cut(topic: str, message: Any) -> Any:
    """Lose everything."""
    return None


SPOILT: Final[dict[str, tuple[Callable[[], Spoil], str]]] = {
    "poses stop": (lambda: drop_poses, "no pose for"),
    "poses freeze": (freeze, "the poses do not change"),
    "poses jump": (lambda: jump, "the poses jumped"),
    "poses are no numbers": (lambda: no_number, "the poses are no numbers"),
    "the clock jumps ahead": (lambda: clock_jump(5), "the clock of the poses jumped"),
    "the clock jumps back": (lambda: clock_jump(-5), "the clock of the poses jumped"),
    "the network is cut": (lambda: cut, "no pose for"),
}


SCENE: Final = "boxes"
FAST: Final = 0.45
"""Speed from which on a fault may come, m/s."""
WATCHED: Final = 8.0
"""Time within which the car has to stand, s."""
WHOLE: Final = 45.0
"""Time in which a drive has ended that nothing stops, s."""
OTHER: Final = 1000
"""What is added to the seed of a drive that was over before its fault."""
UNWRITTEN: Final = 0.1
"""Time before a fault of which ticks may be missing on the disk, s: three of them.

Every tick is written when it is over; the clocks of the drive and of the simulated robot are apart by less than one.
"""
PAUSE: Final = 1.0
"""Duration of a pause of processes, s."""


@dataclass(frozen=True)
class Fault:
    """What breaks, what the drive says about it (empty if nobody is left), and how long the car may take to stand (s).

    A car that drives in time whatever else its computer does may stand in the goal.  `mend` ends a fault after `PAUSE`.
    """

    name: str
    cause: Callable[[Rig, random.Random], None]
    says: str
    watched: float = WATCHED
    mend: Callable[[Rig], None] | None = None


@dataclass(frozen=True)
class Seen:
    """What a fault led to; `way` is the length of the path from the fault to standstill, m."""

    collided: bool
    stood: bool
    said: bool
    kept: bool
    way: float


class Stopping:
    """Condition, to be asked often: whether the car has come to stand since this was made, and its path until then.

    `way` (m) ends where the car was last faster than `CREEPING`, whatever it does after it has stood.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig, self._stands, self._has_stood = rig, rig.standstill(CREEPING), False
        self._last, self._path, self.way = self._place(), 0.0, 0.0

    def __call__(self) -> bool:
        """Whether the car has stood."""
        if not self._has_stood:
            place = self._place()
            self._path, self._last = self._path + math.dist(self._last, place), place
            if abs(self._rig.world.world.speed) > CREEPING:
                self.way = self._path
            self._has_stood = self._stands()
        return self._has_stood

    def _place(self) -> tuple[float, float]:
        x, y = self._rig.world.world.pose[:2]
        return float(x), float(y)


def spoil(name: str) -> Fault:
    """Fault of the messages."""
    make_spoil, says = SPOILT[name]

    def cause(rig: Rig, generator: random.Random) -> None:
        rig.link.spoil = make_spoil()

    return Fault(name, cause, says)


def signalled(name: str, number: int, victims: tuple[str, ...], says: str) -> Fault:
    """Signal to processes; ``group`` is the group of all of them but the guard."""

    def cause(rig: Rig, generator: random.Random) -> None:
        for victim in victims:
            if victim == "group":
                os.killpg(rig.process.pid, number)
            else:
                os.kill(rig.process.pid if victim == "planner" else rig.pid(victim), number)

    return Fault(name, cause, says, mend=resume if number == signal.SIGSTOP else None)


def resume(rig: Rig) -> None:
    """Let paused processes go on."""
    for pid in (rig.process.pid, rig.pid("control"), rig.pid("guard"), rig.pid("display")):
        os.kill(pid, signal.SIGCONT)


def lose(rig: Rig, generator: random.Random) -> None:
    """Lose one message in three from now on."""
    rig.link.spoil = lambda _, message: None if generator.random() < 1 / 3 else message


def load(rig: Rig, generator: random.Random) -> None:
    """Load every core of the machine with two processes."""
    context = multiprocessing.get_context("spawn")
    rig.others = [context.Process(target=burn, daemon=True) for _ in range(2 * (os.cpu_count() or 1))]
    for process in rig.others:
        process.start()


def burn() -> None:
    """Compute until the process is killed."""
    while True:
        math.sqrt(2.0)


PAUSED: Final = "the controller was held up"
FAULTS: Final = (
    signalled("the planner is killed", signal.SIGKILL, ("planner",), "the planner's process has ended"),
    signalled("the controller is killed", signal.SIGKILL, ("control",), "the controller's process ended"),
    signalled("all of kraft but its guard is killed", signal.SIGKILL, ("group",), ""),
    *(spoil(name) for name in SPOILT),
    Fault("one message in three is lost", lose, "of the poses of the last"),
    Fault("all cores are loaded", load, "success", watched=WHOLE),
    signalled("the controller pauses for 1 s", signal.SIGSTOP, ("control",), PAUSED),
    signalled("all of kraft but its guard pauses for 1 s", signal.SIGSTOP, ("group",), PAUSED),
    signalled("all of kraft, with its guard, pauses for 1 s", signal.SIGSTOP, ("guard", "group"), PAUSED),
    signalled("all of kraft, with its guard, is killed", signal.SIGKILL, ("guard", "group"), ""),
)


def run(effort: Effort) -> Report:
    """Let each fault happen many times, at random moments."""
    table = [["fault", "drives", "collided", "stood", "said why", "kept", "way to standstill (m)"]]
    collisions: list[float] = []
    for fault in FAULTS:
        seen = [_told(fault, seed) for seed in range(effort.faults)]
        counts = [sum(getattr(each, name) for each in seen) for name in ("collided", "stood", "said", "kept")]
        said = str(counts[2]) if fault.says else "-"
        ways = [each.way for each in seen if each.stood]
        way = f"{max(ways):.2f} at most" if ways else "-"
        table.append([fault.name, str(len(seen)), str(counts[0]), str(counts[1]), said, str(counts[3]), way])
        collisions.append(float(counts[0]))
    rows = [row("collisions after a fault", "", collisions, Target(0.0, of="worst"))]
    notes = [
        f"Drives in {SCENE} with adaptive-kraft over rosbridge, faults at random moments at {FAST} m/s or more.",
        f"Kept: the ticks until the fault are on the disk, but for those of its last {UNWRITTEN:g} s at most.",
        "The network is cut, and all of kraft is killed or pauses: only the robot's multiplexer can act, 0.2 s later.",
        "All cores are loaded by two processes each: the car stands in the goal, or if decisions or commands are late.",
    ]
    return Report("faults", rows, {"what faults lead to": table}, notes)


def _told(fault: Fault, seed: int) -> Seen:
    """One drive with one fault, reported as it ends; one that was over before the fault is driven with another seed."""
    while True:
        try:
            seen = one(fault, seed)
        except DriveOverError as over:
            print(f"  {fault.name}, seed {seed}: over before the fault: {over}", file=sys.stderr, flush=True)
            seed += OTHER
        else:
            print(f"  {fault.name}, seed {seed}: {seen}", file=sys.stderr, flush=True)
            return seen


def one(fault: Fault, seed: int) -> Seen:
    """One drive with one fault.

    Raises:
        DriveOverError: if the drive was over before.
    """
    generator = random.Random(f"{fault.name} {seed}")
    with tempfile.TemporaryDirectory() as name, Rig(Path(name), SCENE, seed=seed, give_up=2.0) as rig:
        rig.drive_until(generator.uniform(1.0, 5.0))
        rig.until(lambda: abs(rig.world.world.speed) > FAST or rig.is_over, 20.0)
        rig.check_drive()
        began, last = rig.world.world.time, float(rig.rows("steps")[-1][0])
        stands = Stopping(rig)
        fault.cause(rig, generator)
        if fault.mend is not None:
            ends = time.monotonic() + PAUSE
            rig.until(lambda: stands() and time.monotonic() >= ends, PAUSE)
            fault.mend(rig)
        stood = rig.until(stands, fault.watched) and rig.world.world.collision is None
        said = not fault.says or rig.until(lambda: says(rig, fault.says), 10.0)
        kept = keeps([float(each[0]) for each in rig.rows("steps")], began, last)
        return Seen(rig.world.world.collision is not None, stood, said, kept, stands.way)


def keeps(times: Sequence[float], began: float, last: float) -> bool:
    """Whether the `times` of the ticks on the disk reach to a fault that `began` then, when `last` was on it.

    The table is written row by row in the order of the ticks, so none is missing before one that is there.
    """
    before = [time for time in times if time <= began]
    return bool(before) and before[-1] >= began - UNWRITTEN and times[-1] >= last


def says(rig: Rig, words: str) -> bool:
    """Whether the drive has said something."""
    if any(words in event for event in rig.events):
        return True
    return rig.process.poll() is not None and words in rig.process.communicate()[0]
