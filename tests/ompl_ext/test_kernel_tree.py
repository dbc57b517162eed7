"""The tree's indices against brute force over its nodes, while it grows and after it was pruned."""

from __future__ import annotations

import math
from collections import OrderedDict

import numpy as np
import pytest
from numpy.typing import NDArray
from support.kernels import DEFAULT, GOAL, NO_SAFETY, START, TURNS, Array, turns

from kraft.vehicles.benchmark import BENCHMARK
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels import tree_memory
from ompl_ext.kernels.kernel_types import Tree
from ompl_ext.kernels.tree import closed_radius, nearest_better, select
from ompl_ext.kernels.tree_memory import add_descendants, keep_with_ancestors, new_tree, path_to, prune
from ompl_ext.obstacles import Workspace, box
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.solver import DirtSolver

RESOLUTION = Settings().resolution
SETTINGS = [Settings(), Settings(blossom=4, insertions=3), Settings(child_extension=False, heading_weight=0.3)]
IDS = ["default", "three-insertions", "no-child-extension"]


def grown(iterations: int, settings: Settings = DEFAULT, seed: int = 0, safety: Safety | None = None) -> Tree:
    dirt = turns(safety, settings) if safety else turns(settings=settings)
    dirt.start(START, seed)
    dirt.grow(iterations=iterations)
    return dirt.tree_arrays


def column(tree: Tree, name: int) -> Array:
    return tree.value[: tree.count[at.SIZE], name]


def link(tree: Tree, name: int) -> NDArray[np.int64]:
    return tree.link[: tree.count[at.SIZE], name]


def listed_by_region(tree: Tree) -> dict[int, tuple[int, int]]:
    """Level and cell of every listed node; fails if a list is broken or names a node twice."""
    listed: dict[int, tuple[int, int]] = {}
    for level, (start, columns, rows, count) in enumerate(tree.level[:, :4]):
        here = 0
        for cell in range(start, start + columns * rows):
            before, node = -1, int(tree.region_cells[cell, at.HEAD]) - 1
            while node >= 0:
                assert node not in listed
                assert tree.link[node, at.REGION_PREVIOUS] == before
                assert tree.link[node, at.REGION_LEVEL] == level
                listed[node] = level, cell
                here += 1
                before, node = node, int(tree.link[node, at.REGION_NEXT])
        assert here == count
    return listed


def listed_by_cell(tree: Tree) -> dict[int, int]:
    listed: dict[int, int] = {}
    for cell, head in enumerate(tree.cells[:, at.HEAD]):
        node = int(head) - 1
        while node >= 0:
            assert node not in listed
            listed[node] = cell
            node = int(tree.link[node, at.CELL_NEXT])
    return listed


def check_regions(tree: Tree) -> None:
    listed = listed_by_region(tree)
    radius, size = column(tree, at.RADIUS), tree.level_cell
    for node, (level, cell) in listed.items():
        assert tree.region_cells[cell, at.BOUND] > tree.value[node, at.F] * at.TICKS
        assert radius[node] <= size[level] or level == len(size) - 1
        assert level == 0 or radius[node] > size[level - 1]
        start, columns, rows, _ = tree.level[level, :4]
        x, y = ((tree.value[node, :2] - tree.frame[:2]) / size[level]).astype(int)
        assert cell == start + min(y, rows - 1) * columns + min(x, columns - 1)
    hopeful = np.flatnonzero((column(tree, at.F) < tree.best[0]) & (radius >= RESOLUTION))
    assert set(hopeful) <= set(listed)


