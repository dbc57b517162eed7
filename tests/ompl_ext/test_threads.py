"""Trees on several threads: the same plan on every run, one budget for all, the best plan of any of them."""

from __future__ import annotations

import numpy as np
import pytest
from support.kernels import BENCHMARK, GOAL, NO_SAFETY, START, TURNS

from ompl_ext.kernels import kernel_types as at
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.solver import LONGEST_ROUND, DirtSolver
from ompl_ext.verification import verify


def solver(
    threads: int, safety: Safety = NO_SAFETY, capacity: int = 20_000, settings: Settings | None = None
) -> DirtSolver:
    return DirtSolver(BENCHMARK, TURNS, GOAL, safety, settings, capacity, threads=threads)


@pytest.mark.parametrize("threads", [2, 3])
def test_the_same_threads_seed_and_iterations_give_the_same_plan(threads: int) -> None:
    plans = []
    dirt = solver(threads)
    for again in (dirt, solver(threads), dirt):
        again.start(START, 7)
        again.grow(iterations=3001)
        plans.append(again.plan())
        assert again.progress.iterations == 3001
        assert again.progress.edges == 3001 * 32
    first = plans[0]
    assert first is not None
    for plan in plans[1:]:
        assert plan is not None
        assert np.array_equal(plan.trajectory, first.trajectory)
        assert np.array_equal(plan.controls, first.controls)


def test_another_seed_and_another_number_of_threads_give_other_plans() -> None:
    costs = set()
    for threads, seed in ((1, 0), (2, 0), (3, 0), (2, 1)):
        dirt = solver(threads)
        dirt.start(START, seed)
        dirt.grow(iterations=3000)
        costs.add(dirt.best_cost)
    assert len(costs) == 4


def test_local_optimisation_improves_the_plan_of_several_trees_too() -> None:
    costs = []
    for polish in (False, True, True):
        dirt = solver(2, settings=Settings(polish=polish))
        dirt.start(START, 0)
        dirt.grow(iterations=2048)
        plan = dirt.plan()
        assert plan is not None
        assert verify(dirt, plan).problems == ()
        costs.append(plan.cost)
    assert costs[1] == costs[2] < costs[0]


def test_one_thread_is_the_search_without_threads() -> None:
    alone, usual = solver(1), DirtSolver(BENCHMARK, TURNS, GOAL, NO_SAFETY, capacity=20_000)
    for dirt in (alone, usual):
        dirt.start(START, 3)
        dirt.grow(iterations=1000)
    assert alone.best_cost == usual.best_cost


def test_no_tree_keeps_a_node_that_the_best_plan_of_another_excludes() -> None:
    dirt = solver(2)
    dirt.start(START, 0)
    dirt.grow(iterations=8000)
    own, other = (each.tree for each in dirt._trees)
    best = dirt.plan()
    assert best is not None
    assert own.best[0] == other.best[0] == best.cost
    size = int(other.count[at.SIZE])
    goals = other.value[:size, at.COST][other.link[:size, at.AT_GOAL] == 1]
    assert goals.min(initial=np.inf) >= best.cost
    before = dirt.progress.history[-1][1]
    dirt.grow(iterations=4 * LONGEST_ROUND)
    added = other.value[size : int(other.count[at.SIZE]), at.F]
    assert np.all(added < before)


def test_growing_in_two_steps_goes_on_with_the_same_trees() -> None:
    dirt = solver(2)
    dirt.start(START, 1)
    dirt.grow(iterations=1500)
    nodes, cost = dirt.progress.nodes, dirt.best_cost
    progress = dirt.grow(iterations=1500)
    assert progress.iterations == 3000
    assert progress.nodes > nodes
    assert dirt.best_cost <= cost


def test_a_plan_of_several_threads_passes_verification_and_is_retained() -> None:
    safety = Safety(delta=0.02, delta_per_speed=0.05)
    dirt = solver(2, safety)
    dirt.start(START, 2)
    dirt.grow(iterations=4000)
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    assert not verify(dirt, plan).problems
    k = int(np.searchsorted(plan.times, 1.0))
    dirt.start(plan.trajectory[k], 3)
    kept = dirt.retain(plan, float(plan.times[k]))
    assert kept > 0
    dirt.grow(iterations=200)
    after = dirt.plan()
    assert after is not None
    assert after.cost <= plan.cost - plan.times[k] + 1e-6


def test_a_budget_of_time_and_a_stop_end_the_search_of_all_threads() -> None:
    dirt = solver(2)
    dirt.start(START, 0)
    assert dirt.grow(seconds=0.05).seconds >= 0.05
    before = dirt.progress.iterations
    dirt.grow(stop=lambda: dirt.progress.iterations > before)
    assert dirt.progress.iterations > before


def test_full_memory_is_pruned_in_every_tree() -> None:
    dirt = solver(2, capacity=600)
    dirt.start(START, 0)
    dirt.grow(iterations=20_000)
    assert dirt.plan() is not None
    for tree in (each.tree for each in dirt._trees):
        assert tree.count[at.SIZE] <= 600


@pytest.mark.parametrize("threads", [0, -1, 65])
def test_a_number_of_threads_that_is_not_possible_is_refused(threads: int) -> None:
    with pytest.raises(ValueError, match="threads"):
        solver(threads)


def test_a_start_in_the_goal_is_a_plan_with_any_number_of_threads() -> None:
    dirt = DirtSolver(BENCHMARK, TURNS, Goal((1.0, -0.5), 0.3), NO_SAFETY, capacity=1000, threads=2)
    dirt.start(START)
    dirt.grow(iterations=20)
    plan = dirt.plan()
    assert plan is not None
    assert plan.cost == 0.0
