"""Broad phase of exact clearances and of verification: the answers are those of FCL over every obstacle."""

from __future__ import annotations

import math
from dataclasses import replace

import fcl
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.kernels import BENCHMARK, START, random_workspace, turns

from ompl_ext.exact import HEIGHT, SPREAD, ExactClearance
from ompl_ext.obstacles import Circle, OccupancyGrid, Polygon, Workspace, box
from ompl_ext.plan import Plan
from ompl_ext.query import Safety
from ompl_ext.solver import DirtSolver
from ompl_ext.triangulate import triangles
from ompl_ext.vehicle import Footprint
from ompl_ext.verification import FINE, Requirement, verify, violations

seeds = st.integers(0, 2**32 - 1)


def solid(corners: np.ndarray) -> fcl.CollisionObject:
    n = len(corners)
    points = np.vstack([np.column_stack([corners, np.full(n, z)]) for z in (-HEIGHT / 2, HEIGHT / 2)])
    faces = [n, *range(n - 1, -1, -1), n, *range(n, 2 * n)]
    for k in range(n):
        faces += [4, k, (k + 1) % n, n + (k + 1) % n, n + k]
    return fcl.CollisionObject(fcl.Convex(points, n + 2, np.array(faces)), fcl.Transform())


def every_solid(workspace: Workspace) -> list[fcl.CollisionObject]:
    """FCL's solids of all obstacles; each cell of a map is one."""
    found = []
    for obstacle in workspace.obstacles:
        if isinstance(obstacle, Circle):
            place = fcl.Transform(np.array([*obstacle.center, 0.0]))
            found.append(fcl.CollisionObject(fcl.Sphere(obstacle.radius), place))
        elif isinstance(obstacle, Polygon):
            found += [solid(piece) for piece in triangles(obstacle.vertices)]
        else:
            x, y, yaw = obstacle.origin
            turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
            for row, column in zip(*np.nonzero(obstacle.occupied), strict=True):
                cell = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) + np.array([column, row])
                found.append(solid(cell * obstacle.resolution @ turn.T + (x, y)))
    return found


def distance_to_every(solids: list[fcl.CollisionObject], footprint: Footprint, pose: np.ndarray) -> float:
    x, y, theta = pose
    c, s = math.cos(theta), math.sin(theta)
    place = np.array([x + c * footprint.offset, y + s * footprint.offset, 0.0])
    turn = fcl.Transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), place)
    body = fcl.CollisionObject(fcl.Box(footprint.length, footprint.width, HEIGHT), turn)
    if any(fcl.collide(each, body, fcl.CollisionRequest(), fcl.CollisionResult()) for each in solids):
        return 0.0
    return min(
        (fcl.distance(each, body, fcl.DistanceRequest(), fcl.DistanceResult()) for each in solids), default=math.inf
    )


def poses_in(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-1.0, 4.0, (count, 2)), rng.uniform(-7.0, 7.0, count)])


@given(seeds, st.floats(0.05, 0.8), st.floats(0.05, 0.5), st.floats(-0.4, 0.4))
@settings(max_examples=60)
def test_the_exact_clearance_is_that_of_fcl_over_every_obstacle(
    seed: int, length: float, width: float, offset: float
) -> None:
    workspace, footprint = random_workspace(seed, most=12), Footprint(length, width, offset)
    exact, solids, poses = ExactClearance(workspace, footprint), every_solid(workspace), poses_in(seed, 40)
    true = np.array([distance_to_every(solids, footprint, pose) for pose in poses])
    assert exact.distances(poses) == pytest.approx(true, abs=1e-6)
    assert [exact.collides(*pose) for pose in poses] == (true == 0.0).tolist()
    assert np.all(exact.lower_bounds(poses) <= true + 1e-6)
    assert exact.least_distance(poses) == exact.distances(poses).min()
    contacts = np.flatnonzero(exact.distances(poses) <= 0.0).tolist()
    assert exact.first_contact(poses) == (contacts[0] if contacts else None)


@pytest.mark.parametrize("count", [1, 15, 16, 17, 300])
def test_lower_bounds_do_not_depend_on_the_chunks_of_poses(count: int) -> None:
    workspace = random_workspace(5, most=12)
    exact, poses = ExactClearance(workspace, Footprint(0.4, 0.2)), poses_in(9, count)
    together = exact.lower_bounds(poses)
    assert np.array_equal(together, [exact.lower_bounds(pose[None, :])[0] for pose in poses])


