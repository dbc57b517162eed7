"""Maps and large workspaces: the two distance fields never promise more room than there is, and lose at most 2 cm."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.kernels import BENCHMARK, GOAL, NO_SAFETY, point_to_segment

from ompl_ext.exact import ExactClearance
from ompl_ext.kernels.clearance import BEYOND_REACH, MAX_CELLS, cover, fields
from ompl_ext.kernels.fine_field import LARGEST_SPACINGS
from ompl_ext.obstacles import Circle, Obstacle, OccupancyGrid, Polygon, Workspace, box
from ompl_ext.query import Goal, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Footprint

FCL_ERROR = 2e-6
LOSS = Settings().cell
FOOTPRINT = Footprint(0.4, 0.28, 0.05)
seeds = st.integers(0, 2**32 - 1)
yaws = st.sampled_from([0.0, 0.0, 0.3, math.pi / 2, -2.5])
resolutions = st.sampled_from([0.01, 0.02, 0.028, 0.03, 0.05, 0.1, 0.25])


def random_map(seed: int, resolution: float, yaw: float, share: float = 0.08) -> OccupancyGrid:
    """Map of about 3 m x 2.4 m with random cells, and a wall."""
    rng = np.random.default_rng(seed)
    occupied = rng.random((math.ceil(2.4 / resolution), math.ceil(3.0 / resolution))) < share * resolution
    occupied[rng.integers(len(occupied))] |= rng.random(occupied.shape[1]) < 0.5
    return OccupancyGrid(occupied, resolution, (*rng.uniform(-0.5, 1.5, 2), yaw))


def scene(seed: int, resolution: float, yaw: float, *others: Obstacle) -> Workspace:
    return Workspace(((-1.0, 4.0), (-1.5, 4.0)), (random_map(seed, resolution, yaw), *others))


def distance_to_cells(grid: OccupancyGrid, points: np.ndarray) -> np.ndarray:
    """Exact distances (n,) of points to the occupied cells, by all cells."""
    x, y, yaw = grid.origin
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    local = (points - (x, y)) @ turn
    rows, columns = np.nonzero(grid.occupied)
    low = np.column_stack([columns, rows]) * grid.resolution
    if not len(low):
        return np.full(len(points), math.inf)
    gap = np.maximum(np.maximum(low - local[:, None], local[:, None] - low - grid.resolution), 0.0)
    return np.hypot(*np.moveaxis(gap, -1, 0)).min(axis=1)


def true_distances(workspace: Workspace, points: np.ndarray) -> np.ndarray:
    """Exact distances (n,) of points to maps, discs and convex polygons, without FCL."""
    least = np.full(len(points), math.inf)
    for obstacle in workspace.obstacles:
        if isinstance(obstacle, OccupancyGrid):
            least = np.minimum(least, distance_to_cells(obstacle, points))
        elif isinstance(obstacle, Circle):
            least = np.minimum(least, np.maximum(np.hypot(*(points - obstacle.center).T) - obstacle.radius, 0.0))
        else:
            corners, after = obstacle.vertices, np.roll(obstacle.vertices, -1, axis=0)
            side = after - corners
            cross = side[:, 0] * (points[:, None, 1] - corners[:, 1]) - side[:, 1] * (
                points[:, None, 0] - corners[:, 0]
            )
            inside = np.all(cross >= 0, axis=1) | np.all(cross <= 0, axis=1)
            outline = [min(point_to_segment(p, a, b) for a, b in zip(corners, after, strict=True)) for p in points]
            least = np.minimum(least, np.where(inside, 0.0, outline))
    return least


def pinned(workspace: Workspace, footprint: Footprint = FOOTPRINT, goal: Goal = GOAL) -> DirtSolver:
    return DirtSolver(replace(BENCHMARK, footprint=footprint), workspace, goal, NO_SAFETY, Settings(), capacity=10)


def bounds_at(dirt: DirtSolver, points: np.ndarray) -> np.ndarray:
    """Lower bounds (n,) of the distances of points by the fields of a solver."""
    ((ahead, aside, radius, _),) = dirt.problem.discs  # one disc
    poses = np.column_stack([points - (ahead, aside), np.zeros(len(points))])
    bounds: np.ndarray = dirt.clearances(poses) + radius
    return bounds


POST = Footprint(0.2, 0.2)


def pinned_disc(workspace: Workspace) -> DirtSolver:
    return DirtSolver(replace(BENCHMARK, footprint=POST), workspace, GOAL, NO_SAFETY, Settings(discs=1), capacity=10)


EXTRA = (Circle(np.array([3.2, 3.1]), 0.3), box((0.0, 3.0), (0.8, 0.2), 0.4))


@given(seeds, resolutions, yaws, st.booleans())
@settings(max_examples=40)
def test_the_fields_of_a_map_never_exceed_the_distance_and_lose_at_most_two_centimetres_where_it_matters(
    seed: int, resolution: float, yaw: float, with_others: bool
) -> None:
    workspace = scene(seed, resolution, yaw, *(EXTRA if with_others else ()))
    dirt = pinned_disc(workspace)
    points = np.random.default_rng(seed).uniform((-1.0, -1.5), (4.0, 4.0), (1500, 2))
    bound, true = bounds_at(dirt, points), true_distances(workspace, points)
    assert np.all(bound <= true + 1e-7)
    near = (true > cover(POST, 1).radius + LOSS) & (true < POST.reach + BEYOND_REACH - LOSS)
    assert np.all(true[near] - bound[near] <= LOSS + 0.002)  # squares are rounded down beside shapes
    if not with_others:
        assert np.all(true[near] - bound[near] <= LOSS + 1e-6)


@given(seeds, yaws)
@settings(max_examples=15)
def test_two_maps_that_lie_differently_are_both_kept_away_from(seed: int, yaw: float) -> None:
    second = random_map(seed + 1, 0.04, yaw + 0.7)
    workspace = scene(seed, 0.05, yaw, second)
    dirt = pinned_disc(workspace)
    points = np.random.default_rng(seed).uniform((-1.0, -1.5), (4.0, 4.0), (800, 2))
    bound, true = bounds_at(dirt, points), true_distances(workspace, points)
    assert np.all(bound <= true + 1e-7)
    near = (true > cover(POST, 1).radius + LOSS) & (true < POST.reach + BEYOND_REACH - LOSS)
    assert np.all(true[near] - bound[near] <= LOSS + 0.002)


@given(seeds, resolutions, yaws)
@settings(max_examples=25)
def test_an_accepted_pose_in_a_map_is_free_for_fcl(seed: int, resolution: float, yaw: float) -> None:
    workspace = scene(seed, resolution, yaw, *EXTRA)
    dirt, exact = pinned(workspace), ExactClearance(workspace, FOOTPRINT)
    rng = np.random.default_rng(seed)
    for x, y, theta in np.column_stack([rng.uniform((-1.0, -1.5), (4.0, 4.0), (60, 2)), rng.uniform(-7, 7, 60)]):
        true, slack = exact.distance(x, y, theta), dirt.pose_slack(x, y, theta)
        assert slack <= true + FCL_ERROR
        assert dirt.clearances(np.array([[x, y, theta]]))[0] <= true + FCL_ERROR
        loss = cover(FOOTPRINT).radius - FOOTPRINT.width / 2 + LOSS + 0.002
        if true > loss + 0.05 * math.sqrt(2.0):  # a cover's disc reaches beyond the corners of the footprint
            assert slack >= 0.0


def test_a_corridor_barely_wider_than_the_vehicle_is_driven_through_in_a_map_of_200_metres() -> None:
    occupied = np.zeros((2000, 2000), bool)
    occupied[1000:1005, :], occupied[1000:1005, 995:998] = True, False  # a gap of 0.3 m
    occupied[1000:1005, 800:804] = False
    workspace = Workspace(((0.0, 200.0), (0.0, 200.0)), (OccupancyGrid(occupied, 0.1, (0.0, 0.0, 0.0)),))
    footprint = Footprint(0.4, 0.24)
    dirt = pinned(workspace, footprint, Goal((99.65, 120.0), 0.5))
    poses = np.array([[99.65, y, math.pi / 2] for y in np.arange(99.0, 101.5, 0.01)])
    assert all(dirt.pose_slack(*pose) > 0.0 for pose in poses)


def test_a_large_workspace_without_a_map_has_a_fine_field_near_its_obstacles() -> None:
    posts = tuple(Circle(np.array([x, x]), 0.3) for x in np.linspace(5.0, 95.0, 19))
    workspace = Workspace(((0.0, 100.0), (0.0, 100.0)), posts)
    dirt, rng = pinned_disc(workspace), np.random.default_rng(0)
    assert dirt.problem.field.size < 4.1 * MAX_CELLS
    centres = rng.uniform(5.0, 95.0, 300).round(-1)
    angle, gap = rng.uniform(0, 7, 300), rng.uniform(0.17, 0.6, 300)
    points = np.column_stack([centres + (0.3 + gap) * np.cos(angle), centres + (0.3 + gap) * np.sin(angle)])
    bound, true = bounds_at(dirt, points), true_distances(workspace, points)
    assert np.all(bound <= true + 1e-7)
    assert np.all(true - bound <= LOSS + 0.002)


def test_tiny_cells_and_far_distances_stay_within_what_a_vertex_can_hold() -> None:
    occupied = np.zeros((400, 400), bool)
    occupied[200, 200] = True
    workspace = Workspace(((-1.0, 1.4), (-1.0, 1.4)), (OccupancyGrid(occupied, 0.001, (0.0, 0.0, 0.0)),))
    field, fine = fields(workspace, Footprint(0.1, 0.1), 0.07, 0.02)
    assert fine is not None
    assert fine.squares.max() <= LARGEST_SPACINGS**2
    points = np.random.default_rng(1).uniform(-0.9, 1.3, (500, 2))
    true = true_distances(workspace, points)
    assert all(field.at(*p) <= d for p, d in zip(points, true, strict=True))


@pytest.mark.parametrize("shape", [(0, 0), (3, 0), (1, 1)])
def test_an_empty_map_is_free(shape: tuple[int, int]) -> None:
    workspace = Workspace(((0.0, 2.0), (0.0, 2.0)), (OccupancyGrid(np.zeros(shape, bool), 0.05, (0.0, 0.0, 0.0)),))
    assert pinned(workspace).pose_slack(1.0, 1.0, 0.3) > 0.5


def test_polygons_beside_a_map_keep_their_corners() -> None:
    spike = Polygon(np.array([[2.0, 2.0], [2.3, 2.02], [2.0, 2.04]]))
    workspace = scene(3, 0.05, 0.0, spike)
    dirt = pinned_disc(workspace)
    points = np.array([[2.3 + 0.2, 2.02], [2.0 - 0.2, 2.02], [2.1, 2.3]])
    assert np.all(bounds_at(dirt, points) <= true_distances(workspace, points) + 1e-7)


def test_the_fine_field_is_the_same_on_any_number_of_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    workspace = scene(4, 0.1, 0.3, Circle(np.array([3.0, 3.0]), 0.3), box((0.0, 3.0), (1.0, 0.4), 0.5))
    found = []
    for threads in (1, 3):
        monkeypatch.setattr("ompl_ext.kernels.fine_field.THREADS", threads)
        _, fine = fields(workspace, FOOTPRINT, cover(FOOTPRINT).radius, LOSS)
        assert fine is not None
        found.append((fine.tile.tobytes(), fine.squares.tobytes()))
    assert found[0] == found[1]
