"""Search at levels of clearance: the budget that they share, the remainder that they keep, what less clearance saves."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from support.replanner import mushr, proposals, proposer, share_kept, start, turns

from kraft.driving.bound import LATER_DELAY, LATER_GROWTH, DeviationBound
from kraft.driving.level_search import DETOUR, LEAST_GAIN, LEVEL_GAIN, RISE, STALLED
from kraft.driving.levels import INSISTENCE, PAUSE, PROGRESS, PROGRESS_TIME, STEADY, Levels
from kraft.driving.planner_settings import CalibratedBound, PlannerSettings
from kraft.driving.proposal import Proposal
from kraft.driving.proposer import Proposer
from kraft.driving.remainder import RETAINED_TOLERANCE
from kraft.driving.solvers import Solvers
from ompl_ext.plan import Plan
from ompl_ext.solver import DirtSolver

MARGIN = 0.03
BOUND = CalibratedBound(foresight=60.0, shares=(1.0, 0.5, 0.25))


def driven(*bounds: DeviationBound, seed: int = 0, **more: object) -> tuple[Proposer, list[Proposal]]:
    """Proposals with a bound each, from the start of Turns and then from where each plan leads in a cycle."""
    chosen = {"bound": BOUND, "margin": MARGIN, "iterations": 600, "max_iterations": 1200, "retain": "tree", **more}
    subject = proposer(seed, switch_gain=0.5, **chosen)  # type: ignore[arg-type]
    return subject, list(proposals(subject, *bounds))


def test_the_searches_of_a_cycle_share_its_budget() -> None:
    """The bound leaves no way at any level that keeps the margin."""
    for most in (600, 700, 1200):
        _, found = driven(*[DeviationBound(1.0)] * 2, max_iterations=most)
        assert all(proposal.iterations <= most for proposal in found)


def test_a_cycle_whose_budget_ends_without_a_plan_leaves_the_next_levels_to_the_next_cycle() -> None:
    """12 iterations find no way to the goal, which plans need at the first five levels."""
    subject = proposer(bound=BOUND, margin=MARGIN, iterations=30, max_iterations=40)
    subject.set_bound(DeviationBound(0.05))
    first, second = (subject.propose(number, start(), None) for number in range(2))
    assert first.plan is None
    assert second.plan is not None
    assert subject.levels.kept > subject.levels.farsighted


def test_a_plan_keeps_share_and_margin_to_its_end() -> None:
    subject, (found,) = driven(DeviationBound(0.05))
    assert found.plan is not None
    assert found.plan.reaches_goal
    away = subject.dirt.exact.distances(found.plan.trajectory[:, :3]).min()
    assert away >= share_kept(subject) * 0.05 + MARGIN - 1e-9


def test_a_remainder_can_be_retained_without_a_search_at_the_levels_whose_clearance_it_keeps() -> None:
    subject, (found,) = driven(DeviationBound(0.04))
    plan = found.plan
    assert plan is not None
    root = np.array([np.interp(1.0, plan.times, column) for column in plan.trajectory.T])
    query = subject.search.query(1, root, plan, 0.0)
    for bound, expected in ((0.04, [True, True, True]), (0.2, [False, True, True]), (0.4, [False, False, True])):
        subject.levels.bound = DeviationBound(bound)
        assert [subject.level_search.holds(query, number) for number in range(3)] == expected


def test_plans_of_a_bound_that_grows_cost_hardly_more_than_what_was_left() -> None:
    for seed in range(4):
        _, found = driven(DeviationBound(0.04), DeviationBound(0.04), DeviationBound(0.1), seed=seed)
        costs = [proposal.plan.total_cost for proposal in found if proposal.plan is not None]
        assert all(after <= before - 1.0 + STALLED for before, after in itertools.pairwise(costs))


@pytest.mark.parametrize(("bound", "level"), [(0.1, 0), (0.3, 1)])
def test_a_vehicle_without_progress_keeps_less_clearance_only_if_that_saves_time(bound: float, level: int) -> None:
    """The plan that was left states a cost that no plan has."""
    subject, (found,) = driven(DeviationBound(0.001))
    plan = found.plan
    assert plan is not None
    root = np.array([np.interp(1.0, plan.times, column) for column in plan.trajectory.T])
    subject.levels.bound = DeviationBound(bound)
    subject.levels.keep(0, stalled=True)
    proposed = subject.propose(1, root, replace(plan, cost=2.0))
    assert proposed.plan is not None
    assert proposed.plan.reaches_goal
    assert subject.levels.kept == level


@pytest.mark.parametrize(("saved", "level"), [(0.5 * RISE, 1), (2.0 * RISE, 2)])
def test_a_plan_keeps_more_clearance_than_the_last_one_only_if_it_costs_little_more(
    monkeypatch: pytest.MonkeyPatch, saved: float, level: int
) -> None:
    """A search at the level of the last plan, 2, finds one that costs as much less as stated than that at level 1."""
    monkeypatch.setattr("kraft.driving.level_search.DETOUR", math.inf)
    subject, plan, tried = priced(monkeypatch, {1: 10.0, 2: 10.0 - saved})
    keep_steadily(subject.levels, 2)
    subject.propose(1, start(), replace(plan, cost=2.0))
    assert tried == [1, 2]
    assert subject.levels.kept == level


def keep_steadily(levels: Levels, number: int) -> None:
    """Keep a level for so many cycles that a higher one is tried."""
    levels.keep(number, stalled=False)
    for _ in range(STEADY):
        levels.keep(number, stalled=False)


def priced(monkeypatch: pytest.MonkeyPatch, costs: dict[int, float]) -> tuple[Proposer, Plan, list[int]]:
    """Proposer whose plans have the stated total cost at each level, a plan, and the levels that are tried."""
    subject, (found,) = driven(DeviationBound(0.3))
    plan, tried = found.plan, list[int]()
    assert plan is not None
    assert plan.cost_to_go == 0.0
    levels = subject.levels
    levels.kept, levels.stalled, chosen = 0, False, levels.set

    def recorded(number: int, eased: bool) -> DirtSolver:
        tried.append(number)
        return chosen(number, eased)

    def search(_: object, dirt: DirtSolver, *__: object, **___: object) -> Proposal:
        dirt.start(start())
        return Proposal(replace(plan, cost=costs[tried[-1]]))

    monkeypatch.setattr(levels, "set", recorded)
    monkeypatch.setattr(subject.level_search, "holds", lambda *_: False)
    monkeypatch.setattr(subject.search, "run", search)
    return subject, plan, tried


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
    subject, plan, tried = priced(monkeypatch, {0: 20.0, 2: 20.0 - saved, 3: 30.0, 4: 30.0, 5: 30.0, 6: 30.0, 7: 30.0})
    subject.propose(1, start(), replace(plan, cost=left + 1.0))
    assert tried[:2] == [0, 2]
    assert subject.levels.kept == level


@pytest.mark.parametrize(("beyond", "is_compared"), [(0.9 * DETOUR, False), (1.1 * DETOUR, True)])
def test_less_clearance_is_tried_where_a_plan_costs_much_more_than_the_cost_to_go(
    monkeypatch: pytest.MonkeyPatch, beyond: float, is_compared: bool
) -> None:
    dirt = Solvers.of(turns(), mushr(), PlannerSettings(mode="replanning", margin=MARGIN, bound=BOUND)).planning
    dirt.start(start())
    least = dirt.root_cost_to_go
    assert least > 1.0
    subject, _, tried = priced(monkeypatch, {0: least + beyond, 2: least})
    subject.propose(0, start(), None)
    assert tried == ([0, 2] if is_compared else [0])


def test_after_a_refused_plan_the_next_cycles_do_not_try_less_clearance_for_the_same_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    subject, plan, tried = priced(monkeypatch, dict.fromkeys(range(8), 20.0))
    numbers = []
    for number in range(2 * (PAUSE + 1)):
        tried.clear()
        subject.propose(number, start(), replace(plan, cost=21.0))
        numbers.append(len(tried))
    assert subject.levels.kept == 0
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
    subject, plan, tried = priced(monkeypatch, {2: 20.0, 4: 10.0, 5: 20.0, 6: 20.0, 7: 20.0})
    subject.levels.bound, subject.levels.kept = bound, 2
    subject.levels.note_progress(1.0, rises=True)
    for _ in range(waited):
        subject.levels.note_progress(1.0, rises=False)
    assert subject.levels.wide == 3
    subject.propose(1, start(), replace(plan, cost=25.0))
    assert tried[0] == 2
    assert (len(tried) > 1) == is_tried
    assert (subject.levels.kept > 2) == is_tried


@pytest.mark.parametrize(("saved", "level"), [(0.5 * RISE, 2), (2.0 * RISE, 3)])
def test_a_vehicle_that_does_not_know_its_drive_keeps_a_margin_again_only_if_that_costs_little_more(
    monkeypatch: pytest.MonkeyPatch, saved: float, level: int
) -> None:
    """The plan at level 2, with the margin, costs as much more as stated than that at level 3 without it."""
    subject, plan, tried = priced(monkeypatch, {2: 20.0, 3: 20.0 - saved})
    levels = subject.levels
    levels.bound = DeviationBound(0.1, 0.3, 0.3, 1.5)
    keep_steadily(levels, 3)
    subject.propose(1, start(), replace(plan, cost=25.0))
    assert tried == [2, 3]
    assert levels.kept == level


def test_a_vehicle_that_does_not_get_on_takes_any_gain_of_less_clearance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each plan costs as much as the last one, and one with less clearance only a little less."""
    monkeypatch.setattr("kraft.driving.level_search.DETOUR", math.inf)
    subject, plan, _ = priced(monkeypatch, {number: 10.0 - 0.3 * number for number in range(8)})
    levels, kept = subject.levels, []
    for number in range(1, 6):
        subject.propose(number, start(), replace(plan, cost=10.5))
        kept.append(levels.kept)
    assert kept[:3] == [0, 0, 0]  # it was cheaper than the first plan
    assert kept[3] == 1


