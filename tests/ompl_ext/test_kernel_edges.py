"""Edges: the integrator against a second one, and the swept guarantee against dense poses judged by FCL."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.kernels import (
    BENCHMARK,
    GOAL,
    NO_SAFETY,
    ROVER,
    START,
    TURNS,
    Array,
    Rate,
    benchmark_rate,
    fast,
    integrate,
    random_workspace,
    rover_rate,
    turns,
)  # fmt: skip

from ompl_ext.exact import ExactClearance
from ompl_ext.obstacles import Circle, Obstacle, Workspace, box
from ompl_ext.query import Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Footprint, Vehicle, derivative

OPEN = Workspace(((-40.0, 40.0), (-40.0, 40.0)))
seeds = st.integers(0, 2**32 - 1)


def wide(vehicle: Vehicle, steps: int = 10) -> DirtSolver:
    return DirtSolver(vehicle, OPEN, GOAL, NO_SAFETY, Settings(steps=steps, cell=1.0), capacity=10)


WIDE, ROVING = wide(BENCHMARK), wide(ROVER)
UNLIMITED = replace(ROVER, limits=dict.fromkeys(ROVER.limits, (-math.inf, math.inf)))  # the kernels are the rover's


def random_control(vehicle: Vehicle, rng: np.random.Generator) -> Array:
    low, high = vehicle.control_bounds.T
    return np.asarray(np.where(rng.random(len(low)) < 0.4, rng.choice([low, high]), rng.uniform(low, high)))


@given(seeds, st.floats(0.01, 2.0))
@settings(max_examples=100)
def test_an_edge_is_the_runge_kutta_trajectory_of_the_equations(seed: int, duration: float) -> None:
    rng = np.random.default_rng(seed)
    state = np.array([*rng.uniform(-20, 20, 2), rng.uniform(-100, 100), rng.uniform(0, 0.6)])
    control = random_control(BENCHMARK, rng)
    trajectory, slack = WIDE.edge(state, control, duration)
    expected = integrate(benchmark_rate(), state, control, duration, 10)
    assert slack >= 0.0
    assert np.abs(trajectory - expected).max() < 1e-9


@given(seeds, st.floats(0.01, 2.0))
@settings(max_examples=50)
def test_a_vehicle_of_other_dimensions_is_integrated_as_well(seed: int, duration: float) -> None:
    rng = np.random.default_rng(seed)
    state, control = np.array([*rng.uniform(-9, 9, 3), *rng.uniform(-1, 1, 2)]), random_control(ROVER, rng)
    trajectory, _ = ROVING.edge(state, control, duration)
    assert np.abs(trajectory - integrate(rover_rate, state, control, duration, 10)).max() < 1e-9


def test_parameters_reach_the_equations() -> None:
    vehicle = fast(gain=3.0, rate=7.0, steering_max=1.1, wheelbase=0.5)
    state, control = np.array([0.0, 0.0, 0.4, 1.0]), np.array([0.8, -0.7])
    trajectory, _ = wide(vehicle).edge(state, control, 0.5)
    assert np.abs(trajectory - integrate(benchmark_rate(vehicle), state, control, 0.5, 10)).max() < 1e-9


@pytest.mark.parametrize("steps", [1, 2, 5, 10, 33])
def test_an_edge_has_as_many_steps_as_the_settings_say(steps: int) -> None:
    trajectory, _ = wide(BENCHMARK, steps).edge(START, np.array([1.0, 0.3]), 0.7)
    assert trajectory.shape == (steps + 1, 4)
    assert np.abs(trajectory - integrate(benchmark_rate(), START, np.array([1.0, 0.3]), 0.7, steps)).max() < 1e-9


@pytest.mark.parametrize("quantum", [0.05, 0.1])
def test_with_a_quantum_every_edge_takes_a_step_a_quantum(quantum: float) -> None:
    settings = Settings(shortest=0.2, longest=0.8, quantum=quantum)
    dirt = DirtSolver(BENCHMARK, TURNS, GOAL, NO_SAFETY, settings, capacity=3000)
    dirt.start(START, 3)
    dirt.grow(iterations=600)
    tree = dirt.tree()
    counts = tree.durations[1:] / quantum
    assert np.abs(counts - np.round(counts)).max() < 1e-9
    assert 0.2 - quantum / 2 <= tree.durations[1:].min()
    assert tree.durations[1:].max() <= 0.8 + 1e-9
    for node in range(1, 200):
        state, control, duration = tree.states[tree.parents[node]], tree.controls[node], tree.durations[node]
        trajectory, _ = dirt.edge(state, control, duration)
        assert len(trajectory) == round(duration / quantum) + 1
        assert (trajectory[-1] == tree.states[node]).all()
        assert (
            np.abs(trajectory - integrate(benchmark_rate(), state, control, duration, len(trajectory) - 1)).max() < 1e-9
        )


def test_an_edge_with_more_steps_than_memory_is_refused() -> None:
    dirt = DirtSolver(BENCHMARK, OPEN, GOAL, NO_SAFETY, Settings(longest=1.0, quantum=0.1, cell=1.0), capacity=10)
    with pytest.raises(ValueError, match="longer than the longest"):
        dirt.edge(START, np.array([1.0, 0.2]), 2.0)


def test_an_edge_of_another_number_of_values_is_refused() -> None:
    dirt = wide(BENCHMARK, 10)
    with pytest.raises(ValueError, match="the control has 1 values; expected 2: throttle, steering"):
        dirt.edge(START, np.array([1.0]), 0.5)
    with pytest.raises(ValueError, match="the state has 1 values; expected 4: x, y, theta, v"):
        dirt.edge(START[:1], np.array([1.0, 0.2]), 0.5)


@derivative
def _plate_motion(x, u, p):  # type: ignore[no-untyped-def]
    return x[3], x[4], 1e303 * u[2], u[0], u[1]


@derivative
def _plate_stop(x, p, k):  # type: ignore[no-untyped-def]
    return -3.0 * x[3], -3.0 * x[4], 0.0


PLATE = Vehicle(  # moves without regard to its heading, which a derivative without bounds turns
    name="plate",
    derivative=_plate_motion,
    stop=_plate_stop,
    state=("x", "y", "theta", "vx", "vy"),
    controls={"x": (-2.0, 2.0), "y": (-2.0, 2.0), "spin": (-1e12, 1e12)},
    rest=("vx", "vy"),
    footprint=Footprint(0.5, 0.2),
    top_speed=1.0,
)


@pytest.mark.parametrize(("spin", "heading"), [(1e-303, 0.5), (1e-296, 5e6), (1.0, 5e302), (1e12, math.inf)])
def test_an_edge_whose_heading_has_no_sine_is_outside(spin: float, heading: float) -> None:
    trajectory, slack = wide(PLATE).edge(np.zeros(5), np.array([0.2, 0.0, spin]), 0.5)
    assert trajectory[-1, 0] == pytest.approx(0.025)
    assert trajectory[-1, 2] == pytest.approx(heading)
    assert slack > 0.0 if heading < 1e6 else slack == -1.0  # what a pose outside the bounds has


@pytest.mark.parametrize("blossom", [1, 2, 3, 5, 16, 31, 32])
def test_a_lane_does_not_feel_its_neighbours(blossom: int) -> None:
    dirt = turns(settings=Settings(blossom=blossom))
    dirt.start(START, blossom)
    dirt.grow(iterations=400)
    tree = dirt.tree()
    assert len(tree.states) > 5
    for node in range(1, min(len(tree.states), 300)):
        alone, slack = dirt.edge(tree.states[tree.parents[node]], tree.controls[node], tree.durations[node], 9.0)
        assert alone[-1].tobytes() == tree.states[node].tobytes()
        assert slack >= 0.0


def between_samples(rate: Rate, trajectory: Array, control: Array, duration: float, dense: int = 20) -> Array:
    """Poses along each step, from the step's own beginning."""
    h = duration / (len(trajectory) - 1)
    pieces = [integrate(rate, state, control, h, dense)[:-1, :3] for state in trajectory[:-1]]
    return np.vstack([*pieces, trajectory[-1:, :3]])


