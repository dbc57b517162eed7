"""The clearance field and the footprint's cover never promise more room than FCL measures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.kernels import (
    BENCHMARK,
    GOAL,
    NO_SAFETY,
    corners_at,
    point_to_segment,
    polygon_distance,
    random_workspace,
)  # fmt: skip

from ompl_ext.exact import ExactClearance
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels.clearance import clearance_field, cover, tight_clearance
from ompl_ext.kernels.costtogo import value_anywhere
from ompl_ext.obstacles import Circle, Obstacle, OccupancyGrid, Polygon, Workspace, box
from ompl_ext.query import Safety, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.triangulate import triangles
from ompl_ext.vehicle import Footprint

FCL_ERROR = 2e-6  # of its iterative distance (m)
POINT = Footprint(1e-9, 1e-9)
SQUARE = ((0.0, 3.0), (0.0, 3.0))
seeds = st.integers(0, 2**32 - 1)


def points(seed: int, count: int, low: float = 0.0, high: float = 3.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, (count, 2))


@given(seeds, st.sampled_from([0.005, 0.02, 0.05]))
@settings(max_examples=40)
def test_the_field_never_exceeds_the_exact_distance(seed: int, cell: float) -> None:
    workspace = random_workspace(seed)
    field, exact = clearance_field(workspace, 0.1, cell), ExactClearance(workspace, POINT)
    for x, y in points(seed, 60, -0.1, 3.1):
        assert field.at(x, y) <= exact.distance(x, y) + FCL_ERROR


@given(seeds)
@settings(max_examples=15)
def test_the_field_gives_away_no_more_than_its_cells(seed: int) -> None:
    workspace = random_workspace(seed, most=1)
    field = clearance_field(workspace, 0.1, 0.01)
    for point in points(seed, 40):
        allowed = 2 * 0.01 * math.sqrt(0.5) + 1e-5
        assert field.at(*point) >= true_distance(workspace.obstacles[0], point) - allowed


def true_distance(obstacle: Obstacle, point: np.ndarray) -> float:
    """Distance from a point, at most; for a map, what the field may take it for."""
    if isinstance(obstacle, Circle):
        return float(np.hypot(*(point - obstacle.center)) - obstacle.radius)
    if isinstance(obstacle, OccupancyGrid):
        centres = cell_centres(obstacle)
        to_centre = np.hypot(*(point - centres).T).min(initial=math.inf)
        return min(float(to_centre) - obstacle.resolution * math.sqrt(0.5), 1e3)
    return min(-1.0 if inside(obstacle.vertices, point) else math.inf, outline(obstacle.vertices, point))


def cell_centres(grid: OccupancyGrid) -> np.ndarray:
    """Centres (n, 2) of the occupied cells in the world."""
    rows, columns = np.nonzero(grid.occupied)
    local = (np.column_stack([columns, rows]) + 0.5) * grid.resolution
    x, y, yaw = grid.origin
    rotation = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    return local @ rotation.T + np.array([x, y])


def outline(vertices: np.ndarray, point: np.ndarray) -> float:
    return min(point_to_segment(point, vertices[k - 1], vertices[k]) for k in range(len(vertices)))


def inside(vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether each of the points (..., 2) is in the polygon."""
    away = vertices - np.asarray(points)[..., None, :]
    angles = np.arctan2(away[..., 1], away[..., 0])
    turns = (np.diff(angles, append=angles[..., :1]) + math.pi) % (2 * math.pi) - math.pi
    return np.abs(turns.sum(axis=-1)) > 3.0


def pinned_dirt(workspace: Workspace, footprint: Footprint, discs: int = 4) -> DirtSolver:
    vehicle = replace(BENCHMARK, footprint=footprint)
    return DirtSolver(vehicle, workspace, GOAL, NO_SAFETY, Settings(discs=discs), capacity=100)


