"""When a drive counts as unhealthy: missing poses, late commands, late decisions."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from kraft.robot.health import DECISIONS, Health
from kraft.robot.robot_file import Watchdog

PERIOD = 1.0 / 30.0


def drive(health: Health, seconds: float, poses: Callable[[int], int], late: Callable[[int], float]) -> list[float]:
    """Times at which the drive is in trouble."""
    troubles = []
    for k in range(round(seconds / PERIOD)):
        health.tick(k * PERIOD, late(k), poses(k))
        if health.trouble(k * PERIOD):
            troubles.append(k * PERIOD)
    return troubles


def in_time(k: int) -> float:
    return 0.0


def each(k: int) -> int:
    return 1


@pytest.mark.parametrize("rate", [15.0, 30.0])
def test_poses_that_arrive_at_their_rate_are_no_trouble(rate: float) -> None:
    generator = random.Random(1)
    health = Health(Watchdog(), rate, PERIOD)
    assert drive(health, 60.0, lambda k: int(rate > 20.0 or k % 2 == 0) * (generator.random() < 0.95), in_time) == []


@pytest.mark.parametrize("seed", range(20))
def test_one_pose_in_three_lost_is_noticed_within_seconds(seed: int) -> None:
    generator = random.Random(seed)
    health = Health(Watchdog(), 30.0, PERIOD)
    times = drive(health, 12.0, lambda k: int(k * PERIOD < 4.0 or generator.random() > 1 / 3), in_time)
    assert 4.0 < times[0] < 8.0
    assert "% of the poses of the last 2 s are missing" in health.trouble(12.0)


def test_it_is_over_when_the_poses_are_back() -> None:
    health = Health(Watchdog(), 30.0, PERIOD)
    times = drive(health, 12.0, lambda k: int(not 4.0 < k * PERIOD < 5.0), in_time)
    assert times[0] == pytest.approx(4.5, abs=0.1)
    assert times[-1] == pytest.approx(6.75, abs=0.1), "until an eighth is missing"


def test_poses_that_stop_are_left_to_the_limit_of_their_age() -> None:
    for pose_age in (0.1, 0.4, 2.0):
        health = Health(Watchdog(pose_age=pose_age), 30.0, PERIOD)
        times = drive(health, 30.0, lambda k: int(k * PERIOD < 15.0), in_time)
        assert times[0] > 15.0 + pose_age


def test_late_commands_are_trouble_when_they_are_many() -> None:
    rare = Health(Watchdog(), 30.0, PERIOD)
    assert drive(rare, 20.0, each, lambda k: 0.02 * (k % 6 == 0)) == []
    many = Health(Watchdog(), 30.0, PERIOD)
    assert drive(many, 20.0, each, lambda k: 0.02 * (k % 3 == 0))
    assert "the computer is overloaded" in many.trouble(20.0)


def test_two_late_decisions_of_four_are_trouble() -> None:
    health = Health(Watchdog(), 30.0, PERIOD)
    drive(health, 5.0, each, in_time)
    health.decision(late=True)
    assert health.trouble(5.0) == ""
    health.decision(late=True)
    assert health.trouble(5.0) == f"2 of the last {DECISIONS} decisions of the planner came too late"
    for _ in range(3):
        health.decision(late=False)
    assert health.trouble(5.0) == ""


@pytest.mark.parametrize("lost", [0.1, 0.15, 0.2])
def test_a_share_that_may_be_lost_is_no_trouble_from_the_first_tick_on(lost: float) -> None:
    health = Health(Watchdog(), 30.0, PERIOD)
    assert drive(health, 20.0, lambda k: int(int((k + 1) * lost) == int(k * lost)), in_time) == []
