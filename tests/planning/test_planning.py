"""Planning a task: what comes back is verified, repeatable, and honest when there is no plan."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from importlib import import_module

import numpy as np
import pytest
from support.diagnostics import located, raised

from kraft.errors import Code, Defect, InputError
from kraft.planning.feasibility import check_placement, memory_needed
from kraft.planning.plan import PlanResult, finds_plan, plan_task
from kraft.planning.search import Budget, Previous, search_named, settings_without_effect
from kraft.planning.stated_speed import faster_than_stated
from kraft.planning.workspace import fence, settings_of, start_state, workspace_of
from kraft.scenario import Task, load_scenario, parse_scenario
from kraft.vehicles.load import load_vehicle
from ompl_ext.checker import EdgeChecker
from ompl_ext.exact import ExactClearance
from ompl_ext.kernels import specialise
from ompl_ext.motion import EDGE_DURATIONS, edge_durations
from ompl_ext.obstacles import Workspace, box
from ompl_ext.query import Goal
from ompl_ext.vehicle import Footprint, Vehicle
from ompl_ext.verification import Requirement, Verification, Violation

SCENE = """name: room
bounds: {x: [0, 4], y: [0, 4]}
obstacles:
  - {name: pillar, box: {center: [2, 2], size: [1, 1]}}
  - circle: {center: [3.5, 0.5], radius: 0.2}
