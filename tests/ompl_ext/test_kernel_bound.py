"""A clearance delta(t, v) that grows with time, and parameters that change, in the kernels."""

from __future__ import annotations

import numpy as np
import pytest
from support.kernels import BENCHMARK, GOAL, NO_SAFETY, ROVER, TURNS
from support.kernels import START as TURNS_START

from ompl_ext.obstacles import Workspace, box
from ompl_ext.problem import _largest_delta
from ompl_ext.query import Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Vehicle

ROOM = Workspace(((0.0, 4.0), (0.0, 4.0)), (box((3.0, 2.0), (1.0, 4.0)),))  # a wall from x = 2.5 m on
STATE = np.array([1.9, 2.0, 0.0, 0.0, 0.0])  # the rover at rest before the wall
REST = np.zeros(2)
SLACK = 0.05  # of its clearance beyond delta at the start, m


def solver(safety: Safety, vehicle: Vehicle = ROVER) -> DirtSolver:
    return DirtSolver(vehicle, ROOM, None, safety, capacity=10)


def tight(horizon: float, cycle: float = 5.0) -> DirtSolver:
    """Solver whose delta leaves `SLACK` at first, and half a second later nothing."""
    clearance = solver(NO_SAFETY).edge(STATE, REST, 0.0)[1]
    assert clearance > 0.2
    return solver(Safety(True, cycle, clearance - SLACK, delta_per_time=2 * SLACK, delta_horizon=horizon))


def test_clearance_is_the_sum_of_its_parts() -> None:
    safety = Safety(delta=0.1, delta_per_speed=0.2, delta_per_time=0.04, delta_horizon=1.5)
    speeds, times = np.array([0.0, 0.5, -0.5, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, np.inf, -1.0])
    assert safety.clearance(speeds, times) == pytest.approx([0.1, 0.2, 0.24, 0.16, 0.1])


@pytest.mark.parametrize(
    ("safety", "largest"),
    [
        (Safety(delta=0.1, delta_per_speed=0.2, delta_per_time=0.1, delta_horizon=2.0), 0.5),
        (Safety(delta=0.1, delta_per_time=0.1, delta_horizon=2.0, near=1.0), 0.2),
        (Safety(delta=0.1, near=1.0, far_delta=0.3), 0.3),
    ],
)
def test_maps_are_made_for_the_largest_clearance_of_all_times(safety: Safety, largest: float) -> None:
    assert _largest_delta(ROVER, safety) == pytest.approx(largest)


def test_another_clearance_is_kept_after_the_near_time() -> None:
    safety = Safety(
        delta=0.1, delta_per_time=0.04, delta_horizon=2.0, near=1.0, far_delta=0.05, far_delta_per_speed=0.2
    )
    speeds, times = np.array([0.0, 0.0, -0.5, 0.0]), np.array([0.0, 1.0, 1.1, np.inf])
    assert safety.clearance(speeds, times) == pytest.approx([0.1, 0.14, 0.15, 0.05])


def test_an_edge_keeps_one_clearance_until_the_near_time_and_another_one_after_it() -> None:
    clearance = solver(NO_SAFETY).edge(STATE, REST, 0.0)[1]
    dirt = solver(Safety(True, 5.0, clearance - SLACK))
    dirt.set_far(0.5, clearance + SLACK, 0.0)
    assert dirt.edge(STATE, REST, 0.5, 0.0)[1] == pytest.approx(SLACK)
    assert dirt.edge(STATE, REST, 0.6, 0.0)[1] < 0.0
    dirt.set_far(0.5, clearance - 2 * SLACK, 1.0)
    assert dirt.edge(STATE, REST, 0.3, 0.6)[1] == pytest.approx(2 * SLACK)


@pytest.mark.parametrize("near", [-0.1, float("nan")])
def test_a_near_time_that_is_no_time_is_refused(near: float) -> None:
    with pytest.raises(ValueError, match="not negative"):
        Safety(near=near)


@pytest.mark.parametrize("name", ["far_delta", "far_delta_per_speed", "delta_per_time", "delta_horizon"])
@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_a_growth_that_is_no_number_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match="not negative"):
        Safety(**{name: value})


