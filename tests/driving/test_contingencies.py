"""Contingencies as the controller tracks them: the ranking finds the best, and what it verifies keeps the clearance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.replanner import FARSIGHTED, replanner, start

from kraft.driving import contingencies
from kraft.driving.car_model import CarModel
from kraft.driving.contingencies import ContingencyRanking, TrackedContingency
from kraft.driving.contingency_candidates import Begin
from kraft.driving.control import Controller, KinodynamicController, make_controller
from kraft.driving.control_settings import Dwa, Kinodynamic
from kraft.driving.messages import Commitment, ContingencyOrigin, Estimate, Reference, ReferenceKind
from kraft.driving.prediction import ClosedLoopPredictor, required_clearance
from kraft.driving.references import contingency_reference, plan_reference
from kraft.driving.replanner import Replanner
from ompl_ext.arrays import Floats, Ints

STATES = [
    np.array([1.6, 1.2, 1.5, 0.5]),
    np.array([0.6, 0.2, 1.2, 0.5]),
    np.array([1.5, 2.4, 1.57, 0.6]),
    np.array([1.9, 1.0, 1.2, 0.6]),
]


def subject(**settings: object) -> Replanner:
    found = replanner(model="mushr-drive", tracking=True, safety=FARSIGHTED, contingencies="tracked", **settings)
    found.begin(start())
    return found


def predictor(found: Replanner, controller: Controller | None = None) -> ClosedLoopPredictor:
    """Predictor of the replanner's controller, or of another one."""
    model = CarModel(found.dirt.vehicle)
    law = make_controller(Kinodynamic(kind="kinodynamic"), model) if controller is None else controller
    return ClosedLoopPredictor(found.dirt, law, 1 / 30)


def ranking(found: Replanner) -> ContingencyRanking:
    return ContingencyRanking(found.dirt, predictor(found), CarModel(found.dirt.vehicle))


def all_tracked(
    found: Replanner, state: Floats, in_hand: Reference | None, plans: list[Reference]
) -> list[TrackedContingency]:
    each, begin = ranking(found), Begin(state, 2.0, 2.0)
    candidates = [*each.candidates.immediate(begin, in_hand), *each.candidates.along(begin, plans)]
    return [each.track(begin, one.reference(), one.origin) for one in candidates]


def plan_from(found: Replanner, state: Floats) -> Reference | None:
    found.dirt.start(state, 1)
    found.dirt.grow(iterations=300)
    plan = found.dirt.plan()
    return None if plan is None else plan_reference(found.dirt.vehicle, plan, 2.0)


@pytest.mark.parametrize("state", STATES)
def test_the_best_is_committed_whatever_its_origin(state: Floats, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contingencies, "PREDICTIONS", 1000)
    found = subject()
    plan = plan_from(found, state)
    plans = [] if plan is None else [plan]
    best = ranking(found).best(Begin(state, 2.0, 2.0), None, plans)
    each = all_tracked(found, state, None, plans)
    assert len(each) >= 5
    assert best.is_verified == any(one.is_verified for one in each)
    if best.is_verified:
        assert best.rounded_slack >= max(one.rounded_slack for one in each if one.is_verified) - 1
    else:
        assert best.origin is ContingencyOrigin.EMERGENCY


def test_a_candidate_whose_motion_is_not_a_number_is_the_worst_one(monkeypatch: pytest.MonkeyPatch) -> None:
    found = subject()
    slacks_of = found.dirt.least_slacks

    def least_slacks(states: Floats, since: Floats, ends: Ints) -> Floats:
        slacks = slacks_of(states, since, ends)
        if len(slacks) > 1:
            slacks[0] = math.nan
        return slacks

    monkeypatch.setattr(found.dirt, "least_slacks", least_slacks)
    best = ranking(found).best(Begin(STATES[0], 2.0, 2.0), None, [])
    assert best.is_verified
    unknown = replace(best, predicted=replace(best.predicted, slack=math.nan))
    assert unknown.rank < best.rank
    assert unknown.rank < replace(best, predicted=replace(best.predicted, slack=-1e9)).rank