start: {x: 0.5, y: 0.5, heading_deg: 0}
goal: {center: [3, 3], radius: 0.3}
"""
FEW = Budget(iterations=2000)
COLLISION = Violation(Requirement.COLLISION, "plan: collides at t = 1.000 s")


def room(*changes: tuple[str, str]) -> Task:
    text = SCENE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return parse_scenario(text, "room.yaml").task()


@pytest.fixture(scope="module")
def mushr() -> Vehicle:
    return load_vehicle("mushr")


@pytest.fixture(scope="module")
def solved(mushr: Vehicle) -> PlanResult:
    return plan_task(room(), mushr, FEW, seed=3)


def test_a_plan_begins_at_the_start_and_ends_in_the_goal(solved: PlanResult) -> None:
    assert solved.solved
    assert solved.safe
    assert solved.reason == ""
    assert solved.plan is not None
    assert solved.plan.states[0] == pytest.approx([0.5, 0.5, 0, 0])
    assert math.dist(solved.plan.states[-1][:2], (3, 3)) < 0.3
    assert solved.plan.cost == pytest.approx(solved.plan.durations.sum())


def test_the_plan_is_judged_with_its_exact_clearance(solved: PlanResult, mushr: Vehicle) -> None:
    assert solved.plan is not None
    assert solved.verification is not None
    judge = ExactClearance(workspace_of(room(), mushr), mushr.footprint)
    distances = judge.distances(solved.plan.trajectory[:, :3])
    assert solved.verification.min_clearance == pytest.approx(distances.min())


def test_seed_and_iterations_decide_the_plan(solved: PlanResult, mushr: Vehicle) -> None:
    again = plan_task(room(), mushr, FEW, seed=3)
    other = plan_task(room(), mushr, FEW, seed=4)
    assert again.plan is not None
    assert solved.plan is not None
    assert other.plan is not None
    assert again.plan.trajectory.tobytes() == solved.plan.trajectory.tobytes()
    assert other.plan.trajectory.tobytes() != solved.plan.trajectory.tobytes()


def test_the_scenarios_own_budget_holds_unless_another_is_given(mushr: Vehicle) -> None:
    task = parse_scenario(SCENE + "planning: {iterations: 123}\n").task()
    assert plan_task(task, mushr).progress.iterations == 123
    assert plan_task(task, mushr, Budget(iterations=7)).progress.iterations == 7


def test_a_budget_without_a_limit_is_refused() -> None:
    with pytest.raises(InputError, match="budget: is empty; expected iterations or seconds"):
        Budget()


def test_a_time_budget_is_kept(mushr: Vehicle) -> None:
    result = plan_task(room(), mushr, Budget(seconds=0.05))
    assert 0.04 < result.progress.seconds < 0.5
    assert result.solved


@pytest.mark.parametrize("vehicle", ["mushr-lag", "unicycle2", "benchmark"])
def test_every_bundled_vehicle_solves_turns(vehicle: str) -> None:
    result = plan_task(load_scenario("turns").task(), load_vehicle(vehicle), FEW)
    assert result.solved
    assert result.safe


@pytest.mark.parametrize("planner", ["rrt", "est", "kpiece1"])
def test_ompls_own_planners_answer_the_same_query(planner: str, mushr: Vehicle) -> None:
    task = parse_scenario(SCENE + f"planning: {{planner: {planner}}}\n").task()
    result = plan_task(task, mushr, Budget(seconds=0.5))
    assert result.plan is None or result.verification is not None
    assert result.progress.edges == 0  # they count no edges, and none are invented
    if result.plan is not None:
        judge = ExactClearance(workspace_of(task, mushr), mushr.footprint)
        assert judge.distances(result.plan.trajectory[:, :3]).min() > 0


def test_ompls_own_planners_cannot_keep_a_plan(solved: PlanResult, mushr: Vehicle) -> None:
    task = parse_scenario(SCENE + "planning: {planner: est}\n").task()
    assert solved.plan is not None
    (problem,) = raised(lambda: plan_task(task, mushr, FEW, previous=Previous(solved.plan)))
    assert (problem.file, problem.argument, problem.code) == ("planner", True, Code.CONFLICT)


def test_the_footprint_stays_inside_the_bounds(mushr: Vehicle) -> None:
    task = room()
    bare = dataclasses.replace(task, obstacles=())
    result = plan_task(bare, mushr, FEW)
    assert result.plan is not None
    corners = mushr.footprint.corners()
    for x, y, theta, _ in result.plan.trajectory:
        c, s = math.cos(theta), math.sin(theta)
        points = corners @ np.array([[c, s], [-s, c]]) + (x, y)
        assert points.min() >= 0
        assert points.max() <= 4


def test_the_fence_touches_the_bounds_from_outside() -> None:
    corners = np.vstack([side.vertices for side in fence(room().bounds, 1.0)])
    assert (corners.min(), corners.max()) == (-1.0, 5.0)
    inside = (corners > 0) & (corners < 4)
    assert not inside.all(axis=1).any()


def test_what_is_left_of_a_plan_is_kept_from_where_it_is_then(solved: PlanResult, mushr: Vehicle) -> None:
    assert solved.plan is not None
    result = plan_task(room(), mushr, Budget(iterations=1), previous=Previous(solved.plan, 1.0))
    assert result.plan is not None
    assert result.solved
    assert result.progress.retained > 0
    assert result.plan.cost == pytest.approx(solved.plan.cost - 1.0)
    expected = [np.interp(1.0, solved.plan.times, column) for column in solved.plan.trajectory.T]
    assert result.plan.states[0] == pytest.approx(expected)


@pytest.mark.parametrize("elapsed", [-0.1, 1000.0])
def test_a_plan_that_is_over_is_not_a_place_to_start(elapsed: float, solved: PlanResult, mushr: Vehicle) -> None:
    assert solved.plan is not None
    previous = Previous(solved.plan, elapsed)
    assert located(raised(lambda: plan_task(room(), mushr, FEW, previous=previous))) == ["value"]


def test_a_plan_of_another_vehicle_is_refused(solved: PlanResult) -> None:
    assert solved.plan is not None
    previous = Previous(solved.plan, 0.0, "p.json")
    (problem,) = raised(lambda: plan_task(room(), load_vehicle("unicycle2"), FEW, previous=previous))
    assert (problem.file, problem.code) == ("p.json", Code.MISMATCH)
    assert "unicycle2" in problem.expected


def test_a_plan_of_a_vehicle_with_other_controls_is_refused(solved: PlanResult, mushr: Vehicle) -> None:
    assert solved.plan is not None
    previous = Previous(solved.plan, 0.0, "p.json", (mushr.state, ("left", "right")))
    (problem,) = raised(lambda: plan_task(room(), mushr, FEW, previous=previous))
    assert (problem.file, problem.code) == ("p.json", Code.MISMATCH)
    assert "the controls left, right" in problem.problem
    own = dataclasses.replace(previous, names=(mushr.state, tuple(mushr.controls)))
    assert plan_task(room(), mushr, FEW, previous=own).solved


@pytest.mark.parametrize(
    ("old", "new", "expected", "named"),
    [
        ("start: {x: 0.5, y: 0.5", "start: {x: 1.4, y: 2.0", "6:8 start geometry", "'pillar'"),
        ("start: {x: 0.5, y: 0.5", "start: {x: 3.2, y: 0.5", "6:8 start geometry", "obstacles[1]"),
        ("start: {x: 0.5, y: 0.5", "start: {x: 0.1, y: 0.5", "6:8 start geometry", "out of bounds"),
        ("heading_deg: 0}", "heading_deg: 0, speed: 3}", "6:48 start.speed value", "mushr"),
        ("radius: 0.3", "radius: 0.3, limits: {omega: [0, 1]}", "7:53 goal.limits.omega unknown", "mushr"),
        ("radius: 0.3", "radius: 0.3, limits: {theta: [0, 1]}", "7:53 goal.limits.theta unknown", "mushr"),
        ("radius: 0.3", "radius: 0.3, limits: {v: [2, 3]}", "7:49 goal.limits.v value", "mushr"),
        ("center: [3, 3]", "center: [2.2, 2]", "7:16 goal.center geometry", "'pillar'"),
    ],
)  # fmt: skip
def test_a_start_or_goal_where_nothing_can_be_is_explained_at_its_line(
    old: str, new: str, expected: str, named: str, mushr: Vehicle
) -> None:
    (problem,) = raised(lambda: plan_task(room((old, new)), mushr, FEW))
    assert located([problem]) == [expected]
    assert named in problem.problem


def test_a_heading_at_the_goal_is_refused_for_a_vehicle_that_does_not_turn(mushr: Vehicle) -> None:
    sliding = dataclasses.replace(mushr, state=("x", "y", "phase", "v"))
    task = room(("radius: 0.3", "radius: 0.3, heading_deg: 90, heading_tolerance_deg: 5"))
    (problem,) = raised(lambda: check_placement(task, sliding, start_state(task, sliding)))
    assert located([problem]) == ["7:50 goal.heading_deg mismatch"]


def test_a_speed_at_the_start_is_refused_for_a_vehicle_without_a_speed(mushr: Vehicle) -> None:
    drawn = dataclasses.replace(mushr, rest=())
    task = room(("heading_deg: 0}", "heading_deg: 0, speed: 0.1}"))
    (problem,) = raised(lambda: check_placement(task, drawn, start_state(task, drawn)))
    assert located([problem]) == ["6:48 start.speed mismatch"]
    assert raised(lambda: check_placement(room(), drawn, start_state(room(), drawn))) == ()


def test_a_step_that_is_too_short_for_the_edges_of_a_slow_vehicle_is_refused_at_its_line(mushr: Vehicle) -> None:
    task = parse_scenario(SCENE + "planning: {integration_step: 1.0e-5}\n", "room.yaml").task()
    slow = load_vehicle("unicycle2", parameters={"a_max": 0.1})
    for check in (
        lambda: check_placement(task, slow, start_state(task, slow)),
        lambda: plan_task(task, slow, FEW),
        lambda: settings_of(task, slow),
    ):
        assert located(raised(check)) == ["8:30 planning.integration_step conflict"]
    assert raised(lambda: check_placement(task, mushr, start_state(task, mushr))) == ()


def test_the_edges_of_a_vehicle_that_is_slow_for_its_size_lead_as_far_as_it_is_long(mushr: Vehicle) -> None:
    """It does not get anywhere by edges that suit a fast one."""
    assert edge_durations(mushr) == EDGE_DURATIONS
    digger = dataclasses.replace(mushr, footprint=Footprint(4 * mushr.top_speed, 0.8))
    shortest, longest = edge_durations(digger)
    assert longest * digger.top_speed == pytest.approx(digger.footprint.length)
    assert shortest == 0.5 * longest
    assert settings_of(room(), digger).longest == longest
    assert settings_of(parse_scenario(SCENE + "planning: {edge_duration: [1, 2]}\n").task(), digger).longest == 2.0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("planner: rrt", ""),
        ("planner: rrt, goal_bias: 0.05, safety: {delta: 0.1}", ""),
        ("planner: dirt, goal_bias: 0.2, child_extension: false", ""),
        ("planner: sst, goal_bias: 0.2, blossom: 8", ""),
        ("planner: sst, child_extension: false", "planning.child_extension has no effect with the planner sst"),
        ("planner: est, blossom: 8, goal_bias: 0.2", "planning.blossom, planning.goal_bias have no effect with the pl"),
    ],
)
def test_settings_that_a_planner_does_not_have_are_said(settings: str, words: str) -> None:
    task = parse_scenario(f"{SCENE}planning: {{{settings}}}\n").task()
    said = settings_without_effect(task.planning.with_budget(iterations=3))
    assert said.startswith(words) if words else said == ""


def test_a_top_speed_that_the_model_exceeds_is_named_with_the_speed_it_reaches(mushr: Vehicle) -> None:
    assert faster_than_stated(mushr) == ""
    warning = faster_than_stated(dataclasses.replace(mushr, top_speed=0.5 * mushr.top_speed))
    assert f"reaches {mushr.top_speed:.3g} m/s" in warning
    assert f"top_speed is {0.5 * mushr.top_speed:.3g} m/s" in warning


WALL = ("size: [1, 1]", "size: [0.5, 4]")
NEAR = ("x: 0.5, y: 0.5, heading_deg: 0", "x: 1.2975, y: 2.0, heading_deg: 0")


@pytest.mark.parametrize("scale", [1.0, 0.25, 0.05])
def test_a_small_vehicle_gets_through_gaps_that_suit_its_size(scale: float, mushr: Vehicle) -> None:
    """Cells of a fixed size close these gaps to it."""
    shape = Footprint(scale * mushr.footprint.length, scale * mushr.footprint.width)
    vehicle = dataclasses.replace(mushr, footprint=shape, top_speed=scale * mushr.top_speed)
    sides = tuple(box((0.0, side * scale), (scale, 0.6 * scale)) for side in (-0.6, 0.6))
    bounds = (-2.0 * scale, 2.0 * scale), (-2.0 * scale, 2.0 * scale)
    slack = EdgeChecker(vehicle, Workspace(bounds, sides), Goal((1.5 * scale, 0.0), 0.2 * scale)).pose_slack(0, 0, 0)
    assert 0.0 < slack / scale < 0.3 - 0.5 * mushr.footprint.width


@pytest.mark.parametrize("x", [0.41, 0.39, 0.38])
def test_a_long_vehicle_starts_as_near_to_a_wall_as_it_stands(x: float, mushr: Vehicle) -> None:
    """Few discs over a long footprint exceed its ends by a quarter of its width."""
    truck = dataclasses.replace(mushr, footprint=Footprint(0.9, 0.35, 0.1))
    result = plan_task(room(("x: 0.5, y: 0.5", f"x: {x}, y: 0.5"), ("center: [3, 3]", "center: [3, 0.9]")), truck, FEW)
    assert result.solved
    assert result.verification is not None
    assert 0.0 < result.verification.min_clearance <= x - 0.35 + 1e-9


@pytest.mark.parametrize(
    ("task", "reason"),
    [
        (lambda: room(WALL), "the goal is unreachable: no path from the start is wide enough for the footprint"),
        (lambda: room(NEAR), "the start is too near to 'pillar': mushr is 2.5 mm away, and the planner"),
        (
            lambda: room(("heading_deg: 0", "heading_deg: 0, speed: -0.2")),
            "the start is beyond the limits of the vehicle: v is -0.2, not 0 to 0.7",
        ),
        (
            lambda: dataclasses.replace(
                room(),
                planning=parse_scenario(SCENE + "planning: {safety: {delta: 0.4}}\n").planning,
            ),
            "m of the clearance delta that its first cycle requires",
        ),
    ],
    ids=["unreachable", "near", "limits", "delta"],
)
def test_a_hopeless_task_is_answered_without_searching(task: Callable[[], Task], reason: str, mushr: Vehicle) -> None:
    result = plan_task(task(), dataclasses.replace(mushr, limits={"v": (0.0, 0.7)}), FEW)
    assert not result.solved
    assert result.plan is None
    assert reason in result.reason
    assert result.progress.iterations == 0


def test_a_budget_too_small_returns_the_plan_that_ends_nearest(mushr: Vehicle) -> None:
    result = plan_task(load_scenario("turns").task(), mushr, Budget(iterations=3))
    assert not result.solved
    assert result.plan is not None
    assert result.verification is not None
    assert result.plan.cost_to_go > 0
    distance = math.dist(result.plan.states[-1][:2], (1.0, 5.0)) - 0.25
    assert f"ends {distance:.3g} m from the goal region" in result.reason


def test_no_edges_are_told_of_a_planner_that_does_not_count_them(mushr: Vehicle) -> None:
    task = load_scenario("turns", {"planning.planner": "rrt"}).task()
    result = plan_task(task, mushr, Budget(seconds=1e-9))
    assert result.plan is None
    assert result.reason.startswith("no edge may be executed after ")
    assert "tried" not in result.reason


def test_a_heading_that_is_missed_is_what_is_missing(mushr: Vehicle) -> None:
    goal = "radius: 0.3, heading_deg: 180, heading_tolerance_deg: 0.01"
    result = plan_task(room(("radius: 0.3", goal)), mushr, Budget(iterations=500))  # before local optimisation begins
    assert not result.solved
    assert result.plan is not None
    off = abs(math.degrees(math.remainder(result.plan.states[-1][2] - math.pi, math.tau)))
    assert math.dist(result.plan.states[-1][:2], (3, 3)) < 0.3
    assert f"in the goal region, {off:.3g} degrees off the heading" in result.reason


def test_a_plan_that_fails_verification_is_a_defect(mushr: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        import_module("kraft.planning.plan"), "verify", lambda *_: Verification(-1.0, None, (COLLISION,))
    )
    with pytest.raises(Defect, match=r"the plan of seed 3 fails verification: plan: collides at t = 1\.000 s"):
        plan_task(room(), mushr, FEW, seed=3)


@pytest.mark.parametrize(
    ("requirement", "accepted"),
    [(Requirement.COLLISION, False), (Requirement.CLEARANCE, True), (Requirement.CONTINGENCY, True)],
)
def test_a_plan_of_ompls_own_planners_has_to_be_free_of_collisions_and_no_more(
    requirement: Requirement, accepted: bool, mushr: Vehicle, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = Violation(requirement, "plan: has a problem")
    monkeypatch.setattr(import_module("kraft.planning.plan"), "verify", lambda *_: Verification(0.1, None, (problem,)))
    task = parse_scenario(SCENE + "planning: {planner: rrt}\n").task()
    result = plan_task(task, mushr, Budget(iterations=20_000), seed=1)
    assert (result.plan is not None) is accepted
    assert not result.safe


def test_an_unknown_planner_is_answered_with_the_nearest() -> None:
    (problem,) = raised(lambda: search_named("rrrt"))
    assert (problem.file, problem.argument, problem.code) == ("planner", True, Code.NOT_FOUND)
    assert "'rrt'" in problem.expected


def test_a_contingency_stops_the_vehicle_within_the_horizon_that_the_task_gives(
    mushr: Vehicle, solved: PlanResult
) -> None:
    def seconds(result: PlanResult) -> float:
        assert result.plan is not None
        assert result.plan.contingency is not None
        return float(np.ptp(result.plan.contingency.times))

    assert seconds(solved) > 0.25
    task = parse_scenario(SCENE + "planning: {safety: {horizon: 0.2}}\n", "room.yaml").task()
    assert seconds(plan_task(task, mushr, FEW, seed=3)) < 0.21


def test_checking_a_scenario_compiles_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def compile_now(vehicle: Vehicle, source: str) -> None:
        raise AssertionError(f"compiles the {source} of {vehicle.name}")

    monkeypatch.setattr(specialise, "_kernels", {})
    monkeypatch.setattr(specialise, "_execute", compile_now)
    task, vehicle = load_scenario("turns").task(), load_vehicle("mushr")
    check_placement(task, vehicle, start_state(task, vehicle))
    assert memory_needed(task, vehicle) > 0


def test_a_goal_with_a_heading_needs_more_memory() -> None:
    vehicle, goals = load_vehicle("mushr"), ({}, {"goal.heading_deg": 0, "goal.heading_tolerance_deg": 10})
    plain, finer = (memory_needed(load_scenario("turns", settings).task(), vehicle) for settings in goals)
    assert finer > 2 * plain


def test_a_plan_is_found_with_the_iterations_that_a_whole_search_needs(mushr: Vehicle) -> None:
    task = room()
    needed = next(n for n in range(1, 500) if plan_task(task, mushr, Budget(iterations=n)).solved)
    assert needed > 1
    assert not finds_plan(task, mushr, needed - 1)
    assert finds_plan(task, mushr, needed)


def test_no_plan_is_found_where_no_path_leads_to_the_goal(mushr: Vehicle) -> None:
    wall = room(("size: [1, 1]", "size: [4, 0.5]"))
    assert not finds_plan(wall, mushr, 100)


def test_a_negative_seed_is_refused(mushr: Vehicle) -> None:
    with pytest.raises(InputError) as caught:
        plan_task(room(), mushr, FEW, seed=-1)
    assert [(d.file, d.argument) for d in caught.value.diagnostics] == [("seed", True)]