def test_a_clearance_between_delta_at_the_begin_and_later_suffices_at_the_begin_only() -> None:
    dirt = tight(horizon=2.0)
    assert dirt.edge(STATE, REST, 0.0, 0.0)[1] == pytest.approx(SLACK)
    assert dirt.edge(STATE, REST, 0.4, 0.0)[1] == pytest.approx(0.2 * SLACK)
    assert dirt.edge(STATE, REST, 0.0, 0.6)[1] < 0.0
    assert dirt.edge(STATE, REST, 0.6, 0.0)[1] < 0.0
    assert dirt.edge(STATE, REST, 0.5, 5.5)[1] > 0.2  # after the cycle it needs none


def test_the_clearance_grows_no_further_than_until_the_horizon() -> None:
    assert tight(horizon=0.3).edge(STATE, REST, 1.0, 3.0)[1] == pytest.approx(0.4 * SLACK)


@pytest.mark.parametrize(("cycle", "is_safe"), [(0.0, True), (0.4, True), (1.0, False)])
def test_a_contingency_begins_with_the_clearance_of_the_end_of_the_cycle(cycle: float, is_safe: bool) -> None:
    assert (tight(horizon=2.0, cycle=cycle).contingency(STATE) is not None) == is_safe


def test_the_clearance_grows_along_a_contingency() -> None:
    """At 0.6 m/s the rover brakes for over a second, and ends too near for delta then, but not for delta at first."""
    state = np.array([1.89, 2.0, 0.0, 0.6, 0.0])
    constant, growing = (
        solver(Safety(True, 0.0, 0.1, delta_per_time=growth, delta_horizon=5.0)).contingency(state)
        for growth in (0.0, 0.1)
    )
    assert constant is not None
    assert 0.0 < constant.slack < 0.1
    assert growing is None


def test_a_bound_that_is_set_is_that_of_a_new_solver() -> None:
    values = (0.03, 0.05, 0.02, 1.5)
    ours = DirtSolver(BENCHMARK, TURNS, GOAL, Safety(), capacity=5000)
    ours.set_bound(*values)
    fresh = DirtSolver(BENCHMARK, TURNS, GOAL, Safety(True, 1.0, *values), capacity=5000)
    assert ours.safety == fresh.safety
    assert same_plan(ours, fresh)


def test_parameters_that_are_set_are_those_of_a_new_solver() -> None:
    changed = BENCHMARK.with_parameters({"wheelbase": 0.4, "rate": 1.3})
    ours, fresh = (DirtSolver(vehicle, TURNS, GOAL, Safety(), capacity=5000) for vehicle in (BENCHMARK, changed))
    before = ours.edge(TURNS_START, np.array([1.0, 0.5]), 0.9)[0]
    ours.set_parameters(changed.parameter_array)
    assert ours.vehicle.parameters == changed.parameters
    assert not np.allclose(ours.edge(TURNS_START, np.array([1.0, 0.5]), 0.9)[0], before, atol=1e-3)
    assert same_plan(ours, fresh)


def test_setting_parameters_does_not_change_the_vehicle_of_others() -> None:
    ours, other = (DirtSolver(BENCHMARK, ROOM, None, capacity=10) for _ in range(2))
    gain = BENCHMARK.parameters["gain"]
    ours.set_parameters(2.0 * BENCHMARK.parameter_array)
    assert (BENCHMARK.parameters["gain"], other.problem.parameters[0]) == (gain, gain)


def test_a_wrong_number_of_parameters_is_refused() -> None:
    with pytest.raises(ValueError, match="argument"):
        DirtSolver(BENCHMARK, ROOM, None, capacity=10).set_parameters(np.ones(3))


def same_plan(one: DirtSolver, other: DirtSolver) -> bool:
    plans = []
    for dirt in (one, other):
        dirt.start(TURNS_START, 1)
        dirt.grow(iterations=800)
        plans.append(dirt.plan())
    assert plans[0] is not None
    assert plans[1] is not None
    return np.array_equal(plans[0].trajectory, plans[1].trajectory)
