"""DIRT as a whole: repeatable, anytime, never worse than what it was given, and free by FCL's judgement."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from support.kernels import (
    BENCHMARK,
    GOAL,
    NO_SAFETY,
    ROVER,
    START,
    TURNS,
    WALLS,
    Array,
    check_plan,
    planned,
    random_obstacle,
    tree_bytes,
    turns,
)  # fmt: skip

from ompl_ext import solver
from ompl_ext.exact import ExactClearance
from ompl_ext.obstacles import Workspace, box
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Footprint

ROOM = ((0.0, 4.0), (0.0, 4.0))
ACROSS = Goal((3.5, 3.5), 0.25)
CORNER = np.array([0.5, 0.5, 0.8, 0.0])


@pytest.mark.parametrize("safety", [NO_SAFETY, Safety(delta=0.02)], ids=["free", "safe"])
def test_the_same_seed_and_iterations_give_the_same_tree_in_one_call_or_many(safety: Safety) -> None:
    dirt, trees = turns(safety), []
    for parts in ([1500], [1500], [1, 2, 3, 494, 1000], [16, 16, 1468], [750, 750]):
        dirt.start(START, 11)
        for part in parts:
            dirt.grow(iterations=part)
            dirt.plan()  # looking at the plan changes nothing
            dirt.contingency(START)
        assert dirt.progress.iterations == 1500
        trees.append(tree_bytes(dirt))
    assert len(set(trees)) == 1


def test_looks_at_the_clock_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    dirt, trees = DirtSolver(BENCHMARK, TURNS, GOAL, settings=Settings(pruning=True), capacity=20_000), []
    for chunk in (0.002, 0.00005, 0.5):
        monkeypatch.setattr(solver, "LONGEST_CHUNK", chunk)
        dirt.start(START, 2)
        dirt.grow(iterations=9000)
        trees.append(tree_bytes(dirt))
    assert len(set(trees)) == 1


def test_looks_at_the_clock_change_nothing_when_memory_runs_out_either(monkeypatch: pytest.MonkeyPatch) -> None:
    dirt, trees, iterations = DirtSolver(BENCHMARK, TURNS, GOAL, capacity=1000), [], []
    for first in (16, 7, 400):
        monkeypatch.setattr(solver, "FIRST_CHUNK", first)
        monkeypatch.setattr(solver, "_next_chunk", lambda count, took, left, first=first: first)
        dirt.start(START, 2)
        iterations.append(dirt.grow(iterations=6000).iterations)
        trees.append(tree_bytes(dirt))
    assert len(set(iterations)) == 1
    assert len(set(trees)) == 1


@pytest.mark.parametrize("seed", range(8))
def test_a_search_knows_of_its_first_plan_at_once(seed: int) -> None:
    dirt = turns()
    dirt.start(START, seed)
    progress = dirt.grow(stop=lambda: bool(dirt.progress.history))
    assert progress.iterations == progress.first_iteration
    best = dirt.plan()
    assert best is not None
    assert best.cost == progress.history[0][1]


def test_different_seeds_give_different_trees() -> None:
    dirt, trees = turns(), set()
    for seed in (0, 1, 2, -1, 2**63):
        dirt.start(START, seed)
        dirt.grow(iterations=100)
        trees.add(tree_bytes(dirt))
    assert len(trees) == 5


def test_the_cost_never_rises_with_more_iterations() -> None:
    dirt = turns()
    for seed in range(4):
        dirt.start(START, seed)
        last = math.inf
        for _ in range(25):
            progress = dirt.grow(iterations=60)
            plan = dirt.plan()
            if plan is not None and plan.reaches_goal:
                assert plan.cost <= last
                last = plan.cost
        assert last < 12.0
        costs = [cost for _, cost in progress.history]
        assert costs == sorted(costs, reverse=True)
        assert [t for t, _ in progress.history] == sorted(t for t, _ in progress.history)
        assert costs[-1] == last


def test_it_converges_towards_the_straight_way_in_an_empty_room() -> None:
    # From rest: distance 4.24 - 0.25 at 0.6228 m/s, and 1 / 0.9898 s lost to the speed's response.
    fastest = (math.hypot(3, 3) - 0.25) / 0.6228 + 1 / 0.9898
    dirt = DirtSolver(BENCHMARK, Workspace(ROOM), ACROSS, NO_SAFETY, capacity=20_000)
    costs = [planned(dirt, 4000, seed, CORNER).cost for seed in range(3)]
    assert min(costs) > fastest - 0.02
    assert max(costs) < fastest * 1.06


def test_a_budget_of_seconds_is_kept() -> None:
    dirt = turns(capacity=50_000)
    dirt.start(START, 0)
    began, worked = time.perf_counter(), time.thread_time()
    progress = dirt.grow(seconds=0.05)
    assert time.perf_counter() - began >= 0.05
    assert time.thread_time() - worked < 0.2  # on a busy machine the wall clock runs on while the thread waits
    assert progress.iterations > 100
    stops = iter([False, False, True])
    before = progress.iterations
    assert dirt.grow(stop=lambda: next(stops)).iterations > before
    with pytest.raises(ValueError, match="budget"):
        dirt.grow()


@pytest.mark.parametrize("goal", [Goal((1.0, 5.0), 0.1), Goal((5.0, 5.0), 0.5), Goal((0.5, 1.5), 0.2)])
def test_an_unreachable_goal_gives_no_plan_and_no_far_fetched_cost(goal: Goal) -> None:
    # Behind a closed wall, outside the workspace, inside an obstacle.
    wall = box((1.0, 4.2), (2.4, 0.02))
    dirt = DirtSolver(BENCHMARK, Workspace(TURNS.bounds, (*TURNS.obstacles, wall)), goal, NO_SAFETY, capacity=5000)
    for seed in range(3):
        dirt.start(START, seed)
        progress = dirt.grow(iterations=500)
        assert dirt.unreachable
        assert progress.first_solution is None
        assert progress.nodes == 1
        assert dirt.plan() is None


def test_without_a_goal_reached_the_plan_ends_at_the_smallest_cost_to_go() -> None:
    dirt = turns()
    dirt.start(START, 0)
    while dirt.progress.nodes < 10:
        dirt.grow(iterations=1)
    plan, tree = dirt.plan(), dirt.tree()
    assert plan is not None
    assert not plan.reaches_goal
    assert plan.cost_to_go == tree.costs_to_go[1:].min()
    check_plan(dirt, plan)


def test_with_safety_the_nearest_plan_spans_the_cycle_and_has_a_contingency() -> None:
    dirt = turns(Safety(cycle=1.5))
    for seed in range(10):
        dirt.start(START, seed)
        dirt.grow(iterations=8)
        plan = dirt.plan()
        if plan is not None and not plan.reaches_goal:
            assert plan.cost >= 1.5
            check_plan(dirt, plan)


def test_nothing_leaves_a_start_in_collision_or_outside() -> None:
    dirt = turns()
    for state in ([0.5, 1.5, 0, 0], [0.1, 1.5, 0, 0.3], [2.4, 0, math.pi, 0.6], [1, 6.05, -1.57, 0.6], [9, 9, 0, 0]):
        slack = dirt.start(np.array(state, dtype=float), 0)
        progress = dirt.grow(iterations=300)
        assert slack < 0.0
        assert progress.nodes == 1
        assert dirt.plan() is None


def test_nothing_leaves_a_start_that_is_too_near_for_delta() -> None:
    near = Workspace(ROOM, (box((0.5, 1.0), (0.6, 0.3)),))  # 0.21 m to its left
    start = np.array([0.5, 0.5, 0.0, 0.0])
    for delta, leaves in ((0.05, True), (0.25, False)):
        dirt = DirtSolver(BENCHMARK, near, ACROSS, Safety(delta=delta), capacity=3000)
        dirt.start(start, 0)
        assert (dirt.grow(iterations=200).nodes > 1) == leaves


def test_another_clearance_can_be_asked_for_as_if_it_had_been_from_the_beginning() -> None:
    near, beside = Workspace(ROOM, (box((2.0, 0.2), (4.0, 0.2)),)), np.array([0.5, 0.5, 0.0, 0.0])  # 6 cm beside it
    dirt = DirtSolver(BENCHMARK, near, ACROSS, Safety(delta=0.1), capacity=10_000)
    nothing = np.zeros(2)
    before = dirt.edge(beside, nothing, 0.0, 0.0)[1]
    assert before < 0.0
    dirt.start(beside)
    assert dirt.grow(iterations=50).nodes == 1
    assert dirt.contingency(beside) is None
    dirt.set_delta(0.02)
    assert dirt.safety == Safety(delta=0.02)
    assert dirt.edge(beside, nothing, 0.0, 0.0)[1] == pytest.approx(before + 0.08)
    assert dirt.contingency(beside) is not None
    check_plan(dirt, planned(dirt, start=beside))
    other = DirtSolver(BENCHMARK, near, ACROSS, Safety(delta=0.02), capacity=10_000)
    planned(other, start=beside)
    assert tree_bytes(dirt) == tree_bytes(other)


def test_another_clearance_at_rest_no_longer_grows_with_time() -> None:
    dirt = DirtSolver(BENCHMARK, Workspace(ROOM), ACROSS, Safety(), capacity=10)
    dirt.set_bound(0.1, 0.2, 0.3, 1.5)
    dirt.set_delta(0.05)
    assert dirt.safety == Safety(delta=0.05, delta_per_speed=0.2)
    grown, at_once = (dirt.edge(CORNER, np.zeros(2), 0.0, time)[1] for time in (0.9, 0.0))
    assert grown == at_once


def test_a_smaller_goal_can_be_aimed_for_and_the_first_one_again() -> None:
    dirt = DirtSolver(BENCHMARK, Workspace(ROOM), ACROSS, NO_SAFETY, capacity=10_000)
    planned(dirt, start=CORNER)
    first = tree_bytes(dirt)
    dirt.set_goal_region(0.03)
    assert dirt.goal == replace(ACROSS, radius=0.03)
    plan = planned(dirt, iterations=3000, start=CORNER)
    assert plan.reaches_goal
    check_plan(dirt, plan)
    inside = np.array([3.4, 3.4, 0.8, 0.0])  # 0.14 m from the centre
    assert len(planned(dirt, start=inside).durations) > 0
    dirt.set_goal_region(ACROSS.radius)
    assert len(planned(dirt, start=inside).durations) == 0
    planned(dirt, start=CORNER)
    assert tree_bytes(dirt) == first


def test_without_a_goal_there_is_none_whose_radius_can_be_set() -> None:
    with pytest.raises(ValueError, match="no goal to aim for"):
        DirtSolver(BENCHMARK, Workspace(ROOM), None, capacity=10).set_goal_region(0.1)


def test_a_start_inside_the_goal_is_the_solution() -> None:
    dirt = turns()
    assert dirt.start(np.array([1.0, 5.0, 0.0, 0.0]), 0) >= 0.0
    dirt.grow(iterations=200)
    assert dirt.best_node() == (0, True)
    assert dirt.progress.history[-1][1] == 0.0


@pytest.mark.parametrize("goal_heading", [0.0, math.pi / 2, math.pi, -2.0])
def test_a_goal_with_a_heading_is_entered_that_way(goal_heading: float) -> None:
    goal = Goal((2.0, 2.0), 0.3, heading=goal_heading, tolerance=0.2)
    dirt = DirtSolver(BENCHMARK, Workspace(ROOM), goal, NO_SAFETY, capacity=20_000)
    plan = planned(dirt, 15_000, 1, np.array([0.5, 2.0, 0.0, 0.0]))
    assert plan.reaches_goal
    assert abs((plan.states[-1, 2] - goal_heading + math.pi) % (2 * math.pi) - math.pi) <= 0.2
    check_plan(dirt, plan)


@pytest.mark.parametrize("seed", range(3))
def test_a_start_that_faces_away_from_the_goal_is_turned_round(seed: int) -> None:
    # A U-turn 1.4 m wide in the middle of an empty room: every edge of it first leads away from the goal.
    dirt = DirtSolver(BENCHMARK, Workspace(ROOM), Goal((3.5, 2.0), 0.25), NO_SAFETY, capacity=20_000)
    dirt.start(np.array([2.0, 2.0, math.pi, 0.0]), seed)
    dirt.grow(iterations=20_000)
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    check_plan(dirt, plan)


def test_a_plan_shorter_than_the_cycle_has_a_contingency_at_its_end() -> None:
    dirt = DirtSolver(BENCHMARK, Workspace(ROOM), Goal((2.0, 1.0), 0.3), Safety(cycle=8.0, delta=0.02), capacity=10_000)
    plan = planned(dirt, 1500, 0, np.array([1.0, 1.0, 0.0, 0.4]))
    assert plan.reaches_goal
    assert plan.cost < 8.0
    assert plan.contingency is not None
    assert plan.contingency.times[0] == pytest.approx(plan.cost)
    assert np.abs(plan.contingency.states[0] - plan.states[-1]).max() < 1e-12
    check_plan(dirt, plan)


def test_a_full_tree_stops_cleanly_and_keeps_its_plan() -> None:
    for capacity in (100, 500, 2000):
        dirt = DirtSolver(BENCHMARK, TURNS, GOAL, NO_SAFETY, capacity=min(100, capacity), max_nodes=capacity)
        dirt.start(START, 0)
        last = math.inf
        for _ in range(8):
            progress = dirt.grow(seconds=0.02)
            plan = dirt.plan()
            assert progress.nodes <= capacity
            if plan is not None:
                check_plan(dirt, plan)
                if plan.reaches_goal:
                    assert plan.cost <= last
                    last = plan.cost
            elif math.isfinite(last):
                raise AssertionError("the plan was lost")
        assert math.isfinite(last) or capacity == 100


@pytest.mark.parametrize("pruning", [False, True])
def test_by_the_clock_memory_grows_and_does_not_end_the_search(pruning: bool) -> None:
    settings = Settings(pruning=pruning)
    small, large = (DirtSolver(BENCHMARK, TURNS, GOAL, NO_SAFETY, settings, capacity=n) for n in (300, 100_000))
    for _ in range(2):  # the second query begins with the memory of the first
        small.start(START, 4)
        progress = small.grow(seconds=0.2)
        assert progress.seconds >= 0.2
        assert progress.iterations > 600
        large.start(START, 4)
        large.grow(iterations=progress.iterations)
        assert tree_bytes(small) == tree_bytes(large)


def test_a_budget_of_iterations_has_the_same_memory_after_a_search_by_the_clock() -> None:
    fresh, used = (DirtSolver(BENCHMARK, TURNS, GOAL, NO_SAFETY, capacity=300) for _ in range(2))
    used.start(START, 1)
    used.grow(seconds=0.1)
    for dirt in (fresh, used):
        dirt.start(START, 4)
        dirt.grow(iterations=2000)
    assert tree_bytes(fresh) == tree_bytes(used)


def random_scene(seed: int) -> tuple[Workspace, Array, Goal]:
    """A room with obstacles between a start and a goal that are free themselves."""
    rng = np.random.default_rng(seed)
    start = np.array([0.45, 0.45, rng.uniform(-4, 4), rng.uniform(0, 0.6)])
    walls = [box((2, 0), (4, 0.05)), box((2, 4), (4, 0.05)), box((0, 2), (0.05, 4)), box((4, 2), (0.05, 4))]
    obstacles = [random_obstacle(rng, 0.9, 3.1) for _ in range(int(rng.integers(1, 7)))]
    return Workspace(ROOM, (*walls, *obstacles)), start, ACROSS


@pytest.mark.parametrize("block", range(6))
def test_every_plan_in_random_scenes_is_free_and_safe_by_fcl(block: int) -> None:
    plans = 0
    for seed in range(10 * block, 10 * block + 10):
        workspace, start, goal = random_scene(seed)
        safety = [NO_SAFETY, Safety(), Safety(cycle=0.7, delta=0.03, delta_per_speed=0.1)][seed % 3]
        footprint = [Footprint(0.4, 0.28), Footprint(0.3, 0.15, 0.1)][seed % 2]
        dirt = DirtSolver(replace(BENCHMARK, footprint=footprint), workspace, goal, safety, capacity=3000)
        dirt.start(start, seed)
        dirt.grow(iterations=250)
        plan = dirt.plan()
        if plan is None:
            continue
        plans += 1
        check_plan(dirt, plan)
        if plan.contingency is not None:
            exact = ExactClearance(workspace, footprint)
            states = plan.contingency.states
            asked = safety.delta + safety.delta_per_speed * np.abs(states[:, 3])
            assert (exact.distances(states[:, :3]) > asked - 1e-5).all()
            during = plan.trajectory[plan.times <= min(safety.cycle, plan.cost)]
            asked = safety.delta + safety.delta_per_speed * np.abs(during[:, 3])
            assert (exact.distances(during[:, :3]) > asked - 1e-5).all()
    assert plans >= 3


def test_another_vehicle_plans_around_the_corner_too() -> None:
    rover = replace(ROVER, footprint=Footprint(0.3, 0.2, 0.05))
    dirt = DirtSolver(
        rover, Workspace(ROOM, (box((2, 1.5), (0.2, 3)),)), Goal((3.3, 0.7), 0.3), Safety(), capacity=20_000
    )
    dirt.start(np.array([0.6, 0.6, 1.5, 0.0, 0.0]), 1)
    dirt.grow(iterations=15_000)
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    assert (np.abs(plan.trajectory[:, 3]) <= 1.0).all()
    assert (np.abs(plan.trajectory[:, 4]) <= 3.0).all()
    assert ExactClearance(dirt.workspace, rover.footprint).distances(plan.trajectory[:, :3]).min() > 0.0


def test_several_roots_may_begin_a_query() -> None:
    dirt = turns()
    dirt.clear(0)
    dirt.add_root(START)
    dirt.add_root(np.array([1.0, 4.6, math.pi / 2, 0.5]))
    dirt.grow(iterations=300)
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    assert (plan.states[0] == [1.0, 4.6, math.pi / 2, 0.5]).all()
    check_plan(dirt, plan)


@pytest.mark.parametrize("quantum", [0.05, 0.1, 0.25])
def test_a_plan_with_a_quantum_is_as_good_a_plan(quantum: float) -> None:
    dirt = DirtSolver(BENCHMARK, TURNS, GOAL, Safety(), Settings(quantum=quantum), capacity=10_000)
    plan = planned(dirt, 1200)
    assert plan.reaches_goal
    check_plan(dirt, plan)
    dirt.start(plan.states[3], 0)
    dirt.retain(plan, float(np.cumsum(plan.durations)[2]))
    again = dirt.plan()
    assert again is not None
    assert again.cost <= plan.cost - np.cumsum(plan.durations)[2] + 1e-9


def test_walls_alone_let_the_vehicle_through() -> None:
    dirt = DirtSolver(BENCHMARK, Workspace(TURNS.bounds, WALLS), GOAL, NO_SAFETY, capacity=10_000)
    assert planned(dirt, 1500).cost < 10.5


@pytest.mark.parametrize(
    "settings",
    [{"blossom": 33}, {"blossom": 1024}, {"blossom": -1}, {"steps": 0}, {"quantum": 3.0}],
    ids=["33-lanes", "1024-lanes", "minus-1-lane", "no-steps", "quantum-beyond-longest"],
)
def test_settings_that_the_lanes_cannot_hold_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"blossom|steps|quantum"):
        Settings(**settings)  # type: ignore[arg-type]


def test_manoeuvres_of_one_name_are_refused_since_a_contingency_is_known_by_it() -> None:
    with pytest.raises(ValueError, match="manoeuvres names a manoeuvre twice"):
        replace(BENCHMARK, manoeuvres=("brake",) * len(BENCHMARK.manoeuvres))


def test_more_manoeuvres_than_lanes_are_refused() -> None:
    with pytest.raises(ValueError, match="manoeuvres"):
        replace(BENCHMARK, manoeuvres=tuple(f"brake-{k}" for k in range(33)))