def test_a_bound_beside_an_upright_wall_is_the_distance() -> None:
    exact = ExactClearance(Workspace(((0, 4), (0, 4)), (box((2.0, 2.0), (0.2, 3.0)),)), Footprint(0.4, 0.2))
    poses = np.array([[1.0, 2.0, math.pi / 2], [1.0, 2.0, 0.0], [1.0, 2.0, math.pi]])
    assert exact.lower_bounds(poses) == pytest.approx([0.8, 0.7, 0.7])


def test_without_obstacles_every_bound_is_infinite() -> None:
    exact = ExactClearance(Workspace(((0, 4), (0, 4))), Footprint(0.4, 0.2))
    assert exact.least_distance(poses_in(0, 3)) == math.inf
    assert not exact.collides(1.0, 1.0)


def naive(dirt: DirtSolver, plan: Plan) -> tuple[float, set[Requirement]]:
    """Least clearance and violated requirements of a plan without a contingency, with FCL asked everywhere."""
    poses, exact = plan.trajectory[:, :3], dirt.exact
    clearance, found = exact.distances(poses), set()
    delta = dirt.safety.clearance(np.abs(plan.trajectory[:, 3]), plan.times)
    within = plan.times <= dirt.safety.cycle + 1e-9
    if np.any(clearance[within] < delta[within] - 1e-6):
        found.add(Requirement.CLEARANCE)
    if not clearance.min() > 0.0:
        found.add(Requirement.COLLISION)
    ends = np.cumsum(plan.durations)
    for k in range(len(plan.times) - 1):
        edge = min(int(np.searchsorted(ends, plan.times[k] + 1e-9, side="right")), len(ends) - 1)
        fine = dirt.fine(poses_of(plan, k), plan.controls[edge][None], np.diff(plan.times)[k : k + 1], FINE)[0]
        moves = np.hypot(*np.diff(fine[:, :2], axis=0).T)
        moves += np.abs(np.diff(fine[:, 2])) * dirt.vehicle.footprint.reach
        if clearance[k] + clearance[k + 1] <= moves.sum() and not exact.distances(fine[1:-1, :3]).min() > 0.0:
            found.add(Requirement.COLLISION)
    return float(clearance.min()), found


def poses_of(plan: Plan, k: int) -> np.ndarray:
    return plan.trajectory[k : k + 1]


def moved(plan: Plan, by: np.ndarray) -> Plan:
    shift = np.array([*by, 0.0, 0.0])
    return replace(plan, states=plan.states + shift, trajectory=plan.trajectory + shift)


@pytest.mark.parametrize("seed", range(4))
def test_the_verdict_on_plans_moved_towards_obstacles_is_that_of_fcl_at_every_sample(seed: int) -> None:
    dirt = turns(Safety(enabled=False, cycle=1.0, delta=0.02, delta_per_speed=0.1))
    dirt.start(START, seed)
    dirt.grow(iterations=1200)
    plan = dirt.plan()
    assert plan is not None
    verdicts = set()
    for by in np.random.default_rng(seed).uniform(-0.35, 0.35, (12, 2)):
        changed = moved(plan, by)
        least, violated = naive(dirt, changed)
        verification = verify(dirt, changed)
        assert verification.min_clearance == least
        assert {problem.requirement for problem in verification.problems} == violated
        assert violations(dirt, changed) == verification.problems
        verdicts |= {frozenset(violated)}
    assert len(verdicts) > 1


def test_a_post_between_two_samples_is_found() -> None:
    footprint = Footprint(0.02, 0.02)
    vehicle = replace(BENCHMARK, footprint=footprint)
    free = DirtSolver(vehicle, turns().workspace, turns().goal, Safety(enabled=False, cycle=0.0), capacity=20_000)
    free.start(START, 1)
    free.grow(iterations=800)
    plan = free.plan()
    assert plan is not None
    k = len(plan.times) // 2
    middle = plan.trajectory[k : k + 2, :2].mean(axis=0)
    assert np.hypot(*np.diff(plan.trajectory[k : k + 2, :2], axis=0)[0]) > 0.03
    post = Circle(middle, 0.001)
    with_post = Workspace(free.workspace.bounds, (*free.workspace.obstacles, post))
    judge = DirtSolver(vehicle, with_post, free.goal, free.safety, capacity=10)
    verification = verify(judge, plan)
    assert verification.min_clearance > 0.0
    assert [problem.requirement for problem in verification.problems] == [Requirement.COLLISION]


