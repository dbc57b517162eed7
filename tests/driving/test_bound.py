"""The measured bound: its shape, its calibration by observed deviations, and the share of it that plans keep."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from support.replanner import mushr, proposals, proposer, replanner, share_kept, start

from kraft.driving.bound import UNCORRECTED, BoundCalibration, DeviationBound, radius_quantiles, turning_error
from kraft.driving.car_model import model_of
from kraft.driving.levels import HYSTERESIS, STEADY
from kraft.driving.messages import Commitment, Estimate, PredictedMotion, ReferenceKind, Uncertainty
from kraft.driving.planner_settings import CalibratedBound
from kraft.driving.proposal import Proposal
from kraft.driving.proposer import Proposer
from kraft.driving.references import standing_reference
from kraft.vehicles.load import load_vehicle
from ompl_ext.vehicle import OpenLoopErrors

SETTINGS = CalibratedBound()
SHARES = CalibratedBound(foresight=60.0, shares=(1.0, 0.5, 0.25))
WIDE, NARROW = DeviationBound(0.05), DeviationBound(0.5)  # half of `NARROW` does not fit through Turns, a quarter does


def uncertainty(position: float = 0.02, heading: float = 0.03, delay: float = 0.01) -> Uncertainty:
    return Uncertainty(np.diag([position**2, (0.5 * position) ** 2, heading**2, 0.05**2]), delay)


def straight(seconds: float = 2.0, speed: float = 0.5) -> PredictedMotion:
    times = np.linspace(1.0, 1.0 + seconds, 21)
    states = np.column_stack([speed * (times - 1.0), np.zeros((21, 2)), np.full(21, speed)])
    return PredictedMotion(times, states, 0.0)


def calibrated(deviation: float, cycles: int, settings: CalibratedBound = SETTINGS) -> BoundCalibration:
    """Calibration after `cycles` cycles in which the vehicle was `deviation` m beside its prediction."""
    subject = BoundCalibration(settings, mushr())
    for _ in range(cycles):
        subject.committed(straight(), uncertainty())
        subject.observe(2.0, np.array([0.5, deviation, 0.0, 0.5]))
    return subject


# Shape


def test_the_bound_is_that_of_pose_delay_and_time() -> None:
    bound = BoundCalibration(SETTINGS, mushr()).bound(uncertainty())
    corner = mushr().footprint.reach * 0.03
    smaller, larger = math.hypot(0.01, corner), math.hypot(0.02, corner)
    ratios, quantiles = radius_quantiles(SETTINGS.level)
    assert bound.delta == pytest.approx(SETTINGS.initial * larger * np.interp(smaller / larger, ratios, quantiles))
    along = SETTINGS.initial * quantiles[0]
    assert bound.per_speed == pytest.approx(along * 0.01)
    assert bound.per_time == pytest.approx(along * SETTINGS.growth)
    assert (bound.horizon, bound.fastest) == (SETTINGS.horizon, mushr().top_speed)


@pytest.mark.parametrize("level", [0.5, 0.9, 0.99, 0.9999])
def test_quantiles_of_a_line_and_of_a_circle_are_the_known_ones(level: float) -> None:
    ratios, quantiles = radius_quantiles(level)
    assert (ratios[0], ratios[-1]) == (0.0, 1.0)
    assert quantiles[0] == pytest.approx(NormalDist().inv_cdf(0.5 + 0.5 * level), rel=1e-3)
    assert quantiles[-1] == pytest.approx(math.sqrt(-2.0 * math.log(1.0 - level)))
    assert (np.diff(quantiles) > 0.0).all()


@pytest.mark.parametrize("ratio", [0.1, 0.5, 0.8])
def test_a_deviation_is_as_often_within_its_quantile_as_the_level_says(ratio: float) -> None:
    deviations = np.random.default_rng(1).normal(size=(400_000, 2)) * [1.0, ratio]
    quantile = np.interp(ratio, *radius_quantiles(0.99))
    assert (np.hypot(*deviations.T) <= quantile).mean() == pytest.approx(0.99, abs=6e-4)


def test_the_clearance_is_nowhere_less_than_the_parts_of_the_bound_together_and_as_large_where_one_is_alone() -> None:
    bound = DeviationBound(0.15, 0.2, 0.06, 1.5, fastest=0.7)
    since, speeds = (each.ravel() for each in np.meshgrid(np.linspace(0.0, 1.5, 16), np.linspace(0.0, 0.7, 15)))
    together = np.sqrt(0.15**2 + (0.2 * speeds) ** 2 + (0.06 * since) ** 2)
    assert (bound.at(speeds, since) >= together - 1e-12).all()
    alone = ((since == 0.0) & np.isin(speeds, [0.0, 0.7])) | ((speeds == 0.0) & np.isin(since, [0.0, 1.5]))
    assert bound.at(speeds, since)[alone] == pytest.approx(together[alone])
    assert bound.at(speeds, since).max() < 0.15 + 0.2 * 0.7 + 0.06 * 1.5


@pytest.mark.parametrize("stronger", [0.8, 1.4])
def test_the_clearance_of_a_car_that_is_stronger_than_stated_holds_up_to_its_speed(stronger: float) -> None:
    """A force as on a slope changes nothing: it may be against the motion as well."""
    vehicle = load_vehicle("mushr-force")
    model, calibration = model_of(vehicle), BoundCalibration(SETTINGS, vehicle)
    values = {**vehicle.parameters, "v_delta": stronger * vehicle.parameters["v_delta"], "a_x": 0.3}
    model.set_parameters(np.array(list(values.values())))
    assert model.fastest == pytest.approx(max(1.0, stronger) * vehicle.top_speed, rel=0.01)
    calibration.fastest = model.fastest
    bound = calibration.bound(uncertainty(delay=0.1))
    speed = np.array([model.fastest])
    least = math.hypot(bound.delta, model.fastest * math.hypot(bound.per_speed, bound.turning))
    assert bound.at(speed, np.zeros(1))[0] >= least - 1e-12


def test_without_an_error_of_the_pose_the_clearance_is_that_of_speed_and_time() -> None:
    asked = DeviationBound(0.0, 0.2, 0.06, 1.5, fastest=0.7).clearance
    assert (asked.delta, asked.delta_per_speed, asked.delta_per_time) == (0.0, 0.2, 0.06)


def test_the_bound_of_an_uncertainty_follows_the_fastest_speed() -> None:
    subject, known = BoundCalibration(SETTINGS, mushr()), uncertainty()
    assert subject.bound(known) == subject.bound(known) == BoundCalibration(SETTINGS, mushr()).bound(known)
    subject.fastest = 3.0
    assert subject.bound(known).fastest == 3.0
    assert subject.bound(uncertainty(delay=0.5)).per_speed > subject.bound(known).per_speed


def test_until_the_drive_is_identified_the_bound_grows_faster() -> None:
    subject, known = BoundCalibration(SETTINGS, mushr()), uncertainty()
    faster = subject.bound(Uncertainty(known.state, known.delay, acceleration=0.4))
    expected = math.hypot(SETTINGS.growth, 0.5 * UNCORRECTED * 0.4) / SETTINGS.growth
    assert faster.per_time / subject.bound(known).per_time == pytest.approx(expected)
    assert faster.delta == subject.bound(known).delta


def test_a_vehicle_whose_turns_are_predicted_wrongly_has_a_larger_bound_at_speed() -> None:
    slow = OpenLoopErrors((0.2, 1.0), (1.0,), (0.5,), (0.006,), (0.1,))
    fast = OpenLoopErrors((1.0, 3.0), (1.0, 2.0), (0.1, 0.2), (0.08, 0.3), (0.1, 0.2))
    vehicle = replace(mushr(), errors_by_speed=(slow, fast))
    assert turning_error(vehicle) == pytest.approx(0.25 * 0.08 / 2.0)  # of a second, half a second and 2 m/s
    assert turning_error(replace(vehicle, errors_by_speed=(slow,))) == pytest.approx(0.25 * 0.006 / 0.6)
    assert turning_error(mushr()) == 0.0
    known = BoundCalibration(SETTINGS, mushr()).bound(uncertainty())
    bound = BoundCalibration(SETTINGS, vehicle).bound(uncertainty())
    assert bound.turning == pytest.approx(SETTINGS.initial * radius_quantiles(SETTINGS.level)[1][0] * 0.01)
    assert replace(bound, turning=0.0) == known
    top, at_rest = np.array([vehicle.top_speed]), np.zeros(1)
    expected = math.hypot(float(known.at(top, at_rest)[0]), bound.turning * vehicle.top_speed)
    assert bound.at(top, at_rest) == pytest.approx(expected)
    assert bound.at(at_rest, at_rest) == pytest.approx(bound.delta)


def test_drives_at_a_standstill_tell_nothing_about_turns() -> None:
    still = OpenLoopErrors((0.0, 0.0), (1.0,), (0.01,), (0.01,), (0.01,))
    assert turning_error(replace(mushr(), errors_by_speed=(still,))) == pytest.approx(0.25 * 0.01 / 0.1)


def test_the_largest_axis_of_the_position_counts_whatever_its_direction() -> None:
    c, s = math.cos(0.7), math.sin(0.7)
    turn = np.array([[c, -s], [s, c]])
    turned = uncertainty()
    turned.state[:2, :2] = turn @ turned.state[:2, :2] @ turn.T
    subject = BoundCalibration(SETTINGS, mushr())
    assert subject.bound(turned).delta == pytest.approx(subject.bound(uncertainty()).delta)


def test_delta_grows_with_time_until_the_horizon_and_with_speed_in_both_directions() -> None:
    bound = DeviationBound(0.1, 0.2, 0.04, 1.5)
    since, speeds = np.array([-1.0, 0.0, 1.0, 1.5, 9.0]), np.array([0.0, 0.5, -0.5, 0.0, 0.0])
    grown = math.hypot(0.1, 0.06)
    expected = [0.1, 0.2, 0.2 + (grown - 0.1) / 1.5, grown, grown]
    assert bound.at(speeds, since) == pytest.approx(expected)  # of any speed: nothing is spared for it
    assert bound.scaled(0.5).at(speeds, since) == pytest.approx(0.5 * bound.at(speeds, since))


# Calibration


def test_before_deviations_are_observed_the_scale_is_the_stated_one() -> None:
    assert BoundCalibration(SETTINGS, mushr()).factor == pytest.approx(SETTINGS.initial)


def test_the_scale_rises_after_large_deviations_and_falls_after_small_ones_within_its_limits() -> None:
    low, high = SETTINGS.limits
    some, many = calibrated(0.3, 2).factor, calibrated(0.3, 100).factor
    assert SETTINGS.initial < some <= many == high
    assert low == calibrated(0.0, 100).factor < calibrated(0.0, 1).factor < SETTINGS.initial


def test_deviations_as_large_as_expected_lead_to_a_scale_of_one() -> None:
    """Also where the vehicle is turned: its farthest corner counts."""
    unscaled = BoundCalibration(SETTINGS, mushr()).bound(uncertainty()).scaled(1.0 / SETTINGS.initial)
    expected = SETTINGS.expected_ratio * float(unscaled.at(np.array([0.5]), np.array([1.0]))[0])
    assert calibrated(expected, 300).factor == pytest.approx(1.0, abs=0.01)
    turned = BoundCalibration(SETTINGS, mushr())
    for _ in range(300):
        turned.committed(straight(), uncertainty())
        turned.observe(2.0, np.array([0.5, 0.0, expected / mushr().footprint.reach, 0.5]))
    assert turned.factor == pytest.approx(1.0, abs=0.01)


def test_old_deviations_lose_their_weight() -> None:
    subject = calibrated(0.3, 10)
    before = subject.factor
    for _ in range(round(7 * SETTINGS.memory_cycles)):
        subject.committed(straight(), uncertainty())
        subject.observe(2.0, np.array([0.5, 0.0, 0.0, 0.5]))
    assert subject.factor == SETTINGS.limits[0] < before


@pytest.mark.parametrize("time", [0.5, 1.0, 3.5])
def test_an_estimate_outside_the_prediction_is_not_compared(time: float) -> None:
    subject = BoundCalibration(SETTINGS, mushr())
    subject.observe(2.0, np.array([5.0, 5.0, 0.0, 0.5]))  # without a prediction neither
    subject.committed(straight(), uncertainty())
    subject.observe(time, np.array([5.0, 5.0, 0.0, 0.5]))
    assert subject.factor == pytest.approx(SETTINGS.initial)


# First plan


def test_the_first_plan_keeps_the_bound_of_the_estimate_at_the_start() -> None:
    subject = replanner(bound=SHARES, iterations=600)
    subject.begin(start(), uncertainty())
    plan = subject.proposal.plan
    assert plan is not None
    needed = BoundCalibration(SHARES, mushr()).bound(uncertainty()).at(plan.trajectory[:, 3], plan.times)
    assert (subject.dirt.exact.distances(plan.trajectory[:, :3]) >= needed - 1e-6).all()
    estimate = Estimate(0.0, start(), 0.0, uncertainty=uncertainty())
    assert (
        subject.decide(estimate, Commitment(standing_reference(subject.dirt.vehicle, start(), 0.0))).kind
        is ReferenceKind.PLAN
    )


def test_the_first_plan_has_a_budget_of_its_own() -> None:
    spent = {}
    for first in (None, 2000):
        subject = replanner(bound=SHARES, iterations=600, first_iterations=first)
        subject.begin(start(), uncertainty())
        spent[first] = subject.proposal.iterations
    assert spent[None] <= 600
    assert 2000 <= spent[2000] <= 4000


# Shares


def proposed(*bounds: DeviationBound) -> tuple[Proposer, list[Proposal]]:
    """Proposals with a bound each, of a proposer that may keep shares of it."""
    subject = proposer(bound=SHARES, iterations=600)
    return subject, list(proposals(subject, *bounds))


def test_a_bound_that_leaves_a_way_is_kept_wholly() -> None:
    subject, (found,) = proposed(WIDE)
    assert share_kept(subject) == 1.0
    assert found.plan is not None
    assert subject.dirt.exact.distances(found.plan.trajectory[:, :3]).min() >= WIDE.delta - 1e-9


def test_a_bound_that_leaves_no_way_is_kept_in_the_first_share_that_does() -> None:
    subject, (found,) = proposed(NARROW)
    assert share_kept(subject) == 0.25
    assert found.plan is not None
    assert found.plan.reaches_goal
    assert subject.dirt.exact.distances(found.plan.trajectory[:, :3]).min() >= 0.25 * NARROW.delta - 1e-9


def test_a_plan_is_checked_again_with_a_part_of_the_share_that_it_keeps() -> None:
    subject, _ = proposed(NARROW)
    assert subject.dirt.safety.delta == pytest.approx(0.25 * SHARES.recheck * NARROW.delta)


def test_the_share_goes_back_up_when_the_bound_leaves_a_way_again_but_not_at_once() -> None:
    subject = proposer(bound=SHARES, iterations=600)
    kept = [share_kept(subject) for _ in proposals(subject, NARROW, *[WIDE] * (STEADY * 4))]
    assert kept[1] == 0.25
    assert kept[-1] == 1.0
    assert kept == sorted(kept)


def test_the_remainder_of_a_plan_needs_a_little_less_than_a_new_plan() -> None:
    subject, _ = proposed(WIDE)
    levels = subject.levels
    new, eased = (levels.set(0, eased).safety.delta for eased in (False, True))
    assert (new, eased) == (pytest.approx(WIDE.delta), pytest.approx(HYSTERESIS * WIDE.delta))


# In the replanner


def test_the_recorded_delta_is_the_full_bound_also_where_the_plan_keeps_a_share() -> None:
    subject = replanner(bound=SHARES, iterations=600)
    wide = uncertainty(position=0.12, heading=0.03)
    current, cycles = subject.begin(start()), []
    state, time = start(), 0.0
    for _ in range(3):
        cycles.append(subject.step(Estimate(time, state, 0.0, None, wide), current))
        current, time = cycles[-1].commitment, subject.next_step
        predicted = cycles[-1].predicted
        state = np.array([np.interp(time, predicted.times, column) for column in predicted.states.T])
    assert share_kept(subject.proposer) < 1.0
    bound, last = subject.proposer.levels.bound, cycles[-1]
    assert last.predicted.delta is not None
    speeds = last.predicted.states[:, 3]
    assert last.predicted.delta == pytest.approx(bound.at(speeds, last.predicted.times - last.time))
    assert last.predicted.delta[0] > 1.5 * subject.dirt.safety.delta


def test_parameters_in_the_estimate_are_those_that_are_planned_with() -> None:
    subject = replanner(bound=SHARES, iterations=100)
    current = subject.begin(start())
    values = mushr().parameter_array * [1.1, 1.0, 0.8]
    subject.step(Estimate(0.0, start(), 0.0, values, uncertainty()), current)
    for dirt in (subject.dirt, subject.proposer.search.solvers.planning):
        assert dirt.vehicle.parameter_array == pytest.approx(values)
        assert dirt.problem.parameters[:3] == pytest.approx(values)


def test_without_uncertainty_a_bound_would_ask_for_nothing() -> None:
    """So a method file with a bound needs an estimator that states one, see test_methods."""
    subject = replanner(bound=SHARES, iterations=100)
    cycle = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    assert cycle.predicted.delta == pytest.approx(np.zeros(len(cycle.predicted.times)))


def test_a_motion_whose_message_was_lost_calibrates_nothing() -> None:
    """The car did something else than was predicted of the motion that did not arrive."""
    factors = []
    for lost in (False, True):
        subject = replanner(bound=SETTINGS)
        current = subject.begin(start(), uncertainty())
        cycle = subject.step(Estimate(0.0, start(), 0.0, None, uncertainty()), current)
        before = subject.proposer.levels.bound.delta
        elsewhere = cycle.predicted.states[-1] + np.array([0.0, 0.3, 0.0, 0.0])
        estimate = Estimate(float(cycle.predicted.times[-1]) - 0.1, elsewhere, 0.0, None, uncertainty())
        subject.decide(estimate, current if lost else cycle.commitment)
        factors.append(subject.proposer.levels.bound.delta / before)
    assert factors[0] > 1.0
    assert factors[1] == 1.0
