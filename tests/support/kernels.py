"""What the kernel tests share: scenes, vehicles, and an independent integrator to judge the kernels by."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from kraft.vehicles.benchmark import BENCHMARK
from ompl_ext.obstacles import Circle, Obstacle, OccupancyGrid, Polygon, Workspace, box
from ompl_ext.plan import Plan
from ompl_ext.query import Goal, Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.trigonometry import cos, sin
from ompl_ext.vehicle import Footprint, Vehicle, derivative

Array = NDArray[np.float64]
Rate = Callable[[Array, Array], Array]

BOUNDS = ((-0.25, 2.25), (-1.0, 6.0))
WALLS = (
    box((-0.25, 2.5), (0.1, 7)),
    box((2.25, 2.5), (0.1, 7)),
    box((1, -1), (2.6, 0.1)),
    box((1, 6), (2.6, 0.1)),
)
TURNS = Workspace(BOUNDS, (*WALLS, box((0.5, 1.5), (1, 1)), box((1.5, 3.5), (1, 1))))
START = np.array([1.0, -0.5, math.pi / 2, 0.0])
GOAL = Goal((1.0, 5.0), 0.25)
NO_SAFETY = Safety(enabled=False, cycle=0.0)
DEFAULT = Settings()


@derivative
def _rover_motion(x, u, p):  # type: ignore[no-untyped-def]
    return x[3] * cos(x[2]), x[3] * sin(x[2]), x[4], u[0], u[1]


@derivative
def _rover_stop(x, p, k):  # type: ignore[no-untyped-def]
    return -3.0 * x[3], -3.0 * x[4]


ROVER = Vehicle(  # second order, drives backwards and turns on the spot
    name="rover",
    derivative=_rover_motion,
    stop=_rover_stop,
    manoeuvres=("brake",),
    state=("x", "y", "theta", "v", "omega"),
    controls={"acceleration": (-2.0, 2.0), "spin": (-4.0, 4.0)},
    limits={"v": (-1.0, 1.0), "omega": (-3.0, 3.0)},
    rest=("v", "omega"),
    footprint=Footprint(0.5, 0.2),
    top_speed=1.0,
)


def rover_rate(x: Array, u: Array) -> Array:
    return np.array([x[3] * math.cos(x[2]), x[3] * math.sin(x[2]), x[4], u[0], u[1]])


def benchmark_rate(vehicle: Vehicle = BENCHMARK) -> Rate:
    """The benchmark's equations of motion, written down a second time."""
    gain, rate, steering_max, wheelbase = vehicle.parameters.values()

    def f(x: Array, u: Array) -> Array:
        beta = math.atan(0.5 * math.tan(steering_max * u[1]))
        heading = x[2] + beta
        return np.array(
            [
                x[3] * math.cos(heading),
                x[3] * math.sin(heading),
                2.0 * x[3] * math.sin(beta) / wheelbase,
                rate * (gain * u[0] - x[3]),
            ]
        )

    return f


def integrate(rate: Rate, state: Array, control: Array, duration: float, steps: int) -> Array:
    """States (steps + 1, nx) by classical Runge-Kutta."""
    h, x = duration / steps, np.asarray(state, dtype=float)
    states = [x]
    for _ in range(steps):
        k1 = rate(x, control)
        k2 = rate(x + h / 2 * k1, control)
        k3 = rate(x + h / 2 * k2, control)
        k4 = rate(x + h * k3, control)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states.append(x)
    return np.array(states)


def random_obstacle(rng: np.random.Generator, low: float = 0.0, high: float = 3.0) -> Obstacle:
    """A box with yaw, a circle, a star that need not be convex, or an occupancy grid with yaw."""
    x, y = rng.uniform(low, high, 2)
    match rng.integers(4):
        case 0:
            return box((x, y), tuple(rng.uniform(0.02, 0.8, 2)), rng.uniform(-4, 4))
        case 1:
            return Circle(np.array([x, y]), rng.uniform(0.01, 0.4))
        case 2:
            angles = np.sort(rng.uniform(0, 2 * math.pi, rng.integers(5, 9)))
            angles = np.linspace(0, 2 * math.pi, len(angles), endpoint=False) + rng.uniform(0, 0.5, len(angles))
            rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
            vertices = rays * rng.uniform(0.08, 0.5, len(angles))[:, None] + (x, y)
            return Polygon(vertices[:: rng.choice([-1, 1])])
        case _:
            cells = rng.random((rng.integers(1, 9), rng.integers(1, 9))) < 0.3
            return OccupancyGrid(cells, rng.uniform(0.02, 0.1), (x, y, rng.uniform(-4, 4)))