def check_cells(tree: Tree) -> None:
    listed, f = listed_by_cell(tree), column(tree, at.F)
    for node, cell in listed.items():
        block, k = divmod(cell, 64)
        row, block_column = divmod(block, int(tree.block_shape[0]))
        low = tree.frame[:2] + (np.array([block_column, row]) * 8 + (k % 8, k // 8)) * tree.frame[2]
        assert (low - 1e-9 <= tree.value[node, :2]).all()
        assert (tree.value[node, :2] <= low + tree.frame[2] + 1e-9).all()
        below = at.MOST_TICKS - f[node] * at.TICKS
        assert tree.cells[cell, at.BOUND] >= below
        assert tree.block_bound[block] >= below
    assert set(np.flatnonzero(column(tree, at.RADIUS) >= RESOLUTION)) <= set(listed)


def check_costs(tree: Tree) -> None:
    parent, cost = link(tree, at.PARENT), column(tree, at.COST)
    nodes = np.arange(1, len(parent))
    assert parent[0] == -1
    assert ((parent[1:] >= 0) & (parent[1:] < nodes)).all()
    assert (cost[1:] == cost[parent[1:]] + tree.edge[1 : len(parent), -1]).all()
    assert (column(tree, at.F) == cost + column(tree, at.TOGO)).all()
    at_goal = link(tree, at.AT_GOAL) == 1
    if tree.count[at.BEST] >= 0:
        assert at_goal[tree.count[at.BEST]]
        assert tree.best[0] == cost[tree.count[at.BEST]] == cost[at_goal].min()
    else:
        assert not at_goal.any()


@pytest.mark.parametrize("settings", SETTINGS, ids=IDS)
@pytest.mark.parametrize("iterations", [30, 300, 2000])
def test_every_list_and_cost_is_consistent_after_growth(settings: Settings, iterations: int) -> None:
    tree = grown(iterations, settings)
    check_costs(tree)
    check_regions(tree)
    check_cells(tree)


def test_with_safety_the_lists_are_consistent_too() -> None:
    tree = grown(1500, safety=Safety(delta=0.02, delta_per_speed=0.05))
    check_costs(tree)
    check_regions(tree)
    check_cells(tree)


@pytest.mark.parametrize("seed", range(3))
def test_a_node_is_added_only_if_it_can_lead_to_a_better_plan(seed: int) -> None:
    tree = grown(2000, seed=seed)
    goal_costs = np.where(link(tree, at.AT_GOAL) == 1, column(tree, at.COST), math.inf)
    best_before = np.concatenate([[math.inf], np.minimum.accumulate(goal_costs)[:-1]])
    assert (column(tree, at.F) < best_before)[1:].all()


@pytest.mark.parametrize("settings", SETTINGS, ids=IDS)
def test_a_region_ends_at_the_nearest_better_node(settings: Settings) -> None:
    tree = grown(700, settings)
    q, f, radius = tree.value[: tree.count[at.SIZE], :4], column(tree, at.F), column(tree, at.RADIUS)
    parent, resolution = link(tree, at.PARENT), RESOLUTION
    for node in range(1, len(f)):
        distance = np.linalg.norm(q - q[node], axis=1)
        better = f < f[node]
        limit = distance[parent[node]]
        if radius[node] == 0.0:  # closed: a better node is nearer than the resolution
            assert min(distance[better].min(initial=math.inf), limit) < resolution
            continue
        if f[node] < tree.best[0]:  # not too large: no open better node inside, and no larger than the edge
            open_ones = better & (radius >= resolution)
            assert radius[node] <= max(min(distance[open_ones].min(initial=math.inf), limit), resolution) + 1e-9
        assert radius[node] >= min(distance[better].min(initial=math.inf), limit) - 1e-9  # not too small


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_better_node_is_the_one_brute_force_finds(seed: int) -> None:
    tree, rng = grown(1500, seed=seed), np.random.default_rng(seed)
    closed = closed_radius(RESOLUTION, int(tree.count[at.SIZE]))
    f, radius, listed = column(tree, at.F), column(tree, at.RADIUS), listed_by_cell(tree)
    for _ in range(150):
        heading = rng.uniform(-4, 4)
        q = np.array([rng.uniform(-0.25, 2.25), rng.uniform(-1, 6), 0.05 * math.cos(heading), 0.05 * math.sin(heading)])
        bound, limit = rng.uniform(f.min(), f.max() * 1.05), rng.choice([math.inf, 0.1, 0.5])
        candidates = np.array([n for n in listed if f[n] < bound and radius[n] >= closed], int)
        distance = np.linalg.norm(tree.value[candidates, :4] - q, axis=1)
        expected = min(distance.min(initial=math.inf), limit)
        node, found = nearest_better(tree, q, bound, limit, closed)
        if expected >= closed:
            assert found == pytest.approx(expected, rel=1e-12)
            assert (node == -1) == (distance.min(initial=math.inf) >= limit)
        else:
            assert expected <= found < closed
        if node >= 0:
            assert np.linalg.norm(tree.value[node, :4] - q) == pytest.approx(found, rel=1e-12)
            assert f[node] < bound


@pytest.mark.parametrize("seed", range(3))
def test_a_selected_node_holds_the_sample_or_is_the_nearest(seed: int) -> None:
    tree, rng = grown(1200, seed=seed), np.random.default_rng(seed)
    f, radius = column(tree, at.F), column(tree, at.RADIUS)
    for _ in range(300):
        heading = rng.uniform(-4, 4)
        q = np.array([rng.uniform(-0.25, 2.25), rng.uniform(-1, 6), 0.05 * math.cos(heading), 0.05 * math.sin(heading)])
        node = select(tree, q)
        distance = np.linalg.norm(tree.value[: len(f), :4] - q, axis=1)
        holding = np.flatnonzero((f < tree.best[0]) & (distance <= radius) & (radius >= RESOLUTION))
        assert node >= 0
        assert f[node] < tree.best[0]
        if distance[node] > radius[node]:
            assert len(holding) == 0
            still = [n for n in listed_by_cell(tree) if f[n] < tree.best[0]]
            assert distance[node] == pytest.approx(distance[still].min())


def test_the_least_visited_node_whose_region_holds_the_sample_is_selected() -> None:
    tree = grown(1200)
    rng = np.random.default_rng(1)
    f, radius = column(tree, at.F), column(tree, at.RADIUS)
    listed = np.array(sorted(listed_by_region(tree)))
    contested = 0
    for _ in range(200):
        q = tree.value[rng.choice(listed), :4] + rng.uniform(-0.01, 0.01, 4)
        distance = np.linalg.norm(tree.value[listed, :4] - q, axis=1)
        holding = listed[(f[listed] < tree.best[0]) & (distance <= radius[listed])]
        visits = tree.link[holding, at.VISITS]
        contested += len(set(visits.tolist())) > 1
        if len(holding):
            assert tree.link[select(tree, q), at.VISITS] == visits.min()
    assert contested > 20


def test_of_equally_visited_nodes_each_is_selected_equally_often() -> None:
    tree = grown(1200)
    tree.link[:, at.VISITS] = 0
    rng, draws = np.random.default_rng(0), 4000
    f, radius = column(tree, at.F), column(tree, at.RADIUS)
    listed = np.array(sorted(listed_by_region(tree)))
    for _ in range(5):
        q = tree.value[rng.choice(listed), :4] + rng.uniform(-0.01, 0.01, 4)  # regions end at nodes
        distance = np.linalg.norm(tree.value[listed, :4] - q, axis=1)
        holding = listed[(f[listed] < tree.best[0]) & (distance <= radius[listed])]
        if len(holding) < 2:
            continue
        counts = np.bincount([select(tree, q) for _ in range(draws)], minlength=len(f))[holding]
        assert counts.sum() == draws
        expected = draws / len(holding)
        chi_squared = ((counts - expected) ** 2 / expected).sum()
        assert chi_squared < len(holding) + 5 * math.sqrt(2 * len(holding)) + 5


def test_every_node_of_a_cycle_with_safety_was_safe_when_it_left_it() -> None:
    safety = Safety(cycle=1.0, delta=0.02, delta_per_speed=0.1)
    dirt = turns(safety)
    dirt.start(START, 4)
    dirt.grow(iterations=800)
    tree = dirt.tree()
    crossing = [n for n in range(1, len(tree.costs)) if tree.costs[tree.parents[n]] < 1.0 <= tree.costs[n]]
    assert len(crossing) > 20
    for node in crossing:
        parent = tree.parents[node]
        start, duration = tree.costs[parent], tree.durations[node]
        samples, slack = dirt.edge(tree.states[parent], tree.controls[node], duration, float(start))
        assert slack >= 0.0
        h = duration / (len(samples) - 1)
        step = min(int((1.0 - start) / h), len(samples) - 1)
        leaves, _ = dirt.edge(samples[step], tree.controls[node], max(1.0 - start - step * h, 0.0))
        assert dirt.contingency(leaves[-1]) is not None


@pytest.mark.parametrize("settings", SETTINGS, ids=IDS)
def test_pruning_keeps_the_best_plan_and_everything_consistent(settings: Settings) -> None:
    dirt = turns(settings=settings)
    dirt.start(START, 5)
    dirt.grow(iterations=2500)
    before, tree = dirt.plan(), dirt.tree_arrays
    size, f = int(tree.count[at.SIZE]), column(tree, at.F).copy()
    hopeful = int(((f < tree.best[0]) & (column(tree, at.RADIUS) >= RESOLUTION)).sum())
    removed = prune(tree)
    after = dirt.plan()
    assert before is not None
    assert after is not None
    assert removed > 0
    assert tree.count[at.SIZE] == size - removed >= hopeful
    assert before.trajectory.tobytes() == after.trajectory.tobytes()
    assert before.cost == after.cost
    check_costs(tree)
    check_regions(tree)
    check_cells(tree)
    view = dirt.tree()
    for node in range(1, len(view.costs), 7):
        end, _ = dirt.edge(view.states[view.parents[node]], view.controls[node], float(view.durations[node]))
        assert end[-1].tobytes() == view.states[node].tobytes()
    assert prune(tree) == 0
    dirt.grow(iterations=1000)
    check_costs(tree)
    check_regions(tree)
    check_cells(tree)


def test_pruning_a_large_tree_keeps_every_open_node() -> None:
    """Above 100,000 nodes regions smaller than the initial resolution are open, and stay so when nodes are pruned."""
    nowhere = Goal((1.0, 5.0), 1e-6)  # without a solution no bound turns a candidate away
    dirt = DirtSolver(BENCHMARK, TURNS, nowhere, NO_SAFETY, Settings(resolution=0.03), capacity=140_000)
    dirt.start(START, 0)
    while dirt.progress.nodes < 125_000:
        dirt.grow(iterations=2000)
    tree = dirt.tree_arrays
    before = tree.state[sorted(listed_by_region(tree))]
    assert (column(tree, at.RADIUS)[sorted(listed_by_region(tree))] < 0.03).any()
    assert prune(tree) > 0
    open_nodes = sorted(listed_by_region(tree))
    assert np.array_equal(tree.state[open_nodes], before)
    assert set(open_nodes) <= set(listed_by_cell(tree))
    dirt.grow(iterations=2000)  # the resolution has not risen: closed are the nodes that a better one is beside
    closed = closed_radius(0.03, int(tree.count[at.SIZE] + tree.count[at.PRUNED]))
    radius = column(tree, at.RADIUS)
    assert closed < 0.03 * math.sqrt(0.8)
    assert ((radius == 0.0) | (radius >= closed)).all()
    assert set(np.flatnonzero(radius > 0.0)) == set(listed_by_region(tree))
    assert set(listed_by_region(tree)) <= set(listed_by_cell(tree))


def test_a_point_on_the_far_corner_of_the_workspace_can_be_looked_up() -> None:
    tree = grown(500)
    for corner in ((2.25, 6.0), (-0.25, -1.0), (9.0, 9.0), (-9.0, -9.0)):
        q = np.array([*corner, 0.05, 0.0])
        _, distance = nearest_better(tree, q, math.inf, math.inf, 0.0)
        everywhere = np.linalg.norm(tree.value[sorted(listed_by_cell(tree)), :4] - q, axis=1)
        assert distance == pytest.approx(everywhere.min())
        assert select(tree, q) >= 0


def test_memory_is_reused_without_a_trace_of_the_query_before() -> None:
    fresh, used = (DirtSolver(BENCHMARK, TURNS, GOAL, capacity=3000) for _ in range(2))
    used.start(np.add(START, (0.2, 0.1, 0.5, 0.0)), 7)
    used.grow(iterations=900)
    for dirt in (fresh, used):
        dirt.start(START, 3)
        dirt.grow(iterations=600)
    for name in ("states", "parents", "controls", "durations", "costs", "costs_to_go"):
        assert getattr(fresh.tree(), name).tobytes() == getattr(used.tree(), name).tobytes()


def test_in_a_large_workspace_cells_share_memory_and_queries_are_those_of_brute_force() -> None:
    workspace = Workspace(((0.0, 60.0), (0.0, 60.0)), (box((30.0, 30.0), (20.0, 0.5)),))
    dirt = DirtSolver(BENCHMARK, workspace, Goal((55.0, 50.0), 0.5), NO_SAFETY, capacity=20_000)
    dirt.start(np.array([5.0, 5.0, 0.7, 0.0]), 0)
    dirt.grow(iterations=6000)
    tree, rng = dirt.tree_arrays, np.random.default_rng(0)
    assert len(tree.region_cells) < 3_000_000
    assert len(tree.cells) < 600_000
    f, radius, q = column(tree, at.F), column(tree, at.RADIUS), tree.value[: tree.count[at.SIZE], :4]
    for node in rng.integers(1, len(f), 300):
        better = np.flatnonzero((f < f[node]) & (radius >= RESOLUTION))
        nearest = np.linalg.norm(q[better] - q[node], axis=1).min(initial=math.inf)
        assert nearest_better(tree, q[node], f[node], math.inf, RESOLUTION)[1] <= max(nearest, RESOLUTION) + 1e-12
        sample = q[node] + rng.uniform(-0.02, 0.02, 4)
        holding = (np.linalg.norm(q - sample, axis=1) <= radius) & (f < tree.best[0]) & (radius > 0.0)
        if holding.any():
            visits = tree.link[: len(f), at.VISITS]
            assert visits[select(tree, sample)] == visits[holding].min()


def test_a_query_empties_all_cells_of_the_one_before_whatever_the_size_of_its_tree() -> None:
    for iterations in (30, 30_000):  # cells of the nodes one by one, and all of them
        dirt = DirtSolver(BENCHMARK, TURNS, GOAL)
        dirt.start(START, 1)
        dirt.grow(iterations=iterations)
        dirt.clear()
        tree = dirt.tree_arrays
        assert not tree.region_cells.any()
        assert not tree.cells.any()
        assert not tree.block_bound.any()
        assert not tree.level[:, at.LEVEL_COUNT].any()


def test_a_new_solver_has_an_empty_tree() -> None:
    dirt = DirtSolver(BENCHMARK, TURNS, GOAL)
    assert dirt.progress.iterations == dirt.tree_arrays.count[at.SIZE] == 0
    assert dirt.plan() is None
    assert not dirt.tree_arrays.region_cells.any()


def test_memory_of_nodes_begins_cache_lines() -> None:
    tree = grown(10)
    assert all(array.ctypes.data % 64 == 0 for array in (tree.value, tree.link))
    assert tree.link.shape[1] * tree.link.itemsize == 32


def test_descendants_and_ancestors_are_those_of_the_paths_from_the_root() -> None:
    tree = grown(300)
    parent = np.maximum(link(tree, at.PARENT), 0)
    paths = [path_to(tree, node) for node in range(len(parent))]
    below = np.zeros(len(parent), bool)
    below[paths[-1][1]] = True
    add_descendants(below, parent)
    assert below.tolist() == [paths[-1][1] in path for path in paths]
    nodes, keep = np.flatnonzero(below)[::-1], parent == -1
    keep[0] = True
    keep_with_ancestors(keep, parent, nodes, 10)
    kept = {0}
    for node in nodes:
        if len(kept.union(paths[node])) > 11:
            break
        kept.update(paths[node])
    assert 1 < len(kept) <= 11
    assert set(np.flatnonzero(keep).tolist()) == kept


def test_the_memory_of_a_tree_is_reused_empty_once_nothing_refers_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tree_memory, "_unused", OrderedDict())
    names, bounds = ("state", "value", "link", "region_cells", "cells"), ((0.0, 1.37), (0.0, 2.11))
    tree = new_tree(321, 4, 2, bounds)
    for name in names:
        getattr(tree, name)[:] = 7
    part, places = tree.state[5:9, 1], {tree.state.ctypes.data, tree.value.ctypes.data}
    del tree
    for _ in range(3):
        following = new_tree(321, 4, 2, bounds)
        assert not any(getattr(following, name).any() for name in names)
        assert not np.shares_memory(following.state, part)
    assert (part == 7).all()
    assert following.value.ctypes.data in places
    for rows in range(400, 430):
        new_tree(rows, 4, 2, bounds)
    assert len(tree_memory._unused) == tree_memory.REUSED_SIZES
