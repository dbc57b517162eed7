"""Goals with a heading and with limits of further components are reached, and the plans obey the model."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.kernels import NO_SAFETY, ROVER, integrate, rover_rate

from ompl_ext import solver
from ompl_ext.exact import ExactClearance
from ompl_ext.following import PathFollower
from ompl_ext.kernels import kernel_types as at
from ompl_ext.kernels import posepath, posetogo
from ompl_ext.kernels.clearance import tight_cover
from ompl_ext.kernels.specialise import polish_kernels
from ompl_ext.kernels.trajectory_types import Stages, backward, stages
from ompl_ext.motion import motion_of
from ompl_ext.obstacles import Workspace, box
from ompl_ext.plan import Plan
from ompl_ext.problem import make_problem, pose_cost_to_go_of
from ompl_ext.query import Goal, Settings
from ompl_ext.solver import DirtSolver
from ompl_ext.vehicle import Footprint
from ompl_ext.verification import verify

ROOM = Workspace(((0.0, 3.0), (0.0, 3.0)), (box((1.5, 1.6), (0.2, 2.0)),))
START = np.array([0.6, 2.2, 0.0, 0.0, 0.0])
AT_REST = {"v": (-0.05, 0.05), "omega": (-0.05, 0.05)}
GOAL = Goal((2.4, 2.2), 0.03, math.pi / 2, math.radians(3), AT_REST)
RNG = np.random.default_rng(5)


def rover_plan(goal: Goal = GOAL, settings: Settings | None = None, iterations: int = 1024, seed: int = 1) -> Plan:
    dirt = DirtSolver(ROVER, ROOM, goal, NO_SAFETY, settings)
    dirt.start(START, seed)
    dirt.grow(iterations=iterations)
    plan = dirt.plan()
    assert plan is not None
    assert not verify(dirt, plan).problems
    return plan


@pytest.fixture(scope="module")
def parked() -> Plan:
    return rover_plan()


def test_an_independent_integration_of_the_plan_ends_in_the_goal(parked: Plan) -> None:
    state, exact = START, ExactClearance(ROOM, ROVER.footprint)
    for control, duration in zip(parked.controls, parked.durations, strict=True):
        states = integrate(rover_rate, state, control, float(duration), 50)
        assert min(exact.distance(*pose) for pose in states[::5, :3]) > 0.0
        state = states[-1]
    assert math.dist(state[:2], GOAL.center) <= GOAL.radius
    assert abs(math.remainder(state[2] - GOAL.heading, math.tau)) <= GOAL.tolerance
    assert np.all(np.abs(state[3:]) <= 0.05)
    assert np.all((parked.controls >= [-2, -4]) & (parked.controls <= [2, 4]))


def test_the_same_seed_gives_the_same_plan_to_the_last_bit(parked: Plan) -> None:
    again = rover_plan()
    assert np.array_equal(again.controls, parked.controls)
    assert np.array_equal(again.trajectory, parked.trajectory)


def test_local_optimisation_can_be_switched_off_and_saves_time(parked: Plan) -> None:
    without = rover_plan(settings=Settings(polish=False))
    assert not without.reaches_goal or without.cost > parked.cost
    assert DirtSolver(ROVER, ROOM, GOAL, NO_SAFETY, Settings(polish=False))._polish is None


def test_local_optimisation_is_repeated_until_it_saves_little(monkeypatch: pytest.MonkeyPatch) -> None:
    repeated = rover_plan(iterations=4096)
    monkeypatch.setattr(solver, "CONVERGES", 1.0)  # each plan once
    assert repeated.cost < 0.999 * rover_plan(iterations=4096).cost


def test_where_edges_along_a_path_fail_the_first_plan_is_an_optimised_path(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = np.zeros((0, 2)), np.zeros(0)
    monkeypatch.setattr(PathFollower, "edges_along", lambda *_: nothing)
    dirt = DirtSolver(ROVER, ROOM, GOAL, NO_SAFETY)
    dirt.start(START, 1)
    assert dirt.grow(iterations=1024).first_iteration == 0
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    assert not verify(dirt, plan).problems


def test_a_smaller_tolerance_of_the_heading_can_be_aimed_for() -> None:
    dirt = DirtSolver(ROVER, ROOM, GOAL, NO_SAFETY)
    dirt.set_goal_region(0.02, math.radians(0.5))
    dirt.start(START, 1)
    dirt.grow(iterations=1024)
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    assert abs(math.remainder(plan.states[-1, 2] - GOAL.heading, math.tau)) <= math.radians(0.5)


def test_a_plan_that_begins_in_the_goal_has_nothing_to_improve() -> None:
    here = Goal((START[0], START[1]), 0.05, START[2], math.radians(3), AT_REST)
    assert len(rover_plan(here).durations) == 0


def test_a_goal_without_heading_and_limits_needs_neither_guide_nor_optimisation() -> None:
    dirt = DirtSolver(ROVER, ROOM, Goal((2.4, 2.2), 0.3), NO_SAFETY)
    assert dirt.problem.option[at.POSE_HEADINGS] == 0
    assert dirt.problem.option[at.CUT_AT_GOAL] == 0
    assert dirt._polish is None


@pytest.mark.parametrize(("name", "change"), [("v", 0.2), ("omega", -0.2)])
def test_limits_are_part_of_what_a_goal_contains(name: str, change: float) -> None:
    state = np.array([*GOAL.center, GOAL.heading, 0.0, 0.0])
    assert GOAL.contains(ROVER, state)
    state[ROVER.index(name)] += change
    assert not GOAL.contains(ROVER, state)
    assert replace(GOAL, limits={}).contains(ROVER, state)


def test_what_is_in_the_goal_has_nothing_left_to_go() -> None:
    """Else an edge that ends there could be dropped although it is better than the best plan."""
    wide = Goal((2.4, 2.2), 0.3, math.pi / 2, 0.5, {"v": (-0.4, 0.4)})
    dirt = DirtSolver(ROVER, ROOM, wide, NO_SAFETY)
    states = np.zeros((200, 5))
    states[:, :2] = wide.center + RNG.uniform(-0.3, 0.3, (200, 2))
    states[:, 2], states[:, 3] = wide.heading + RNG.uniform(-0.6, 0.6, 200), RNG.uniform(-0.5, 0.5, 200)
    inside = 0
    for state in states:
        dirt.start(state)
        arrived = wide.contains(ROVER, state)
        assert (dirt.root_cost_to_go == 0.0) == arrived
        inside += arrived
    assert 20 < inside < 180


def test_a_slow_vehicle_need_not_leave_the_way_at_the_fastest_speed_of_the_goal() -> None:
    """From standstill 5 cm before the goal's region with at most 0.9 m/s there: it takes what accelerating takes."""
    goal = Goal((2.4, 2.2), 0.05, limits={"v": (-0.9, 0.9)})
    dirt = DirtSolver(ROVER, Workspace(ROOM.bounds), goal, NO_SAFETY)
    dirt.start(np.array([2.3, 2.2, 0.0, 0.0, 0.0]))
    rate = float(motion_of(ROVER).rate[ROVER.index("v")])
    assert dirt.root_cost_to_go <= math.sqrt(2.0 * 0.06 / rate)  # a cell may cost a centimetre


