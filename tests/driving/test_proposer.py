"""What the replanner may commit next: margins, foresight, recovering, verification, the clock."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable

import numpy as np
import pytest
from support.replanner import BESIDE_THE_WALL, FARSIGHTED, drive, mushr, proposer, replanner, start, turns

from kraft.driving.messages import ReferenceKind, Uncertainty
from kraft.driving.planner_settings import CalibratedBound, Clearance
from kraft.driving.proposer import RECOVERY_MARGIN
from kraft.planning.workspace import workspace_of
from ompl_ext.exact import ExactClearance
from ompl_ext.query_tree import Progress
from ompl_ext.solver import DirtSolver


def test_a_plan_keeps_the_margin_to_its_end_and_the_clearance_as_far_as_foresight_reaches() -> None:
    subject = replanner(safety=FARSIGHTED, margin=0.03)
    subject.begin(start())
    plan = subject.proposal.plan
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
    assert subject.proposer.propose(9, moving, None).plan is None
    assert subject.dirt.safety.delta == 0.15


def test_recover_is_for_a_vehicle_at_rest_and_not_in_collision() -> None:
    settings = {"safety": Clearance(delta=0.15, delta_per_speed=0.0), "recover": True}
    for change in ([0.0, 0.0, 0.0, 0.4], [0.12, 0.0, 0.0, 0.0]):
        subject = replanner(**settings)  # type: ignore[arg-type]
        subject.begin(BESIDE_THE_WALL + np.array(change))
        assert subject.proposal.plan is None
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


def test_a_plan_that_comes_too_late_is_dropped_in_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    subject = proposer(realtime=True, cycle=0.2, lead=0.0)
    subject.propose(0, start(), None)
    late = itertools.chain([0.0], itertools.repeat(5.0))
    monkeypatch.setattr("kraft.driving.proposer.clock.perf_counter", lambda: next(late))
    monkeypatch.setattr(subject.dirt, "grow", lambda **_: subject.dirt.progress)
    proposal = subject.propose(1, start(), None)
    assert proposal.missed
    assert proposal.plan is None
    assert "planning took 5.000 s" in proposal.reason


def test_a_path_of_a_geodesic_method_that_comes_too_late_is_dropped_in_real_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    subject = proposer(realtime=True, cycle=0.2, lead=0.0, type="geodesic")
    assert subject.propose(0, start(), None).plan is not None
    late = itertools.chain([0.0], itertools.repeat(5.0))
    monkeypatch.setattr("kraft.driving.proposer.clock.perf_counter", lambda: next(late))
    proposal = subject.propose(2, start(), None)
    assert (proposal.missed, proposal.plan, proposal.seconds) == (True, None, 5.0)


@pytest.mark.parametrize("realtime", [False, True])
def test_the_first_plan_which_is_made_before_the_drive_is_never_late(
    monkeypatch: pytest.MonkeyPatch, realtime: bool
) -> None:
    subject = proposer(realtime=realtime, cycle=0.2, lead=0.0)
    late = itertools.chain([0.0, 0.0], itertools.repeat(5.0))
    monkeypatch.setattr("kraft.driving.proposer.clock.perf_counter", lambda: next(late))
    monkeypatch.setattr(subject.dirt, "grow", lambda grow=subject.dirt.grow, **_: grow(iterations=300))
    proposal = subject.propose(0, start(), None)
    assert proposal.seconds == 5.0
    assert proposal.plan is not None
    assert not proposal.missed


def test_by_the_clock_a_search_without_the_margin_has_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search with the margin finds nothing: half of the time is its, the rest that of the one without."""
    subject = proposer(realtime=True, margin=0.03, cycle=0.5, lead=0.05)
    now, granted, both = [0.0], list[float](), subject.search.solvers
    monkeypatch.setattr("kraft.driving.proposer.clock.perf_counter", lambda: now[0])
    for dirt in (both.planning, both.checking):

        def grow(seconds: float, dirt: DirtSolver = dirt, grow: Callable[..., Progress] = dirt.grow) -> Progress:
            granted.append(seconds)
            now[0] += seconds
            return grow(iterations=300)

        monkeypatch.setattr(dirt, "grow", grow)
    monkeypatch.setattr(both.planning, "plan", lambda _=None: None)
    proposal = subject.propose(0, start(), None)
    assert granted == pytest.approx([0.175, 0.175, 0.0])  # of 0.8 x 0.5 s - 0.05 s; with a plan it goes on
    assert proposal.plan is not None
    assert not proposal.missed


def test_by_the_clock_the_iterations_of_all_levels_are_counted() -> None:
    bound = CalibratedBound(shares=(1.0, 0.25))
    subject = proposer(cycle=0.2, lead=0.0, bound=bound, realtime=True)
    assert subject.propose(0, start(), None).iterations >= 300
