"""Simulated time that stands, goes on or goes back; and drives by it."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from benchmarks.rig import Rig
from kraft.robot.loopback import LoopbackBus
from kraft.robot.timebase import LOOK, TopicClock
from kraft.robot.world import clock_message

STEP = 20_000_000  # time between two messages, ns of the machine's clock


class Simulation:
    """Sends its time every STEP, and moves the machine's clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        bus = LoopbackBus()
        self.monotonic, self.time = 10**12, 10**15
        for place in ("loopback", "timebase"):
            monkeypatch.setattr(f"kraft.robot.{place}.time.monotonic_ns", lambda: self.monotonic)
        self.clock, self._node = TopicClock(bus.node("kraft"), "/clock"), bus.node("world")

    def run(self, seconds: float, speed: float = 1.0, sends: bool = True) -> None:
        for _ in range(round(1e9 * seconds / STEP)):
            self.monotonic += STEP
            self.time += round(speed * STEP)
            if sends:
                self._node.publish("/clock", clock_message(self.time))
            assert 0.0 < self.clock.wall(1.0) <= LOOK


@pytest.mark.parametrize("sends", [True, False])
def test_a_paused_clock_stands_and_goes_on_at_its_speed(monkeypatch: pytest.MonkeyPatch, sends: bool) -> None:
    simulation = Simulation(monkeypatch)
    clock = simulation.clock
    simulation.run(3.0, 0.5)
    assert not clock.stands
    simulation.run(0.4, 0.0, sends)
    assert not clock.stands, "it may only be late"
    simulation.run(0.3, 0.0, sends)
    assert clock.stands
    at = clock.now()
    assert at - simulation.time == pytest.approx(0.25e9, abs=1e7), "it went on for half a second"
    simulation.run(20.0, 0.0, sends)
    assert (clock.stands, clock.now(), clock.restarts) == (True, at, 0)
    simulation.run(0.2, 0.5)
    assert clock.stands, "the simulation has not come to the time that the drive had"
    simulation.run(0.5, 0.5)
    assert not clock.stands
    for _ in range(50):
        simulation.run(0.04, 0.5)
        assert clock.now() == pytest.approx(simulation.time, abs=1e6)


def test_a_clock_that_goes_back_has_restarted_and_late_messages_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = Simulation(monkeypatch)
    clock = simulation.clock
    simulation.run(2.0)
    simulation.time -= 100_000_000
    simulation.run(0.02)
    assert (clock.restarts, clock.is_running) == (0, True)
    simulation.time -= 3 * 10**9
    simulation.run(0.02)
    assert (clock.restarts, clock.is_running) == (1, False)
    simulation.run(1.0)
    assert clock.is_running
    assert clock.now() == pytest.approx(simulation.time, abs=1e6)


def test_the_car_stands_while_its_clock_stands_and_the_drive_ends_when_it_goes_back(tmp_path: Path) -> None:
    with Rig(tmp_path, give_up=30.0, speed=0.5) as rig:
        rig.drive_until(1.0)
        frozen: list[Any] = []

        def freeze(topic: str, message: Any) -> Any:
            if topic == "/clock":
                frozen.append(message)
                return frozen[0]
            return message

        rig.link.spoil = freeze
        assert rig.stands(10.0)
        assert rig.until(lambda: any("the time on /clock stands" in event for event in rig.events), 1.0)
        rig.link.spoil = lambda _, message: message
        assert rig.until(lambda: abs(rig.world.world.speed) > 0.25, 60.0)
        rig.link.spoil = lambda topic, message: clock_message(10**9) if topic == "/clock" else message
        result = rig.process.result(30)
        assert rig.stands(1.0)
        assert (rig.process.returncode, result["outcome"]) == (1, "stopped")
        assert "the time on /clock has gone back" in result["reason"]


def test_the_guard_stops_the_car_when_the_controller_is_killed_while_the_clock_stands(tmp_path: Path) -> None:
    with Rig(tmp_path, speed=0.5) as rig:
        rig.drive_until(1.0)
        rig.link.spoil = lambda topic, message: None if topic == "/clock" else message
        assert rig.until(lambda: any("the time on /clock stands" in event for event in rig.events), 5.0)
        commands = rig.world._commands
        os.kill(rig.pid("control"), signal.SIGKILL)
        assert rig.stands(6.0)
        assert rig.until(lambda: rig.process.poll() is not None, 30.0)
        assert rig.world._commands > commands + 15, "the guard sends for a second"