def test_a_vehicle_gets_on_only_if_plans_are_cheaper_than_the_cheapest_before() -> None:
    """Costs that rise and fall are no progress; after `INSISTENCE` the present cost counts as the cheapest one."""
    subject, _ = driven(DeviationBound(0.01), cycle=0.5)
    levels = subject.levels
    levels.note_progress(10.0, rises=True)
    found = []
    for k in range(10):
        levels.note_progress(11.0 if k % 2 == 0 else 9.5, rises=False)
        found.append(levels.gets_on)
    waits, insists = math.floor(PROGRESS_TIME / 0.5), math.floor(INSISTENCE / 0.5)
    assert found == [True] * waits + [False] * insists + [True] * (10 - waits - insists)
    levels.note_progress(9.5 - PROGRESS * PROGRESS_TIME, rises=False)
    again = []
    for _ in range(waits + 1):
        again.append(levels.gets_on)
        levels.note_progress(20.0, rises=False)
    assert again == [True] * (waits + 1)
    assert not levels.gets_on


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
    monkeypatch.setattr("kraft.driving.level_search.DETOUR", -math.inf)  # so that levels below are searched at too
    monkeypatch.setattr("kraft.driving.level_search.LEVEL_GAIN", math.inf)
    subject, found = driven(DeviationBound(0.04), DeviationBound(0.04))
    plan = found[-1].plan
    assert found[0].iterations > 600
    assert plan is not None
    remainder = subject.search.query(2, plan.states[0], plan, 0.0).remainder
    assert remainder is not None
    assert remainder.edges is not None
    assert len(remainder.edges.durations) > remainder.edges.remaining  # and edges that begin on it
