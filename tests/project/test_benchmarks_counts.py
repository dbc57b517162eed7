"""Benchmarks count what they say: changes that are followed, searches without a plan, memory, drives that break."""

from __future__ import annotations

import math
import mmap
import subprocess
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import changes, drive, faults, goals, polish, robot
from benchmarks.effort import SMOKE
from benchmarks.exact import Body
from benchmarks.judge import MOTION
from benchmarks.machine import resident_bytes
from benchmarks.scenes import scene
from ompl_ext.arrays import Matrix
from ompl_ext.solver import DirtSolver


def test_a_search_without_a_plan_has_an_infinite_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DirtSolver, "plan", lambda self: None)
    monkeypatch.setattr(polish, "WARM_UP", 100)
    rows = {each.quantity: each for each in polish.over_time(scene("turns"), polish=True, seeds=2)}
    assert rows["turns, with: cost after 5 ms"].samples == (math.inf, math.inf)
    assert rows["turns, with: cost after 20 ms"].met is False
    assert rows["turns, with: steering after 5 ms"].samples == ()
    assert len(rows["turns, with: first plan"].samples) == 2


def test_a_change_is_followed_when_a_value_is_first_near() -> None:
    values = [(-1.0, 0.0), (0.5, 3.0), (1.5, -2.0), (2.5, 0.4), (3.5, 2.0)]
    assert changes.followed(values, 0.5) == 2.5
    assert changes.followed(values, 0.1) == math.inf
    assert changes.followed(values[:3], 0.1) is None  # the trial ended too soon to say
    found = {each.quantity: each for each in changes.following("it", [0.5, 2.5, math.inf, 4.0])}
    assert next(each.median for name, each in found.items() if "within 3 s" in name) == 50.0


def test_predictions_are_good_from_the_time_on_from_which_they_stay_good() -> None:
    def errors(*each: float) -> list[tuple[float, float]]:
        return [(0.25 * k, error) for k, error in enumerate(each)]

    by_chance = errors(*[1.0 if k % 3 == 0 else 9.0 for k in range(20)])
    assert changes.settled(by_chance, 2.0) == math.inf
    assert changes.settled(errors(1.0, 9.0, 9.0, *[1.0] * 8), 2.0) == 0.75
    assert changes.settled([(-0.25, 1.0), *errors(9.0, *[1.0] * 8)], 2.0) == 0.25
    many = [(0.05 * k, 9.0 if k in (1, 30) else 1.0) for k in range(80)]
    assert changes.settled(many, 2.0) == 0.0, "19 of 20 are more than 90 %"
    assert changes.settled(errors(9.0, 9.0, 1.0, 1.0, 1.0), 2.0) == 0.5, "half a second until the drive ends"
    assert changes.settled(errors(9.0, 9.0, 9.0, 1.0, 1.0), 2.0) is None
    assert changes.settled([], 2.0) is None
    drives = [changes.Drive("none", "success", 2.0, tuple(by_chance), ())] * 2
    (share,) = (each for each in changes.rows_of("none", drives, 2.0) if "within 3 s" in each.quantity)
    assert (share.median, share.target) == (0.0, None)


def test_trials_with_a_change_have_the_seeds_of_those_without_and_their_errors_since_then() -> None:
    same = [changes.change_of(kind, 5)[0] for kind in changes.KINDS]
    assert len(set(same)) == 1
    drive = changes.drive(changes.KINDS.index("linkage"), SMOKE.method)
    assert drive.kind == "linkage"
    assert changes.TIMES[0] <= drive.change <= changes.TIMES[1]
    assert all(0.0 < error < 1.0 for _, error in drive.errors)
    offsets = [abs(value) for time, value in drive.estimates if time < 0.0]
    assert np.median(offsets) == pytest.approx(math.radians(4.0), abs=math.radians(2.0))