def outline_points(footprint: Footprint) -> Array:
    corners = footprint.corners()
    t = np.linspace(0, 1, 9)[:-1, None]
    return np.vstack([corners[k - 1] + t * (corners[k] - corners[k - 1]) for k in range(4)])


def farthest_outside_all_samples(footprint: Footprint, samples: Array, dense: Array) -> Array:
    """The point that the body sweeps and that is farthest from the body at every sample."""
    body = outline_points(footprint)
    c, s = np.cos(dense[:, 2])[:, None], np.sin(dense[:, 2])[:, None]
    x = dense[:, 0, None] + c * body[:, 0] - s * body[:, 1]
    y = dense[:, 1, None] + s * body[:, 0] + c * body[:, 1]
    swept, nearest = np.stack([x.ravel(), y.ravel()], axis=1), np.full(x.size, math.inf)
    for px, py, theta in samples:
        dx, dy = swept[:, 0] - px, swept[:, 1] - py
        along = dx * math.cos(theta) + dy * math.sin(theta) - footprint.offset
        across = dy * math.cos(theta) - dx * math.sin(theta)
        out = np.maximum(np.abs(along) - footprint.length / 2, 0), np.maximum(np.abs(across) - footprint.width / 2, 0)
        nearest = np.minimum(nearest, np.hypot(*out))
    return np.asarray(swept[nearest.argmax()])