class Uncompiled:
    """Controller whose closed loop is predicted tick by tick."""

    def __init__(self, law: Controller) -> None:
        self._law = law

    def command(self, estimate: Estimate, reference: Reference) -> Floats:
        """Control (nu,) at the estimate's time."""
        return self._law.command(estimate, reference)


@pytest.mark.parametrize("state", STATES)
def test_the_compiled_closed_loop_is_that_of_the_controller_tick_by_tick(state: Floats) -> None:
    found = subject()
    predict, plan = predictor(found), plan_from(found, state)
    assert plan is not None
    assert isinstance(predict.controller, KinodynamicController)
    slowly = replace(predict, controller=Uncompiled(predict.controller))
    contingency = next(ranking(found).candidates.immediate(Begin(state, 2.3, 2.3), None)).reference()
    for switch in (2.0, 2.11, 2.4, 3.0):
        one, other = (each(state, 2.0, 2.4, Commitment(plan, switch, contingency)) for each in (predict, slowly))
        assert one.controls is not None
        assert other.controls is not None
        assert np.array_equal(one.states, other.states)
        assert np.array_equal(one.controls, other.controls)
        assert one.slack == other.slack
    one, other = (each.until_rest(state, 2.3, contingency, 2.0) for each in (predict, slowly))
    assert np.array_equal(one.times, other.times)
    assert np.array_equal(one.states, other.states)
    assert one.slack == other.slack


def test_the_contingency_of_a_predictive_controller_is_predicted_as_it_tracks_it_tick_by_tick() -> None:
    found, state = subject(), STATES[0]
    controller = make_controller(Dwa(kind="dwa"), CarModel(found.dirt.vehicle), found.dirt)
    predict = predictor(found, controller)
    contingency = next(ranking(found).candidates.immediate(Begin(state, 2.0, 2.0), None)).reference()
    one = predict.until_rest(state, 2.0, contingency, 2.0)
    other = replace(predict, controller=Uncompiled(controller)).until_rest(state, 2.0, contingency, 2.0)
    assert np.array_equal(one.states, other.states)
    assert one.slack == other.slack


def test_what_is_verified_keeps_the_clearance_until_standstill() -> None:
    found, verified = subject(), 0
    for state in STATES:
        best = ranking(found).best(Begin(state, 2.0, 2.0), None, [])
        if best.is_verified:
            verified += 1
            exact = found.dirt.exact.distances(best.predicted.states[:, :3])
            assert (exact - required_clearance(found.dirt, best.predicted.states)).min() >= -1e-6
            assert abs(best.predicted.final_state[3]) <= found.dirt.safety.rest_speed
    assert verified > 0


@pytest.mark.parametrize("begun", [0.0, 0.25, 1.0])
def test_the_clearance_of_a_contingency_grows_from_the_beginning_of_the_cycle_on(begun: float) -> None:
    """What is verified keeps the grown clearance, and a growth that leaves no room refuses it, as SAFETY does."""
    found, state = subject(), STATES[0]
    contingency = next(ranking(found).candidates.immediate(Begin(state, 2.0, 2.0), None)).reference()
    slacks = []
    for growth in (0.0, 0.05, 0.3, 0.6):
        found.dirt.set_bound(0.02, 0.0, growth, 1.5)
        motion = predictor(found).until_rest(state, 2.0, contingency, 2.0 - begun)
        exact = found.dirt.exact.distances(motion.states[:, :3])
        required = 0.02 + growth * np.minimum(motion.times - 2.0 + begun, 1.5)
        slacks.append(motion.slack)
        assert motion.slack <= float((exact - required).min()) + 1e-6
    assert slacks == sorted(slacks, reverse=True)
    assert slacks[0] > 0.0 > slacks[-1]
    assert found.dirt.safety.cycle == 1.0


def test_a_path_without_length_is_not_followed_at_low_speed() -> None:
    found, state = subject(), STATES[0]
    times = np.linspace(2.0, 3.0, 5)
    turning = Reference(ReferenceKind.PLAN, times, np.tile(state, (5, 1)), np.zeros((4, 2)), np.zeros(2))
    assert ranking(found).candidates.creeping(state, 2.0, turning) is None