@pytest.mark.parametrize("turns", [-1, 0, 2])
def test_headings_of_a_path_go_on_from_the_start(turns: int) -> None:
    found, paths = pose_cost_to_go_of(ROVER, ROOM, GOAL, Settings(cell=0.02)), 0
    headings = RNG.uniform(-math.pi, math.pi, 20) + turns * math.tau
    for x, y, theta in np.column_stack([RNG.uniform(0.4, 1.1, (20, 2)), headings]):
        for path in found.paths_from(x, y, theta, 6):
            assert np.abs(np.diff(np.append(theta, path.poses[:, 2]))).max() < math.pi
            paths += 1
    assert paths > 40


def test_a_motion_that_turns_far_is_an_arc() -> None:
    ahead, turning, time = 0.7, 1.2, 2.0
    radius, angle = ahead / turning, turning * time
    after = posepath._poses_after(np.array([1.0, 2.0, 0.0]), np.array([[ahead, 0.0, turning, 0.1]]), np.array([time]))
    assert after[0] == pytest.approx([1.0 + radius * math.sin(angle), 2.0 + radius * (1.0 - math.cos(angle)), angle])


@pytest.mark.parametrize("name", ["speed", "x", "theta"])
def test_limits_of_what_is_no_component_besides_the_pose_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        make_problem(ROVER, ROOM, replace(GOAL, limits={name: (0.0, 1.0)}), NO_SAFETY, Settings())


