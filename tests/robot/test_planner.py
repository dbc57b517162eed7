"""The planner of a drive: what it asks for, new maps and goals, and what held or blocked the vehicle."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kraft.driving.method import load_method
from kraft.driving.planner_settings import Clearance, PlannerSettings
from kraft.robot.drive import on_the_clock
from kraft.robot.planner import Planner
from kraft.robot.protocol import DecisionRequest, DriveSpec, NewGoal, Sense, TaskChange
from kraft.robot.robot_file import Robot
from kraft.scenario import OccupancyMap, load_scenario
from kraft.vehicles.load import load_vehicle
from ompl_ext.obstacles import box
from ompl_ext.poses import pose_of

ROBOT: dict[str, Any] = {
    "name": "r", "transport": {"kind": "loopback"},
    "pose": {"topic": "/pose", "type": "geometry_msgs/msg/PoseStamped"}, "command": {"topic": "/drive"},
}  # fmt: skip


def robot(**changed: Any) -> Robot:
    return Robot.model_validate({**ROBOT, **changed}, strict=False)


@pytest.mark.slow
def test_a_start_with_less_clearance_lowers_what_is_asked_for_there_alone() -> None:
    """0.1 m from the right wall, from where the vehicle leaves with the clearance that it has."""
    asked = Clearance(delta=0.12, delta_per_speed=0.0)
    settings = PlannerSettings(
        mode="replanning", cycle=0.6, lead=0.3, safety=asked, recover=True, on_board="contingency"
    )
    method = load_method("filtered-kraft").model_copy(update={"planner": settings})
    task = load_scenario("turns").task()
    planner = Planner(DriveSpec(task, method, load_vehicle("mushr"), robot(), 60.0))
    planner.begin((1.96, 0.0, math.pi / 2))
    assert planner._replanner is not None
    proposer, checking = planner._replanner.proposer, planner._solvers.checking
    assert proposer.recovers
    assert checking.safety.delta < 0.1
    start = task.start
    proposer.propose(1, np.array([start.x, start.y, start.heading, 0.0]), None)
    assert not proposer.recovers
    assert checking.safety.delta == 0.12


@pytest.mark.slow
def test_what_blocked_the_vehicle_stays_until_a_map_has_news_of_its_place() -> None:
    """A doorstep that the robot's sensor does not see: maps that arrive every second would lead onto it again."""
    task = load_scenario("turns").task()
    method = load_method("adaptive-kraft")
    planner = Planner(DriveSpec(task, method, load_vehicle("mushr-force"), robot(), 60.0))
    planner.begin((task.start.x, task.start.y, task.start.heading))
    replanner, step = planner._replanner, box((1.7, 2.5), (0.2, 0.2), 0.0)
    assert replanner is not None
    occupied = np.zeros((160, 60), dtype=bool)

    def arrives(*places: tuple[slice, slice]) -> tuple[object, ...]:
        cells = occupied.copy()
        for place in places:
            cells[place] = True
        planner.change(TaskChange(None, OccupancyMap(cells, 0.05, (-0.5, -1.0, 0.0), name="map")))
        return replanner.blocked

    arrives()
    replanner._blocked = (step,)
    far, there = (slice(150, 152), slice(5, 7)), (slice(68, 73), slice(42, 47))
    assert arrives(far) == (step,)
    assert arrives(there) == ()


@pytest.mark.slow
def test_a_plan_that_a_new_map_forbids_is_not_committed() -> None:
    """It was planned before the map came, and the map came before it was decided."""
    task, vehicle = load_scenario("boxes").task(), load_vehicle("mushr-force")
    spec = DriveSpec(task, on_the_clock(load_method("adaptive-kraft")), vehicle, robot(), 60.0)
    start = task.start.x, task.start.y, task.start.heading
    reasons = []
    for blocked in (False, True):
        planner = Planner(spec)
        begun = planner.begin(start)
        if blocked:
            wall = OccupancyMap(np.ones((1, 40), dtype=bool), 0.05, (0.0, 0.0, 0.0), name="map")
            planner.change(TaskChange(None, wall))
        answer, _ = planner.decide(DecisionRequest(-0.3, 0, Sense(0), begun.commitment))
        reasons.append(answer.cycle.reason)
    assert reasons[0] == ""
    assert "clearance" in reasons[1] or "no manoeuvre stops safely" in reasons[1]


