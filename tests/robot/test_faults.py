"""Whatever breaks in the middle of a drive, the car stands without a collision, says why, and what was driven is kept.

Each fault happens once here, at a moment that a seed draws; `benchmarks/faults.py` lets each happen many times.
"""

from __future__ import annotations

import itertools
import json
import math
import multiprocessing
import os
import random
import re
import signal
from pathlib import Path
from typing import Any

import pytest

from benchmarks.faults import SPOILT, cut
from benchmarks.rig import CREEPING, Rig

ROOM = """
name: room
bounds: {x: [-3, 3], y: [-1, 7]}
obstacles: [{name: block, box: {center: [0, 4.5], size: [0.6, 0.3]}}]
start: {x: 0, y: 0, heading_deg: 90}
goal: {center: [0, 6], radius: 0.25}
vehicle: mushr
"""
"""Scene for faults after which nobody steers: only the multiplexer can stop the car then, wherever it is."""


def moment(fault: str) -> float:
    return random.Random(fault).uniform(1.5, 4.0)


def keeps_what_was_driven(rig: Rig, since: float) -> None:
    """Every tick until the fault is on the disk, and so is every cycle."""
    times = [float(row[0]) for row in rig.rows("steps")]
    assert times[-1] >= since - 0.5
    assert max(b - a for a, b in itertools.pairwise(times)) < 1.6
    lines = (rig.folder / "out" / "cycles.jsonl").read_text(encoding="utf-8").splitlines()
    assert len([json.loads(line) for line in lines]) >= int(since) - 1


def drives(rig: Rig) -> bool:
    return rig.until(lambda: abs(rig.world.world.speed) > 0.25 or rig.result is not None, 60.0)


def test_the_car_stands_says_why_and_goes_on_when_its_messages_are_spoilt(tmp_path: Path) -> None:
    faults = [name for name in SPOILT if name != "the network is cut"]
    random.Random(5).shuffle(faults)
    with Rig(tmp_path, give_up=30.0) as rig:
        rig.drive_until(1.0)
        for fault in faults:
            spoil, why = SPOILT[fault]
            for _ in range(4):  # the fault may come when the car stops for another reason
                assert drives(rig)
                known = len(rig.events)
                rig.link.spoil = spoil()
                assert rig.stands(5.0), (fault, rig.world.world.collision, rig.world.world.speed)
                rig.link.spoil = lambda _, message: message
                if any(why in event for event in rig.events[known:]):
                    break
            else:
                pytest.fail(f"{fault}: {rig.events}")
        assert drives(rig)
        assert rig.world.world.collision is None


def test_the_drive_ends_and_says_why_when_the_network_stays_cut(tmp_path: Path) -> None:
    with Rig(tmp_path, give_up=2.0) as rig:
        rig.drive_until(moment("network"))
        rig.link.spoil = cut
        assert rig.stands(5.0), (rig.world.world.collision, rig.world.world.speed)
        result = rig.process.result(60)
        assert (rig.process.returncode, result["outcome"]) == (1, "stopped")
        assert "no pose for" in result["reason"]
        keeps_what_was_driven(rig, moment("network"))


@pytest.mark.parametrize("speed", [1.0, 0.9], ids=["machine clock", "clock of the simulation"])
def test_a_connection_that_is_lost_is_the_reason_with_how_long_and_what_the_car_was_told(
    tmp_path: Path, speed: float
) -> None:
    """The time on the clock topic stands too then, and no pose comes: neither is the reason."""
    with Rig(tmp_path, give_up=2.0, speed=speed) as rig:
        rig.drive_until(1.0)
        rig.link.close()
        assert rig.stands(5.0), (rig.world.world.collision, rig.world.world.speed)
        result = rig.process.result(60)
        assert (rig.process.returncode, result["outcome"]) == (1, "stopped")
        reason = re.fullmatch(
            rf"the connection to {rig.url} is lost, and did not come back within ([\d.]+) s: the vehicle could not be "
            r"told to brake; its multiplexer stops it 0.2 s after the last command",
            result["reason"],
        )
        assert reason is not None, result["reason"]
        assert 1.5 < float(reason[1]) < 6.0
        assert result["t_s"] < 20.0