def test_a_plan_is_looked_at_wherever_the_body_has_moved_by_5_mm(monkeypatch: pytest.MonkeyPatch) -> None:
    """One edge of 2 s at 0.6 m/s, of which 20 samples are 6 cm apart."""
    seen: list[Matrix] = []

    def nothing(self: Body, poses: Matrix) -> bool:
        seen.append(poses)
        return False

    monkeypatch.setattr(Body, "any_collision", nothing)
    problem = replace(goals.turning_round(3.0), start=np.array([0.5, 1.5, 0.0, 0.6]))
    problem = replace(problem, goal=replace(problem.goal, radius=3.0, tolerance=math.pi, limits={}))
    plan: Any = SimpleNamespace(controls=np.array([[1.0, 0.5]]), durations=np.array([2.0]))
    assert problem.holds(plan)
    (poses,) = seen
    shift = np.hypot(*np.diff(poses[:, :2], axis=0).T) + np.abs(np.diff(poses[:, 2])) * problem.vehicle.footprint.reach
    assert 0.001 < shift.max() <= MOTION
    times = problem.integrated(plan).times
    assert (len(times), times[-1]) == (goals.FINER + 1, pytest.approx(2.0))


def test_the_growth_of_the_memory_is_that_of_now_and_not_of_its_peak(monkeypatch: pytest.MonkeyPatch) -> None:
    def taken(size: int) -> mmap.mmap:
        region = mmap.mmap(-1, size)  # from the system: an array may be in memory that others have given back
        region.write(bytes(size))
        return region

    def trial(spec: Any) -> SimpleNamespace:
        cycles = [SimpleNamespace(planning_ms=1.0)] * 2
        if spec == 0:
            taken(240_000_000).close()  # before memory is counted
        else:
            kept.append(taken(16_000_000))
        return SimpleNamespace(cycles=cycles)

    kept: list[mmap.mmap] = []
    monkeypatch.setattr(drive, "run_trial", trial)
    monkeypatch.setattr(drive, "spec", lambda scene, method, seed: seed - drive.SEED)
    before = resident_bytes()
    rows = {each.quantity: each for each in drive.growth_rows(replace(SMOKE, cycles=15))}
    assert rows["resident memory, growth after the first trials"].median == pytest.approx(4 * 16e6 / 2**20, rel=0.2)
    assert resident_bytes() - before == pytest.approx(14 * 16e6, rel=0.3)


class Car:
    """Simulated car of a rig that is moved by hand."""

    def __init__(self) -> None:
        self.pose, self.speed = np.zeros(3), 0.5
        self.world = SimpleNamespace(world=self)
        self.stands = False

    def standstill(self, slow: float) -> Any:
        return lambda: self.stands


def test_the_way_to_standstill_is_that_of_the_path_and_ends_there() -> None:
    car: Any = Car()
    stopping = faults.Stopping(car)
    for angle in np.linspace(0.0, 1.5 * math.pi, 200):  # three quarters of a circle of 1 m
        car.pose = np.array([math.sin(angle), 1.0 - math.cos(angle), angle])
        assert not stopping()
    assert stopping.way == pytest.approx(1.5 * math.pi, rel=1e-3)
    car.speed = 0.01
    assert not stopping()
    car.stands = True
    assert stopping()
    car.pose, car.speed, car.stands = np.array([9.0, 9.0, 0.0]), 0.5, False  # after a pause it drives on
    assert stopping()
    assert stopping.way == pytest.approx(1.5 * math.pi, rel=1e-3)


def test_what_was_driven_is_kept_if_it_reaches_to_the_fault() -> None:
    ticks = [k / 30 for k in range(91)]
    assert faults.keeps(ticks, 3.02, ticks[-1])
    assert faults.keeps([*ticks, 4.0, 4.1], 3.02, ticks[-1])
    assert not faults.keeps(ticks[:-15], 3.02, ticks[-16]), "half a second is missing"
    assert not faults.keeps([*ticks[:-15], 4.0], 3.02, ticks[-16]), "and is not made up for by later ticks"
    assert not faults.keeps(ticks[:-2], 3.02, ticks[-1]), "a tick that was there is gone"
    assert not faults.keeps([], 3.02, 3.0)


def test_a_drive_that_hangs_leaves_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    processes: list[subprocess.Popen[str]] = []

    def sleep(*arguments: str) -> subprocess.Popen[str]:
        processes.append(subprocess.Popen(["sleep", "60"], stdout=subprocess.PIPE, text=True))
        return processes[-1]

    monkeypatch.setattr(robot, "_kraft", sleep)
    monkeypatch.setattr(robot, "TIMEOUT", 0.1)
    with pytest.raises(subprocess.TimeoutExpired):
        robot.drive("turns", "rosbridge", 0)
    assert [process.returncode for process in processes] == [-9, -9]
