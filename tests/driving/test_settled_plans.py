"""A plan that is kept: the tree that a cycle retains, the budget that it spends, the gain that it asks of another way."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import cache
from operator import attrgetter

import numpy as np
import pytest
from support.replanner import FARSIGHTED, drive, mushr, proposer, replanner, start

from kraft.driving.messages import PlanLoss
from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.proposal import Proposal
from kraft.driving.proposer import Proposer
from kraft.driving.remainder import Remainder, retain, start_with_best_corrections
from kraft.driving.solvers import Solvers
from kraft.driving.ways import goes_same_way
from kraft.planning.workspace import start_state
from kraft.scenario import Task, load_scenario
from ompl_ext.arrays import Floats
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.nearest_points import nearest_points
from ompl_ext.plan import Plan
from ompl_ext.solver import DirtSolver

BRANCHED = 3  # seed with which a tree has open branches along its plan
SHORT = 20  # iterations that do not reach the goal of Turns
MOVED = np.array([0.02, -0.02, 0.04, 0.0])


@cache
def boxes() -> Task:
    return load_scenario("boxes").task()


def proposed(subject: Proposer) -> Plan:
    plan = subject.propose(0, start(), None).plan
    assert plan is not None
    return plan


def after_a_cycle(plan: Plan, moved: Floats | float = 0.0) -> Floats:
    state: Floats = np.array([np.interp(1.0, plan.times, column) for column in plan.trajectory.T])
    return state + moved


def remainder_of(subject: Proposer, plan: Plan) -> Remainder:
    remainder = subject.search.query(1, plan.states[0], plan, 0.0).remainder
    assert remainder is not None
    return remainder


@pytest.mark.parametrize("retain", ["plan", "tree"])
def test_a_plan_that_ends_with_the_cycle_up_to_rounding_has_no_remainder(retain: str) -> None:
    subject = proposer(retain=retain)
    plan = proposed(subject).head(0.0)
    ends = 1.0 + 5e-10
    short = replace(plan, durations=np.array([ends]), cost=ends)
    subject.search.keep(subject.dirt, short)
    assert subject.search.grown is not None
    assert subject.search.grown.edges is None
    assert subject.propose(1, after_a_cycle(plan), short).plan is not None


def end_after_retaining(retain: str, moved: Floats) -> tuple[float, Floats]:
    """Distance of the end of the retained remainder from the plan's end, m, and its state (nx,); inf if it was lost."""
    subject = proposer(retain=retain)
    plan = proposed(subject)
    edges = len(plan.durations) - int(np.searchsorted(plan.durations.cumsum(), 1.0 + 1e-9, side="right"))
    subject.propose(1, after_a_cycle(plan, moved), plan)
    node = int(subject.dirt.retained_nodes[edges - 1])
    if node < 0:
        return math.inf, plan.states[-1]
    end = subject.dirt.tree_arrays.state[node]
    return math.dist(end[:2], plan.states[-1][:2]), end


def test_a_cycle_retains_the_remainder_of_the_plan_and_edges_of_its_tree_that_begin_on_it() -> None:
    subject = proposer(seed=BRANCHED, retain="tree")
    plan = proposed(subject)
    before, edges = subject.dirt.tree(), remainder_of(subject, plan).edges
    assert edges is not None
    assert len(edges.parents) > edges.remaining == len(edges.targets) > 0
    assert edges.durations[: edges.remaining].sum() == pytest.approx(plan.cost - 1.0)
    assert all(parent < k for k, parent in enumerate(edges.parents))
    known = {(*control, duration) for control, duration in zip(before.controls, before.durations, strict=True)}
    for control, duration in zip(edges.controls[edges.remaining :], edges.durations[edges.remaining :], strict=True):
        assert (*control, duration) in known
    proposal = subject.propose(1, after_a_cycle(plan), plan)
    assert proposal.retained > edges.remaining
    end = subject.dirt.retained_nodes[edges.remaining - 1]
    assert subject.dirt.tree_arrays.value[end, at.COST] == pytest.approx(plan.cost - 1.0)


def test_a_remainder_that_the_last_attempt_has_retained_is_not_added_again() -> None:
    subject = proposer(seed=BRANCHED, retain="tree")
    plan = proposed(subject)
    dirt, remainder, root, views = subject.dirt, remainder_of(subject, plan), after_a_cycle(plan, MOVED), []
    for attempts in (1, 0):
        dirt.start(root, 5)
        continued = attempts > 0 and start_with_best_corrections(dirt, root, remainder, 5, attempts)
        assert continued == (attempts > 0)
        assert retain(dirt, root, remainder, continued) is PlanLoss.NONE
        dirt.grow(iterations=50, timed=False)
        views.append((dirt.tree(), dirt.progress.edges, dirt.progress.retained))
    assert views[0][0].states.tobytes() == views[1][0].states.tobytes()
    assert views[0][1:] == views[1][1:]


