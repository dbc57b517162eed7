"""Blockage: a vehicle that does not move though it is on a plan, and plans round what blocks it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.replanner import mushr, planner_settings, replanner, start, turns

from kraft.driving.blockage import GAP, Blockage
from kraft.driving.messages import Commitment, Cycle, Estimate, Reference, ReferenceKind
from kraft.driving.planner_settings import Clearance
from kraft.driving.replanner import FORGET, Replanner
from kraft.driving.solvers import Solvers
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats
from ompl_ext.exact import ExactClearance
from ompl_ext.obstacles import Polygon, Workspace
from ompl_ext.poses import poses_of

PATIENCE, CYCLE = 1.0, 0.25
LEFT, RIGHT = turns().bounds.x
ACROSS = Polygon(np.array([[LEFT, 0.5], [RIGHT, 0.5], [RIGHT, 0.6], [LEFT, 0.6]]))
"""A wall across the whole of Turns, before the start."""
CAREFUL = {"cycle": CYCLE, "blocked": PATIENCE, "safety": Clearance(delta=0.02, delta_per_speed=0.0)}
STATE = np.array([1.0, 0.5, 0.5 * math.pi, 0.0])


def reference(speed: float = 0.5, kind: ReferenceKind = ReferenceKind.PLAN) -> Reference:
    """Straight on, upwards, from `STATE`."""
    times = np.linspace(0.0, 10.0, 41)
    states = STATE + np.column_stack([np.zeros(41), speed * times, np.zeros(41), np.full(41, speed)])
    return Reference(kind, times, states, np.tile([0.5, 0.0], (40, 1)), np.zeros(2))


def watched(states: Floats, followed: Reference) -> tuple[int, ...]:
    """Numbers of the cycles in which a vehicle with these estimated states counts as blocked."""
    subject = Blockage(PATIENCE, mushr())
    found = (subject.observe(k * CYCLE, state, followed) for k, state in enumerate(states))
    return tuple(k for k, obstacle in enumerate(found) if obstacle is not None)


# Detection


def test_a_vehicle_that_stands_on_a_plan_is_blocked_after_its_patience_and_again_after_as_long() -> None:
    resting = np.tile(STATE, (11, 1)) + 0.01 * np.random.default_rng(0).standard_normal((11, 4))
    assert watched(resting, reference()) == (4, 9)


def test_a_vehicle_whose_plans_hardly_intend_to_move_is_blocked_after_longer() -> None:
    """One that pushes without effect is identified as weak, and its plans are as slow."""
    cycles = watched(np.tile(STATE, (20, 1)), reference(0.02))
    assert cycles == (13,)  # after 3.2 s, when 0.2 m over 3.2 have been intended


def test_after_a_doubt_a_vehicle_is_blocked_after_twice_as_long() -> None:
    subject = Blockage(PATIENCE, mushr())
    subject.doubt()
    found = [subject.observe(k * CYCLE, STATE, reference()) for k in range(11)]
    assert [k for k, each in enumerate(found) if each is not None] == [8]


def test_a_vehicle_that_moves_or_turns_is_not_blocked() -> None:
    moving = STATE + np.outer(np.arange(20), [0.0, 0.02, 0.0, 0.0])
    turning = STATE + np.outer(np.arange(20), [0.0, 0.0, 0.05, 0.0])
    assert watched(moving, reference()) == watched(turning, reference()) == ()


@pytest.mark.parametrize(("uncertain", "blocked"), [(0.4, True), (0.6, False)])
def test_a_vehicle_whose_drive_may_be_too_weak_is_not_blocked(uncertain: float, blocked: bool) -> None:
    """Plans intend 0.5 m/s; a standard deviation of 0.6 m/s^2 lets a drive lack that."""
    subject = Blockage(PATIENCE, mushr())
    found = [subject.observe(k * CYCLE, STATE, reference(0.5), uncertain) for k in range(20)]
    assert any(each is not None for each in found) == blocked


def test_a_vehicle_that_stands_on_a_contingency_is_not_blocked() -> None:
    assert watched(np.tile(STATE, (20, 1)), reference(kind=ReferenceKind.CONTINGENCY)) == ()


def test_a_vehicle_that_drives_to_and_fro_in_a_narrow_place_is_not_blocked() -> None:
    subject = Blockage(PATIENCE, mushr())
    plans = [reference(speed) for speed in (0.2, -0.2)]
    assert all(subject.observe(k * CYCLE, STATE, plans[k % 2]) is None for k in range(20))


@pytest.mark.parametrize(("speed", "ahead"), [(0.5, 1.0), (-0.5, -1.0)])
def test_the_obstacle_is_where_the_plan_leads_and_leaves_a_gap(speed: float, ahead: float) -> None:
    subject = Blockage(PATIENCE, mushr())
    found = [subject.observe(k * CYCLE, STATE, reference(speed)) for k in range(5)][-1]
    assert found is not None
    assert ahead * (found.obstacle.vertices[:, 1].mean() - STATE[1]) > 0.0
    exact = ExactClearance(Workspace(((-9.0, 9.0), (-9.0, 9.0)), (found.obstacle,)), mushr().footprint)
    assert exact.distances(poses_of(STATE[None, :], mushr())) == pytest.approx([GAP])


def test_it_has_held_the_vehicle_since_this_stands() -> None:
    subject, moving = Blockage(PATIENCE, mushr()), STATE + np.outer(np.arange(4), [0.0, 0.1, 0.0, 0.0])
    found = [subject.observe(k * CYCLE, state, reference()) for k, state in enumerate([*moving, *[moving[-1]] * 5])]
    assert found[:7] == [None] * 7
    assert found[7] is not None
    assert found[7].begin == 3 * CYCLE


# In the replanner


def held(subject: Replanner, cycles: int, state: Floats) -> list[Cycle]:
    """Cycles of a vehicle that stays where it is."""
    current: Commitment = subject.begin(state)
    found = list[Cycle]()
    for number in range(cycles):
        found.append(subject.step(Estimate(number * CYCLE, state, 0.0), current))
        current = found[-1].commitment
    return found


def careful(**settings: object) -> Replanner:
    return replanner(model="mushr-drive", **CAREFUL, **settings)  # type: ignore[arg-type]


def careful_solvers(*more: Polygon) -> Solvers:
    """Solvers of such a replanner, with more obstacles than the task has."""
    return Solvers.of(turns(), load_vehicle("mushr-drive"), planner_settings(**CAREFUL), more)


def test_plans_lead_round_what_blocks_the_vehicle() -> None:
    subject = careful(iterations=1000, recover=True)
    cycles = held(subject, 8, start())
    stopped = next(k for k, cycle in enumerate(cycles) if cycle.reason)
    assert [len(cycle.blocked) for cycle in cycles] == [0] * stopped + [1] * (8 - stopped)
    assert cycles[-1].blocked == subject.blocked
    assert [cycle.held for cycle in cycles if cycle.held is not None] == [(0.0, cycles[stopped].decided)]
    assert cycles[stopped].held is not None
    plan = subject.proposal.plan
    assert plan is not None
    obstacle = Workspace(subject.dirt.workspace.bounds, subject.blocked)
    away = ExactClearance(obstacle, subject.dirt.vehicle.footprint).distances(poses_of(plan.trajectory, mushr()))
    assert away.min() > 0.0


def test_the_maps_of_what_blocks_the_vehicle_are_made_after_the_decision() -> None:
    subject = careful()
    current: Commitment = subject.begin(start())
    before = subject.dirt
    for number in range(8):
        cycle = subject.decide(Estimate(number * CYCLE, start(), 0.0), current)
        current = cycle.commitment
        assert subject.dirt is before
        if cycle.blocked:
            break
        subject.prepare()
    assert subject.blocked
    subject.prepare()
    assert len(subject.dirt.workspace.obstacles) == len(before.workspace.obstacles) + 1


def test_the_vehicle_keeps_its_parameters_and_its_task_when_it_is_blocked() -> None:
    subject, solvers = careful(), careful_solvers()
    values = np.array(list(subject.dirt.vehicle.parameters.values())) * 0.9
    solvers.set_parameters(values)
    subject.set_solvers(solvers)
    before = len(subject.dirt.workspace.obstacles)
    held(subject, 6, start())
    assert np.array(list(subject.dirt.vehicle.parameters.values())) == pytest.approx(values)
    assert len(subject.dirt.workspace.obstacles) == before + 1


def test_what_blocked_the_vehicle_is_forgotten_where_it_leaves_no_way() -> None:
    subject = careful()
    subject.set_solvers(careful_solvers(ACROSS), (ACROSS,))
    cycles = held(subject, round((FORGET + 2.0 * PATIENCE) / CYCLE) + 2, start())
    forgotten = next(k for k, cycle in enumerate(cycles) if "no way leads round" in cycle.reason)
    assert [cycle.blocked for cycle in cycles[: forgotten + 1]] == [*[(ACROSS,)] * forgotten, ()]


def test_after_that_twice_the_time_on_a_plan_shows_that_something_is_in_the_way() -> None:
    """No way led round what was found, which may be no obstacle at all."""
    seen = []
    for wall in (None, ACROSS):
        subject = careful()
        if wall is not None:
            subject.set_solvers(careful_solvers(wall), (wall,))
        cycles = held(subject, round((FORGET + 2.0 * PATIENCE) / CYCLE) + 2, start())
        found = next(k for k, cycle in enumerate(cycles) if cycle.held is not None)
        seen.append(sum(cycle.kind is ReferenceKind.PLAN for cycle in cycles[:found]))
    assert seen == [round(PATIENCE / CYCLE), round(2.0 * PATIENCE / CYCLE)]


def test_one_shot_methods_refuse_the_setting() -> None:
    with pytest.raises(ValueError, match="later cycles"):
        replanner(mode="one-shot", blocked=PATIENCE)
