"""Benchmarks of what is estimated: unknown cars, their bound, and the errors of the estimates."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.benchmarks import quantities

from benchmarks import estimated, estimates, knowledge
from benchmarks.effort import SMOKE
from kraft.vehicles.load import load_vehicle


def test_random_cars_are_within_their_ranges_and_can_be_held() -> None:
    vehicle, rng = load_vehicle("mushr-force"), np.random.default_rng(0)
    for _ in range(50):
        values = estimated.random_car(rng, vehicle).parameters
        assert all(vehicle.ranges[name].low <= value <= vehicle.ranges[name].high for name, value in values.items())
        needed = math.hypot(values["a_x"], values["a_y"]) * values["tau"] * (1 - values["u_0"]) / values["v_delta"]
        assert needed <= 0.5


def test_episodes_compare_the_true_motion_with_the_bound() -> None:
    episodes = [estimated.episode(number, SMOKE.method) for number in range(SMOKE.estimated)]
    for each in episodes:
        assert 0 < each.held <= each.ticks
        assert each.broken <= each.cycles
        assert 0.01 < each.delta < 1.0
        assert 0.0 < each.deviation < 1.0
    table = estimated.report(episodes, 0.99, 1.0, SMOKE)
    assert quantities(table)["episodes"] == SMOKE.estimated
    repeated, other = estimated.episode(0, SMOKE.method), estimated.episode(0, SMOKE.method, again=1)
    assert replace(repeated, seconds=0.0) == replace(episodes[0], seconds=0.0)
    assert (other.number, other.deviation == repeated.deviation) == (0, False)


def test_further_drives_of_a_world_are_counted_apart() -> None:
    drive = estimated.episode(0, SMOKE.method)
    hit, late = replace(drive, outcome="collision"), replace(drive, outcome="timeout")
    other = replace(drive, number=5, outcome="success")
    table = estimated.report(
        [hit, other], 0.99, 1.0, SMOKE, [hit, replace(hit, number=5), hit, replace(late, number=5)]
    )
    found = quantities(table)
    rows = [value for name, value in found.items() if "further" in name or "these" in name]
    assert found["episodes"] == 2
    assert rows == [75.0, 1.0, 25.0]


def test_a_robot_knows_what_the_benchmark_says_and_nothing_more() -> None:
    spec, true = estimated.episode_parts(knowledge.PRONE[0], SMOKE.method)
    assert knowledge.knowing(spec, true, knowledge.Known()) == spec.vehicle
    told = knowledge.knowing(spec, true, knowledge.Known((*knowledge.TURNING, *knowledge.DELAY)))
    for name, value in told.parameters.items():
        known = name in knowledge.TURNING
        assert value == pytest.approx((true if known else spec.vehicle).parameters[name])
        share = knowledge.NARROWER if known else 1.0
        assert told.ranges[name].std == pytest.approx(share * spec.vehicle.ranges[name].std)
    sensing = spec.scenario.sensing
    assert told.delay == (sensing.command_delay + sensing.latency, knowledge.DELAY_STD)
    misled = knowledge.knowing(spec, true, knowledge.KNOWN["wheelbase and steering offset twice as wrong"])
    assert misled.ranges == spec.vehicle.ranges
    assert true.parameters["L"] - misled.parameters["L"] == pytest.approx(
        2.0 * (true.parameters["L"] - spec.vehicle.parameters["L"])
    )


def test_a_prone_world_is_driven_with_other_seeds() -> None:
    first, again = (knowledge.outcome(k, knowledge.Known(), SMOKE.method) for k in (2, 2 + len(knowledge.PRONE)))
    assert {first, again} <= {"success", "collision", "timeout"}


def test_estimates_are_compared_with_the_truth_at_their_own_time() -> None:
    """The oracle knows pose and speed; the speed here is a difference quotient of the true poses."""
    slip = estimates.KINDS.index("slip")
    known, estimated_errors = (estimates.drive(slip, name).values for name in ("oracle", SMOKE.method))
    assert np.abs(known[:, :3]).max() < 1e-6
    assert np.sqrt(np.mean(known[:, 3] ** 2)) < 0.02
    assert 0.003 < np.sqrt(np.mean(estimated_errors[:, :2] ** 2)) < 0.1
