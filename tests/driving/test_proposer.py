"""What the replanner may commit next: margins, foresight, recovering, verification, the clock."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support.replanner import BESIDE_THE_WALL, FARSIGHTED, MARGIN, drive, mushr, replanner, start, turns

from kraft.driving.messages import ReferenceKind, Uncertainty
from kraft.driving.method import CalibratedBound, Clearance, PlannerSettings
from kraft.driving.proposer import RECOVERY_MARGIN
from kraft.driving.solvers import MIN_GOAL_RADIUS, Solvers, aimed_for, goal_region
from kraft.errors import Defect
from kraft.planning.workspace import goal_of, workspace_of
from kraft.scenario import load_scenario
from ompl_ext.exact import ExactClearance
from ompl_ext.kernels import kernel_types as at
from ompl_ext.plan import Plan
from ompl_ext.query import Goal
from ompl_ext.query_tree import Progress
from ompl_ext.solver import DirtSolver
from ompl_ext.verification import Violation


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


def test_a_plan_keeps_the_margin_to_its_end_and_the_clearance_as_far_as_foresight_reaches() -> None:
    subject = replanner(safety=FARSIGHTED, margin=0.03)
    subject.begin(start())
    plan = subject._proposal.plan
    assert plan is not None
    away = subject.dirt.exact.distances(plan.trajectory[:, :3])
    assert away.min() >= 0.03
    soon = plan.times <= 3.0
    assert np.all(away[soon] >= 0.03 + 0.02 + 0.05 * plan.trajectory[soon, 3] - 1e-9)


def test_a_start_without_room_for_the_margin_is_planned_from_without_it() -> None:
    begin = BESIDE_THE_WALL + np.array([0.08, 0.0, 0.0, 0.0])
    cycles = drive(replanner(margin=0.03), 2, begin=begin)
    assert cycles[0].kind is ReferenceKind.PLAN
    assert 0.0 < cycles[0].clearance < 0.03


def test_a_vehicle_that_rests_nearer_than_the_clearance_stays_there() -> None:
    cycles = drive(replanner(safety=Clearance(delta=0.15, delta_per_speed=0.0)), 3, begin=BESIDE_THE_WALL)
    assert [cycle.kind for cycle in cycles] == [ReferenceKind.CONTINGENCY] * 3
    lack = re.fullmatch(
        r"the predicted start of the cycle lacks (0\.\d{3}) m of the clearance delta that the cycle requires",
        cycles[0].reason,
    )
    assert lack is not None
    task, vehicle = turns(), mushr()
    away = ExactClearance(workspace_of(task, vehicle), vehicle.footprint).distance(*BESIDE_THE_WALL[:3])
    assert 0.15 - away - 5e-4 <= float(lack[1]) <= 0.15 - away + 0.02  # the field loses up to 2 cm
    np.testing.assert_allclose(cycles[-1].predicted.final_state, BESIDE_THE_WALL, atol=1e-6)


def test_with_recover_it_leaves_with_the_clearance_that_it_has_and_then_keeps_what_is_asked_for() -> None:
    subject = replanner(safety=Clearance(delta=0.15, delta_per_speed=0.0), recover=True)
    cycles = drive(subject, 8, begin=BESIDE_THE_WALL)
    assert cycles[0].kind is ReferenceKind.PLAN
    assert min(cycle.clearance for cycle in cycles) >= 0.1 - RECOVERY_MARGIN - 1e-3
    assert cycles[-1].clearance >= 0.15
    assert subject.dirt.safety.delta == 0.15


def test_a_vehicle_that_has_recovered_keeps_what_is_asked_for_also_while_it_drives() -> None:
    subject = replanner(safety=Clearance(delta=0.15, delta_per_speed=0.0), recover=True)
    drive(subject, 8, begin=BESIDE_THE_WALL)
    moving = BESIDE_THE_WALL + np.array([0.0, 0.0, 0.0, 0.4])
    assert subject._proposer.propose(9, moving, None).plan is None
    assert subject.dirt.safety.delta == 0.15


def test_recover_is_for_a_vehicle_at_rest_and_not_in_collision() -> None:
    settings = {"safety": Clearance(delta=0.15, delta_per_speed=0.0), "recover": True}
    for change in ([0.0, 0.0, 0.0, 0.4], [0.12, 0.0, 0.0, 0.0]):
        subject = replanner(**settings)  # type: ignore[arg-type]
        subject.begin(BESIDE_THE_WALL + np.array(change))
        assert subject._proposal.plan is None
        assert subject.dirt.safety.delta == 0.15


@pytest.mark.parametrize(("nearer", "acceleration"), [(0.07, 3.0), (0.08, 0.5), (0.08, 3.0)])
def test_a_vehicle_at_rest_leaves_a_narrow_place_however_fast_its_bound_grows(
    nearer: float, acceleration: float
) -> None:
    """The bound grows by more in a cycle than a vehicle at rest can gain: it could not even stay."""
    uncertain = Uncertainty(np.diag([0.1**2, 0.1**2, 0.05**2, 0.05**2]), 0.01, acceleration)
    begin = BESIDE_THE_WALL + np.array([nearer, 0.0, 0.0, 0.0])
    subject = replanner(
        tracking=True, model="mushr-drive", cycle=0.25, margin=0.03, iterations=500, recover=True,
        bound=CalibratedBound(foresight=60.0), on_board="contingency", contingencies="tracked",
    )  # fmt: skip
    cycles = drive(subject, 16, begin=begin, uncertainty=uncertain)
    assert min(cycle.clearance for cycle in cycles) > 0.02
    assert [cycle.kind for cycle in cycles[-8:]] == [ReferenceKind.PLAN] * 8
    assert cycles[-1].clearance > 0.2


@pytest.mark.parametrize(("away", "radius"), [(0.2, 0.1), (0.1, 0.05), (0.004, MIN_GOAL_RADIUS)])
def test_the_goal_region_shrinks_before_a_vehicle_that_has_not_arrived(away: float, radius: float) -> None:
    """By its own estimate it has: a plan from within the scene's region, 0.25 m, would else be to stay there."""
    subject = replanner()
    subject.begin(np.array([1.0, 5.0 - away, math.pi / 2, 0.0]))
    plan = subject._proposal.plan
    assert plan is not None
    assert math.dist(plan.states[-1][:2], (1.0, 5.0)) <= radius
    assert (len(plan.durations) > 0) == (away > MIN_GOAL_RADIUS)