@given(
    seeds,
    st.floats(0.05, 0.8),
    st.floats(0.05, 0.5),
    st.floats(-0.4, 0.4),
    st.integers(1, 8),
)
@settings(max_examples=25)
def test_the_spare_clearance_of_a_pose_never_exceeds_the_exact_clearance(
    seed: int, length: float, width: float, offset: float, discs: int
) -> None:
    workspace, footprint = random_workspace(seed), Footprint(length, width, offset)
    dirt, exact = pinned_dirt(workspace, footprint, discs), ExactClearance(workspace, footprint)
    headings = np.random.default_rng(seed).uniform(-10, 10, 40)
    for (x, y), theta in zip(points(seed, 40), headings, strict=True):
        slack = dirt.start(np.array([x, y, theta, 0.0]))
        assert slack <= exact.distance(x, y, theta) + FCL_ERROR
        if slack >= 0.0:
            assert exact.distance(x, y, theta) > 0.0


@example(44620, Settings(excess=0.05))  # a disc around others tells more of them than they do
@given(seeds, st.sampled_from([Settings(), Settings(excess=0.05)]))
@settings(max_examples=15)
def test_clearances_of_many_poses_agree_with_the_check_of_each(seed: int, chosen: Settings) -> None:
    workspace, footprint = random_workspace(seed), Footprint(0.44, 0.28, -0.005)
    dirt = DirtSolver(replace(BENCHMARK, footprint=footprint), workspace, GOAL, NO_SAFETY, chosen, capacity=10)
    poses = np.column_stack([points(seed, 60, 0.1, 2.9), np.random.default_rng(seed).uniform(-7.0, 7.0, 60)])
    exact = ExactClearance(workspace, footprint)
    in_groups = bool((dirt.problem.discs[:, 3] > 0).any())
    tolerance = 1.5 / float(dirt.problem.scalar[at.GRID_INVERSE]) if in_groups else 1e-6
    for pose, found in zip(poses, dirt.clearances(poses), strict=True):
        true = exact.distance(*pose)
        assert found <= true + FCL_ERROR
        if 0.0 < true < math.inf:  # infinite without an obstacle
            assert found >= true - 0.2  # what the discs exceed the footprint by, and what the cells lose
        slack = dirt.pose_slack(*pose)
        assert found < 0.0 if slack < 0.0 else found >= slack - tolerance


@given(seeds, st.sampled_from([1, 5, 40]))
@settings(max_examples=15)
def test_the_least_distance_of_poses_is_the_smallest_exact_one(seed: int, count: int) -> None:
    dirt = pinned_dirt(random_workspace(seed), Footprint(0.4, 0.2, 0.1))
    generator = np.random.default_rng(seed)
    poses = np.column_stack([generator.uniform(-0.5, 3.5, (count, 2)), generator.uniform(-7.0, 7.0, count)])
    assert dirt.least_distance(poses) == dirt.exact.distances(poses).min()


def test_a_pose_with_room_to_spare_is_never_refused() -> None:
    footprint = Footprint(0.4, 0.28)
    refused = cover(footprint).radius - footprint.width / 2 + 2 * 0.02 * math.sqrt(0.5) + 0.1 * math.sqrt(2) + 1e-4
    for seed in range(12):
        workspace = random_workspace(seed)
        dirt, exact = pinned_dirt(workspace, footprint), ExactClearance(workspace, footprint)
        for (x, y), theta in zip(points(seed, 40), np.linspace(-4, 4, 40), strict=True):
            if exact.distance(x, y, theta) > refused:
                assert dirt.start(np.array([x, y, theta, 0.0])) >= 0.0


@given(st.floats(0.01, 3.0), st.floats(0.01, 3.0), st.floats(-2.0, 2.0), st.integers(1, 40), seeds)
@settings(max_examples=100)
def test_the_discs_cover_every_point_of_the_footprint(
    length: float, width: float, offset: float, discs: int, seed: int
) -> None:
    footprint = Footprint(length, width, offset)
    centres, radius = cover(footprint, discs)
    inside = footprint.corners()[0] + points(seed, 200, 0.0, 1.0) * (-length, width)
    for point in (*inside, *footprint.corners()):
        assert np.hypot(point[0] - centres, point[1]).min() <= radius + 1e-12


@given(st.floats(0.01, 3.0), st.floats(0.01, 3.0), st.floats(-2.0, 2.0))
@settings(max_examples=100)
def test_reach_holds_and_the_inscribed_disc_is_held_by_the_footprint(
    length: float, width: float, offset: float
) -> None:
    footprint = Footprint(length, width, offset)
    assert np.hypot(*footprint.corners().T).max() == pytest.approx(footprint.reach)
    front, rear = offset + length / 2, offset - length / 2
    to_sides = min(front, -rear, width / 2)
    assert footprint.inscribed == pytest.approx(max(0.0, to_sides))


