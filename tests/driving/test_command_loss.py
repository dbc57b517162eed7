"""Loss of commands: where the robot's multiplexer stops it, and plans that leave room for that."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.replanner import drive, replanner, start, turns

from kraft.driving.car_model import model_of
from kraft.driving.command_loss import SHARES, CommandLoss
from kraft.driving.messages import Estimate, PredictedMotion, ReferenceKind
from kraft.driving.plan_search import PlanSearch
from kraft.driving.planner_settings import Clearance, PlannerSettings
from kraft.driving.proposer import Proposer
from kraft.driving.solvers import Solvers
from kraft.driving.vehicle_model import braking_control
from kraft.planning.workspace import start_state
from kraft.scenario import load_scenario
from kraft.vehicles.load import load_vehicle
from ompl_ext.plan import Plan
from ompl_ext.poses import poses_of

PLANNER = PlannerSettings(
    mode="replanning", iterations=600, safety=Clearance(delta=0.01), on_board="contingency", contingencies="tracked"
)
SOLVERS = Solvers.of(turns(), load_vehicle("mushr-drive"), PLANNER)
DIRT = SOLVERS.checking
SPEED = 0.6
WALL = 5.95
"""Near side of the far wall of Turns, m."""
REASON = "no room for a stop without commands"


def on_the_way(y: float) -> PredictedMotion:
    """A tick of a car that drives straight on to the far wall at SPEED."""
    state = np.array([1.2, y, math.pi / 2, SPEED])
    control = np.array([0.9, 0.0])
    trajectory, slack = DIRT.edge(state, control, 1 / 30)
    return PredictedMotion(np.array([0.0, 1 / 30]), trajectory[[0, -1]], slack, controls=control[None, :])


def test_a_multiplexer_brakes_with_the_wheels_as_they_are() -> None:
    control = braking_control(DIRT.vehicle, np.array([0.0, 0.0, 0.0, SPEED]), np.array([0.9, 0.3]))
    assert control[0] < 0.0
    assert control[1] == 0.3


def nearest(slack: Callable[[float], float]) -> float:
    """Largest y at which the slack is not negative, by bisection."""
    near, far = 4.6, WALL
    while far - near > 1e-4:
        middle = 0.5 * (near + far)
        near, far = (middle, far) if slack(middle) >= 0.0 else (near, middle)
    return near


@pytest.mark.parametrize("timeout", [0.1, 0.2, 0.5])
def test_the_way_without_commands_is_that_of_the_timeout_and_of_braking(timeout: float) -> None:
    """A moving car needs that way more before the wall than one that stands."""
    loss, zero = CommandLoss(DIRT, timeout), np.zeros(2)
    standing = nearest(lambda y: DIRT.edge(np.array([1.2, y, math.pi / 2, 0.0]), zero, 0.0, 0.0)[1])
    held = np.array([0.9, 0.0])
    state = DIRT.edge(on_the_way(4.6).states[0], held, timeout)[0][-1]
    while state[3] > DIRT.safety.rest_speed:
        state = DIRT.edge(state, braking_control(DIRT.vehicle, state, held), 0.05)[0][-1]
    way = float(state[1]) - 4.6
    assert way > SPEED * timeout
    assert standing - nearest(lambda y: loss.slack(on_the_way(y))) == pytest.approx(way, abs=0.02)


@pytest.mark.parametrize("growth", [0.1, 0.3])
def test_the_clearance_grows_until_the_car_stands(growth: float) -> None:
    dirt = Solvers.of(turns(), load_vehicle("mushr-drive"), PLANNER).checking
    loss, held = CommandLoss(dirt, 0.2), np.array([0.9, 0.0])
    state, time = dirt.edge(on_the_way(4.6).states[0], held, 0.2)[0][-1], 0.2
    while state[3] > dirt.safety.rest_speed:
        state, time = dirt.edge(state, braking_control(dirt.vehicle, state, held), 0.05)[0][-1], time + 0.05
    assert time > dirt.safety.cycle
    without = nearest(lambda y: loss.slack(on_the_way(y)))
    dirt.set_bound(dirt.safety.delta, dirt.safety.delta_per_speed, growth, 10.0)
    cycle = dirt.safety.cycle
    assert without - nearest(lambda y: loss.slack(on_the_way(y))) == pytest.approx(growth * time, abs=growth * 0.1)
    assert dirt.safety.cycle == cycle


def test_a_later_moment_of_the_cycle_counts_as_well() -> None:
    loss = CommandLoss(DIRT, 0.2)
    control = np.array([0.9, 0.0])
    state, states = on_the_way(5.0).states[0], [on_the_way(5.0).states[0]]
    for _ in range(24):
        state = DIRT.edge(state, control, 1 / 30)[0][-1]
        states.append(state)
    times = np.arange(25) / 30
    whole = PredictedMotion(times, np.array(states), 0.0, controls=np.tile(control, (24, 1)))
    begin = replace(whole, times=times[:2], states=whole.states[:2], controls=control[None, :])
    assert loss.slack(begin) >= 0.0
    assert loss.slack(whole) < 0.0


def test_a_plan_that_leaves_no_room_is_not_committed() -> None:
    """With a timeout of seconds hardly any plan does; the plan's own clearance is the same."""
    settings = {"safety": Clearance(delta=0.01), "on_board": "contingency", "contingencies": "tracked"}
    cycles = {}
    for timeout in (None, 6.0):
        subject = replanner(model="mushr-drive", tracking=True, command_timeout=timeout, **settings)
        state, found = start(), []
        current = subject.begin(state)
        for number in range(4):
            cycle = subject.step(Estimate(max(0.0, number - 0.1), state, 0.0), current)
            current, state = cycle.commitment, cycle.predicted.final_state
            found.append(cycle)
        cycles[timeout] = found
    refused = {timeout: [cycle for cycle in found if REASON in cycle.reason] for timeout, found in cycles.items()}
    assert cycles[None][1].kind is ReferenceKind.PLAN
    assert refused[None] == []
    assert refused[6.0]
    assert all(cycle.kind is ReferenceKind.CONTINGENCY for cycle in refused[6.0])


