"""SST beside DIRT: the same propagation and checks, sparse trees, costs that fall, plans that verify."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from kraft.planning.plan import plan_task
from kraft.planning.search import Budget, Previous
from kraft.planning.workspace import goal_of, safety_of_task, settings_of, start_state, workspace_of
from kraft.scenario import Task, load_scenario
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats
from ompl_ext.kernels import kernel_types as at
from ompl_ext.query import Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle
from ompl_ext.verification import verify


@cache
def task() -> Task:
    scenario = load_scenario("turns").task()
    return replace(scenario, planning=scenario.planning.model_copy(update={"planner": "sst"}))


@cache
def vehicle() -> Vehicle:
    return load_vehicle("benchmark")


def solver(safety: Safety | None = None) -> DirtSolver:
    settings, maps = settings_of(task(), vehicle()), workspace_of(task(), vehicle())
    return DirtSolver(vehicle(), maps, goal_of(task()), safety or safety_of_task(task()), settings, capacity=20_000)


def start() -> Floats:
    return start_state(task(), vehicle())


def active(subject: DirtSolver) -> Floats:
    """Configurations (n, 4) of the active nodes."""
    tree = subject.tree_arrays
    value = tree.value[: tree.count[at.SIZE]]
    return value[np.isfinite(value[:, at.F]), : at.Q_DIM].copy()


def test_the_task_chooses_the_planner() -> None:
    assert settings_of(task(), vehicle()).planner == "sst"
    assert not settings_of(task(), vehicle()).polish
    with pytest.raises(ValueError, match="rrt"):
        Settings(planner="rrt")


def test_more_iterations_make_plans_cheaper_and_the_same_seed_gives_the_same_plan() -> None:
    subject, found = solver(), []
    for _ in range(2):
        subject.start(start(), 3)
        costs = []
        for iterations in (300, 3000):
            subject.grow(iterations=iterations)
            costs.append(subject.best_cost)
        plan = subject.plan()
        assert plan is not None
        assert plan.reaches_goal
        assert not verify(subject, plan).problems
        assert costs[1] < costs[0]
        found.append((tuple(costs), plan.controls.tobytes()))
    assert found[0] == found[1]
    assert 9.25 < found[0][0][1] < 11.5  # the geodesic at top speed, and DIRT's cost within 15 %


def test_chunks_of_iterations_give_the_plan_of_all_at_once() -> None:
    subject, costs = solver(), []
    for chunks in ((1000,), (400, 600)):
        subject.start(start(), 1)
        for chunk in chunks:
            subject.grow(iterations=chunk)
        costs.append((subject.best_cost, int(subject.tree_arrays.count[at.SIZE])))
    assert costs[0] == costs[1]


def test_every_witness_has_one_active_node() -> None:
    subject = solver()
    subject.start(start(), 0)
    subject.grow(iterations=1500)
    nodes, size = active(subject), int(subject.tree_arrays.count[at.SIZE])
    assert 100 < len(nodes) < size
    near = np.linalg.norm(nodes[:, None] - nodes[None], axis=2) < 0.02  # a fifth of the radius around a witness
    assert near.sum() < 1.5 * len(nodes)


def test_edges_of_an_earlier_plan_are_kept() -> None:
    subject = solver()
    subject.start(start(), 0)
    subject.grow(iterations=800)
    plan = subject.plan()
    assert plan is not None
    elapsed = float(plan.durations[:2].sum())
    subject.start(plan.states[2], 5)
    assert subject.retain(plan, elapsed) == len(plan.durations) - 2
    kept = subject.best_cost
    assert kept == pytest.approx(plan.cost - elapsed)
    subject.grow(iterations=300)
    assert subject.best_cost <= kept


def test_with_safety_every_plan_has_a_contingency() -> None:
    subject = solver(Safety(delta=0.02, delta_per_speed=0.1))
    subject.start(start(), 2)
    subject.grow(iterations=1500)
    plan = subject.plan()
    assert plan is not None
    assert plan.contingency is not None
    assert not verify(subject, plan).problems


def test_plan_task_plans_with_it_and_begins_with_a_previous_plan() -> None:
    first = plan_task(task(), vehicle(), Budget(iterations=500), seed=1)
    assert first.solved
    assert first.safe
    assert first.plan is not None
    again = plan_task(task(), vehicle(), Budget(iterations=100), seed=2, previous=Previous(first.plan, 2.0))
    assert again.plan is not None
    assert again.plan.cost <= first.plan.cost - 2.0 + 0.1
