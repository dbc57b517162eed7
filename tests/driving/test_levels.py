"""Levels of clearance under a measured bound: their order, the budget that they share, the remainder that they keep."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.replanner import mushr, proposals, replanner, share_kept, start, turns

from kraft.driving.bound import LATER_DELAY, LATER_DELTA, LATER_GROWTH, BoundCalibration, DeviationBound
from kraft.driving.levels import (
    HYSTERESIS,
    INSISTENCE,
    NARROW,
    NEAR,
    PAUSE,
    PROGRESS,
    PROGRESS_TIME,
    SOON,
    STEADY,
    Level,
    Levels,
    levels_of,
)
from kraft.driving.messages import Estimate, ReferenceKind, Uncertainty
from kraft.driving.method import CalibratedBound, Clearance, PlannerSettings
from kraft.driving.proposer import (
    DETOUR,
    LEAST_GAIN,
    LEVEL_GAIN,
    RISE,
    STALLED,
    Proposal,
    Proposer,
    _Query,
)
from kraft.driving.remainder import RETAINED_TOLERANCE
from kraft.driving.replanner import Replanner
from kraft.driving.solvers import Solvers
from ompl_ext.plan import Plan
from ompl_ext.solver import DirtSolver

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


def driven(*bounds: DeviationBound, seed: int = 0, **more: object) -> tuple[Replanner, list[Proposal]]:
    """Proposals with a bound each, from the start of Turns and then from where each plan leads in a cycle."""
    chosen = {"bound": BOUND, "margin": MARGIN, "iterations": 600, "max_iterations": 1200, "retain": "tree", **more}
    subject = replanner(seed, switch_gain=0.5, **chosen)
    return subject, list(proposals(subject, *bounds))


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


# Search


def test_the_searches_of_a_cycle_share_its_budget() -> None:
    """The bound leaves no way at any level that keeps the margin."""
    for most in (600, 700, 1200):
        _, found = driven(*[DeviationBound(1.0)] * 2, max_iterations=most)
        assert all(proposal.iterations <= most for proposal in found)


def test_a_cycle_whose_budget_ends_without_a_plan_leaves_the_next_levels_to_the_next_cycle() -> None:
    """12 iterations find no way to the goal, which plans need at the first five levels."""
    subject = replanner(bound=BOUND, margin=MARGIN, iterations=30, max_iterations=40)
    subject._proposer.set_bound(DeviationBound(0.05))
    first, second = (subject._proposer.propose(number, start(), None) for number in range(2))
    assert first.plan is None
    assert second.plan is not None
    assert subject._proposer._levels.kept > subject._proposer._levels.farsighted


def test_a_plan_keeps_share_and_margin_to_its_end() -> None:
    subject, (found,) = driven(DeviationBound(0.05))
    assert found.plan is not None
    assert found.plan.reaches_goal
    away = subject.dirt.exact.distances(found.plan.trajectory[:, :3]).min()
    assert away >= share_kept(subject._proposer) * 0.05 + MARGIN - 1e-9


def test_a_remainder_can_be_retained_without_a_search_at_the_levels_whose_clearance_it_keeps() -> None:
    subject, (found,) = driven(DeviationBound(0.04))
    plan, proposer = found.plan, subject._proposer
    assert plan is not None
    root = np.array([np.interp(1.0, plan.times, column) for column in plan.trajectory.T])
    query = _Query(1, root, proposer._remainder(plan), 0.0)
    for bound, expected in ((0.04, [True, True, True]), (0.2, [False, True, True]), (0.4, [False, False, True])):
        proposer._levels.bound = DeviationBound(bound)
        assert [proposer._holds(query, number) for number in range(3)] == expected


def test_plans_of_a_bound_that_grows_cost_hardly_more_than_what_was_left() -> None:
    for seed in range(4):
        _, found = driven(DeviationBound(0.04), DeviationBound(0.04), DeviationBound(0.1), seed=seed)
        costs = [proposal.plan.total_cost for proposal in found if proposal.plan is not None]
        assert all(after <= before - 1.0 + STALLED for before, after in itertools.pairwise(costs))


@pytest.mark.parametrize(("bound", "level"), [(0.1, 0), (0.3, 1)])
def test_a_vehicle_without_progress_keeps_less_clearance_only_if_that_saves_time(bound: float, level: int) -> None:
    """The plan that was left states a cost that no plan has."""
    subject, (found,) = driven(DeviationBound(0.001))
    plan, proposer = found.plan, subject._proposer
    assert plan is not None
    root = np.array([np.interp(1.0, plan.times, column) for column in plan.trajectory.T])
    proposer._levels.bound = DeviationBound(bound)
    proposer._levels.keep(0, stalled=True)
    proposed = proposer.propose(1, root, replace(plan, cost=2.0))
    assert proposed.plan is not None
    assert proposed.plan.reaches_goal
    assert proposer._levels.kept == level


@pytest.mark.parametrize(("saved", "level"), [(0.5 * RISE, 1), (2.0 * RISE, 2)])
def test_a_plan_keeps_more_clearance_than_the_last_one_only_if_it_costs_little_more(
    monkeypatch: pytest.MonkeyPatch, saved: float, level: int
) -> None:
    """A search at the level of the last plan, 2, finds one that costs as much less as stated than that at level 1."""
    monkeypatch.setattr("kraft.driving.proposer.DETOUR", math.inf)
    proposer, plan, tried = priced(monkeypatch, {1: 10.0, 2: 10.0 - saved})
    proposer._levels.kept, proposer._levels._steady = 2, STEADY
    proposer.propose(1, start(), replace(plan, cost=2.0))
    assert tried == [1, 2]
    assert proposer._levels.kept == level


def priced(monkeypatch: pytest.MonkeyPatch, costs: dict[int, float]) -> tuple[Proposer, Plan, list[int]]:
    """Proposer whose plans have the stated total cost at each level, a plan, and the levels that are tried."""
    subject, (found,) = driven(DeviationBound(0.3))
    plan, proposer, tried = found.plan, subject._proposer, list[int]()
    assert plan is not None
    assert plan.cost_to_go == 0.0
    levels = proposer._levels
    levels.kept, levels.stalled, chosen = 0, False, levels.set

    def recorded(number: int, eased: bool) -> DirtSolver:
        tried.append(number)
        return chosen(number, eased)

    def search(_: object, dirt: DirtSolver, *__: object, **___: object) -> Proposal:
        dirt.start(start())
        return Proposal(replace(plan, cost=costs[tried[-1]]))

    monkeypatch.setattr(levels, "set", recorded)
    monkeypatch.setattr(proposer, "_holds", lambda *_: False)
    monkeypatch.setattr(proposer, "_search", search)
    return proposer, plan, tried


@pytest.mark.parametrize(
    ("left", "saved", "level"),
    [
        (20.0, 0.9 * LEVEL_GAIN * 20.0, 0),
        (20.0, 1.1 * LEVEL_GAIN * 20.0, 2),
        (19.0, 0.9 * LEVEL_GAIN * 20.0, 2),
        (19.0, 0.9 * LEAST_GAIN, 0),
    ],
)
def test_less_clearance_has_to_save_a_share_of_the_cost_or_little_where_plans_would_get_more_expensive(
    monkeypatch: pytest.MonkeyPatch, left: float, saved: float, level: int
) -> None:
    proposer, plan, tried = priced(monkeypatch, {0: 20.0, 2: 20.0 - saved, 3: 30.0, 4: 30.0, 5: 30.0, 6: 30.0, 7: 30.0})
    proposer.propose(1, start(), replace(plan, cost=left + 1.0))
    assert tried[:2] == [0, 2]
    assert proposer._levels.kept == level


@pytest.mark.parametrize(("beyond", "is_compared"), [(0.9 * DETOUR, False), (1.1 * DETOUR, True)])
def test_less_clearance_is_tried_where_a_plan_costs_much_more_than_the_cost_to_go(
    monkeypatch: pytest.MonkeyPatch, beyond: float, is_compared: bool
) -> None:
    dirt = solvers().planning
    dirt.start(start())
    least = dirt.root_cost_to_go
    assert least > 1.0
    proposer, _, tried = priced(monkeypatch, {0: least + beyond, 2: least})
    proposer.propose(0, start(), None)
    assert tried == ([0, 2] if is_compared else [0])


def test_after_a_refused_plan_the_next_cycles_do_not_try_less_clearance_for_the_same_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    proposer, plan, tried = priced(monkeypatch, dict.fromkeys(range(8), 20.0))
    numbers = []
    for number in range(2 * (PAUSE + 1)):
        tried.clear()
        proposer.propose(number, start(), replace(plan, cost=21.0))
        numbers.append(len(tried))
    assert proposer._levels.kept == 0
    assert numbers[0] > 1
    assert numbers == [numbers[0], *[1] * PAUSE] * 2


@pytest.mark.parametrize(
    ("bound", "waited", "is_tried"),
    [
        (DeviationBound(0.1, LATER_DELAY, LATER_GROWTH, 1.5), 0, True),
        (DeviationBound(0.1, 1.1 * LATER_DELAY, LATER_GROWTH, 1.5), 0, False),
        (DeviationBound(0.1, LATER_DELAY, 1.1 * LATER_GROWTH, 1.5), 0, False),
        (DeviationBound(0.1, LATER_DELAY, 1.1 * LATER_GROWTH, 1.5), 3, True),
    ],
)
def test_only_a_vehicle_that_knows_its_drive_or_does_not_get_on_gives_up_the_margin_for_a_gain(
    monkeypatch: pytest.MonkeyPatch, bound: DeviationBound, waited: int, is_tried: bool
) -> None:
    proposer, plan, tried = priced(monkeypatch, {2: 20.0, 4: 10.0, 5: 20.0, 6: 20.0, 7: 20.0})
    proposer._levels.bound, proposer._levels.kept, proposer._levels._waited = bound, 2, waited
    assert proposer._levels.wide == 3
    proposer.propose(1, start(), replace(plan, cost=25.0))
    assert tried[0] == 2
    assert (len(tried) > 1) == is_tried
    assert (proposer._levels.kept > 2) == is_tried


@pytest.mark.parametrize(("saved", "level"), [(0.5 * RISE, 2), (2.0 * RISE, 3)])
def test_a_vehicle_that_does_not_know_its_drive_keeps_a_margin_again_only_if_that_costs_little_more(
    monkeypatch: pytest.MonkeyPatch, saved: float, level: int
) -> None:
    """The plan at level 2, with the margin, costs as much more as stated than that at level 3 without it."""
    proposer, plan, tried = priced(monkeypatch, {2: 20.0, 3: 20.0 - saved})
    levels = proposer._levels
    levels.bound, levels.kept, levels._steady = DeviationBound(0.1, 0.3, 0.3, 1.5), 3, STEADY
    proposer.propose(1, start(), replace(plan, cost=25.0))
    assert tried == [2, 3]
    assert levels.kept == level


def test_a_vehicle_that_does_not_get_on_takes_any_gain_of_less_clearance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each plan costs as much as the last one, and one with less clearance only a little less."""
    monkeypatch.setattr("kraft.driving.proposer.DETOUR", math.inf)
    proposer, plan, _ = priced(monkeypatch, {number: 10.0 - 0.3 * number for number in range(8)})
    levels, kept = proposer._levels, []
    for number in range(1, 6):
        proposer.propose(number, start(), replace(plan, cost=10.5))
        kept.append(levels.kept)
    assert kept[:3] == [0, 0, 0]  # it was cheaper than the first plan
    assert kept[3] == 1