@dataclass(frozen=True)
class _Refusing(CommandLoss):
    """Refuses the first plan that it is asked about."""

    seen: list[Plan]

    def keeps(self, plan: Plan, cycle: float) -> bool:
        self.seen.append(plan)
        return len(self.seen) > 1


def test_another_plan_of_the_tree_is_proposed_if_the_best_one_leaves_no_room() -> None:
    proposer = Proposer(PlanSearch(SOLVERS, PLANNER, 0, command_timeout=0.2))
    refusing = _Refusing(DIRT, 0.2, [])
    proposer.search.loss = refusing
    proposal = proposer.propose(0, start(), None)
    best, other = refusing.seen
    assert proposal.plan is other
    assert other.reaches_goal
    assert other.cost >= best.cost
    assert (poses_of(other.trajectory[:1], DIRT.vehicle) == poses_of(best.trajectory[:1], DIRT.vehicle)).all()


def slower(solvers: Solvers, plan: Plan) -> list[Plan]:
    return list(CommandLoss(solvers.checking, 0.2).slower(plan, plan.states[0], PLANNER.cycle, 0))


def test_a_slower_plan_has_less_drive_for_a_cycle_and_leads_the_same_way() -> None:
    plan = Proposer(PlanSearch(SOLVERS, PLANNER, 0)).propose(0, start(), None).plan
    assert plan is not None
    found = slower(SOLVERS, plan)
    assert len(found) > 4
    speeds = [float(np.interp(PLANNER.cycle, each.times, each.trajectory[:, 3])) for each in (plan, *found)]
    assert speeds == sorted(speeds, reverse=True)
    for share, each in zip(SHARES, found, strict=False):
        during = np.concatenate([[0.0], each.durations.cumsum()[:-1]]) < PLANNER.cycle - 0.05
        assert np.allclose(each.controls[during][:, 0], share * plan.controls[: during.sum(), 0])
        assert np.array_equal(each.controls[during][:, 1], plan.controls[: during.sum(), 1])
    places = found[1].trajectory[found[1].times <= PLANNER.cycle, :2]
    away = np.linalg.norm(places[:, None] - plan.trajectory[None, :, :2], axis=2).min(axis=1)
    assert away.max() < 0.05


