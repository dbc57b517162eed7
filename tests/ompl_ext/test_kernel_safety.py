"""SAFETY (Alg. 2) against a second roll-out of every manoeuvre judged by FCL."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.kernels import (
    BENCHMARK,
    GOAL,
    NO_SAFETY,
    ROVER,
    Array,
    benchmark_rate,
    integrate,
    random_workspace,
)  # fmt: skip

from ompl_ext.exact import ExactClearance
from ompl_ext.obstacles import Workspace, box
from ompl_ext.query import REST_SHARE, Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Footprint

STEERING = dict(zip(BENCHMARK.manoeuvres, (0.0, 0.5, -0.5, 1.0, -1.0), strict=True))
SAFETY = Safety(delta=0.03, delta_per_speed=0.1)


def roll_out(manoeuvre: str, state: Array, safety: Safety) -> Array | None:
    """States until standstill, one a step; None if the horizon is too short."""
    control, states = np.array([0.0, STEERING[manoeuvre]]), [state]
    for _ in range(math.ceil(safety.horizon / safety.step)):
        if abs(states[-1][3]) <= safety.rest_speed:
            return np.array(states)
        states.append(integrate(benchmark_rate(), states[-1], control, safety.step, 1)[-1])
    return np.array(states) if abs(states[-1][3]) <= safety.rest_speed else None


def slack(exact: ExactClearance, states: Array, safety: Safety) -> float:
    """Clearance beyond delta(v) at every moment of a braking trajectory."""
    poses, speeds = exact.distances(states[:, :3]), np.abs(states[:, 3])
    return float((poses - safety.delta - safety.delta_per_speed * speeds).min())


def states_in(rng: np.random.Generator, count: int, size: float = 3.0) -> Array:
    return np.column_stack(
        [rng.uniform(0.2, size - 0.2, (count, 2)), rng.uniform(-4, 4, count), rng.uniform(0, 0.6228, count)]
    )


def inside(states: Array, workspace: Workspace) -> bool:
    (x_low, x_high), (y_low, y_high) = workspace.bounds
    x, y = states[:, 0], states[:, 1]
    return bool(((x_low < x) & (x < x_high) & (y_low < y) & (y < y_high)).all())


def test_a_start_in_the_goal_is_a_plan_only_with_a_contingency() -> None:
    wall = box((1.6, 1.0), (0.1, 2.0))
    goal = replace(GOAL, center=(1.0, 1.0), radius=0.3)
    dirt = DirtSolver(BENCHMARK, Workspace(((0.0, 3.0), (0.0, 3.0)), (wall,)), goal, SAFETY)
    moving, resting = np.array([1.2, 1.0, 0.0, 0.6]), np.array([1.0, 1.0, 0.0, 0.0])
    assert dirt.start(moving) >= 0.0
    assert dirt.contingency(moving) is None
    assert dirt.plan() is None
    dirt.grow(iterations=2000)
    plan = dirt.plan()
    assert plan is None or plan.contingency is not None
    dirt.start(resting)
    at_once = dirt.plan()
    assert at_once is not None
    assert (at_once.cost, at_once.contingency is None) == (0.0, False)


def test_a_slow_vehicle_at_its_top_speed_does_not_stand() -> None:
    slow = replace(BENCHMARK, top_speed=0.01)
    dirt = DirtSolver(slow, Workspace(((0.0, 3.0), (0.0, 3.0))), GOAL, Safety())
    state = np.array([1.0, 1.0, 0.0, 0.008])
    assert not Safety().is_resting(slow, state)
    contingency = dirt.contingency(state)
    assert contingency is not None
    assert contingency.states[0, 3] == 0.008
    assert contingency.states[-1, 3] <= REST_SHARE * slow.top_speed < contingency.states[-2, 3]
    assert Safety().is_resting(BENCHMARK, state)


def scene(seed: int) -> tuple[DirtSolver, ExactClearance, Array]:
    workspace = random_workspace(seed, most=4)
    dirt = DirtSolver(BENCHMARK, workspace, GOAL, SAFETY, capacity=10)
    return dirt, ExactClearance(workspace, BENCHMARK.footprint), states_in(np.random.default_rng(seed), 30)


@pytest.mark.parametrize("seed", range(8))
def test_the_manoeuvre_it_returns_keeps_delta_until_standstill(seed: int) -> None:
    dirt, exact, states = scene(seed)
    for state in states:
        contingency = dirt.contingency(state)
        if contingency is None:
            continue
        rolled = roll_out(contingency.manoeuvre, state, SAFETY)
        assert rolled is not None
        assert np.abs(rolled - contingency.states).max() < 1e-9
        assert abs(contingency.states[-1, 3]) <= SAFETY.rest_speed
        assert (np.abs(contingency.states[:-1, 3]) > SAFETY.rest_speed).all()
        assert 0.0 <= contingency.slack <= slack(exact, rolled, SAFETY) + 1e-5
        steering = np.array([0.0, STEERING[contingency.manoeuvre]])
        fine = [integrate(benchmark_rate(), s, steering, SAFETY.step, 3)[:-1] for s in rolled[:-1]]
        assert slack(exact, np.vstack([*fine, rolled[-1:]]), SAFETY) > -1e-5


@pytest.mark.parametrize("seed", range(8))
def test_a_manoeuvre_with_five_centimetres_to_spare_is_never_refused_and_the_first_one_is_taken(seed: int) -> None:
    # Circles and polygons only: a map's cells are blurred by half their diagonal, up to 7 cm here.
    dirt, exact, states = scene(seed + 40)
    if any(hasattr(obstacle, "occupied") for obstacle in dirt.workspace.obstacles):
        dirt = DirtSolver(BENCHMARK, Workspace(dirt.workspace.bounds, (box((1, 2), (0.5, 0.2), 0.3),)), GOAL, SAFETY)
        exact = ExactClearance(dirt.workspace, BENCHMARK.footprint)
    for state in states:
        contingency = dirt.contingency(state)
        taken = BENCHMARK.manoeuvres.index(contingency.manoeuvre) if contingency else len(STEERING)
        for name in BENCHMARK.manoeuvres[:taken]:
            rolled = roll_out(name, state, SAFETY)
            assert rolled is not None
            if inside(rolled, dirt.workspace):
                beyond_rest = 0.02  # a manoeuvre that stands may creep on while others still move
                inner = Workspace(tuple((a + beyond_rest, b - beyond_rest) for a, b in dirt.workspace.bounds))
                assert slack(exact, rolled, SAFETY) <= 0.05 or not inside(rolled, inner)


def test_a_later_manoeuvre_is_taken_where_the_earlier_ones_hit_something() -> None:
    straight_ahead = box((1.55, 1.0), (0.08, 0.08))
    workspace = Workspace(((0.0, 3.0), (0.0, 3.0)), (straight_ahead,))
    dirt = DirtSolver(BENCHMARK, workspace, GOAL, Safety(), capacity=10)
    free = DirtSolver(BENCHMARK, Workspace(workspace.bounds), GOAL, Safety(), capacity=10)
    state = np.array([0.75, 1.0, 0.0, 0.6])
    assert free.contingency(state).manoeuvre == "straight"  # type: ignore[union-attr]
    contingency = dirt.contingency(state)
    assert contingency is not None
    assert contingency.manoeuvre in ("hard-left", "hard-right", "left", "right")
    assert abs(contingency.states[-1, 2]) > 0.2


def test_a_dead_end_at_full_speed_has_no_contingency() -> None:
    wall = Workspace(((0.0, 3.0), (0.0, 3.0)), (box((1.5, 1.5), (0.1, 3.0)),))
    dirt = DirtSolver(BENCHMARK, wall, GOAL, Safety(), capacity=10)
    assert dirt.contingency(np.array([1.15, 1.5, 0.0, 0.6])) is None
    assert dirt.contingency(np.array([0.4, 1.5, 0.0, 0.6])) is not None


@pytest.mark.parametrize(("horizon", "enough"), [(0.5, False), (3.0, False), (4.0, False), (4.3, True), (10.0, True)])
def test_a_manoeuvre_that_does_not_stop_within_the_horizon_is_not_safe(horizon: float, enough: bool) -> None:
    # 0.6 m/s falls below 0.01 m/s after ln(60) / 0.9898 = 4.137 s
    dirt = DirtSolver(BENCHMARK, Workspace(((-5.0, 5.0), (-5.0, 5.0))), GOAL, Safety(horizon=horizon), capacity=10)
    assert (dirt.contingency(np.array([0.0, 0.0, 0.0, 0.6])) is not None) == enough


def test_a_vehicle_at_rest_is_its_own_contingency() -> None:
    dirt = DirtSolver(BENCHMARK, Workspace(((0.0, 2.0), (0.0, 2.0))), GOAL, Safety(), capacity=10)
    contingency = dirt.contingency(np.array([1.0, 1.0, 0.3, 0.005]), after=1.5)
    assert contingency is not None
    assert contingency.states.shape == (1, 4)
    assert contingency.times.tolist() == [1.5]


def test_times_count_steps_from_when_braking_begins() -> None:
    dirt = DirtSolver(BENCHMARK, Workspace(((-5.0, 5.0), (-5.0, 5.0))), GOAL, Safety(step=0.05), capacity=10)
    contingency = dirt.contingency(np.array([0.0, 0.0, 0.0, 0.3]), after=2.0)
    assert contingency is not None
    assert contingency.times[0] == 2.0
    assert np.allclose(np.diff(contingency.times), 0.05)
    assert len(contingency.times) == len(contingency.states)


def test_delta_grows_with_speed() -> None:
    beside = Workspace(((-5.0, 5.0), (-5.0, 5.0)), (box((0.0, 0.3 + 0.14), (10.0, 0.2)),))  # 0.2 m to the left
    state = np.array([-2.0, 0.0, 0.0, 0.6])
    straight = replace(BENCHMARK, footprint=Footprint(0.4, 0.28))
    for per_speed, safe in ((0.0, True), (0.2, True), (0.45, False)):
        dirt = DirtSolver(straight, beside, GOAL, Safety(delta=0.02, delta_per_speed=per_speed), capacity=10)
        contingency = dirt.contingency(state)
        assert (contingency is not None and contingency.manoeuvre == "straight") == safe


@pytest.mark.parametrize("x", [-0.1, -0.6, 3.1, 4.0])
def test_a_state_outside_the_workspace_has_no_contingency(x: float) -> None:
    dirt = DirtSolver(BENCHMARK, Workspace(((0.0, 3.0), (0.0, 3.0))), GOAL, Safety(), capacity=10)
    for v in (0.0, 0.6):
        for theta in (0.0, math.pi):
            assert dirt.contingency(np.array([x, 1.5, theta, v])) is None


def test_a_vehicle_that_also_turns_stands_only_when_it_neither_drives_nor_turns() -> None:
    dirt = DirtSolver(ROVER, Workspace(((-5.0, 5.0), (-5.0, 5.0))), GOAL, Safety(), capacity=10)
    contingency = dirt.contingency(np.array([0.0, 0.0, 0.0, 0.005, 2.5]))
    assert contingency is not None
    assert len(contingency.states) > 5
    assert (np.abs(contingency.states[-1, 3:]) <= 0.01).all()


@pytest.mark.parametrize("seed", range(3))
def test_the_contingency_of_a_plan_begins_where_the_cycle_ends(seed: int) -> None:
    workspace = Workspace(((0.0, 4.0), (0.0, 4.0)), (box((2, 2), (0.6, 1.5)),))
    safety = replace(SAFETY, cycle=1.3)
    dirt = DirtSolver(BENCHMARK, workspace, replace(GOAL, center=(3.5, 2.0)), safety, capacity=5000)
    dirt.start(np.array([0.5, 2.0, 0.0, 0.3]), seed)
    dirt.grow(iterations=1500)
    plan = dirt.plan()
    assert plan is not None
    assert plan.contingency is not None
    assert plan.contingency.times[0] == pytest.approx(1.3)
    exact = ExactClearance(workspace, BENCHMARK.footprint)
    k = int(np.searchsorted(np.cumsum(plan.durations), 1.3))
    into = 1.3 - np.cumsum(plan.durations)[k] + plan.durations[k]
    begins = integrate(benchmark_rate(), plan.states[k], plan.controls[k], into, 200)[-1]
    assert np.abs(plan.contingency.states[0] - begins).max() < 1e-4
    assert slack(exact, plan.contingency.states, safety) > -1e-5
    during = plan.times <= 1.3
    assert slack(exact, plan.trajectory[during], safety) > -1e-5


def test_without_safety_a_plan_may_end_its_cycle_where_it_cannot_stop() -> None:
    # The goal touches a wall: at top speed it is reached, but not by an edge that could still brake.
    wall = Workspace(((0.0, 3.0), (0.0, 3.0)), (box((2.5, 1.5), (0.1, 3.0)),))
    goal, start = replace(GOAL, center=(2.2, 1.5), radius=0.1), np.array([1.55, 1.5, 0.0, 0.6228])
    plans = []
    for safety in (NO_SAFETY, Safety(cycle=2.0)):
        dirt = DirtSolver(BENCHMARK, wall, goal, safety, capacity=5000)
        dirt.start(start, 1)
        dirt.grow(iterations=3000)
        plans.append(dirt.plan())
    fast, safe = plans
    assert fast is not None
    assert fast.contingency is None
    assert safe is None or (safe.contingency is not None and safe.cost > fast.cost)