def test_no_more_edges_than_the_limit_are_retained_and_the_most_promising_first() -> None:
    subject = proposer(seed=BRANCHED, retain="tree")
    plan = proposed(subject)
    everything, few = (subject.dirt.retainable_edges(plan, 1.0, limit) for limit in (1000, 2))
    assert len(few.parents) <= few.remaining + 2 < len(everything.parents)
    none = subject.dirt.retainable_edges(plan, 1.0, 0)
    assert len(none.parents) == none.remaining


def test_nothing_of_a_tree_is_retained_after_a_plan_of_another_proposal() -> None:
    subject = proposer(retain="tree")
    plan = proposed(subject)
    subject.propose(1, after_a_cycle(plan), plan)
    assert remainder_of(subject, plan).edges is None
    assert subject.search.query(2, start(), None, 0.0).remainder is None


def test_from_a_state_that_differs_a_little_the_rest_is_corrected_to_end_where_it_was_to_end() -> None:
    as_it_is, _ = end_after_retaining("plan", MOVED)
    corrected, _ = end_after_retaining("tree", MOVED)
    assert corrected < 0.05
    assert corrected < 0.5 * as_it_is


@pytest.mark.parametrize("margin", [0.0, 0.03])
def test_with_the_same_seed_a_tree_is_retained_and_grown_the_same(margin: float) -> None:
    settings = {"retain": "tree", "max_iterations": 600, "switch_gain": 1.0, "margin": margin, "safety": FARSIGHTED}
    one, two = (drive(replanner(**settings), 4, error=MOVED / 2) for _ in range(2))  # type: ignore[arg-type]
    assert [(c.cost_to_goal, c.nodes, c.retained) for c in one] == [(c.cost_to_goal, c.nodes, c.retained) for c in two]
    assert max(cycle.retained for cycle in one) > 0


def test_a_search_spends_more_until_the_goal_is_reached_and_stops_at_the_largest_budget() -> None:
    unreached = proposer(iterations=10, max_iterations=SHORT)
    proposal = unreached.propose(0, start(), None)
    assert proposal.iterations == SHORT
    assert proposal.plan is None or not proposal.plan.reaches_goal
    assert proposer(iterations=20).propose(0, start(), None).iterations == 20


def test_a_search_that_has_converged_spends_no_more() -> None:
    cycles = drive(replanner(iterations=SHORT, max_iterations=3000, retain="tree"), 6)
    assert SHORT < cycles[0].iterations < 3000
    assert cycles[0].cost_to_goal < math.inf
    assert min(cycle.iterations for cycle in cycles) == SHORT


def test_the_largest_budget_is_not_below_the_smallest() -> None:
    with pytest.raises(ValueError, match="less than iterations"):
        PlannerSettings(mode="replanning", iterations=1000, max_iterations=999)
    assert PlannerSettings(mode="replanning", iterations=1000).largest_budget == 1000


def test_the_largest_budget_of_the_first_plan_is_not_below_its_smallest() -> None:
    with pytest.raises(ValueError, match="less than first_iterations"):
        PlannerSettings(mode="replanning", first_iterations=1000, first_max_iterations=999)
    with pytest.raises(ValueError, match="without first_iterations"):
        PlannerSettings(mode="replanning", first_max_iterations=999)
    chosen = [PlannerSettings(mode="replanning", first_iterations=900, first_max_iterations=k) for k in (None, 5000)]
    assert [each.for_first_plan.largest_budget for each in chosen] == [1800, 5000]


@cache
def two_ways() -> tuple[Plan, Plan]:
    """Two plans that pass the first box of Boxes on different sides, the cheaper one first."""
    solvers = Solvers.of(boxes(), mushr(), PlannerSettings(mode="replanning"))
    dirt, plans = solvers.checking, list[Plan]()
    for seed in range(12):
        dirt.start(start_state(boxes(), mushr()), seed)
        dirt.grow(iterations=2000)
        plan = dirt.plan()
        assert plan is not None
        plans.append(plan)
    to_goal = sorted((plan for plan in plans if plan.reaches_goal), key=attrgetter("total_cost"))
    for one, two in itertools.combinations(to_goal, 2):
        if two.total_cost > one.total_cost + 0.01 and not goes_same_way(dirt, one, two):
            return one, two
    raise AssertionError("all plans go the same way")


