"""Local optimisation makes plans cheaper and smoother, for several vehicles, and leaves the search as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.kernels import GOAL, NO_SAFETY, ROVER, START, TURNS

from kraft.planning.workspace import goal_of, settings_of, start_state, workspace_of
from kraft.scenario import load_scenario
from kraft.vehicles.benchmark import BENCHMARK
from kraft.vehicles.load import load_vehicle
from ompl_ext.kernels import kernel_types as at
from ompl_ext.plan import Plan
from ompl_ext.polish import MOST_LONGER, USUAL, Guess, Polish, divided, guess_of, interval_of
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle
from ompl_ext.verification import verify

ITERATIONS = 1024


def steering_changes(vehicle: Vehicle, plan: Plan) -> float:
    ranges = np.ptp(vehicle.control_bounds, axis=1)
    return float(np.abs(np.diff(plan.controls / ranges, axis=0)).sum())


def plan_of(dirt: DirtSolver, start: np.ndarray, seed: int, iterations: int = ITERATIONS) -> Plan:
    dirt.start(start, seed)
    dirt.grow(iterations=iterations)
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    assert not verify(dirt, plan).problems
    return plan


def turns(polish: bool | None, safety: Safety = NO_SAFETY, **settings: float) -> DirtSolver:
    return DirtSolver(BENCHMARK, TURNS, GOAL, safety, Settings(polish=polish, **settings))


@pytest.mark.parametrize("seed", range(4))
def test_an_optimised_plan_costs_less_and_hardly_changes_its_controls(seed: int) -> None:
    usual, polished = (plan_of(turns(polish), START, seed) for polish in (False, True))
    assert polished.cost < 9.65 < usual.cost
    assert steering_changes(BENCHMARK, polished) < 0.2 * steering_changes(BENCHMARK, usual)


@pytest.mark.parametrize("scenario", ["turns", "boxes"])
def test_smoothing_reduces_the_changes_of_the_controls_and_takes_a_share_of_the_time_at_most(scenario: str) -> None:
    task = load_scenario(scenario).task()
    goal, start = goal_of(task), start_state(task, BENCHMARK)
    dirt = DirtSolver(BENCHMARK, workspace_of(task, BENCHMARK), goal, NO_SAFETY, Settings(polish=False))
    polish, smoothest = Polish(BENCHMARK, dirt.problem), USUAL.smoothnesses[0]
    for seed in range(3):
        plan = plan_of(dirt, start, seed)
        guess = guess_of(BENCHMARK, plan.times, plan.trajectory, plan.controls, plan.durations)
        rough, smooth = (
            polish.improve(guess, goal, smoothness=each) for each in (smoothest._replace(longer=0.0), None)
        )
        assert rough is not None
        assert smooth is not None
        changes = [np.abs(np.diff(each.controls[:, 1])).sum() for each in (rough, smooth)]
        assert changes[1] < 0.98 * changes[0]
        assert smooth.time < (1.0 + MOST_LONGER * smoothest.longer) * rough.time


def test_edges_that_fail_beside_each_other_do_not_add_up_what_clearance_they_ask_for() -> None:
    dirt = turns(polish=False)
    polish, count = Polish(BENCHMARK, dirt.problem), 60
    states = np.linspace(START, START + np.array([0.0, 6.0, 0.0, 0.6]), count + 1)  # straight through both obstacles
    ahead = np.column_stack([np.ones(count), np.zeros(count)])
    polish._load(Guess(states, ahead, np.full(count, 0.16)), GOAL, 0.0, 1.0)
    assert polish._replay() > 10
    margin = polish._work.margin[: count + 1]
    cell = 1.0 / float(dirt.problem.scalar[at.GRID_INVERSE])
    assert margin.max() == pytest.approx(cell)  # the walls are thicker than a cell


@pytest.mark.parametrize(("scenario", "name"), [("boxes", "mushr"), ("posts", "jackal"), ("turns", "unicycle2")])
def test_it_holds_for_other_vehicles(scenario: str, name: str) -> None:
    task, vehicle = load_scenario(scenario).task(), load_vehicle(name)
    plans = []
    for polish in (False, True):
        settings = replace(settings_of(task, vehicle), polish=polish)
        dirt = DirtSolver(vehicle, workspace_of(task, vehicle), goal_of(task), NO_SAFETY, settings)
        plans.append(plan_of(dirt, start_state(task, vehicle), seed=1))
    assert plans[1].cost < 0.99 * plans[0].cost
    # the jackal's way between the posts is almost straight: its controls change by less than their range as it is
    assert steering_changes(vehicle, plans[1]) < max(steering_changes(vehicle, plans[0]), 1.0)


def test_it_holds_for_a_vehicle_defined_in_code_and_a_small_goal() -> None:
    goal = Goal((1.9, 5.5), 0.1)
    start = np.array([1.0, -0.5, np.pi / 2, 0.0, 0.0])
    usual, polished = (
        plan_of(DirtSolver(ROVER, TURNS, goal, NO_SAFETY, Settings(polish=polish)), start, 2, 4096)
        for polish in (False, True)
    )
    assert polished.cost < usual.cost


def test_the_same_iterations_give_the_same_plan_however_they_are_divided() -> None:
    plans = []
    for chunk in (ITERATIONS, ITERATIONS, 128):
        dirt = turns(polish=True)
        dirt.start(START, 5)
        for _ in range(0, ITERATIONS, chunk):
            dirt.grow(iterations=chunk)
        plan = dirt.plan()
        assert plan is not None
        plans.append(plan)
    assert np.array_equal(plans[0].controls, plans[1].controls)
    assert plans[2].cost < 9.65


def test_the_search_does_not_know_of_the_optimisation_until_its_end() -> None:
    counts = []
    for polish in (False, True):
        dirt = turns(polish)
        dirt.start(START, 7)
        progress = dirt.grow(iterations=ITERATIONS)
        counts.append((progress.first_iteration, progress.first_solution, dirt.tree()))
    assert counts[0][0] == counts[1][0]
    assert counts[0][1] is not None
    assert counts[1][1] is not None
    assert counts[0][1][1] == counts[1][1][1]  # the cost of the first plan
    size = len(counts[0][2].parents)
    assert len(counts[1][2].parents) > size
    assert np.array_equal(counts[0][2].states, counts[1][2].states[:size])


def test_without_a_heading_it_is_off_unless_it_is_asked_for() -> None:
    default, off = (plan_of(turns(polish), START, 3) for polish in (None, False))
    assert np.array_equal(default.controls, off.controls)


def test_too_few_iterations_for_an_optimisation_do_not_load_it() -> None:
    dirt = turns(polish=True)
    dirt.start(START, 3)
    dirt.grow(iterations=100)
    assert dirt._polish is None
    dirt.grow(iterations=200)
    assert dirt._polish is not None


def test_an_optimised_plan_has_a_contingency_and_keeps_the_clearance() -> None:
    safety = Safety(delta=0.02, delta_per_speed=0.1, horizon=10.0)
    usual, polished = (plan_of(turns(polish, safety), START, 1) for polish in (False, True))
    assert polished.contingency is not None
    assert polished.cost < usual.cost


def test_durations_are_multiples_of_a_step_where_they_have_to_be() -> None:
    usual, polished = (plan_of(turns(polish, quantum=0.05), START, 1) for polish in (False, True))
    steps = polished.durations / 0.05
    assert np.abs(steps - np.round(steps)).max() < 1e-9
    assert polished.cost < usual.cost


def test_a_trajectory_is_divided_without_changing_it() -> None:
    guess = Guess(np.array([[0.0], [1.0], [3.0]]), np.array([[1.0], [2.0]]), np.array([1.0, 1.0]))
    found = divided(guess, np.array([0.5, 0.5, 0.5, 0.5, 0.5]))
    assert found.states[:, 0].tolist() == [0.0, 0.5, 1.0, 2.0, 3.0, 3.0]
    assert found.controls[:, 0].tolist() == [1.0, 1.0, 2.0, 2.0, 2.0]


def test_intervals_are_short_for_fast_vehicles_and_long_for_long_plans() -> None:
    fast = replace(BENCHMARK, top_speed=6.0)
    assert interval_of(BENCHMARK, 10.0) == 0.1
    assert interval_of(fast, 1.0) == pytest.approx(0.35 * 0.4 / 6.0)
    assert interval_of(fast, 300.0) == 1.0


@pytest.mark.parametrize("nearer_first", [True, False])
def test_with_several_starts_the_reported_cost_is_that_of_the_plan(nearer_first: bool) -> None:
    """Plans from the first start are optimised, those from others stay as they were found."""
    starts = [START, np.add(START, [0.5, 0.5, 0.0, 0.0])]
    dirt, (first, second) = turns(polish=True), starts[::-1] if nearer_first else starts
    dirt.start(first, 0)
    dirt.add_root(second)
    dirt.grow(iterations=1500)
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    assert dirt.progress.history[-1][1] == pytest.approx(plan.cost)
    assert not verify(dirt, plan).problems