def test_a_vehicle_gets_on_only_if_plans_are_cheaper_than_the_cheapest_before() -> None:
    """Costs that rise and fall are no progress; after `INSISTENCE` the present cost counts as the cheapest one."""
    subject, _ = driven(DeviationBound(0.01), cycle=0.5)
    levels = subject._proposer._levels
    levels.note_progress(10.0, rises=True)
    found = []
    for k in range(10):
        levels.note_progress(11.0 if k % 2 == 0 else 9.5, rises=False)
        found.append(levels.gets_on)
    waits, insists = math.floor(PROGRESS_TIME / 0.5), math.floor(INSISTENCE / 0.5)
    assert found == [True] * waits + [False] * insists + [True] * (10 - waits - insists)
    levels.note_progress(9.5 - PROGRESS * PROGRESS_TIME, rises=False)
    assert levels._waited == 0


def test_the_same_remainder_is_retained_in_every_run() -> None:
    bounds = [DeviationBound(0.04), DeviationBound(0.1), DeviationBound(0.06), DeviationBound(0.12)]
    one, two = (driven(*bounds)[1] for _ in range(2))
    for a, b in zip(one, two, strict=True):
        assert (a.iterations, a.nodes, a.retained) == (b.iterations, b.nodes, b.retained)
        assert a.plan is not None
        assert b.plan is not None
        assert a.plan.trajectory.tobytes() == b.plan.trajectory.tobytes()


