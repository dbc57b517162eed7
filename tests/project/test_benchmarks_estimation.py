"""Benchmarks of what is estimated: unknown cars, their bound, and the errors of the estimates."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.benchmarks import quantities

from benchmarks import estimated, estimates, knowledge
from benchmarks.effort import FULL, SMOKE
from benchmarks.parallel import grouped_interval
from kraft.trial.result import Outcome
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


def test_a_method_without_a_clearance_or_a_level_is_reported_without_what_it_does_not_state() -> None:
    drive = estimated.episode(0, SMOKE.method)
    unbounded = replace(drive, ticks=0, held=0, cycles=0, broken=0, delta=0.0, deviation=0.0, judged_to_end=False)
    table = estimated.report([unbounded], None, 1.0, SMOKE)
    assert not any("delta" in name for name in quantities(table))
    assert [each.target for each in table.rows if each.target] == []
    fixed = estimated.report([drive], None, 1.0, SMOKE)
    assert any("delta did not hold" in name for name in quantities(fixed))
    assert [each.target for each in fixed.rows if each.target] == []
    assert "nan" not in table.text() + fixed.text()
    stated = estimated.report([drive], 0.99, 1.0, SMOKE)
    assert len([each.target for each in stated.rows if each.target]) == 2


def test_delta_held_at_a_collision_only_if_it_was_known_just_before() -> None:
    spec, true = estimated.episode_parts(0, SMOKE.method)
    result = estimated.driven(spec, true)
    hit = replace(result, outcome=Outcome.COLLISION)
    assert estimated.judged(0, hit, spec.vehicle, 0.0).judged_to_end
    unbounded = replace(hit.cycles[-1], predicted=replace(hit.cycles[-1].predicted, delta=None))
    last = [step for step in hit.steps if step.time < unbounded.time + 0.1]
    short = replace(hit, cycles=(*hit.cycles[:-1], unbounded), steps=tuple(last), time=unbounded.time + 0.11)
    found = estimated.judged(0, short, spec.vehicle, 0.0)
    assert (found.judged_to_end, found.collided_within_delta) == (False, False)
    counted = quantities(estimated.report([found], 0.99, 1.0, SMOKE))
    assert counted["collisions without a tick with a bound just before"] == 1.0
    assert counted["collisions at a tick at which delta held"] == 0.0


def test_what_collides_for_want_of_knowledge_is_judged_by_world() -> None:
    worlds = len(knowledge.PRONE)
    outcomes = ["collision" if k % worlds < 9 else "success" for k in range(6 * worlds)]
    found = knowledge.row_of("it", outcomes)
    assert found.median == pytest.approx(100 / 3)
    assert f"54 of {6 * worlds}, {grouped_interval([6] * 9 + [0] * 18, [6] * 27)}; 0 timeouts" in found.quantity


def test_estimates_are_measured_in_worlds_that_no_target_is() -> None:
    assert FULL.estimated <= estimates.FIRST_CAR
    assert FULL.arenas <= estimates.FIRST_ARENA


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