def test_the_goal_region_is_the_whole_one_again_when_the_vehicle_is_farther_away() -> None:
    subject = replanner()
    subject.begin(np.array([1.0, 4.9, math.pi / 2, 0.0]))
    subject._proposer.propose(1, start(), None)
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


def test_what_is_verified_is_all_that_may_be_executed(monkeypatch: pytest.MonkeyPatch) -> None:
    heads = list[Plan]()

    def violations(_: DirtSolver, head: Plan) -> tuple[Violation, ...]:
        heads.append(head)
        return ()

    monkeypatch.setattr("kraft.driving.proposer.violations", violations)
    for mode, until in (("replanning", 1.0), ("one-shot", math.inf)):
        subject = replanner(mode=mode)
        subject.begin(start())
        plan, head = subject._proposal.plan, heads[-1]
        assert plan is not None
        assert len(plan.durations) > 2
        assert head.times[-1] == pytest.approx(head.durations.sum())
        assert head.times[-1] >= min(until, plan.cost) - 1e-9
        assert len(head.times) == len(head.trajectory)
        assert len(head.states) == len(head.durations) + 1
        np.testing.assert_array_equal(head.trajectory, plan.trajectory[: len(head.times)])
    assert {round(head.durations.sum(), 6) for head in heads} != {round(heads[0].durations.sum(), 6)}


def test_a_plan_that_fails_its_verification_is_a_defect(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kraft.driving.proposer.violations", lambda *_: ("plan: collides",))
    with pytest.raises(Defect, match=r"cycle 0 fails verification: plan: collides"):
        replanner().begin(start())


def test_a_plan_that_comes_too_late_is_dropped_in_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    subject = replanner(realtime=True, cycle=0.2, lead=0.0)
    subject.begin(start())
    late = itertools.chain([0.0], itertools.repeat(5.0))
    monkeypatch.setattr("kraft.driving.proposer.clock.perf_counter", lambda: next(late))
    monkeypatch.setattr(subject.dirt, "grow", lambda **_: subject.dirt.progress)
    proposal = subject._proposer.propose(1, start(), None)
    assert proposal.missed
    assert proposal.plan is None
    assert "planning took 5.000 s" in proposal.reason


def test_a_path_of_a_geodesic_method_that_comes_too_late_is_dropped_in_real_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    subject = replanner(realtime=True, cycle=0.2, lead=0.0, type="geodesic")
    assert subject._proposer.propose(0, start(), None).plan is not None
    late = itertools.chain([0.0], itertools.repeat(5.0))
    monkeypatch.setattr("kraft.driving.proposer.clock.perf_counter", lambda: next(late))
    proposal = subject._proposer.propose(2, start(), None)
    assert (proposal.missed, proposal.plan, proposal.seconds) == (True, None, 5.0)


@pytest.mark.parametrize("realtime", [False, True])
def test_the_first_plan_which_is_made_before_the_drive_is_never_late(
    monkeypatch: pytest.MonkeyPatch, realtime: bool
) -> None:
    subject = replanner(realtime=realtime, cycle=0.2, lead=0.0)
    late = itertools.chain([0.0, 0.0], itertools.repeat(5.0))
    monkeypatch.setattr("kraft.driving.proposer.clock.perf_counter", lambda: next(late))
    monkeypatch.setattr(subject.dirt, "grow", lambda grow=subject.dirt.grow, **_: grow(iterations=300))
    proposal = subject._proposer.propose(0, start(), None)
    assert proposal.seconds == 5.0
    assert proposal.plan is not None
    assert not proposal.missed


def test_by_the_clock_a_search_without_the_margin_has_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search with the margin finds nothing: half of the time is its, the rest that of the one without."""
    subject = replanner(realtime=True, margin=0.03, cycle=0.5, lead=0.05)
    now, granted, both = [0.0], list[float](), subject._proposer._solvers
    monkeypatch.setattr("kraft.driving.proposer.clock.perf_counter", lambda: now[0])
    for dirt in (both.planning, both.checking):

        def grow(seconds: float, dirt: DirtSolver = dirt, grow: Callable[..., Progress] = dirt.grow) -> Progress:
            granted.append(seconds)
            now[0] += seconds
            return grow(iterations=300)

        monkeypatch.setattr(dirt, "grow", grow)
    monkeypatch.setattr(both.planning, "plan", lambda _=None: None)
    proposal = subject._proposer.propose(0, start(), None)
    assert granted == pytest.approx([0.175, 0.175, 0.0])  # of 0.8 x 0.5 s - 0.05 s; with a plan it goes on
    assert proposal.plan is not None
    assert not proposal.missed


def test_by_the_clock_the_iterations_of_all_levels_are_counted() -> None:
    bound = CalibratedBound(shares=(1.0, 0.25))
    subject = replanner(cycle=0.2, lead=0.0, bound=bound, realtime=True)
    assert subject._proposer.propose(0, start(), None).iterations >= 300