@pytest.mark.parametrize(("y", "some"), [(5.25, True), (5.3, False)])
def test_a_slower_plan_that_ends_within_the_cycle_where_nothing_stops_the_car_is_none(y: float, some: bool) -> None:
    """It ends short of the goal that the plan reaches, too near to the wall for a contingency."""
    root, control = np.array([1.2, y, math.pi / 2, SPEED]), np.array([[0.9, 0.0]])
    trajectory, slack = DIRT.edge(root, control[0], 0.3)
    assert slack > 0.0
    plan = Plan(
        controls=control, durations=np.array([0.3]), states=trajectory[[0, -1]],
        times=np.linspace(0.0, 0.3, len(trajectory)), trajectory=trajectory,
        cost=0.3, cost_to_go=0.0, reaches_goal=True, contingency=None,
    )  # fmt: skip
    found = slower(SOLVERS, plan)
    assert bool(found) is some
    assert all(each.contingency is not None for each in found)


def test_of_a_vehicle_with_two_driven_sides_both_are_slowed() -> None:
    vehicle = load_vehicle("jackal")
    task = load_scenario("posts").task()
    solvers = Solvers.of(task, vehicle, PLANNER)
    plan = Proposer(PlanSearch(solvers, PLANNER, 0)).propose(0, start_state(task, vehicle), None).plan
    assert plan is not None
    assert model_of(vehicle).driven.tolist() == [True, True]
    assert model_of(load_vehicle("f1tenth")).driven.tolist() == [True, False]
    assert np.allclose(slower(solvers, plan)[0].controls[0], SHARES[0] * plan.controls[0])


@dataclass(frozen=True)
class _Slow(CommandLoss):
    """Has room at most at `limit` m/s."""

    limit: float

    def slack(self, motion: PredictedMotion) -> float:
        return self.limit - float(motion.states[:, 3].max())


def test_a_plan_that_leaves_no_room_is_driven_more_slowly() -> None:
    """No cycle is refused, and all keep the limit; without it the vehicle is faster."""
    settings = {"safety": Clearance(delta=0.01), "on_board": "contingency", "contingencies": "tracked"}
    fastest = {}
    for limit in (0.3, 9.0):
        subject = replanner(model="mushr-drive", tracking=True, command_timeout=0.2, **settings)
        subject.proposer.search.loss = _Slow(subject.dirt, 0.2, limit)
        cycles = drive(subject, 3)
        assert not any(REASON in cycle.reason for cycle in cycles)
        assert cycles[1].kind is ReferenceKind.PLAN
        fastest[limit] = max(float(cycle.predicted.states[:, 3].max()) for cycle in cycles)
    assert fastest[0.3] <= 0.3
    assert fastest[9.0] > 0.4


def test_a_plan_without_edges_cannot_be_slowed() -> None:
    solvers = Solvers.of(turns(), load_vehicle("mushr-drive"), PlannerSettings(mode="replanning"))
    root = start_state(turns(), load_vehicle("mushr-drive"))
    none = Plan(
        controls=np.zeros((0, 2)), durations=np.zeros(0), states=root[None, :], times=np.zeros(1),
        trajectory=root[None, :], cost=0.0, cost_to_go=0.0, reaches_goal=True, contingency=None,
    )  # fmt: skip
    assert slower(solvers, none) == []
