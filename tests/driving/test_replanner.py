"""Every decision of the replanner: what it commits, and why."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from support.replanner import FARSIGHTED, MARGIN, drive, mushr, planner_settings, replanner, start, turns

from kraft.driving.car_model import CarModel
from kraft.driving.contingencies import emergency_reference
from kraft.driving.control import make_controller
from kraft.driving.control_settings import Geometric
from kraft.driving.messages import Commitment, ContingencyOrigin, Cycle, Estimate, ReferenceKind
from kraft.driving.planner_settings import Clearance, PlannerSettings
from kraft.driving.prediction import ClosedLoopPredictor
from kraft.driving.replanner import Replanner
from kraft.driving.room import NEARBY, free_by
from kraft.driving.solvers import Solvers
from ompl_ext.arrays import Floats
from ompl_ext.obstacles import box
from ompl_ext.poses import poses_of


def test_the_first_cycle_executes_the_plan_made_before_the_clock_ran() -> None:
    first = drive(replanner(), 1)[0]
    assert (first.number, first.time, first.kind) == (0, 0.0, ReferenceKind.PLAN)
    assert first.reference.start == 0.0
    np.testing.assert_array_equal(first.reference.states[0], start())
    assert first.reference.end == pytest.approx(first.cost_to_goal)


def test_the_clearance_of_a_cycle_is_that_of_its_predicted_motion_whenever_it_is_asked_for() -> None:
    subject = replanner()
    for cycle in drive(subject, 3):
        poses = poses_of(cycle.predicted.states, subject.dirt.vehicle)
        assert cycle.clearance == subject.dirt.least_distance(poses) > 0.0


@pytest.mark.parametrize("tracking", [False, True])
@pytest.mark.parametrize("safety", [None, FARSIGHTED])
def test_a_vehicle_that_is_where_it_was_predicted_reaches_the_goal_without_a_contingency(
    safety: Clearance | None, tracking: bool
) -> None:
    cycles = drive(replanner(safety=safety, tracking=tracking, margin=0.03), 9)
    assert [cycle.kind for cycle in cycles] == [ReferenceKind.PLAN] * 9
    costs = [cycle.cost_to_goal for cycle in cycles]
    assert costs[-1] < costs[0] - 6.0
    assert min(cycle.clearance for cycle in cycles) > 0.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_vehicle_that_does_as_planned_needs_no_contingency_for_a_clearance_that_grows_fast_with_speed(
    seed: int,
) -> None:
    """Asked for in the coming cycle alone it lets plans cut corners that the next cycle crawls round, but drives on."""
    cycles = drive(replanner(seed, safety=MARGIN, margin=0.03), 9)
    assert [cycle.kind for cycle in cycles] == [ReferenceKind.PLAN] * 9
    assert min(cycle.predicted.slack for cycle in cycles) >= 0.0


def test_a_plan_that_the_controller_gets_ahead_of_by_more_than_the_margin_is_rejected() -> None:
    """The controller looks ahead of the plan: where that speeds up, 0.25 of the difference of speeds is the slack."""
    cycles = drive(replanner(2, safety=MARGIN, margin=0.03, tracking=True), 9)
    refused = [cycle for cycle in cycles if cycle.kind is ReferenceKind.CONTINGENCY]
    assert refused
    assert all("from the latest estimate" in cycle.reason for cycle in refused)
    assert all(cycle.predicted.slack >= 0.0 for cycle in cycles)  # each of them with a safe one


def test_each_cycle_begins_where_the_last_one_is_predicted_to_end() -> None:
    cycles = drive(replanner(), 4)
    for before, after in itertools.pairwise(cycles):
        assert after.time == pytest.approx(before.predicted.times[-1])
        np.testing.assert_allclose(after.predicted.states[0], before.predicted.final_state, atol=2e-3)


def test_what_is_left_of_the_last_plan_is_kept() -> None:
    cycles = drive(replanner(), 3)
    assert cycles[0].retained == 0
    assert cycles[1].retained > 0
    assert cycles[2].retained > 0


def test_a_step_is_due_its_lead_before_the_cycle() -> None:
    subject = replanner(lead=0.25)
    subject.begin(start())
    assert subject.next_step == 0.0
    drive(subject, 1)
    assert subject.next_step == pytest.approx(0.75)


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
@pytest.mark.parametrize("delay", [0.05, 0.4, 1.5])
def test_a_cycle_begins_when_what_is_committed_has_arrived_and_where_what_is_under_way_leads(
    delay: float, seed: int
) -> None:
    """A vehicle that does as predicted is, with any delay, where the next cycle is predicted to begin."""
    subject = replanner(seed, delay=delay, tracking=True, margin=0.06)  # for what tracking leaves a plan by
    standing, found = subject.begin(start()), list[Cycle]()
    late = max(0.0, delay - 0.1)
    for number in range(6):
        now = subject.next_step
        begun = [cycle for cycle in found if cycle.time <= now + 1e-9]
        state, current = start(), standing
        if begun:
            times, states = begun[-1].predicted.times, begun[-1].predicted.states
            state = np.array([np.interp(now, times, column) for column in states.T])
            current = begun[-1].commitment
        found.append(subject.step(Estimate(now, state, 0.0), current))
        assert found[-1].time == pytest.approx(number + late)
        assert found[-1].reference.start == pytest.approx(number + late)
    assert [cycle.kind for cycle in found] == [ReferenceKind.PLAN] * 6
    for before, after in itertools.pairwise(found):
        assert before.predicted.times[-1] == pytest.approx(after.time)
        np.testing.assert_allclose(after.predicted.states[0], before.predicted.final_state, atol=5e-3)
    assert math.dist(found[-1].predicted.final_state[:2], start()[:2]) > 1.5


def test_one_shot_plans_once() -> None:
    subject = replanner(mode="one-shot")
    first = drive(subject, 1)[0]
    assert first.kind is ReferenceKind.PLAN
    assert subject.next_step == math.inf


def test_a_plan_that_is_unsafe_from_the_latest_estimate_is_not_committed() -> None:
    towards_the_wall = np.array([0.9, 0.0, 0.0, 0.0])  # the corridor's inner half width is 1.2 m
    cycles = drive(replanner(safety=MARGIN), 2, towards_the_wall)
    assert cycles[1].kind is ReferenceKind.CONTINGENCY
    assert "from the latest estimate" in cycles[1].reason
    assert cycles[1].contingency is cycles[1].reference


def test_a_method_without_a_clearance_refuses_a_plan_for_a_collision_not_for_a_lack_of_clearance() -> None:
    towards_the_wall = np.array([0.9, 0.0, 0.0, 0.0])
    asked, unasked = (drive(subject, 2, towards_the_wall)[1] for subject in (replanner(safety=MARGIN), replanner()))
    assert "may touch" not in asked.reason
    assert unasked.kind is ReferenceKind.CONTINGENCY
    assert unasked.reason == "from the latest estimate the motion along the plan may touch an obstacle"


def test_a_plan_is_committed_without_clearance_if_none_is_asked_for() -> None:
    assert drive(replanner(), 2, np.array([0.02, 0.0, 0.0, 0.0]))[1].kind is ReferenceKind.PLAN


@pytest.mark.parametrize("age", [0.6, math.inf])
def test_an_old_or_missing_observation_stops_the_vehicle(age: float) -> None:
    subject = replanner(patience=0.5)
    current = subject.begin(start())
    first = subject.step(Estimate(0.0, start(), math.inf), current)
    assert first.kind is ReferenceKind.PLAN  # where it stands at the start is known
    late = subject.step(Estimate(0.9, first.predicted.states[-3], age), first.commitment)
    assert late.kind is ReferenceKind.CONTINGENCY
    assert ("newest observation" if math.isfinite(age) else "no observation") in late.reason


def test_an_observation_that_is_late_but_not_too_late_does_not_stop_it() -> None:
    subject = replanner(patience=0.5)
    first = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    assert subject.step(Estimate(0.9, first.predicted.states[-4], 0.4), first.commitment).kind is ReferenceKind.PLAN


def test_without_a_plan_the_vehicle_stops() -> None:
    subject = replanner(safety=Clearance(delta=0.5))  # more than the start has to the near wall
    cycle = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    assert cycle.kind is ReferenceKind.CONTINGENCY
    assert " m of the clearance delta that the cycle requires" in cycle.reason
    np.testing.assert_allclose(cycle.predicted.final_state[:2], start()[:2], atol=1e-6)


def test_a_prediction_in_collision_stops_the_vehicle_one_cycle_later() -> None:
    subject = replanner()
    first = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    fast = np.array([1.0, 0.7, math.pi / 2, 0.6])  # 10 cm from the first box's level and heading past it
    into = np.array([0.45, 0.6, math.pi / 2, 0.6])  # 0.2 m before the first box
    stopped = subject.step(Estimate(0.9, into, 0.0), first.commitment)
    assert stopped.kind is ReferenceKind.CONTINGENCY
    assert subject.step(Estimate(1.9, fast, 0.0), stopped.commitment).reason != ""


def test_an_estimate_in_collision_is_moved_to_the_nearest_free_state() -> None:
    subject = replanner()
    inside = np.array([0.5, 0.85, math.pi / 2, 0.0])  # its front is 5 cm inside the first box
    cycle = subject.step(Estimate(0.0, inside, 0.0), subject.begin(start()))
    assert subject.dirt.exact.distance(*cycle.predicted.states[0][:3]) > 0.0
    assert math.dist(cycle.predicted.states[0][:2], inside[:2]) < 0.13


def between_boxes(gap: float) -> Replanner:
    """A replanner whose map has a box on either side of the start, `gap` m from the rear half of the vehicle."""
    x, y, aside = start()[0], start()[1], 0.5 * mushr().footprint.width + gap + 0.2
    boxes = tuple(box((x + side * aside, y - 0.15), (0.4, 0.4), 0.0) for side in (-1.0, 1.0))
    settings = {"on_board": "contingency", "safety": Clearance(delta=0.1)}
    subject = replanner(**settings)  # type: ignore[arg-type]
    subject.set_solvers(Solvers.of(turns(), mushr(), planner_settings(**settings), boxes))
    return subject


@pytest.mark.parametrize("gap", [0.03, 0.035])
@pytest.mark.parametrize("aside", [0.0, 0.005])
def test_a_vehicle_at_rest_between_boxes_is_taken_to_stand_near_where_it_is_estimated(gap: float, aside: float) -> None:
    """There is no place with more room: the nearest one is in front of the boxes, and the vehicle is not there."""
    subject, place = between_boxes(gap), start() + np.array([aside, 0.0, 0.0, 0.0])
    cycle = subject.step(Estimate(0.0, place, 0.0), subject.begin(start()))
    assert cycle.contingency_origin is ContingencyOrigin.STANDING
    assert math.dist(cycle.predicted.final_state[:2], place[:2]) <= NEARBY + 1e-9
    np.testing.assert_array_equal(cycle.predicted.states[0], cycle.predicted.final_state)
    assert free_by(subject.dirt, cycle.predicted.final_state) >= free_by(subject.dirt, place)


def test_every_contingency_ends_at_standstill() -> None:
    for cycle in drive(replanner(safety=MARGIN), 8):
        assert cycle.contingency is not None
        assert abs(cycle.contingency.states[-1][3]) <= 0.01
        assert cycle.contingency.rest[0] == 0.0


def too_fast_beside_the_contingency(first: Cycle, share: float) -> Floats:
    """`share` of delta(v) beside where a contingency begins, so fast that no manoeuvre keeps delta(v)."""
    assert first.contingency is not None
    delta = 0.05 + 0.25 * float(first.contingency.states[0][3])  # what it was verified for
    state = first.contingency.state_at(1.0) + np.array([share * delta, 0.0, 0.0, 0.0])
    state[3] = 4.0  # for which 1.05 m are asked for, more than there is
    return state


@pytest.mark.parametrize("share", [0.0, 1.95, -1.95])
def test_the_contingency_in_hand_is_used_when_none_is_safe_and_the_vehicle_is_near_where_it_begins(
    share: float,
) -> None:
    subject = replanner(safety=MARGIN)
    first = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    assert first.contingency is not None
    second = subject.step(Estimate(1.0, too_fast_beside_the_contingency(first, share), 0.0), first.commitment)
    assert second.kind is ReferenceKind.CONTINGENCY
    assert second.reference is first.contingency


@pytest.mark.parametrize("share", [2.05, -2.05])
def test_an_emergency_is_what_is_left_when_none_is_safe_and_the_one_in_hand_begins_elsewhere(share: float) -> None:
    subject = replanner(safety=MARGIN)
    first = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    state = too_fast_beside_the_contingency(first, share)
    second = subject.step(Estimate(1.0, state, 0.0), first.commitment)
    assert (second.kind, second.reference.start) == (ReferenceKind.CONTINGENCY, 1.0)
    assert second.reference is not first.contingency
    expected = emergency_reference(subject.dirt, state, 1.0)
    np.testing.assert_array_equal(second.reference.states, expected.states)
    np.testing.assert_array_equal(second.reference.controls, expected.controls)
    assert second.contingency is second.reference


@pytest.mark.parametrize(("turn", "kept"), [(0.0, True), (0.9, True), (-0.9, True), (1.1, False), (math.pi, False)])
def test_the_contingency_in_hand_counts_how_far_a_turn_moves_the_farthest_point(turn: float, kept: bool) -> None:
    """Turns in multiples of the one that moves the footprint's farthest point by 2 delta(v), or in radians."""
    subject = replanner(safety=MARGIN)
    first = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    assert first.contingency is not None
    state = too_fast_beside_the_contingency(first, 0.0)
    delta = 0.05 + 0.25 * float(first.contingency.states[0][3])
    state[2] += turn * (2.0 * delta / mushr().footprint.reach if abs(turn) < 2.0 else 1.0)
    second = subject.step(Estimate(1.0, state, 0.0), first.commitment)
    assert (second.reference is first.contingency) == kept


