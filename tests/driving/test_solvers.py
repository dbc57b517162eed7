"""Solvers of a method: what planning asks for and checking does not, and the region that they aim for."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.replanner import FARSIGHTED, MARGIN, mushr, replanner, start, turns

from kraft.driving.planner_settings import Clearance, PlannerSettings
from kraft.driving.solvers import MIN_GOAL_RADIUS, Solvers, aimed_for, goal_region
from kraft.planning.workspace import goal_of
from kraft.scenario import load_scenario
from ompl_ext.kernels import kernel_types as at
from ompl_ext.query import Goal


def solvers(**settings: object) -> Solvers:
    return Solvers.of(turns(), mushr(), PlannerSettings(**{"mode": "replanning", **settings}))  # type: ignore[arg-type]


def test_without_margin_and_foresight_what_plans_is_what_checks() -> None:
    for same in (solvers(), solvers(safety=MARGIN), solvers(safety=Clearance(foresight=1.0))):
        assert same.planning is same.checking


def test_planning_keeps_margin_and_foresight_and_checking_does_not() -> None:
    ours = solvers(safety=FARSIGHTED, margin=0.03, goal_margin=0.1)
    shape, larger_footprint = mushr().footprint, ours.planning.vehicle.footprint
    assert ours.checking.vehicle.footprint == shape
    assert (larger_footprint.length, larger_footprint.width) == (
        pytest.approx(shape.length + 0.06),
        pytest.approx(shape.width + 0.06),
    )
    assert larger_footprint.offset == shape.offset
    assert (ours.planning.safety.cycle, ours.checking.safety.cycle) == (3.0, 1.0)
    for dirt in (ours.planning, ours.checking):
        assert (dirt.safety.enabled, dirt.safety.delta, dirt.safety.delta_per_speed) == (True, 0.02, 0.05)
        assert dirt.goal is not None
        assert dirt.goal.radius == pytest.approx(0.15)  # the scene's is 0.25 m


def test_the_cost_to_go_of_poses_leads_a_car_that_faces_away_round_and_not_astern_into_a_wall() -> None:
    ahead, facing_away = start(), start()
    facing_away[2] += math.pi
    seconds = {}
    for kind in ("position", "pose"):
        dirt = solvers(cost_to_go=kind, margin=0.03).planning
        seconds[kind] = [
            dirt.start(state) and float(dirt.tree_arrays.value[0, at.TOGO]) for state in (ahead, facing_away)
        ]
    assert seconds["position"][0] == seconds["position"][1]
    assert seconds["pose"][1] > seconds["pose"][0] + 0.5
    assert all(seconds["pose"][k] >= seconds["position"][k] for k in range(2))


def test_a_margin_leaves_at_least_half_of_a_goals_radius() -> None:
    goal = solvers(goal_margin=0.4).checking.goal
    assert goal is not None
    assert goal.radius == 0.5 * load_scenario("turns").goal.radius


def test_with_a_heading_a_margin_leaves_half_of_its_tolerance_and_of_limits_of_rest() -> None:
    limits = {"v": (-0.06, 0.04), "omega": (0.2, 0.4)}
    goal = Goal((1.0, 5.0), 0.08, 0.5, math.radians(6.0), limits)
    aimed = aimed_for(goal, 0.1)
    assert (aimed.center, aimed.radius, aimed.heading) == (goal.center, 0.04, 0.5)
    assert aimed.tolerance == pytest.approx(math.radians(3.0))
    assert aimed.limits == {"v": (-0.03, 0.02), "omega": (0.2, 0.4)}
    assert aimed_for(replace(goal, tolerance=math.radians(1.2)), 0.1).tolerance == pytest.approx(math.radians(1.0))
    assert aimed_for(replace(goal, tolerance=math.radians(0.8)), 0.1).tolerance == pytest.approx(math.radians(0.8))
    settings = PlannerSettings(mode="replanning", goal_margin=0.1)
    parked = Solvers.of(load_scenario("parking").task(), mushr(), settings).goal
    assert (parked.radius, parked.tolerance) == (0.025, pytest.approx(math.radians(2.5)))
    assert parked.limits == {"v": (-0.025, 0.025)}


def test_without_a_heading_or_a_margin_only_the_radius_is_smaller() -> None:
    resting = Goal((1.0, 5.0), 0.3, limits={"v": (-0.05, 0.05)})
    assert aimed_for(resting, 0.1) == replace(resting, radius=0.3 - 0.1)
    parked = replace(resting, heading=0.5, tolerance=0.1)
    assert aimed_for(parked, 0.0) == parked
    passed = replace(parked, limits={})
    assert aimed_for(passed, 0.1) == replace(passed, radius=0.3 - 0.1)


@pytest.mark.parametrize(("away", "radius"), [(0.2, 0.1), (0.1, 0.05), (0.004, MIN_GOAL_RADIUS)])
def test_the_goal_region_shrinks_before_a_vehicle_that_has_not_arrived(away: float, radius: float) -> None:
    """By its own estimate it has: a plan from within the scene's region, 0.25 m, would else be to stay there."""
    subject = replanner()
    subject.begin(np.array([1.0, 5.0 - away, math.pi / 2, 0.0]))
    plan = subject.proposal.plan
    assert plan is not None
    assert math.dist(plan.states[-1][:2], (1.0, 5.0)) <= radius
    assert (len(plan.durations) > 0) == (away > MIN_GOAL_RADIUS)


def test_the_goal_region_is_the_whole_one_again_when_the_vehicle_is_farther_away() -> None:
    subject = replanner()
    subject.begin(np.array([1.0, 4.9, math.pi / 2, 0.0]))
    subject.proposer.propose(1, start(), None)
    assert subject.dirt.goal is not None
    assert subject.dirt.goal.radius == 0.25


@pytest.mark.parametrize(
    ("away", "off_deg", "radius", "tolerance_deg"),
    [
        (0.1, 20.0, 0.25, 10.0),  # it has to turn
        (0.3, 0.0, 0.25, 10.0),
        (0.1, 2.0, 0.05, 10.0),  # nearer to the border of the disc
        (0.1, 8.0, 0.25, 4.0),  # nearer to the limit of the heading
        (0.0, 0.5, 0.25, 1.0),
    ],
)
def test_a_goal_with_a_heading_shrinks_only_for_a_vehicle_in_it_where_it_is_nearest_to_its_limits(
    away: float, off_deg: float, radius: float, tolerance_deg: float
) -> None:
    heading = {"goal.heading_deg": 90.0, "goal.heading_tolerance_deg": 10.0}
    goal = goal_of(load_scenario("turns", heading).task())
    state = np.array([1.0, 5.0 - away, math.radians(90.0 + off_deg), 0.0])
    assert goal_region(goal, mushr(), state) == pytest.approx((radius, math.radians(tolerance_deg)))
