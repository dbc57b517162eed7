"""Levels of clearance under a measured bound: their order, the budget that they share, the remainder that they keep."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from support.replanner import mushr, replanner, share_kept, start, turns

from kraft.driving.bound import LATER_DELAY, LATER_DELTA, LATER_GROWTH, BoundCalibration, DeviationBound
from kraft.driving.levels import (
    HYSTERESIS,
    NARROW,
    NEAR,
    SOON,
    STEADY,
    Level,
    Levels,
    levels_of,
)
from kraft.driving.messages import Estimate, ReferenceKind, Uncertainty
from kraft.driving.planner_settings import CalibratedBound, Clearance, PlannerSettings
from kraft.driving.solvers import Solvers

FORESIGHT, MARGIN = 60.0, 0.03
BOUND = CalibratedBound(foresight=FORESIGHT, shares=(1.0, 0.5, 0.25))
UNCERTAIN = Uncertainty(np.diag([0.02**2, 0.01**2, 0.03**2, 0.05**2]), 0.01)


def settings(margin: float = MARGIN, bound: CalibratedBound = BOUND, **more: object) -> PlannerSettings:
    return PlannerSettings(mode="replanning", margin=margin, bound=bound, **more)  # type: ignore[arg-type]


@cache
def solvers() -> Solvers:
    return Solvers.of(turns(), mushr(), settings())


def levels() -> Levels:
    return Levels(solvers(), settings())


# Order


def test_margin_then_foresight_are_given_up_after_the_smallest_share() -> None:
    far = [Level(share, MARGIN, FORESIGHT) for share in BOUND.shares]
    narrow = [Level(0.25 * part, 0.0, FORESIGHT, narrow=True) for part in NARROW]
    soon = [Level(share, 0.0, SOON, narrow=True) for share in (1.0, 0.25)]
    assert levels_of(settings()) == (*far, *narrow, *soon, Level(0.25, 0.0, 1.0, narrow=True))


def test_what_the_settings_do_not_ask_for_is_no_level() -> None:
    short = CalibratedBound(shares=BOUND.shares)
    assert levels_of(settings(0.0, short)) == tuple(Level(share, 0.0, 1.0) for share in BOUND.shares)
    assert len(levels_of(settings(MARGIN, short))) == len(BOUND.shares) + len(NARROW)
    assert levels_of(PlannerSettings(mode="replanning", safety=Clearance())) == (Level(1.0),)


def test_every_second_level_is_tried_as_long_as_plans_keep_their_foresight() -> None:
    subject = levels()
    assert (subject.wide, subject.farsighted, len(subject.all)) == (3, 5, 8)
    assert subject.downwards(0) == [0, 2, 4, 5, 6, 7]
    assert subject.downwards(6) == [6, 7]


def test_after_steady_cycles_the_next_higher_level_is_tried_and_the_lowest_with_foresight() -> None:
    subject = levels()
    subject.keep(6, stalled=False)
    for _ in range(STEADY):
        assert not subject.tries_higher
        subject.keep(6, stalled=False)
    assert subject.tries_higher
    assert subject.upwards() == [4, 5]
    subject.keep(2, stalled=False)
    assert subject.upwards() == [1]


@pytest.mark.parametrize("number", [0, 1, 3, 5])
def test_a_vehicle_without_progress_tries_the_next_level_as_well(number: int) -> None:
    subject = levels()
    subject.keep(number, stalled=True)
    assert (subject.kept, subject.stalled) == (number, True)
    subject.keep(number, stalled=False)
    assert not subject.stalled


@pytest.mark.parametrize("number", [2, 4, 7])
def test_neither_margin_nor_foresight_is_given_up_for_progress(number: int) -> None:
    subject = levels()
    subject.keep(number, stalled=True)
    assert not subject.stalled


def test_a_level_asks_for_its_share_its_margin_and_its_foresight() -> None:
    subject = levels()
    subject.bound = DeviationBound(0.1, 0.2, 0.05, 1.5)
    for number, level in enumerate(subject.all):
        safety = subject.set(number, eased=False).safety
        assert safety.delta == pytest.approx(0.1 * level.share + level.margin)
        assert safety.delta_per_time == pytest.approx((math.hypot(0.1, 0.05 * 1.5) - 0.1) / 1.5 * level.share)
        assert (safety.cycle, safety.delta_horizon) == (level.foresight, 1.5)
    assert solvers().checking.safety.cycle == 1.0


@pytest.mark.parametrize("unknown", [0.0, 0.25])
def test_only_narrow_levels_give_up_what_the_bound_asks_for_the_speed_and_never_that_of_an_unknown_delay(
    unknown: float,
) -> None:
    subject, per_speed = levels(), LATER_DELAY + unknown
    subject.bound = DeviationBound(0.1, per_speed, 0.05, 1.5)
    for number, level in enumerate(subject.all):
        expected = per_speed if number < subject.wide else unknown + level.share * LATER_DELAY
        assert subject.set(number, eased=False).safety.delta_per_speed == pytest.approx(expected)
        part = HYSTERESIS if number < subject.wide else BOUND.recheck
        assert subject.set(number, eased=True).safety.delta_per_speed == pytest.approx(expected * part)
        assert solvers().checking.safety.delta_per_speed == pytest.approx(expected * part)
        subject.kept = number
        subject.require()
        assert solvers().checking.safety.delta_per_speed == pytest.approx(expected * BOUND.recheck)


def test_every_level_keeps_what_the_bound_asks_for_turns() -> None:
    subject = levels()
    subject.bound = DeviationBound(0.1, 0.05, 0.02, 1.5, turning=0.03)
    for number, level in enumerate(subject.all):
        kept = level.kept_of(subject.bound, 0.8)
        assert kept.turning == pytest.approx(0.8 * 0.03)
        safety = subject.set(number, eased=False).safety
        assert safety.delta_per_speed >= 0.03
    assert subject.bound.later.turning == 0.03


def test_the_remainder_of_a_plan_needs_at_a_narrow_level_what_suffices_when_it_is_checked_again() -> None:
    subject = levels()
    subject.bound = DeviationBound(0.1, 0.2, 0.05, 1.5)
    narrow = subject.wide
    subject.keep(narrow, stalled=False)
    eased = subject.set(narrow, eased=True).safety
    subject.require()
    again = solvers().checking.safety
    assert (eased.delta, eased.delta_per_speed) == pytest.approx((again.delta, again.delta_per_speed))
    assert eased.delta < HYSTERESIS * subject.set(narrow, eased=False).safety.delta


def test_the_later_part_of_a_plan_keeps_what_the_bound_is_expected_to_be_then() -> None:
    subject = levels()
    subject.bound = DeviationBound(0.2, 0.4, 0.3, 1.5)
    later = subject.bound.later
    assert later.at(np.ones(1), np.zeros(1)) == pytest.approx(math.hypot(0.2, 1.5 * LATER_GROWTH) + LATER_DELAY)
    safety = subject.set(1, eased=False).safety
    assert (safety.near, safety.far_delta_per_speed) == (NEAR, LATER_DELAY)
    assert safety.far_delta == pytest.approx(0.5 * later.delta + MARGIN)
    assert solvers().checking.safety.near == math.inf


def test_the_bound_that_is_expected_later_is_no_larger_than_it_is_now_but_for_the_least_error_of_a_pose() -> None:
    now = DeviationBound(0.15, 0.05, 0.02, 1.5)
    times, speeds = np.full(2, 1.5), np.array([0.0, 0.7])
    assert now.later.at(speeds, times) == pytest.approx(now.at(speeds, times))
    assert DeviationBound(0.01).later.delta == LATER_DELTA


# In the replanner


def test_the_first_plan_keeps_the_bound_of_the_stated_uncertainty() -> None:
    subject = replanner(bound=BOUND, margin=MARGIN, iterations=600)
    expected = BoundCalibration(BOUND, mushr()).bound(UNCERTAIN)
    subject.begin(start(), UNCERTAIN)
    plan = subject.proposal.plan
    assert plan is not None
    needed = MARGIN + share_kept(subject.proposer) * expected.at(plan.trajectory[:, 3], plan.times)
    assert np.all(subject.dirt.exact.distances(plan.trajectory[:, :3]) >= needed - 1e-9)


def test_solvers_of_another_task_ask_for_the_same_bound() -> None:
    subject = replanner(bound=BOUND, margin=MARGIN, iterations=100)
    subject.begin(start(), UNCERTAIN)
    bound = subject.proposer.levels.bound
    assert bound.delta > 0.0
    subject.set_solvers(solvers())
    assert subject.proposer.levels.bound is bound
    assert subject.dirt.safety.delta == pytest.approx(BOUND.recheck * bound.delta)


def test_a_plan_in_hand_is_checked_at_its_level_when_the_map_changes() -> None:
    """The same map again changes nothing: the plan that keeps a small share of the bound is committed."""
    subject = replanner(bound=BOUND, margin=MARGIN, iterations=600)
    current = subject.begin(start(), UNCERTAIN)
    subject.proposer.levels.keep(2, stalled=False)
    subject.proposer.recovers = True
    subject.proposer.levels.require()
    asked = subject.dirt.safety
    subject.set_solvers(solvers())
    assert subject.proposer.levels.kept == 2
    assert subject.proposer.recovers
    assert subject.dirt.safety == asked
    cycle = subject.step(Estimate(0.0, start(), 0.0, None, UNCERTAIN), current)
    assert cycle.kind is ReferenceKind.PLAN


def test_plans_to_another_goal_may_cost_more_without_a_lack_of_progress() -> None:
    subject = levels()
    for cost in (5.0, 9.0, 9.0, 9.0):
        assert subject.gets_on
        subject.note_progress(cost, rises=False)
    assert not subject.gets_on
    subject.set_solvers(solvers())
    subject.note_progress(9.0, rises=False)
    assert subject.gets_on