def test_an_edge_that_passes_a_small_goal_ends_in_it() -> None:
    goal = Goal((0.9, 2.5), 0.04)  # every edge of a rover at full speed moves by much more
    dirt = DirtSolver(ROVER, ROOM, goal, NO_SAFETY)
    assert dirt.problem.option[at.CUT_AT_GOAL] == 1
    dirt.start(np.array([0.9, 0.6, math.pi / 2, 0.9, 0.0]), 0)
    dirt.grow(iterations=3000)
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    assert math.dist(plan.trajectory[-1][:2], goal.center) < goal.radius


def test_the_cost_to_go_of_poses_knows_turning_and_reversing() -> None:
    room = Workspace(((0.0, 3.0), (0.0, 3.0)))
    goal = Goal((1.5, 1.5), 0.03, 0.0, math.radians(3))
    found = pose_cost_to_go_of(ROVER, room, goal, Settings(cell=0.01))

    def seconds(x: float, y: float, theta: float) -> float:
        path = found.path_from(x, y, theta)
        assert path is not None
        assert math.dist(path.poses[0, :2], (x, y)) < 0.1
        assert math.dist(path.poses[-1, :2], (1.5, 1.5)) < 0.1
        return float(path.times.sum())

    assert seconds(0.7, 1.5, 0.0) == pytest.approx(0.8, abs=0.1)  # ahead at 1 m/s
    assert seconds(2.3, 1.5, 0.0) == pytest.approx(0.8, abs=0.1)  # astern
    assert seconds(1.5, 1.5, math.pi) == pytest.approx(math.pi / 3, rel=0.1)  # on the spot at 3 rad/s
    assert seconds(1.5, 2.2, 0.0) > 0.7 + 0.3  # a rover does not move sideways


def test_a_vehicle_that_hardly_turns_has_a_way_straight_ahead_and_none_to_another_heading() -> None:
    straight = replace(ROVER, controls={**ROVER.controls, "spin": (-1e-3, 1e-3)})
    room, ahead = Workspace(((0.0, 3.0), (0.0, 3.0))), Goal((2.4, 1.5), 0.1, 0.0, math.radians(3))
    dirt = DirtSolver(straight, room, ahead, NO_SAFETY)
    dirt.start(np.array([0.6, 1.5, 0.0, 0.0, 0.0]))
    dirt.grow(iterations=64)
    plan = dirt.plan()
    assert plan is not None
    assert plan.reaches_goal
    assert not verify(dirt, plan).problems
    across = DirtSolver(straight, room, replace(ahead, heading=math.pi / 2), NO_SAFETY)
    across.start(np.array([0.6, 1.5, 0.0, 0.0, 0.0]))
    across.grow(iterations=64)
    assert (found := across.plan()) is None or not found.reaches_goal