@given(seeds)
@settings(max_examples=30)
def test_convex_pieces_have_the_polygons_area_and_turn_left(seed: int) -> None:
    shapes = [o for o in random_workspace(seed).obstacles if isinstance(o, Polygon)]
    for shape in shapes:
        assert sum(map(area, triangles(shape.vertices))) == pytest.approx(abs(area(shape.vertices)))
        assert all(area(piece) > 0 for piece in triangles(shape.vertices))


def area(vertices: np.ndarray) -> float:
    x, y = vertices.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


U_SHAPE = Polygon(np.array([[1, 1], [2, 1], [2, 2], [1.7, 2], [1.7, 1.3], [1.3, 1.3], [1.3, 2], [1, 2.0]]))


@pytest.mark.parametrize("vertices", [U_SHAPE.vertices, U_SHAPE.vertices[::-1]])
def test_the_bay_of_a_concave_polygon_is_free_for_both_judges(vertices: np.ndarray) -> None:
    workspace = Workspace(SQUARE, (Polygon(vertices),))
    assert ExactClearance(workspace, POINT).distance(1.5, 1.6) == pytest.approx(0.2, abs=1e-5)
    assert 0.2 - 0.03 < clearance_field(workspace, 0.1).at(1.5, 1.6) <= 0.2


@pytest.mark.parametrize(
    "shape",
    [
        np.array([[1, 1], [2, 1], [2, 2], [1, 2], [1, 1.0]]),
        np.array([[1, 1], [1, 1], [2, 1], [2, 2], [2, 2], [1, 2.0]]),
        np.array([[1, 1], [1.5, 1], [2, 1], [2, 1.5], [2, 2], [1, 2.0]]),
        np.vstack([U_SHAPE.vertices, U_SHAPE.vertices[:1]]),
    ],
    ids=["closed", "repeated", "collinear", "concave-closed"],
)
def test_repeated_and_collinear_vertices_change_nothing(shape: np.ndarray) -> None:
    workspace = Workspace(SQUARE, (Polygon(shape),))
    field, exact = clearance_field(workspace, 0.1), ExactClearance(workspace, POINT)
    assert np.isfinite(field.values).all()
    for point in points(5, 300):
        assert field.at(*point) > true_distance(workspace.obstacles[0], point) - 0.03
        assert field.at(*point) <= max(outline(shape, point), 0.0)
        assert (exact.distance(*point) <= 0.0) == inside(shape, point)


def test_a_pentagram_is_refused_because_it_crosses_itself() -> None:
    angles = math.pi / 2 + np.arange(5) * 4 * math.pi / 5
    with pytest.raises(ValueError, match="cross"):
        triangles(np.stack([np.cos(angles), np.sin(angles)], axis=1))


@given(st.integers(0, 12), st.integers(0, 12), seeds)
@settings(max_examples=60)
def test_rectangles_cover_exactly_the_occupied_cells_once(rows: int, columns: int, seed: int) -> None:
    occupied = np.random.default_rng(seed).random((rows, columns)) < 0.5
    painted = np.zeros((rows, columns), int)
    for row, column, height, width in OccupancyGrid(occupied, 0.1, (0.0, 0.0, 0.0)).rectangles():
        painted[row : row + height, column : column + width] += 1
    assert (painted == occupied).all()


@pytest.mark.parametrize("yaw", [0.0, 0.3, math.pi / 2, -2.5])
def test_full_map_cells_are_the_box_in_their_place(yaw: float) -> None:
    c, s = math.cos(yaw), math.sin(yaw)
    cells = np.zeros((4, 6), bool)
    cells[1:3, 2:5] = True
    middle = 0.1 * np.array([3.5, 2.0])
    place = (1.4 + c * middle[0] - s * middle[1], 1.2 + s * middle[0] + c * middle[1])
    same = box(place, (0.3, 0.2), yaw)
    grid = Workspace(SQUARE, (OccupancyGrid(cells, 0.1, (1.4, 1.2, yaw)),))
    field, exact = clearance_field(grid, 0.1), ExactClearance(grid, Footprint(0.01, 0.01))
    for point in points(3, 200):
        distance = exact.distance(*point)
        if distance > 0.0:
            assert distance == pytest.approx(
                polygon_distance(corners_at(Footprint(0.01, 0.01), *point, 0.0), same.vertices), abs=1e-5
            )
        assert field.at(*point) <= max(outline(same.vertices, point), 0.0)


