"""The cost-to-go is the geodesic distance over top speed, and hardly ever above it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.kernels import BENCHMARK, NO_SAFETY, random_workspace

from ompl_ext.kernels.clearance import ClearanceField, clearance_field
from ompl_ext.kernels.costtogo import UNREACHABLE, CostToGo, cost_to_go, seconds_to_goal
from ompl_ext.obstacles import Circle, OccupancyGrid, Workspace, box
from ompl_ext.problem import make_problem
from ompl_ext.query import Goal
from ompl_ext.query import Settings as PlannerSettings

ROOM = ((0.0, 4.0), (0.0, 4.0))


def togo_of(
    workspace: Workspace, goal: tuple[float, float], radius: float = 0.25, speed: float = 1.0, inscribed: float = 0.1
) -> CostToGo:
    return cost_to_go(clearance_field(workspace, 0.3), inscribed, goal, radius, speed)


def at(togo: CostToGo, x: float, y: float) -> float:
    """Bilinear interpolation, written a second time."""
    u, v = (x - togo.origin[0]) / togo.cell - 0.5, (y - togo.origin[1]) / togo.cell - 0.5
    c, r = math.floor(u), math.floor(v)
    u, v = u - c, v - r
    s = togo.seconds.astype(float)
    return float((s[r, c] * (1 - u) + s[r, c + 1] * u) * (1 - v) + (s[r + 1, c] * (1 - u) + s[r + 1, c + 1] * u) * v)


@pytest.mark.parametrize("goal", [(2.0, 2.0), (0.3, 3.7), (1.013, 2.207)])
@pytest.mark.parametrize("radius", [0.05, 0.25, 1.0])
def test_in_an_empty_room_it_is_the_straight_distance_to_the_region(goal: tuple[float, float], radius: float) -> None:
    togo = togo_of(Workspace(ROOM), goal, radius, speed=0.5)
    for x, y in np.random.default_rng(0).uniform(0, 4, (300, 2)):
        exact = max(math.hypot(x - goal[0], y - goal[1]) - radius, 0.0) / 0.5
        assert -0.02 / 0.5 < at(togo, x, y) - exact < 0.006 / 0.5


def test_around_one_corner_it_is_the_taut_string() -> None:
    # A thin wall from the left side; the inscribed disc has to keep 0.1 m away from its tip at (2, 2).
    workspace = Workspace(ROOM, (box((0.75, 2.0), (2.5, 1e-3)),))
    togo = togo_of(workspace, (0.8, 3.2), inscribed=0.1)
    errors = []
    for x, y in np.random.default_rng(1).uniform((0.2, 0.2), (1.8, 1.5), (200, 2)):
        string = around_disc(np.array([x, y]), np.array([0.8, 3.2]), np.array([2.0, 2.0]), 0.1) - 0.25
        errors.append(at(togo, x, y) - string)
    assert min(errors) > -0.06  # a cell counts as free where its best point is
    assert max(errors) < 0.03


def around_disc(a: np.ndarray, b: np.ndarray, centre: np.ndarray, r: float) -> float:
    """Length of the shortest way from a to b that passes the disc on its right-hand side (b above, a below)."""
    da, db = np.linalg.norm(a - centre), np.linalg.norm(b - centre)
    to_a, to_b = math.atan2(*(a - centre)[::-1]), math.atan2(*(b - centre)[::-1])
    turn = (to_b - to_a) % (2 * math.pi) - math.acos(r / da) - math.acos(r / db)
    return math.sqrt(da**2 - r**2) + math.sqrt(db**2 - r**2) + r * turn


def test_it_never_falls_faster_than_a_free_straight_way_is_long() -> None:
    # A lower bound may not exceed the length of a free way plus the bound at its end.
    worst = 0.0
    for seed in range(5):
        field = clearance_field(random_workspace(seed, most=4, size=4.0), 0.3)
        togo = cost_to_go(field, 0.1, (3.5, 3.5), 0.25, 1.0)
        ends = np.random.default_rng(seed).uniform(0.05, 3.95, (400, 2, 2))
        for p, q in ends:
            if free_between(field, p, q, 0.1):
                worst = max(worst, abs(at(togo, *p) - at(togo, *q)) - math.dist(p, q))
    assert worst < 0.02


def free_between(field: ClearanceField, p: np.ndarray, q: np.ndarray, needed: float) -> bool:
    """Whether a disc can surely roll straight from p to q."""
    ways = np.linspace(p, q, max(2, int(math.dist(p, q) / 0.02)))
    columns, rows = ((ways - field.origin) // field.cell).astype(int).T
    return bool((field.values[rows, columns] >= needed).all())


def test_it_falls_along_a_straight_way_to_the_goal() -> None:
    togo = togo_of(Workspace(ROOM), (3.5, 2.0))
    values = [at(togo, x, 1.3 + 0.2 * x) for x in np.linspace(0.1, 3.2, 200)]
    assert (np.diff(values) < 1e-6).all()


@pytest.mark.parametrize("thickness", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_behind_closed_walls_nothing_is_reachable(thickness: float, yaw: float) -> None:
    c, s = math.cos(yaw), math.sin(yaw)
    sides = [((0.5, 0.0), (thickness, 1.0)), ((-0.5, 0.0), (thickness, 1.0)), ((0.0, 0.5), (1.0, thickness)),
             ((0.0, -0.5), (1.0, thickness))]  # fmt: skip
    walls = [box((2 + c * x - s * y, 2 + s * x + c * y), size, yaw) for (x, y), size in sides]
    togo = togo_of(Workspace(ROOM, tuple(walls)), (2.0, 2.0), 0.2)
    for x, y in [(0.2, 0.2), (3.8, 0.5), (1.2, 3.5), (2.0, 3.2)]:
        assert at(togo, x, y) >= 0.99 * UNREACHABLE
    assert at(togo, 2.1, 2.1) < 1.0


def test_a_gap_narrower_than_the_inscribed_disc_is_closed_and_a_wider_one_is_open() -> None:
    def through(gap: float) -> float:
        half = (4.0 - gap) / 2
        walls = (box((half / 2 - 0.5, 2.0), (half + 1, 0.1)), box((4.5 - half / 2, 2.0), (half + 1, 0.1)))
        return at(togo_of(Workspace(((0.0, 4.0), (0.0, 4.0)), walls), (2.0, 3.5), inscribed=0.14), 2.0, 0.5)

    assert through(0.281) == pytest.approx(2.75, abs=0.02)
    assert through(0.20) >= 0.99 * UNREACHABLE


def test_a_goal_inside_an_obstacle_or_outside_the_room_is_out_of_reach() -> None:
    for goal in ((2.0, 2.0), (9.0, 9.0), (-50.0, 2.0)):
        togo = togo_of(Workspace(ROOM, (Circle(np.array([2.0, 2.0]), 0.8),)), goal)
        assert at(togo, 0.5, 0.5) >= 0.99 * UNREACHABLE


def test_twice_the_top_speed_takes_half_the_time() -> None:
    workspace = random_workspace(3, size=4.0)
    slow, quick = (togo_of(workspace, (3.5, 3.5), speed=v).seconds.astype(float) for v in (0.5, 1.0))
    known = (slow < 1e6) & (quick < 1e6)
    assert np.allclose(slow[known], 2 * quick[known], rtol=1e-6)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_where_the_body_can_stand_the_value_is_a_time_or_out_of_reach_and_nothing_between(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = OccupancyGrid(rng.random((12, 12)) < 0.25, 0.32, (0.1, 0.1, rng.uniform(-0.1, 0.1)))
    workspace = Workspace(ROOM, (cells,))
    field = clearance_field(workspace, 0.3)
    togo = cost_to_go(field, 0.05, (3.5, 3.5), 0.25, 1.0)
    for x, y in rng.uniform(0, 4, (400, 2)):
        if field.at(x, y) >= 0.05:
            assert at(togo, x, y) < 1e3 or at(togo, x, y) > 0.99 * UNREACHABLE


def test_the_kernel_interpolates_as_it_should() -> None:
    workspace = random_workspace(5, size=4.0)
    problem = make_problem(BENCHMARK, workspace, Goal((3.5, 3.5), 0.25), NO_SAFETY, PlannerSettings())
    scalar = problem.scalar
    togo = CostToGo(problem.togo, (float(scalar[13]), float(scalar[14])), 1 / float(scalar[15]))
    for x, y in np.random.default_rng(2).uniform(0, 4, (200, 2)):
        assert seconds_to_goal(problem, x, y) == pytest.approx(at(togo, x, y), rel=1e-9, abs=1e-9)


def test_the_goal_region_itself_costs_next_to_nothing() -> None:
    togo = togo_of(Workspace(ROOM), (2.0, 2.0), 0.25)
    angles = np.linspace(0, 2 * math.pi, 100)
    rim = [at(togo, 2 + 0.2499 * math.cos(a), 2 + 0.2499 * math.sin(a)) for a in angles]
    assert max(rim) < 0.006
    assert at(togo, 2.0, 2.0) == 0.0
