"""Whatever breaks in the middle of a drive, the car stands without a collision, says why, and what was driven is kept.

Each fault happens once here, at a moment that the seed draws.
"""

from __future__ import annotations

import copy
import itertools
import json
import math
import multiprocessing
import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.rig import Rig

from kraft.robot.messages import make, nanoseconds_of

POSES = "/pf/pose/odom"


def drop_poses(topic: str, message: Any) -> Any:
    return None if topic == POSES else message


class Freeze:
    """The first pose again and again, with new stamps."""

    def __init__(self) -> None:
        self.first: Any = None

    def __call__(self, topic: str, message: Any) -> Any:
        if topic != POSES:
            return message
        self.first = self.first or message
        frozen = copy.deepcopy(self.first)
        frozen.header.stamp = message.header.stamp
        return frozen


def jump(topic: str, message: Any) -> Any:
    if topic == POSES:
        message.pose.pose.position.x += 2.0
    return message


def no_number(topic: str, message: Any) -> Any:
    if topic == POSES:
        message.pose.pose.position.y = math.nan
    return message


def clock_jump(seconds: int) -> Callable[[str, Any], Any]:
    def spoil(topic: str, message: Any) -> Any:
        if topic == POSES:
            time = nanoseconds_of(message.header.stamp) + seconds * 10**9
            message.header.stamp = make("builtin_interfaces/msg/Time", sec=time // 10**9, nanosec=time % 10**9)
        return message

    return spoil


def cut(topic: str, message: Any) -> Any:
    return None


ROOM = """
name: room
bounds: {x: [-3, 3], y: [-1, 7]}
obstacles: [{name: block, box: {center: [0, 4.5], size: [0.6, 0.3]}}]
start: {x: 0, y: 0, heading_deg: 90}
goal: {center: [0, 6], radius: 0.25}
vehicle: mushr
"""
"""Scene for faults after which nobody steers: only the multiplexer can stop the car then, wherever it is."""
SPOILT: dict[str, tuple[Callable[[], Callable[[str, Any], Any]], str]] = {
    "poses stop": (lambda: drop_poses, "no pose for"),
    "poses freeze": (Freeze, "the poses do not change"),
    "poses jump": (lambda: jump, "the poses jumped"),
    "poses are no numbers": (lambda: no_number, "the poses are no numbers"),
    "the clock jumps ahead": (lambda: clock_jump(5), "the clock of the poses jumped"),
    "the clock jumps back": (lambda: clock_jump(-5), "the clock of the poses jumped"),
    "the network is cut": (lambda: cut, "no pose for"),
}


def moment(fault: str) -> float:
    return random.Random(fault).uniform(1.5, 5.0)


def keeps_what_was_driven(rig: Rig, since: float) -> None:
    """Every tick until the fault is on the disk, and so is every cycle."""
    times = [float(row[0]) for row in rig.rows("steps")]
    assert times[-1] >= since - 0.5
    assert max(b - a for a, b in itertools.pairwise(times)) < 1.6
    lines = (rig.folder / "out" / "cycles.jsonl").read_text(encoding="utf-8").splitlines()
    assert len([json.loads(line) for line in lines]) >= int(since) - 1


@pytest.mark.parametrize("fault", SPOILT)
def test_the_car_stands_and_says_why_when_its_messages_are_spoilt(tmp_path: Path, fault: str) -> None:
    spoil, why = SPOILT[fault]
    with Rig(tmp_path) as rig:
        rig.drive_until(moment(fault))
        rig.link.spoil = spoil()
        assert rig.stands(5.0), (rig.world.world.collision, rig.world.world.speed)
        assert rig.until(lambda: any(why in event for event in rig.events), 5.0), rig.events
        out, _ = rig.process.communicate(timeout=60)
        result = json.loads(out)
        assert (rig.process.returncode, result["outcome"]) == (1, "stopped")
        assert why in result["reason"]
        keeps_what_was_driven(rig, moment(fault))


def test_the_car_stands_by_its_contingency_when_the_planner_is_killed(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.drive_until(moment("planner"))
        os.kill(rig.process.pid, signal.SIGKILL)
        assert rig.stands(6.0), (rig.world.world.collision, rig.world.world.speed)
        assert rig.until(lambda: any("the planner's process has ended" in event for event in rig.events), 8.0)
        keeps_what_was_driven(rig, moment("planner"))


def room(folder: Path) -> str:
    (folder / "room.yaml").write_text(ROOM, encoding="utf-8")
    return str(folder / "room.yaml")


def test_the_multiplexer_stops_the_car_when_the_controller_is_killed(tmp_path: Path) -> None:
    with Rig(tmp_path, room(tmp_path)) as rig:
        rig.drive_until(moment("controller"))
        os.kill(rig.controller or 0, signal.SIGKILL)
        assert rig.stands(6.0), (rig.world.world.collision, rig.world.world.speed)
        out, _ = rig.process.communicate(timeout=60)
        assert "the controller's process ended with -9" in json.loads(out)["reason"]
        keeps_what_was_driven(rig, moment("controller"))


@pytest.mark.parametrize("victim", ["planner", "controller", "both"])
def test_the_car_slows_down_when_a_process_pauses_for_a_second_and_goes_on(tmp_path: Path, victim: str) -> None:
    with Rig(tmp_path, room(tmp_path)) as rig:
        rig.drive_until(moment(f"pause {victim}"))
        before, both = abs(rig.world.world.speed), [rig.process.pid, rig.controller or 0]
        pids = {"planner": both[:1], "controller": both[1:]}.get(victim, both)
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(1.0)
        after = abs(rig.world.world.speed)
        for pid in pids:
            os.kill(pid, signal.SIGCONT)
        assert rig.until(lambda: rig.result is not None or rig.world.world.time > 45.0, 90.0)
        assert rig.world.world.collision is None
        if victim != "planner":
            assert after < 0.5 * before
            assert any("the controller was held up" in event for event in rig.events)


def test_one_message_in_three_may_be_lost(tmp_path: Path) -> None:
    generator = random.Random(3)
    with Rig(tmp_path) as rig:
        rig.drive_until(1.0)
        rig.link.spoil = lambda _, message: None if generator.random() < 1 / 3 else message
        assert rig.until(lambda: rig.result is not None, 70.0)
        assert rig.world.world.collision is None


def burn() -> None:
    while True:
        math.sqrt(2.0)


def test_a_loaded_machine_does_not_make_it_collide(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    burners = [context.Process(target=burn, daemon=True) for _ in range(2 * (os.cpu_count() or 1))]
    try:
        with Rig(tmp_path) as rig:
            rig.drive_until(2.0)
            for burner in burners:
                burner.start()
            assert rig.until(lambda: rig.result is not None or rig.world.world.time > 20.0, 60.0)
            assert rig.world.world.collision is None
    finally:
        for burner in burners:
            if burner.is_alive():
                burner.kill()