BOX, POST = box((1.5, 1.5), (1.0, 0.3), 0.4), box((1.5, 1.5), (0.01, 0.01))


@pytest.mark.parametrize("obstacle", [BOX, POST], ids=["box", "post"])
@pytest.mark.parametrize("offset", [0.0, 0.1])
def test_the_exact_clearance_is_exact_near_and_far(obstacle: Polygon, offset: float) -> None:
    footprint = Footprint(0.4, 0.28, offset)
    exact, rng = ExactClearance(Workspace(SQUARE, (obstacle,)), footprint), np.random.default_rng(0)
    for x, y in points(4, 2000):
        theta = rng.uniform(-7, 7)
        distance = exact.distance(x, y, theta)
        if distance > 0.0:
            corners = corners_at(footprint, x, y, theta)
            assert distance == pytest.approx(polygon_distance(corners, obstacle.vertices), abs=1e-5)


def test_the_exact_clearance_of_a_disc_is_exact_near_and_far() -> None:
    disc, footprint = Circle(np.array([1.5, 1.5]), 0.2), Footprint(0.4, 0.28, 0.1)
    exact, rng = ExactClearance(Workspace(SQUARE, (disc,)), footprint), np.random.default_rng(0)
    for x, y in points(4, 2000):
        theta = rng.uniform(-7, 7)
        distance = exact.distance(x, y, theta)
        if distance > 0.0:
            true = outline(corners_at(footprint, x, y, theta), disc.center) - 0.2
            assert distance == pytest.approx(true, abs=3e-4)  # FCL iterates on round shapes


def test_the_exact_clearance_of_a_turned_offset_body_is_what_geometry_says() -> None:
    exact = ExactClearance(Workspace(SQUARE, (Circle(np.array([1.0, 2.0]), 0.25),)), Footprint(0.4, 0.2, 0.1))
    assert exact.distance(1.0, 1.0, 0.0) == pytest.approx(0.65, abs=1e-6)  # its side
    assert exact.distance(1.0, 1.0, math.pi / 2) == pytest.approx(0.45, abs=1e-6)  # its front
    assert exact.distance(1.0, 1.0, -math.pi / 2) == pytest.approx(0.65, abs=1e-6)  # its rear
    assert exact.distance(1.0, 2.0, 0.0) <= 0.0


def test_without_obstacles_there_is_room_without_end() -> None:
    workspace = Workspace(SQUARE)
    assert ExactClearance(workspace, POINT).distance(1.0, 1.0) == math.inf
    assert clearance_field(workspace, 0.1).at(1.0, 1.0) > 1e5


def test_large_workspaces_get_larger_cells_and_keep_the_bound() -> None:
    workspace = Workspace(((0.0, 120.0), (0.0, 60.0)), (Circle(np.array([60.0, 30.0]), 2.0),))
    field, exact = clearance_field(workspace, 0.3), ExactClearance(workspace, POINT)
    assert field.values.size < 4_300_000
    for x, y in points(1, 200, 50.0, 60.0) - (0.0, 20.0):
        assert field.at(x, y) <= exact.distance(x, y) + 1e-5


CORNERS = {
    "the diagonal of an ear passes through another corner": [
        [0.8, 0.9], [0.1, 0.9], [0.1, 0.55], [0.45, 0.55], [0.45, 0.2], [0.8, 0.2],
    ],
    "corners on many common lines": [
        [-0.3, 0.4], [0.0, 0.0], [0.4, 0.3], [0.8, 0.6], [1.2, 0.9], [1.6, 1.2], [1.3, 1.6], [0.9, 1.3], [0.5, 1.0],
        [0.2, 1.4], [0.6, 1.7], [0.3, 2.1], [0.69, 2.4], [0.39, 2.8], [-0.01, 2.5], [-0.4, 2.2], [-0.8, 1.9],
        [-1.2, 1.6], [-0.9, 1.2], [-0.6, 0.8], [-0.2, 1.1], [0.1, 0.7],
    ],
}  # fmt: skip