FAST = fast(gain=6.0, rate=8.0, steering_max=1.2, wheelbase=0.4)
AGILE = fast(gain=2.0, rate=20.0, steering_max=1.4, wheelbase=0.15)
BODIES = [Footprint(0.4, 0.28), Footprint(0.6, 0.1, 0.25), Footprint(0.2, 0.5), Footprint(0.8, 0.06, -0.3)]
CARS = [(v, benchmark_rate(v)) for v in (BENCHMARK, FAST, AGILE)]


def post_between_the_samples(
    vehicle: Vehicle, rate: Rate, state: Array, control: Array, duration: float, steps: int
) -> tuple[Workspace, Array, Array]:
    """A thin post where an edge can hit it and the samples are farthest from it; samples and dense poses."""
    samples = integrate(rate, state, control, duration, steps)
    dense = between_samples(rate, samples, control, duration)
    post = Circle(farthest_outside_all_samples(vehicle.footprint, samples[:, :3], dense), 0.002)
    low, high = dense[:, :2].min(axis=0) - 0.1, dense[:, :2].max(axis=0) + 0.1
    return Workspace(((low[0], high[0]), (low[1], high[1])), (post,)), samples, dense


def assert_no_post_is_driven_over(
    vehicle: Vehicle, rate: Rate, state: Array, control: Array, duration: float, steps: int
) -> None:
    workspace, _, dense = post_between_the_samples(vehicle, rate, state, control, duration, steps)
    sharp = Settings(steps=steps, cell=0.005, discs=24)
    _, slack = DirtSolver(vehicle, workspace, GOAL, NO_SAFETY, sharp, capacity=10).edge(state, control, duration)
    if slack >= 0.0:
        assert ExactClearance(workspace, vehicle.footprint).distances(dense).min() > 0.0


@given(seeds, st.sampled_from(range(3)), st.sampled_from(BODIES), st.floats(0.1, 1.5), st.integers(3, 10))
@settings(max_examples=40)
def test_a_car_never_drives_over_a_post_between_two_samples(
    seed: int, which: int, body: Footprint, duration: float, steps: int
) -> None:
    rng = np.random.default_rng(seed)
    car, rate = CARS[which]
    state = np.array([0.0, 0.0, rng.uniform(-4, 4), rng.uniform(0, car.top_speed)])
    duration = min(duration, steps / car.parameters["rate"])  # longer steps are too coarse to integrate
    assert_no_post_is_driven_over(replace(car, footprint=body), rate, state, random_control(car, rng), duration, steps)


@given(seeds, st.sampled_from(BODIES), st.floats(0.3, 1.0), st.integers(3, 10))
@settings(max_examples=25)
def test_a_vehicle_that_turns_on_the_spot_never_hits_a_post_between_two_samples(
    seed: int, body: Footprint, duration: float, steps: int
) -> None:
    rng = np.random.default_rng(seed)
    state = np.array([0.0, 0.0, rng.uniform(-4, 4), rng.uniform(-0.9, 0.9), rng.uniform(-2.9, 2.9)])
    limitless = replace(UNLIMITED, footprint=body)
    control = random_control(ROVER, rng) * (0.2, 0.2)
    assert_no_post_is_driven_over(limitless, rover_rate, state, control, duration, steps)


@pytest.mark.parametrize("what", ["drives", "turns"])
def test_a_vehicle_that_goes_there_and_back_within_a_step_never_hits_a_post(what: str) -> None:
    # Speed changes sign in the middle of a step: both ends are the same pose, the middle is not.
    vehicle = replace(UNLIMITED, footprint=Footprint(0.8, 0.06))
    state = np.array([0.0, 0.0, 0.3, 1.0 if what == "drives" else 0.0, 0.0 if what == "drives" else 2.0])
    control = np.array([-2.0, 0.0]) if what == "drives" else np.array([0.0, -4.0])
    assert_no_post_is_driven_over(vehicle, rover_rate, state, control, 1.0, 1)
    assert_no_post_is_driven_over(vehicle, rover_rate, state, control, 1.0, 3)


def thin_posts(rng: np.random.Generator) -> Iterator[Obstacle]:
    for x, y in rng.uniform(0, 3, (8, 2)):
        yield box((x, y), (0.01, 0.01), rng.uniform(-2, 2))