def test_a_plan_that_leads_past_an_obstacle_is_followed_before_the_vehicle_stops() -> None:
    """Ahead is a wall that the brakes do not save the car from; the plan steers away from it."""
    found, origins = subject(), set()
    for x in np.linspace(1.2, 2.0, 9):
        for heading in (0.4, 0.9, 1.2):
            state = np.array([x, 0.4, heading, 0.7])
            plan = plan_from(found, state)
            if plan is not None:
                best = ranking(found).best(Begin(state, 2.0, 2.0), None, [plan])
                origins.add(best.origin)
                assert best.reference.stop is not None
                assert best.reference.kind is ReferenceKind.CONTINGENCY
    assert ContingencyOrigin.SAFE in origins


def test_following_a_plan_and_creeping_are_candidates_that_begin_where_the_vehicle_is_and_stop() -> None:
    found = subject()
    state = np.array([1.6, -0.3, 1.57, 0.5])
    plan = plan_from(found, state)
    assert plan is not None
    candidates = list(ranking(found).candidates.along(Begin(state, 2.0, 2.0), [plan]))
    assert {one.origin for one in candidates} == {ContingencyOrigin.PLAN_THEN_STOP, ContingencyOrigin.CREEPING}
    for one in candidates:
        reference = one.reference()
        assert reference.start == 2.0
        assert np.all(np.diff(reference.times) > 0.0)
        assert len(reference.controls) == len(reference.times) - 1
        np.testing.assert_allclose(reference.states[0][:3], state[:3], atol=1e-6)
        assert reference.end == pytest.approx(one.end)
        if one.origin is ContingencyOrigin.CREEPING:  # the other has the state at which the plan is left twice
            np.testing.assert_allclose(one.motion.times, reference.times, atol=1e-9)
            np.testing.assert_allclose(one.motion.states, reference.states, atol=1e-9)
        assert abs(reference.states[-1][3]) <= found.dirt.safety.rest_speed
        assert reference.stop is not None
        assert 2.0 < reference.stop.begin < reference.end
    standing = np.array([1.6, -0.3, 1.57, 0.0])
    assert list(ranking(found).candidates.along(Begin(standing, 2.0, 2.0), [plan])) == []


def test_the_contingency_in_hand_is_kept_where_nothing_else_is_safe() -> None:
    found = subject()
    state = np.array([1.5, 2.2, 1.57, 0.6])
    safe = found.dirt.contingency(state, 2.0)
    assert safe is not None
    in_hand = contingency_reference(found.dirt.vehicle, safe)
    each = {one.origin for one in all_tracked(found, state, in_hand, [])}
    assert ContingencyOrigin.IN_HAND in each
    best = ranking(found).best(Begin(state, 2.0, 2.0), in_hand, [])
    assert best.rounded_slack >= max(one.rounded_slack for one in all_tracked(found, state, in_hand, [])) - 1


def test_a_contingency_without_clearance_is_an_emergency() -> None:
    found = subject()
    into_the_wall = np.array([1.95, 1.0, 0.0, 0.7])
    best = ranking(found).best(Begin(into_the_wall, 2.0, 2.0), None, [])
    assert (best.is_verified, best.origin) == (False, ContingencyOrigin.EMERGENCY)
    assert best.impact_speed == min(one.impact_speed for one in all_tracked(found, into_the_wall, None, []))


def test_a_standing_vehicle_that_may_not_drive_stands() -> None:
    found = subject(on_board="contingency")
    first = found.step(Estimate(0.0, start(), 0.0), found.begin(start()))
    assert first.switch == 1.0
    stopped = first.contingency
    assert stopped is not None
    rest = stopped.states[-1].copy()
    rest[3] = 0.05  # noise
    late = found.step(Estimate(stopped.end + 1.0, rest, math.inf), first.commitment)
    assert late.contingency_origin is ContingencyOrigin.STANDING
    np.testing.assert_array_equal(late.predicted.final_state[:3], rest[:3])
    assert late.stopping is not None