def covered_alike(vertices: np.ndarray, seed: int) -> None:
    """The pieces turn left and cover what the polygon does, at random points off its outline."""
    pieces = triangles(vertices)
    assert all(area(piece) > 0.0 for piece in pieces)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    points = np.random.default_rng(seed).uniform(low, high, (200, 2))
    points = points[[outline(vertices, point) > 1e-9 for point in points]]
    assert np.array_equal(sum(inside(piece, points).astype(int) for piece in pieces), inside(vertices, points))


def test_a_small_polygon_has_its_area_wherever_it_is() -> None:
    """The products of these corners differ by less than their rounding error."""
    side = 2.0**-14
    square = np.array([[0.0, 0.0], [side, 0.0], [side, side], [0.0, side]])
    (piece,) = triangles(square[::-1] + 8192.0)
    assert area(piece - 8192.0) == side**2


@pytest.mark.parametrize("corners", CORNERS.values(), ids=CORNERS)
@pytest.mark.parametrize("turn", [1, -1])
def test_an_ear_that_only_rounding_makes_one_is_not_cut_off(corners: list[list[float]], turn: int) -> None:
    covered_alike(np.array(corners)[::turn], 0)


@given(st.lists(st.integers(1, 12), min_size=4, max_size=16), st.integers(0, 15), seeds)
@settings(max_examples=150)
def test_the_pieces_of_a_skyline_cover_it_alone(heights: list[int], first: int, seed: int) -> None:
    """Its outline has right angles on a grid of 5 cm, so that many corners are on common lines."""
    across = [0.05 * k for k in range(len(heights) + 1)]
    outlined = [(across[0], 0.0), (across[-1], 0.0)]
    for k in range(len(heights) - 1, -1, -1):
        outlined += [(across[k + 1], 0.05 * heights[k]), (across[k], 0.05 * heights[k])]
    covered_alike(np.roll(np.array(outlined), first, axis=0), seed)


@given(seeds)
@settings(max_examples=15)
def test_the_least_slack_of_motions_is_the_smallest_of_their_states(seed: int) -> None:
    safety = Safety(delta=0.05, delta_per_speed=0.2, delta_per_time=0.04, delta_horizon=2.0, near=3.0, far_delta=0.3)
    dirt = DirtSolver(BENCHMARK, random_workspace(seed), GOAL, safety, capacity=10)
    generator, ends = np.random.default_rng(seed), np.array([1, 8, 30])
    states = np.column_stack([points(seed, 30), generator.uniform(-7.0, 7.0, 30), generator.uniform(-1.0, 1.0, 30)])
    since = generator.choice([-0.5, 0.0, 1.0, 2.5, 3.0, 3.5, math.inf], 30)
    slacks = dirt.clearances(states[:, :3]) - safety.clearance(states[:, 3], since)
    expected = [each.min() for each in np.split(slacks, ends[:-1])]
    np.testing.assert_array_equal(dirt.least_slacks(states, since, ends), expected)


@pytest.mark.parametrize("pose", [(math.nan, 1.5, 1.0, 0.0), (1.5, 1.5, math.nan, math.nan)])
def test_a_place_that_is_not_a_number_is_looked_up_in_the_corner_and_not_beyond_the_memory(
    pose: tuple[float, float, float, float],
) -> None:
    scalar, field = np.zeros(at.SCALARS), np.full((4, 5), 0.25, np.float32)
    scalar[[at.GRID_INVERSE, at.REACH]], field[:, 0] = (1.0, 1.0), -0.25
    disc, no_tile, no_squares = np.array([[0.0, 0.0, 0.5, 0.0]]), np.full((1, 1), -1, np.int32), np.zeros((1, 1))
    maps = at.Maps(disc, field, no_tile, no_squares.astype(np.uint16), scalar)
    assert tight_clearance(maps, *pose) == -0.75  # type: ignore[arg-type]
    assert value_anywhere(field, scalar, math.nan, 1.5) == -0.25
