"""Edges of an earlier plan or tree in a new query: kept where they are free and safe, dropped elsewhere."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.kernels import (
    BENCHMARK,
    DEFAULT,
    GOAL,
    NO_SAFETY,
    START,
    TURNS,
    check_plan,
    planned,
    turns,
)  # fmt: skip

from ompl_ext.kernels.tree_memory import path_along, path_to
from ompl_ext.plan import Plan
from ompl_ext.query import Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.verification import Requirement, verify


def test_retaining_more_than_memory_holds_stops_cleanly() -> None:
    plan = planned(turns())
    small = DirtSolver(BENCHMARK, TURNS, GOAL, NO_SAFETY, capacity=5, max_nodes=5)
    small.start(START, 0)
    added = small.retain(plan)
    assert small.progress.nodes == 5
    assert added == 4


def test_of_a_tree_with_two_roots_only_what_is_below_the_plan_is_retained() -> None:
    dirt = turns()
    dirt.clear(0)
    dirt.add_root(START)
    dirt.add_root(np.array([1.0, -0.3, math.pi / 2, 0.0]))
    dirt.grow(iterations=600)
    tree = dirt.tree()
    root = [0, 1]
    for parent in tree.parents[2:]:
        root.append(root[parent])
    first = next(node for node in range(2, len(root)) if root[node] == 0)
    edges = dirt.retainable_edges(dirt.plan_to(first), 0.0, 1000)
    below = {(*tree.controls[k], tree.durations[k]) for k in range(2, len(root)) if root[k] == 0}
    assert len(edges.parents) > 1
    assert {(*u, t) for u, t in zip(edges.controls.tolist(), edges.durations.tolist(), strict=True)} <= below


def remaining(plan: Plan, k: int) -> float:
    return plan.cost - float(plan.times[k])


@pytest.mark.parametrize("seed", range(6))
def test_a_retained_plan_is_never_lost_at_the_end_of_an_edge(seed: int) -> None:
    dirt = turns()
    plan = planned(dirt, 1000, seed)
    assert plan.reaches_goal
    for k, elapsed in enumerate([0.0, *np.cumsum(plan.durations)[:-1]]):
        dirt.start(plan.states[k], 1)
        assert dirt.retain(plan, float(elapsed)) == len(plan.durations) - k
        again = dirt.plan()
        assert again is not None
        assert again.reaches_goal
        assert again.cost <= plan.cost - elapsed + 1e-9
        assert np.abs(again.states - plan.states[k:]).max() < 1e-12


def test_a_plan_retained_in_the_middle_of_an_edge_is_hardly_ever_lost() -> None:
    dirt, kept, asked = turns(), 0, 0
    for seed in range(8):
        plan = planned(dirt, 1000, seed)
        for k in range(1, len(plan.times) - 1, 2):
            dirt.start(plan.trajectory[k], 1)
            dirt.retain(plan, float(plan.times[k]))
            if dirt.best_node() == (0, True):  # begins inside the goal
                continue
            again = dirt.plan()
            asked += 1
            kept += again is not None and again.reaches_goal and again.cost <= remaining(plan, k) + 1e-9
    assert kept >= 0.98 * asked  # a partial edge is sampled anew, a few end a millimetre short of the margin


def test_growing_after_retaining_never_makes_the_plan_worse() -> None:
    dirt = turns()
    plan = planned(dirt, 400, 3)
    k = 20
    dirt.start(plan.trajectory[k], 9)
    dirt.retain(plan, float(plan.times[k]))
    cost = math.inf
    for _ in range(10):
        dirt.grow(iterations=100)
        better = dirt.plan()
        assert better is not None
        assert better.cost <= min(cost, remaining(plan, k) + 1e-9)
        cost = better.cost
        check_plan(dirt, better)


def test_from_a_displaced_root_only_free_and_safe_edges_are_retained() -> None:
    rng, safety = np.random.default_rng(0), Safety(delta=0.03, delta_per_speed=0.05)
    dirt = turns(safety)
    plan, dropped = planned(dirt, 1200, 1), 0
    for _ in range(60):
        k = int(rng.integers(0, len(plan.times) - 1))
        displaced = plan.trajectory[k] + rng.normal(0, (0.05, 0.05, 0.15, 0.05))
        left = int((np.cumsum(plan.durations) > plan.times[k] + 1e-9).sum())
        dirt.start(displaced, 1)
        added, tree = dirt.retain(plan, float(plan.times[k])), dirt.tree()
        assert added == len(tree.states) - 1 <= left
        assert (tree.parents[1:] == np.arange(added)).all()  # what follows a dropped edge is dropped
        dropped += left - added
        for node in range(1, added + 1):
            parent = tree.parents[node]
            samples, slack = dirt.edge(
                tree.states[parent], tree.controls[node], float(tree.durations[node]), float(tree.costs[parent])
            )
            assert slack >= 0.0
            assert dirt.exact.distances(samples[:, :3]).min() > 0.0
        again = dirt.plan()
        if again is not None:
            check_plan(dirt, again)
    assert dropped > 0


def test_an_edge_with_a_control_beyond_the_bounds_is_dropped_with_all_after_it() -> None:
    dirt = turns()
    plan = planned(dirt, 1000)
    weak = DirtSolver(replace(BENCHMARK, controls={**BENCHMARK.controls, "throttle": (0.0, 0.9)}), TURNS, GOAL)
    first = int(np.argmax(plan.controls[:, 0] > 0.9))
    assert plan.controls[first, 0] > 0.9
    weak.start(START, 1)
    weak.retain(plan)
    assert (weak.retained_nodes[:first] >= 0).all()
    assert (weak.retained_nodes[first:] == -1).all()
    assert weak.tree().controls[:, 0].max() <= 0.9


def test_an_edge_longer_than_the_longest_becomes_several_on_the_same_way() -> None:
    slow = turns(settings=replace(DEFAULT, shortest=1.0, longest=2.0, steps=20))
    plan = planned(slow, 3000)
    assert plan.durations.max() > 1.2
    dirt = turns()
    dirt.start(plan.states[0], 1)
    pieces = int(np.ceil(plan.durations / dirt.settings.longest - 1e-9).sum())
    assert dirt.retain(plan) == pieces > len(plan.durations)
    again = dirt.plan()
    assert again is not None
    assert again.durations.max() <= dirt.settings.longest + 1e-9
    assert again.cost == pytest.approx(plan.cost)
    np.testing.assert_allclose(again.states[-1], plan.states[-1], atol=1e-5)


def test_verification_finds_a_control_beyond_the_bounds() -> None:
    dirt = turns()
    plan = planned(dirt, 1000)
    weak = DirtSolver(replace(BENCHMARK, controls={**BENCHMARK.controls, "throttle": (0.0, 0.9)}), TURNS, GOAL)
    assert Requirement.CONTROL not in {problem.requirement for problem in verify(dirt, plan).problems}
    (found,) = [problem for problem in verify(weak, plan).problems if problem.requirement is Requirement.CONTROL]
    assert "throttle" in found.text


def test_retaining_nothing_adds_nothing() -> None:
    dirt = turns()
    plan = planned(dirt)
    for elapsed in (plan.cost, plan.cost + 5.0):
        dirt.start(START, 0)
        assert dirt.retain(plan, elapsed) == 0
    dirt.start(START, 0)
    assert dirt.retain_edges([], np.zeros((0, 2)), np.zeros(0)) == 0


def test_a_whole_tree_can_be_retained() -> None:
    dirt = turns()
    planned(dirt, 600)
    tree = dirt.tree()
    dirt.start(START, 5)
    added = dirt.retain_edges([int(p) - 1 for p in tree.parents[1:]], tree.controls[1:], tree.durations[1:])
    assert added == len(tree.states) - 1
    assert dirt.tree().states.tobytes() == tree.states.tobytes()


def test_a_query_continues_with_edges_as_if_all_were_added_at_once() -> None:
    dirt, views = turns(), []
    planned(dirt, 600)
    tree = dirt.tree()
    parents, controls, durations = tree.parents[1:] - 1, tree.controls[1:], tree.durations[1:]
    for first in (0, 7):
        dirt.start(START + np.array([0.01, 0.0, 0.02, 0.0]), 5)
        added = 0
        if first > 0:
            added = dirt.retain_edges(parents[:first], controls[:first], durations[:first])
        added += dirt.retain_edges(parents, controls, durations, continued=first > 0)
        assert added == dirt.progress.retained == int((dirt.retained_nodes >= 0).sum())
        dirt.grow(iterations=100)
        views.append((dirt.tree(), dirt.retained_nodes.tolist()))
    assert 0 < len(views[0][1]) == len(views[1][1])
    assert views[0][1] == views[1][1]
    assert views[0][0].states.tobytes() == views[1][0].states.tobytes()


def test_the_trajectory_of_a_plan_is_that_of_its_edges_one_by_one() -> None:
    plan, dirt = planned(turns()), turns()
    state, clock, row = plan.states[0], 0.0, 0
    for control, duration in zip(plan.controls, plan.durations, strict=True):
        samples, _ = dirt.edge(state, control, duration)
        steps = len(samples) - 1
        np.testing.assert_array_equal(plan.trajectory[row : row + steps + 1], samples)
        expected = clock + duration * np.arange(1, steps + 1) / steps
        np.testing.assert_array_equal(plan.times[row + 1 : row + steps + 1], expected)
        state, clock, row = samples[-1], clock + duration, row + steps
    assert len(plan.times) == row + 1


def test_a_known_plan_is_the_best_one_until_the_search_finds_a_better_one() -> None:
    dirt = turns()
    first = planned(dirt)
    assert dirt.plan(first) is first
    dirt.grow(iterations=5000)
    better = dirt.plan(first)
    assert better is not None
    assert better.cost < first.cost


def test_the_nodes_of_a_plan_are_found_by_its_edges() -> None:
    dirt = turns()
    plan = planned(dirt)
    edges = np.column_stack([plan.controls, plan.durations])
    tree = dirt.tree_arrays
    assert path_along(tree, edges) == path_to(tree, dirt.best_node()[0])
    edges[2, 0] += 1e-9
    assert path_along(tree, edges) == path_to(tree, dirt.best_node()[0])[:3]