def with_both(subject: Proposer) -> tuple[DirtSolver, Plan]:
    """Solver whose tree has both plans, and the dearer one, which was retained."""
    (cheap, dear), dirt = two_ways(), subject.dirt
    dirt.start(start_state(boxes(), mushr()))
    dirt.retain(dear)
    kept = dirt.plan_to(int(dirt.retained_nodes[-1]))
    dirt.retain(cheap)
    return dirt, kept


def test_another_way_is_refused_below_the_gain_and_taken_above_it() -> None:
    cheap, dear = two_ways()
    saved = dear.total_cost - cheap.total_cost
    for gain, refused in ((0.0, False), (0.9 * saved, False), (1.1 * saved, True)):
        subject = proposer(task=boxes(), switch_gain=gain)
        dirt, kept = with_both(subject)
        plan, was_refused = subject.search.choose(dirt, kept)
        assert plan is not None
        assert was_refused is refused
        assert plan.total_cost == pytest.approx((dear if refused else cheap).total_cost)


def test_a_plan_goes_the_same_way_as_itself_and_not_the_way_on_the_other_side_of_a_box() -> None:
    cheap, dear = two_ways()
    dirt = proposer(task=boxes()).dirt
    assert goes_same_way(dirt, cheap, cheap)
    assert not goes_same_way(dirt, cheap, dear)
    assert not goes_same_way(dirt, dear, cheap)


def test_of_the_points_of_a_path_the_first_of_the_nearest_ones_counts() -> None:
    generator = np.random.default_rng(0)
    points, path = generator.uniform(0.0, 3.0, (40, 2)), generator.uniform(0.0, 3.0, (60, 2))
    path[30:] = path[:30]
    nearest, away = np.empty(40, np.int64), np.empty(40)
    nearest_points()(points, path, nearest, away)
    distances = np.linalg.norm(points[:, None] - path[None], axis=2)
    np.testing.assert_array_equal(nearest, distances.argmin(axis=1))
    np.testing.assert_array_equal(away, distances.min(axis=1))


def test_without_the_margin_a_plan_is_better_if_it_saves_the_gain_or_alone_reaches_the_goal() -> None:
    cheap, dear = (Proposal(plan, lost=PlanLoss.COLLISION) for plan in two_ways())
    assert cheap.plan is not None
    assert dear.plan is not None
    saved = dear.plan.total_cost - cheap.plan.total_cost
    assert cheap.is_better_than(dear, 0.9 * saved)
    assert not cheap.is_better_than(dear, 1.1 * saved)
    short = replace(dear, plan=replace(dear.plan, reaches_goal=False))
    assert cheap.is_better_than(short, 1.1 * saved)
    assert not replace(cheap, plan=None).is_better_than(dear, 0.9 * saved)


@pytest.mark.parametrize(
    ("gain", "lost", "dearer", "asked"),
    [
        (1.0, PlanLoss.COLLISION, 1.0, True),
        (0.0, PlanLoss.COLLISION, 1.0, False),
        (1.0, PlanLoss.NONE, 1.0, False),
        (1.0, PlanLoss.COLLISION, 0.0, False),
    ],
)
def test_the_solver_of_a_lost_remainder_is_asked_only_if_a_gain_is_required_and_the_plan_costs_more(
    monkeypatch: pytest.MonkeyPatch, gain: float, lost: PlanLoss, dearer: float, asked: bool
) -> None:
    """The last plan is that of the solver without margin, and the one with the margin finds another one."""
    plan, _ = two_ways()
    subject, tried = proposer(task=boxes(), switch_gain=gain, margin=0.03), list[DirtSolver]()
    subject.search.keep(subject.dirt, plan)

    def run(_: object, dirt: DirtSolver, *__: object) -> Proposal:
        tried.append(dirt)
        return Proposal(replace(plan, cost=plan.cost - 1.0 + dearer), lost=lost)  # the cycle is 1 s of the plan

    monkeypatch.setattr(subject.search, "run", run)
    subject.propose(1, start_state(boxes(), mushr()), plan)
    both = subject.search.solvers
    assert tried == ([both.planning, both.checking] if asked else [both.planning])


def test_without_a_remainder_the_first_solver_that_finds_a_plan_is_the_only_one() -> None:
    subject = proposer(task=boxes(), switch_gain=1.0, margin=0.03)
    plan = subject.propose(0, start_state(boxes(), mushr()), None).plan
    assert plan is not None
    assert subject.search.grown is not None
    assert subject.search.grown.dirt is subject.search.solvers.planning