def random_workspace(seed: int, most: int = 5, size: float = 3.0) -> Workspace:
    rng = np.random.default_rng(seed)
    obstacles = tuple(random_obstacle(rng, 0.0, size) for _ in range(rng.integers(1, most + 1)))
    return Workspace(((0.0, size), (0.0, size)), obstacles)


@functools.cache
def turns(safety: Safety = NO_SAFETY, settings: Settings = DEFAULT, capacity: int = 20_000) -> DirtSolver:
    """A planner in the scene of two turns; it is shared, so a test calls `start` first."""
    return DirtSolver(BENCHMARK, TURNS, GOAL, safety, settings, capacity)


def fast(**changes: float) -> Vehicle:
    """The benchmark vehicle with other parameters; its kernels are the same."""
    vehicle = BENCHMARK.with_parameters(changes)
    return replace(vehicle, top_speed=vehicle.parameters["gain"])


def tree_bytes(dirt: DirtSolver) -> bytes:
    tree = dirt.tree()
    arrays = (tree.states, tree.parents, tree.controls, tree.durations, tree.costs, tree.costs_to_go)
    return b"".join(a.tobytes() for a in arrays)


def planned(dirt: DirtSolver, iterations: int = 800, seed: int = 0, start: Array = START) -> Plan:
    dirt.start(start, seed)
    dirt.grow(iterations=iterations)
    plan = dirt.plan()
    assert plan is not None
    return plan


def check_plan(dirt: DirtSolver, plan: Plan) -> None:
    """What holds for every plan, by a second integrator and FCL."""
    vehicle, rate = dirt.vehicle, benchmark_rate(dirt.vehicle)
    assert plan.cost == pytest.approx(plan.durations.sum(), abs=1e-9)
    assert plan.times[0] == 0.0
    assert plan.times[-1] == pytest.approx(plan.cost)
    assert (np.diff(plan.times) > 0).all()
    assert (plan.trajectory[0] == plan.states[0]).all()
    assert (plan.trajectory[-1] == plan.states[-1]).all()
    low, high = vehicle.control_bounds.T
    assert ((low <= plan.controls) & (plan.controls <= high)).all()
    dense = []
    for k, (state, control) in enumerate(zip(plan.states, plan.controls, strict=False)):
        flown = integrate(rate, state, control, plan.durations[k], 40)
        assert np.abs(flown[-1] - plan.states[k + 1]).max() < 1e-3
        dense.append(flown)
    poses = np.vstack(dense)[:, :3]
    assert dirt.exact.distances(poses).min() > -1e-9
    assert dirt.exact.distances(plan.trajectory[:, :3]).min() > 0.0
    if plan.reaches_goal and dirt.goal is not None:
        assert math.dist(plan.states[-1, :2], dirt.goal.center) <= dirt.goal.radius
        assert plan.cost_to_go == 0.0
    if dirt.safety.enabled:
        assert plan.contingency is not None
        assert plan.contingency.slack >= 0.0


def point_to_segment(p: Sequence[float], a: Sequence[float], b: Sequence[float]) -> float:
    """Distance in the plane, in plain numbers: arrays of two take ten times as long."""
    along, aside, x, y = b[0] - a[0], b[1] - a[1], p[0] - a[0], p[1] - a[1]
    t = min(max((x * along + y * aside) / max(along * along + aside * aside, 1e-300), 0.0), 1.0)
    return math.hypot(x - t * along, y - t * aside)


def polygon_distance(p: Array, q: Array) -> float:
    """Distance between the outlines of two polygons that do not cross."""
    first, second = p.tolist(), q.tolist()
    there = [point_to_segment(corner, second[k - 1], second[k]) for corner in first for k in range(len(second))]
    back = [point_to_segment(corner, first[k - 1], first[k]) for corner in second for k in range(len(first))]
    return min(*there, *back)


def corners_at(footprint: Footprint, x: float, y: float, theta: float) -> Array:
    c, s = math.cos(theta), math.sin(theta)
    return np.asarray(footprint.corners() @ np.array([[c, s], [-s, c]]) + (x, y))