def test_a_remainder_that_is_kept_costs_no_more_than_what_was_left() -> None:
    _, found = driven(*[DeviationBound(0.04)] * 5)
    costs = [proposal.plan.total_cost for proposal in found if proposal.plan is not None]
    assert all(after <= before - 1.0 + RETAINED_TOLERANCE for before, after in itertools.pairwise(costs))


def test_a_plan_keeps_its_tree_when_less_clearance_is_searched_for_and_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kraft.driving.proposer.DETOUR", -math.inf)  # so that levels below are searched at too
    monkeypatch.setattr("kraft.driving.proposer.LEVEL_GAIN", math.inf)
    subject, found = driven(DeviationBound(0.04), DeviationBound(0.04))
    proposer, plan = subject._proposer, found[-1].plan
    assert found[0].iterations > 600
    assert plan is not None
    remainder = proposer._remainder(plan)
    assert remainder is not None
    assert remainder.edges is not None
    assert len(remainder.edges.durations) > remainder.edges.remaining  # and edges that begin on it


# In the replanner


def test_the_first_plan_keeps_the_bound_of_the_stated_uncertainty() -> None:
    subject = replanner(bound=BOUND, margin=MARGIN, iterations=600)
    expected = BoundCalibration(BOUND, mushr()).bound(UNCERTAIN)
    subject.begin(start(), UNCERTAIN)
    plan = subject._proposal.plan
    assert plan is not None
    needed = MARGIN + share_kept(subject._proposer) * expected.at(plan.trajectory[:, 3], plan.times)
    assert np.all(subject.dirt.exact.distances(plan.trajectory[:, :3]) >= needed - 1e-9)