def safe_plan() -> tuple[DirtSolver, Plan]:
    """A plan of a small vehicle, with a contingency that asks for no clearance."""
    vehicle = replace(BENCHMARK, footprint=Footprint(0.02, 0.02))
    dirt = DirtSolver(vehicle, turns().workspace, turns().goal, Safety(cycle=1.0), capacity=20_000)
    dirt.start(START, 1)
    dirt.grow(iterations=800)
    plan = dirt.plan()
    assert plan is not None
    assert verify(dirt, plan).problems == ()
    return dirt, plan


@pytest.mark.parametrize(("share", "said"), [(0.0, "contingency: collides at"), (0.5, "contingency: collides between")])
def test_a_contingency_that_collides_is_found_at_its_samples_and_between_them(share: float, said: str) -> None:
    dirt, plan = safe_plan()
    assert plan.contingency is not None
    before, after = plan.contingency.states[:2, :2]
    assert np.hypot(*(after - before)) > 0.03
    post = Circle(before + share * (after - before), 0.001)
    with_post = Workspace(dirt.workspace.bounds, (*dirt.workspace.obstacles, post))
    judge = DirtSolver(dirt.vehicle, with_post, dirt.goal, dirt.safety, capacity=10)
    problems = verify(judge, plan).problems
    found = [problem.text for problem in problems if problem.requirement is Requirement.COLLISION]
    assert violations(judge, plan) == problems
    assert any(text.startswith(said) for text in found), found


def test_states_that_are_not_finite_are_a_violation() -> None:
    dirt, plan = safe_plan()
    stop, nowhere = plan.contingency, plan.trajectory.copy()
    assert stop is not None
    nowhere[3, 0] = math.nan
    states = stop.states.copy()
    states[-1, 1] = math.inf
    for changed in (replace(plan, trajectory=nowhere), replace(plan, contingency=replace(stop, states=states))):
        found = verify(dirt, changed)
        assert [problem.requirement for problem in found.problems] == [Requirement.CONSISTENCY]
        assert violations(dirt, changed) == found.problems


def test_a_start_in_the_goal_is_a_plan_only_if_it_keeps_the_clearance() -> None:
    found = []
    for delta in (0.0, 5.0):
        dirt = turns(Safety(enabled=False, cycle=1.0, delta=delta))
        assert dirt.goal is not None
        dirt.start(np.array([*dirt.goal.center, *START[2:]]), 0)
        plan = dirt.plan()
        found.append(plan is not None and plan.reaches_goal)
    assert found == [True, False]


def test_a_map_of_many_rectangles_is_as_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    occupied = np.random.default_rng(2).random((60, 70)) < 0.05
    workspace = Workspace(((0.0, 3.5), (0.0, 3.0)), (OccupancyGrid(occupied, 0.05, (0.2, 0.1, 0.3)),))
    exact, solids, footprint = (
        ExactClearance(workspace, Footprint(0.3, 0.2)),
        every_solid(workspace),
        Footprint(0.3, 0.2),
    )
    for pose in poses_in(4, 60):
        true = distance_to_every(solids, footprint, pose)
        assert exact.distance(*pose) == pytest.approx(true, abs=1e-6)
        assert (exact.distance(*pose) == 0.0) == (true == 0.0)
    assert SPREAD > 3e-4, "the error of FCL's distances to round shapes"


def test_a_body_that_just_touches_a_wall_is_in_contact() -> None:
    """FCL tells no contact of some of these poses, and the distance -1."""
    wall = box((7.0, -0.05), (14.0, 0.1))
    for footprint in (Footprint(2.0, 0.8), Footprint(0.4, 0.3)):
        exact = ExactClearance(Workspace(((-20.0, 20.0), (-20.0, 20.0)), (wall,)), footprint)
        for x in np.linspace(6.0, 8.0, 21):
            assert exact.distance(float(x), footprint.width / 2) == pytest.approx(0.0, abs=1e-9)
            assert exact.distance(float(x), footprint.length / 2, math.pi / 2) == pytest.approx(0.0, abs=1e-9)