def test_a_contingency_goes_on_when_no_other_is_safe() -> None:
    subject = replanner(safety=MARGIN)
    first = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    near_the_box = np.array([0.5, 0.78, math.pi / 2, 0.6])
    second = subject.step(Estimate(1.0, near_the_box, 0.0), first.commitment)
    third = subject.step(Estimate(1.9, near_the_box, 0.0), second.commitment)
    assert third.reference is second.reference


def test_looking_ahead_leaves_the_controller_as_it_is() -> None:
    controller = make_controller(Geometric(kind="geometric"), CarModel(mushr()))  # which remembers errors
    planner = PlannerSettings(mode="replanning", iterations=300)
    subject = Replanner(Solvers.of(turns(), mushr(), planner), planner, controller, 0, period=1 / 30)
    reference = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start())).reference
    untouched = make_controller(Geometric(kind="geometric"), CarModel(mushr()))
    beside, predict = start() + np.array([0.05, 0.1, 0.1, 0.3]), ClosedLoopPredictor(subject.dirt, controller, 1 / 30)
    for k in range(5):
        estimate = Estimate(0.3 + k / 30, beside, 0.0)
        predict(beside, estimate.time, estimate.time + 1.0, Commitment(reference))
        np.testing.assert_array_equal(controller.command(estimate, reference), untouched.command(estimate, reference))


def test_the_same_seed_drives_the_same_way() -> None:
    once, again = drive(replanner(seed=5), 5), drive(replanner(seed=5), 5)
    for first, second in zip(once, again, strict=True):
        assert first.reference.states.tobytes() == second.reference.states.tobytes()
    other = drive(replanner(seed=6), 5)
    assert any(
        first.reference.states.shape != second.reference.states.shape
        or not np.array_equal(first.reference.states, second.reference.states)
        for first, second in zip(once, other, strict=True)
    )