def test_solvers_of_another_task_ask_for_the_same_bound() -> None:
    subject = replanner(bound=BOUND, margin=MARGIN, iterations=100)
    subject.begin(start(), UNCERTAIN)
    bound = subject._bound
    assert bound is not None
    subject.set_solvers(Solvers.of(turns(), mushr(), subject._settings))
    assert subject._proposer._levels.bound is bound
    assert subject.dirt.safety.delta == pytest.approx(BOUND.recheck * bound.delta)


def test_a_plan_in_hand_is_checked_at_its_level_when_the_map_changes() -> None:
    """The same map again changes nothing: the plan that keeps a small share of the bound is committed."""
    subject = replanner(bound=BOUND, margin=MARGIN, iterations=600)
    current = subject.begin(start(), UNCERTAIN)
    subject._proposer._levels.keep(2, stalled=False)
    subject._proposer.recovers = True
    subject._proposer._levels.require()
    asked = subject.dirt.safety
    subject.set_solvers(Solvers.of(turns(), mushr(), subject._settings))
    assert subject._proposer._levels.kept == 2
    assert subject._proposer.recovers
    assert subject.dirt.safety == asked
    cycle = subject.step(Estimate(0.0, start(), 0.0, None, UNCERTAIN), current)
    assert cycle.kind is ReferenceKind.PLAN


def test_plans_to_another_goal_may_cost_more_without_a_lack_of_progress() -> None:
    levels = Levels(Solvers.of(turns(), mushr(), replanner(bound=BOUND)._settings), replanner(bound=BOUND)._settings)
    for cost in (5.0, 9.0, 9.0, 9.0):
        assert levels.gets_on
        levels.note_progress(cost, rises=False)
    assert not levels.gets_on
    levels.set_solvers(Solvers.of(turns(), mushr(), replanner(bound=BOUND)._settings))
    levels.note_progress(9.0, rises=False)
    assert levels.gets_on
