"""Measures of a trial: each against a motion for which it is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.fake_trials import cycle

from kraft.driving.messages import ContingencyOrigin, Cycle, PlanLoss, PredictedMotion
from kraft.trial.measures import BAND, Kept, Measures, Step, farthest_point, measure, normalised_squares, pooled
from kraft_cli.work.run import measures_table
from ompl_ext.arrays import Matrix
from ompl_ext.vehicle import Footprint

FOOTPRINT = Footprint(0.4, 0.2)
POSE = (0, 1, 2)


def straight(number: int, kind: str = "plan", delta: float | None = 0.02) -> Cycle:
    """A cycle of one second that predicts a drive along x at 1 m/s."""
    times = np.array([number, number + 1.0])
    states = np.array([[number, 0.0, 0.0, 1.0], [number + 1.0, 0.0, 0.0, 1.0]])
    asked = None if delta is None else np.full(2, delta)
    return replace(cycle(number, kind), predicted=PredictedMotion(times, states, 0.1, asked))


def drive(seconds: float, aside: float = 0.0, turned: float = 0.0) -> list[Step]:
    """Ticks of a drive along x at 1 m/s, `aside` m to the left and `turned` rad."""
    times = np.arange(0.0, seconds, 0.05)
    return [Step(float(t), (float(t), aside, turned), 1.0, np.zeros(4), np.zeros(2), 0) for t in times]


def test_a_car_where_it_was_predicted_keeps_the_clearance() -> None:
    found = measure([straight(0), straight(1, "contingency")], drive(2.0, aside=0.015), FOOTPRINT, POSE)
    assert (found.plans.ticks, found.contingencies.ticks) == (20, 20)
    assert (found.plans.coverage, found.contingencies.coverage, found.clearance.coverage) == (1.0, 1.0, 1.0)
    assert found.clearance.delta_mean == pytest.approx(0.02)
    assert all(set(values) == {15} for values in found.deviation_mm)
    assert found.deviation_quantiles((0.5, 1.0)) == [[pytest.approx(0.1 * k), 0.015, 0.015] for k in range(1, 11)]


def test_a_car_that_is_farther_off_does_not() -> None:
    found = measure([straight(0)], drive(1.0, aside=0.025), FOOTPRINT, POSE)
    assert (found.clearance.coverage, found.clearance.held) == (0.0, 0)


def test_a_turned_car_is_as_far_off_as_its_farthest_corner() -> None:
    turned = 0.1
    corner = math.hypot(0.2, 0.1) * 2 * math.sin(turned / 2)
    true, expected = np.array([[1.0, 2.0, 0.5 + turned]]), np.array([[1.0, 2.0, 0.5]])
    assert farthest_point(true, expected, FOOTPRINT) == pytest.approx([corner])
    random = np.random.default_rng(0)
    for _ in range(50):  # no point of the rectangle is farther off than a corner
        pose, other = random.normal(size=3), random.normal(size=3)
        x, y = random.uniform(-0.2, 0.2), random.uniform(-0.1, 0.1)
        at = [p[:2] + rotation(p[2]) @ [x, y] for p in (pose, other)]
        farthest = farthest_point(pose[None, :], other[None, :], FOOTPRINT)[0]
        assert np.hypot(*(at[0] - at[1])) <= farthest + 1e-12


def rotation(angle: float) -> Matrix:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def test_ticks_after_the_next_cycle_began_belong_to_that_one() -> None:
    cycles = [straight(0, delta=0.01), straight(1, delta=0.05)]
    found = measure(cycles, drive(2.0, aside=0.03), FOOTPRINT, POSE)
    assert (found.clearance.ticks, found.clearance.held) == (40, 20)


def test_a_method_without_clearance_has_deviations_only() -> None:
    found = measure([straight(0, delta=None)], drive(1.0), FOOTPRINT, POSE)
    assert (found.clearance.ticks, found.clearance.coverage, found.clearance.delta_mean) == (0, None, None)
    assert len(found.deviation_mm) == 10


def costing(number: int, cost: float, lost: PlanLoss = PlanLoss.NONE) -> Cycle:
    return replace(straight(number), cost_to_goal=cost, lost=lost)


def test_a_plan_that_costs_more_than_was_left_is_a_regression() -> None:
    costs = [(9.0, PlanLoss.NONE), (8.4, PlanLoss.NONE), (8.0, PlanLoss.COLLISION), (math.inf, PlanLoss.NONE),
             (9.0, PlanLoss.NONE), (9.0, PlanLoss.ESTIMATE)]  # fmt: skip
    found = measure([costing(k, *each) for k, each in enumerate(costs)], drive(6.0), FOOTPRINT, POSE)
    assert found.compared == 3  # 9 and 8.4, 8.4 and 8, 9 and 9
    assert found.regressions == {"edge in collision": 1, "estimate moved": 1}  # 8.4 is less than 0.5 above 8


def test_contingencies_are_counted_by_origin() -> None:
    origins = [ContingencyOrigin.SAFE, ContingencyOrigin.IN_HAND, ContingencyOrigin.EMERGENCY, None]
    cycles = [replace(straight(k), contingency_origin=origin) for k, origin in enumerate(origins)]
    found = measure(cycles, drive(4.0), FOOTPRINT, POSE)
    assert (found.emergencies, found.in_hand) == (1, 1)


def test_a_contingency_that_the_trial_ends_before_is_not_counted() -> None:
    cycles = [replace(straight(k), contingency_origin=ContingencyOrigin.EMERGENCY) for k in range(3)]
    counts = [measure(cycles, drive(1.9), FOOTPRINT, POSE, end=end).emergencies for end in (1.9, 2.0)]
    assert counts == [2, 3]


def test_the_band_holds_95_percent_of_a_consistent_estimators_errors() -> None:
    from scipy.stats import chi2

    assert pytest.approx(chi2.ppf([0.025, 0.975], 3), abs=1e-4) == BAND
    errors = np.random.default_rng(0).chisquare(3, 4000)
    found = measure([], [], FOOTPRINT, POSE, errors_squared=errors.tolist()).consistency
    assert found is not None
    assert found.share == pytest.approx(0.95, abs=0.01)
    assert found.mean == pytest.approx(3.0, abs=0.15)


def test_the_share_in_the_band_is_told_with_the_band() -> None:
    (row,) = measures_table(measure([], [], FOOTPRINT, POSE, errors_squared=[1.0, 3.0, 5.0, 20.0]), 0)
    assert row == (
        "covariance",
        "normalised squared error 7.2 on average (3 if the stated covariance is right, less if it is cautious, more if "
        "errors exceed it); 75 % of poses in its 95 % band, 0.22 to 9.3",
    )


def test_the_clearance_that_was_kept_is_told_in_the_units_of_the_table() -> None:
    kept = Kept(ticks=1000, held=999, delta_sum_m=168.0)
    (row,) = measures_table(measure([], [], FOOTPRINT, POSE).model_copy(update={"plans": kept}), 0)
    assert row == ("delta(v)", "held at 99.9 % of the ticks, 0.168 m on average")


def test_each_error_is_normalised_by_its_own_covariance() -> None:
    random, given = np.random.default_rng(0), []
    for scale in (1e-4, 1e-2, 1.0):
        root = scale * random.normal(size=(3, 3))
        given.append((scale * random.normal(size=3), root @ root.T + 1e-3 * scale**2 * np.eye(3)))
    alone = [float(error @ np.linalg.solve(covariance, error)) for error, covariance in given]
    assert normalised_squares(given) == alone
    assert normalised_squares([]) == []


def test_measures_of_trials_add_up() -> None:
    one = measure([straight(0)], drive(1.0, aside=0.01), FOOTPRINT, POSE, 2, [1.0, 20.0])
    two = measure([straight(0)], drive(0.5, aside=0.03), FOOTPRINT, POSE, 1)
    both = pooled([one, two])
    assert (both.clearance.ticks, both.clearance.held, both.messages_lost) == (30, 20, 3)
    assert both.deviation_mm[0] == (10, 10, 30, 30)
    assert both.consistency == one.consistency
    assert pooled([]) == Measures()
    assert Measures.model_validate_json(both.model_dump_json()) == both


def test_after_a_lost_message_the_motion_is_compared_with_the_contingency_on_board() -> None:
    stops = PredictedMotion(np.array([1.0, 2.0]), np.array([[1.0, 0, 0, 1.0], [1.5, 0, 0, 0.0]]), 0.1, np.full(2, 0.02))
    contingency = straight(1, "contingency").reference
    on_board = replace(straight(0), contingency=contingency, stopping=stops, switch=1.0)
    lost = [replace(straight(1), delivered=False), replace(straight(2), delivered=False)]
    times = np.arange(0.0, 3.0, 0.05)
    places = np.interp(times, [0.0, 1.0, 2.0], [0.0, 1.0, 1.5])
    steps = [
        Step(float(t), (float(x), 0.0, 0.0), 1.0, np.zeros(4), np.zeros(2), 0)
        for t, x in zip(times, places, strict=True)
    ]
    found = measure([on_board, *lost], steps, FOOTPRINT, POSE)
    assert (found.plans.ticks, found.contingencies.ticks) == (20, 40)
    assert found.clearance.coverage == 1.0
    assert len(found.deviation_mm) == 30
    alone = measure([straight(0), *lost], steps, FOOTPRINT, POSE)
    assert (alone.plans.ticks, alone.plans.held) == (60, 21)  # where the lost plan begins, too


def test_nothing_is_compared_after_the_end_of_the_prediction() -> None:
    found = measure([straight(0)], drive(2.0, aside=0.01), FOOTPRINT, POSE)
    assert (found.plans.ticks, found.plans.held, len(found.deviation_mm)) == (20, 20, 10)


def test_nothing_is_compared_while_the_watchdog_stops_the_car() -> None:
    steps = [replace(step, watchdog=step.time > 0.475) for step in drive(1.0, aside=1.0)]
    found = measure([straight(0)], steps, FOOTPRINT, POSE, watchdog_stops=1)
    assert (found.plans.ticks, found.watchdog_stops) == (10, 1)
    assert pooled([found, found]).watchdog_stops == 2