def test_ways_of_what_cannot_reverse_have_its_smallest_turns_where_those_lead_farther(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ahead = np.array([[0.25, 0.0, -0.5], [0.25, 0.0, 0.5], [0.5, 0.0, -0.5], [0.5, 0.0, 0.0], [0.5, 0.0, 0.5]])
    original = posetogo.pose_cost_to_go
    monkeypatch.setattr("ompl_ext.problem.pose_cost_to_go", lambda *given: original(*given[:5], ahead, *given[6:]))
    street = Workspace(((0.0, 3.0), (0.0, 1.3)))

    def leads_round(x: float) -> bool:
        goal = Goal((x, 0.25), 0.05, 0.0, 0.1)
        path = pose_cost_to_go_of(ROVER, street, goal, Settings(cell=0.02)).path_from(1.5, 1.05, math.pi)
        return path is not None and len(path.times) > 0

    assert leads_round(2.5)
    monkeypatch.setattr(posetogo, "GAIN", math.inf)  # gentler turns alone
    assert not leads_round(2.51)


def test_ways_number_the_twists_as_those_who_follow_them() -> None:
    small = replace(ROVER, footprint=Footprint(0.2, 0.2))  # whose extreme twists depend on the length that counts
    motion, wide = motion_of(small), small.footprint.with_margin(0.05)
    twists, numbers = motion.extreme_twists(small.footprint.reach)
    assert not np.array_equal(numbers, motion.extreme_twists(wide.reach)[1])
    found = pose_cost_to_go_of(small, ROOM, GOAL, Settings(cell=0.02, way_margin=0.05))
    assert np.array_equal(found.motions[:, :2], twists[:, :2])  # they turn less than the vehicle can


@pytest.mark.parametrize(
    "goal", [Goal((1.5, 2.5), 0.1), Goal((1.5, 2.5), 0.1, math.pi / 2, 0.2), Goal((1.5, 2.5), 0.1, math.pi, 0.2)]
)
def test_ways_of_poses_avoid_a_gap_without_the_margin_and_take_it_if_there_is_no_other(goal: Goal) -> None:
    gap, wide = 0.5 * ROVER.footprint.width + 0.02, Settings(pose_cost_to_go=True, way_margin=0.05)
    start = np.array([1.5, 0.5, math.pi / 2, 0.0, 0.0])

    def seconds(settings: Settings, right_end: float) -> float:
        walls = [box((0.5 * (1.5 - gap), 1.5), (1.5 - gap, 0.1)),
                 box((0.5 * (1.5 + gap + right_end), 1.5), (right_end - 1.5 - gap, 0.1))]  # fmt: skip
        dirt = DirtSolver(ROVER, Workspace(((0.0, 4.0), (0.0, 3.0)), tuple(walls)), goal, NO_SAFETY, settings)
        dirt.start(start)
        return float(dirt.tree_arrays.value[0, at.TOGO])

    through = seconds(Settings(pose_cost_to_go=True), 3.0)
    around, forced = seconds(wide, 3.0), seconds(wide, 4.0)
    assert through < 2.5
    assert through + 0.2 < around < 6.0
    assert forced < 20.0


def test_motion_finds_rates_ranges_and_extreme_velocities() -> None:
    motion = motion_of(ROVER)
    v, omega = ROVER.index("v"), ROVER.index("omega")
    assert motion.high[[v, omega]] == pytest.approx([1.0, 3.0], abs=0.25)
    assert motion.rate[[v, omega]] == pytest.approx([2.0, 4.0], rel=1e-6)
    twists, numbers = motion.extreme_twists(0.3)
    assert len(twists) == len(numbers)
    for ahead, turning in ((1, 0), (-1, 0), (0, 3), (0, -3), (1, 3), (-1, -3)):
        assert np.abs(twists - (ahead, 0, turning)).max(axis=1).min() < 0.6


@pytest.mark.parametrize("footprint", [Footprint(0.44, 0.28, -0.005), Footprint(0.2, 0.9), Footprint(0.5, 0.5)])
@pytest.mark.parametrize("excess", [0.005, 0.02])
def test_the_tight_cover_contains_the_footprint_and_hardly_more(footprint: Footprint, excess: float) -> None:
    discs = tight_cover(footprint, excess)
    corners = footprint.corners()
    low, high = corners.min(axis=0), corners.max(axis=0)
    points = np.random.default_rng(0).uniform(low, high, (3000, 2))
    gaps = np.linalg.norm(points[:, None] - discs[:, :2], axis=2) - discs[:, 2]
    assert gaps.min(axis=1).max() <= 1e-9
    turn = np.linspace(0, math.tau, 200)
    rim = discs[:, None, :2] + discs[:, 2, None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    outside = np.maximum(np.maximum(low - rim, rim - high), 0.0)
    assert np.linalg.norm(outside, axis=2).max() <= math.sqrt(2.0) * excess + 1e-9


def test_the_linear_quadratic_problem_is_solved_as_by_dense_equations() -> None:
    n, nx, m, stiffness = 4, len(ROVER.state), len(ROVER.controls) + 1, 50.0
    root = RNG.normal(size=(n + 1, nx, nx))
    problem = stages(n, nx, m)._replace(
        a=RNG.normal(size=(n, nx, nx)),
        b=RNG.normal(size=(n, nx, m)),
        c=RNG.normal(size=(n, nx)),
        q_matrix=root @ root.transpose(0, 2, 1),
        q=RNG.normal(size=(n + 1, nx)),
        r_diagonal=RNG.uniform(0.5, 1.5, size=(n, m)),
        r=RNG.normal(size=(n, m)),
        jump=RNG.normal(size=(n, m - 1)),
        jump_weight=np.vstack([np.zeros((1, m - 1)), RNG.uniform(0.5, 1.5, size=(n - 1, m - 1))]),
        low=np.full((n, m), -1e6),
        high=np.full((n, m), 1e6),
    )
    work, solve = backward(n, nx, m), polish_kernels(ROVER).solve
    assert solve(problem, n, 0.0, stiffness, work)
    dx, du = dense_solution(problem, stiffness)
    assert work.dx[1:] == pytest.approx(dx, abs=1e-6)
    assert work.du == pytest.approx(du, abs=1e-6)
    bounded = problem._replace(low=np.full((n, m), -0.05), high=np.full((n, m), 0.05))
    assert solve(bounded, n, 0.0, stiffness, work)
    assert np.abs(work.du).max() == pytest.approx(0.05)


def dense_solution(stages: Stages, stiffness: float) -> tuple[np.ndarray, np.ndarray]:
    """States 1 ... n and controls that minimise the same costs, by one system of linear equations."""
    n, nx, m = stages.b.shape
    size = n * (nx + m)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    for k in range(n):
        x, u = slice(k * nx, (k + 1) * nx), slice(n * nx + k * m, n * nx + (k + 1) * m)  # the state after stage k
        hessian[x, x] += stages.q_matrix[k + 1]
        gradient[x] += stages.q[k + 1]
        hessian[u, u] += np.diag(stages.r_diagonal[k])
        gradient[u] += stages.r[k]
        jump = np.zeros((m - 1, size))  # change of the controls, without the duration, from the stage before
        jump[:, u] = np.eye(m)[:-1]
        if k > 0:
            jump[:, u.start - m : u.start] = -np.eye(m)[:-1]
        hessian += jump.T @ np.diag(stages.jump_weight[k]) @ jump
        gradient += jump.T @ (stages.jump_weight[k] * stages.jump[k])
        defect = np.zeros((nx, size))
        defect[:, x], defect[:, u] = np.eye(nx), -stages.b[k]
        if k > 0:
            defect[:, (k - 1) * nx : k * nx] = -stages.a[k]
        hessian += stiffness * defect.T @ defect
        gradient -= stiffness * defect.T @ stages.c[k]
    solution = -np.linalg.solve(hessian, gradient)
    return solution[: n * nx].reshape(n, nx), solution[n * nx :].reshape(n, m)