@pytest.mark.parametrize("seed", range(6))
def test_what_the_field_accepts_fcl_finds_free_at_every_moment(seed: int) -> None:
    rng = np.random.default_rng(seed)
    car, rate = CARS[seed % 3]
    car = replace(car, footprint=BODIES[seed % 4])
    obstacles = tuple(thin_posts(rng)) + random_workspace(seed, most=2).obstacles
    workspace = Workspace(((0.0, 3.0), (0.0, 3.0)), obstacles)
    dirt, exact = DirtSolver(car, workspace, GOAL, NO_SAFETY, capacity=10), ExactClearance(workspace, car.footprint)
    accepted = 0
    for _ in range(300):
        state = np.array([*rng.uniform(0.2, 2.8, 2), rng.uniform(-4, 4), rng.uniform(0, car.top_speed)])
        control, duration = random_control(car, rng), rng.uniform(0.1, 1.0)
        trajectory, slack = dirt.edge(state, control, duration)
        if slack >= 0.0 and accepted < 25:
            accepted += 1
            clearance = exact.distances(between_samples(rate, trajectory, control, duration, 5)).min()
            assert clearance > 0.0
            assert slack <= clearance + 1e-5
    assert accepted > 5


@pytest.mark.parametrize("seed", range(4))
def test_inside_the_cycle_an_accepted_edge_keeps_delta_at_every_moment(seed: int) -> None:
    rng, safety = np.random.default_rng(seed), Safety(cycle=1.0, delta=0.05, delta_per_speed=0.1)
    car, rate = CARS[seed % 3]
    workspace = random_workspace(100 + seed, most=4)
    dirt, exact = DirtSolver(car, workspace, GOAL, safety, capacity=10), ExactClearance(workspace, car.footprint)
    accepted = 0
    for _ in range(400):
        state = np.array([*rng.uniform(0.2, 2.8, 2), rng.uniform(-4, 4), rng.uniform(0, car.top_speed)])
        control, duration, start = random_control(car, rng), rng.uniform(0.1, 1.0), rng.uniform(0, 1.2)
        trajectory, slack = dirt.edge(state, control, duration, start)
        if slack < 0.0 or accepted >= 15:
            continue
        accepted += 1
        h = duration / (len(trajectory) - 1)
        dense = np.vstack([integrate(rate, s, control, h, 5)[:-1] for s in trajectory[:-1]] + [trajectory[-1:]])
        times = start + np.linspace(0, duration, len(dense))
        asked = np.where(times <= 1.0, 0.05 + 0.1 * dense[:, 3], 0.0)
        assert (exact.distances(dense[:, :3]) > asked - 1e-5).all()
    assert accepted > 5


def test_an_edge_that_leaves_the_workspace_or_a_limit_is_refused() -> None:
    dirt = DirtSolver(BENCHMARK, Workspace(((0.0, 2.0), (0.0, 2.0))), GOAL, NO_SAFETY, capacity=10)
    forward = np.array([1.0, 0.0])
    assert dirt.edge(np.array([1.0, 1.0, 0.0, 0.5]), forward, 1.0)[1] >= 0.0
    assert dirt.edge(np.array([1.8, 1.0, 0.0, 0.5]), forward, 1.0)[1] < 0.0
    assert ROVING.edge(np.array([0, 0, 0, 0.9, 0.0]), np.array([2.0, 0.0]), 1.0)[1] < 0.0
    assert ROVING.edge(np.array([0, 0, 0, 0.0, 0.0]), np.array([0.5, 0.0]), 1.0)[1] >= 0.0


def test_an_edge_that_begins_outside_the_workspace_is_refused() -> None:
    quick = fast(gain=20.0, rate=10.0)
    dirt = DirtSolver(quick, Workspace(((0.0, 9.0), (0.0, 2.0))), GOAL, NO_SAFETY, capacity=10)
    for x in (-0.05, -0.5, -1.5):
        assert dirt.edge(np.array([x, 1.0, 0.0, 19.0]), np.array([1.0, 0.0]), 0.2)[1] < 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("component", range(4))
def test_a_state_that_is_not_a_number_gives_no_edge(bad: float, component: int) -> None:
    state = np.array([1.0, 1.0, 0.0, 0.0])
    state[component] = bad
    dirt = DirtSolver(BENCHMARK, Workspace(((0.0, 2.0), (0.0, 2.0))), GOAL, NO_SAFETY, capacity=10)
    assert dirt.edge(state, np.array([1.0, 0.0]), 1.0)[1] < 0.0