@pytest.mark.slow
def test_the_planner_identifies_nothing_from_the_time_in_which_something_held_the_vehicle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task, vehicle = load_scenario("boxes").task(), load_vehicle("mushr-force")
    planner = Planner(DriveSpec(task, on_the_clock(load_method("adaptive-kraft")), vehicle, robot(), 60.0))
    begun, left_out = planner.begin((task.start.x, task.start.y, task.start.heading)), list[tuple[float, float]]()
    replanner = planner._replanner
    assert replanner is not None
    decide = replanner.decide
    monkeypatch.setattr(replanner, "decide", lambda *given: replace(decide(*given), held=(0.1, 2.2)))
    monkeypatch.setattr(planner._estimator, "leave_out", lambda *span: left_out.append(span))
    planner.decide(DecisionRequest(-0.3, 0, Sense(0), begun.commitment))
    assert left_out == [(0.1, 2.2)]


@pytest.mark.slow
def test_a_goal_that_cannot_be_reached_is_not_taken_and_the_last_one_stays() -> None:
    task, vehicle = load_scenario("turns").task(), load_vehicle("mushr")
    planner = Planner(DriveSpec(task, on_the_clock(load_method("adaptive-kraft")), vehicle, robot(), 60.0))
    planner.begin((task.start.x, task.start.y, task.start.heading))
    x, y = task.goal.center
    taken = planner.change(TaskChange(NewGoal((50.0, 2.0)), None))
    assert taken.goal is None
    assert taken.refused == f"the goal (50, 2) is out of bounds: the last one, ({x:g}, {y:g}), stays"
    assert taken.problem == ""
    taken = planner.change(TaskChange(NewGoal((x, y)), None))
    assert (taken.goal, taken.problem, taken.refused) == (NewGoal((x, y)), "", "")
    wall = OccupancyMap(np.ones((10, 10), bool), 0.1, (x - 0.5, y - 0.5, 0.0), name="map")
    taken = planner.change(TaskChange(None, wall))
    assert (taken.goal, taken.problem) == (None, f"the goal ({x:g}, {y:g}) is in collision with 'map'")
    taken = planner.change(TaskChange(NewGoal((50.0, 2.0)), None))
    assert taken.refused.startswith("the goal (50, 2) is out of bounds: ")
    assert taken.problem == f"the goal ({x:g}, {y:g}) is in collision with 'map'", "which the last one still is"


@pytest.mark.slow
def test_plans_end_with_the_heading_of_a_new_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.perf_counter", time.process_time)  # for the budgets: the machine may be busy
    task, vehicle = load_scenario("boxes").task(), load_vehicle("mushr-force")
    described = robot(goal={"topic": "/goal", "heading_tolerance_deg": 15})
    planner = Planner(DriveSpec(task, on_the_clock(load_method("adaptive-kraft")), vehicle, described, 60.0))
    begun = planner.begin((task.start.x, task.start.y, task.start.heading))
    heading, tolerance = math.radians(150), math.radians(15)
    taken = planner.change(TaskChange(NewGoal(task.goal.center, heading, tolerance), None))
    assert not taken.problem
    assert not taken.refused
    planner.decide(DecisionRequest(-0.3, 0, Sense(0), begun.commitment))
    assert planner._replanner is not None
    for _ in range(20):  # one search may find nothing in time
        planner.prepare()
        if (plan := planner._replanner.proposal.plan) is not None:
            break
    assert plan is not None
    assert plan.reaches_goal
    x, y, theta = pose_of(plan.states[-1], vehicle)
    assert math.dist((x, y), task.goal.center) <= task.goal.radius
    assert abs(math.remainder(theta - heading, math.tau)) <= tolerance