def test_the_drive_ends_when_the_steering_is_the_wrong_way_round(tmp_path: Path) -> None:
    (tmp_path / "room.yaml").write_text(ROOM, encoding="utf-8")

    def swap(topic: str, message: Any) -> Any:
        if topic == "/drive":
            message.drive.steering_angle *= -1.0
        return message

    with Rig(tmp_path, scenario=str(tmp_path / "room.yaml")) as rig:
        rig.link.spoil = swap
        result = rig.process.result(60)
        assert (rig.process.returncode, result["outcome"]) == (1, "stopped")
        assert "the steering is the wrong way round (command.steering.scale" in result["reason"]
        assert rig.stands(5.0), (rig.world.world.collision, rig.world.world.speed)
        assert result["t_s"] < 15.0


def test_the_car_stands_by_its_contingency_when_the_planner_is_killed(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.drive_until(moment("planner"))
        os.kill(rig.process.pid, signal.SIGKILL)
        assert rig.stands(6.0), (rig.world.world.collision, rig.world.world.speed)
        assert rig.until(lambda: any("the planner's process has ended" in event for event in rig.events), 8.0)
        keeps_what_was_driven(rig, moment("planner"))


def test_the_brake_guard_stops_the_car_when_the_controller_is_killed(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.drive_until(moment("controller"))
        os.kill(rig.pid("control"), signal.SIGKILL)
        assert rig.stands(6.0), (rig.world.world.collision, rig.world.world.speed)
        assert "the controller's process ended with -9" in rig.process.result(60)["reason"]
        keeps_what_was_driven(rig, moment("controller"))
        driven = [float(row[0]) for row in rig.rows("guard")]
        assert driven[0] - float(rig.rows("steps")[-1][0]) < 0.15, "it acts before the multiplexer does"
        assert driven[-1] > driven[0] + 1.0, "it commands the car to stand for a second"


def test_the_brake_guard_stops_the_car_when_all_processes_of_the_group_pause(tmp_path: Path) -> None:
    """SIGSTOP to the group of processes, as a terminal sends it with Ctrl-Z, does not reach the guard."""
    with Rig(tmp_path) as rig:
        rig.drive_until(moment("group"))
        os.killpg(rig.process.pid, signal.SIGSTOP)
        try:
            assert rig.stands(6.0), (rig.world.world.collision, rig.world.world.speed)
        finally:
            os.killpg(rig.process.pid, signal.SIGCONT)
        assert rig.until(rig.standstill(CREEPING), 5.0), "after the pause too, before it drives on"
        assert drives(rig)
        assert rig.world.world.collision is None
        assert any("the controller was held up" in event and "the brake guard" in event for event in rig.events), (
            rig.events
        )


def room(folder: Path) -> str:
    (folder / "room.yaml").write_text(ROOM, encoding="utf-8")
    return str(folder / "room.yaml")


def test_the_multiplexer_stops_the_car_when_controller_and_guard_are_killed(tmp_path: Path) -> None:
    with Rig(tmp_path, room(tmp_path)) as rig:
        rig.drive_until(2.0)
        for name in ("guard", "control"):
            os.kill(rig.pid(name), signal.SIGKILL)
        assert rig.stands(6.0), (rig.world.world.collision, rig.world.world.speed)
        assert rig.world.mux_stops > 0


def test_a_drive_ends_when_its_guard_has_ended(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig:
        rig.drive_until(1.5)
        os.kill(rig.pid("guard"), signal.SIGKILL)
        assert rig.stands(6.0), (rig.world.world.collision, rig.world.world.speed)
        assert "the brake guard has ended" in rig.process.result(60)["reason"]


def burn() -> None:
    while True:
        math.sqrt(2.0)


def test_the_car_stands_and_says_why_when_one_message_in_three_is_lost(tmp_path: Path) -> None:
    generator = random.Random(3)
    with Rig(tmp_path, give_up=30.0) as rig:
        rig.drive_until(moment("lost"))
        rig.link.spoil = lambda _, message: None if generator.random() < 1 / 3 else message
        assert rig.stands(8.0), (rig.world.world.collision, rig.world.world.speed)
        assert any("of the poses of the last 2 s are missing" in event for event in rig.events), rig.events
        rig.link.spoil = lambda _, message: message
        assert drives(rig)
        assert rig.world.world.collision is None


def test_a_loaded_machine_does_not_make_it_collide(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    burners = [context.Process(target=burn, daemon=True) for _ in range(2 * (os.cpu_count() or 1))]
    try:
        with Rig(tmp_path) as rig:
            rig.drive_until(1.0)
            for burner in burners:
                burner.start()
            assert rig.until(lambda: rig.result is not None or rig.world.world.time > 6.0, 60.0)
            assert rig.world.world.collision is None
    finally:
        for burner in burners:
            if burner.is_alive():
                burner.kill()
