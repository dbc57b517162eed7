"""Every decision of the replanner: what it commits, and why."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from kraft.control import make_controller
from kraft.driving import Estimate, Kind, Reference
from kraft.errors import Defect
from kraft.method import Clearance, Geometric, Kinodynamic, OpenLoop, Planner
from kraft.model import Model
from kraft.proposer import LEEWAY, SMALLEST_GOAL, Planners
from kraft.replanner import Replanner
from kraft.scenario import Task, load_scenario
from kraft.stopping import emergency, plan_reference, stop_control
from kraft.trial_result import Cycle
from kraft.vehicle import load_vehicle
from kraft.workspace import start_state
from ompl_ext.arrays import Floats
from ompl_ext.plan import Plan
from ompl_ext.solver import Dirt, Progress
from ompl_ext.vehicle import Vehicle
from ompl_ext.verify import Verification

MARGIN = Clearance(delta=0.05, delta_per_speed=0.25)
FARSIGHTED = Clearance(delta=0.02, delta_per_speed=0.05, foresight=3.0)
BESIDE_THE_WALL = np.array([1.96, 0.0, math.pi / 2, 0.0])  # 0.1 m from the right wall


@cache
def turns() -> Task:
    return load_scenario("turns").task()


@cache
def mushr() -> Vehicle:
    return load_vehicle("mushr")


def replanner(
    seed: int = 0,
    task: Task | None = None,
    tracking: bool = False,
    model: str = "mushr",
    delay: float = 0.0,
    **settings: object,
) -> Replanner:
    planner = Planner(**{"mode": "replanning", "iterations": 300, "lead": 0.1, **settings})  # type: ignore[arg-type]
    kind = Kinodynamic(kind="kinodynamic") if tracking else OpenLoop(kind="open_loop")
    vehicle = load_vehicle(model)
    controller = make_controller(kind, Model(vehicle))
    return Replanner(
        Planners.of(task or turns(), vehicle, planner), planner, controller, seed, period=1 / 30, delay=delay
    )


def start() -> Floats:
    return start_state(turns(), mushr())


def drive(subject: Replanner, cycles: int, error: Floats | None = None, begin: Floats | None = None) -> list[Cycle]:
    """Cycles of a vehicle that is, up to `error`, where it is predicted to be."""
    state, time = start() if begin is None else begin, 0.0
    current = subject.begin(state)
    found: list[Cycle] = []
    for _ in range(cycles):
        believed = state if error is None or not found else state + error
        found.append(subject.step(Estimate(time, believed, 0.0), current))
        current, time = found[-1].reference, subject.next_step
        predicted = found[-1].predicted
        state = np.array([np.interp(time, predicted.times, column) for column in predicted.states.T])
    return found


def test_the_first_cycle_executes_the_plan_made_before_the_clock_ran() -> None:
    first = drive(replanner(), 1)[0]
    assert (first.number, first.time, first.kind) == (0, 0.0, Kind.PLAN)
    assert first.reference.start == 0.0
    np.testing.assert_array_equal(first.reference.states[0], start())
    assert first.reference.end == pytest.approx(first.cost_to_goal)


@pytest.mark.parametrize("tracking", [False, True])
@pytest.mark.parametrize("safety", [None, FARSIGHTED])
def test_a_vehicle_that_is_where_it_was_predicted_reaches_the_goal_without_a_contingency(
    safety: Clearance | None, tracking: bool
) -> None:
    cycles = drive(replanner(safety=safety, tracking=tracking, margin=0.03), 9)
    assert [cycle.kind for cycle in cycles] == [Kind.PLAN] * 9
    costs = [cycle.cost_to_goal for cycle in cycles]
    assert costs[-1] < costs[0] - 6.0
    assert min(cycle.clearance for cycle in cycles) > 0.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_vehicle_that_does_as_planned_needs_no_contingency_for_a_clearance_that_grows_fast_with_speed(
    seed: int,
) -> None:
    """Asked for in the coming cycle alone it lets plans cut corners that the next cycle crawls round, but drives on."""
    cycles = drive(replanner(seed, safety=MARGIN, margin=0.03), 9)
    assert [cycle.kind for cycle in cycles] == [Kind.PLAN] * 9
    assert min(cycle.predicted.slack for cycle in cycles) >= 0.0


def test_a_controller_that_gets_ahead_of_a_plan_by_more_than_the_margin_is_told_so() -> None:
    """The controller looks ahead of the plan: where that speeds up, 0.25 of the difference of speeds is the slack."""
    cycles = drive(replanner(2, safety=MARGIN, margin=0.03, tracking=True), 9)
    refused = [cycle for cycle in cycles if cycle.kind is Kind.CONTINGENCY]
    assert refused
    assert all("from the latest estimate" in cycle.reason for cycle in refused)
    assert all(cycle.predicted.slack >= 0.0 for cycle in cycles)  # each of them with a safe one


def test_each_cycle_begins_where_the_last_one_is_predicted_to_end() -> None:
    cycles = drive(replanner(), 4)
    for before, after in itertools.pairwise(cycles):
        assert after.time == pytest.approx(before.predicted.times[-1])
        np.testing.assert_allclose(after.predicted.states[0], before.predicted.end, atol=2e-3)


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
            current = begun[-1].reference
        found.append(subject.step(Estimate(now, state, 0.0), current))
        assert found[-1].time == pytest.approx(number + late)
        assert found[-1].reference.start == pytest.approx(number + late)
    assert [cycle.kind for cycle in found] == [Kind.PLAN] * 6
    for before, after in itertools.pairwise(found):
        assert before.predicted.times[-1] == pytest.approx(after.time)
        np.testing.assert_allclose(after.predicted.states[0], before.predicted.end, atol=5e-3)
    assert math.dist(found[-1].predicted.end[:2], start()[:2]) > 1.5


def test_one_shot_plans_once() -> None:
    subject = replanner(mode="one-shot")
    first = drive(subject, 1)[0]
    assert first.kind is Kind.PLAN
    assert subject.next_step == math.inf


def test_a_plan_that_is_unsafe_from_the_latest_estimate_is_not_committed() -> None:
    towards_the_wall = np.array([0.9, 0.0, 0.0, 0.0])  # the corridor's inner half width is 1.2 m
    cycles = drive(replanner(safety=MARGIN), 2, towards_the_wall)
    assert cycles[1].kind is Kind.CONTINGENCY
    assert "from the latest estimate" in cycles[1].reason
    assert cycles[1].contingency is cycles[1].reference


def test_a_plan_is_committed_without_clearance_if_none_is_asked_for() -> None:
    assert drive(replanner(), 2, np.array([0.02, 0.0, 0.0, 0.0]))[1].kind is Kind.PLAN


@pytest.mark.parametrize("age", [0.6, math.inf])
def test_an_old_or_missing_observation_stops_the_vehicle(age: float) -> None:
    subject = replanner(patience=0.5)
    current = subject.begin(start())
    first = subject.step(Estimate(0.0, start(), math.inf), current)
    assert first.kind is Kind.PLAN  # where it stands at the start is known
    late = subject.step(Estimate(0.9, first.predicted.states[-3], age), first.reference)
    assert late.kind is Kind.CONTINGENCY
    assert "newest observation" in late.reason


def test_an_observation_that_is_late_but_not_too_late_does_not_stop_it() -> None:
    subject = replanner(patience=0.5)
    first = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    assert subject.step(Estimate(0.9, first.predicted.states[-4], 0.4), first.reference).kind is Kind.PLAN


def test_without_a_plan_the_vehicle_stops() -> None:
    subject = replanner(safety=Clearance(delta=0.5))  # more than the start has to the near wall
    cycle = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    assert cycle.kind is Kind.CONTINGENCY
    assert "lacks clearance" in cycle.reason
    np.testing.assert_allclose(cycle.predicted.end[:2], start()[:2], atol=1e-6)


def test_a_prediction_in_collision_stops_the_vehicle_one_cycle_later() -> None:
    subject = replanner()
    first = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    fast = np.array([1.0, 0.7, math.pi / 2, 0.6])  # 10 cm from the first box's level and heading past it
    into = np.array([0.45, 0.6, math.pi / 2, 0.6])  # 0.2 m before the first box
    stopped = subject.step(Estimate(0.9, into, 0.0), first.reference)
    assert stopped.kind is Kind.CONTINGENCY
    assert subject.step(Estimate(1.9, fast, 0.0), stopped.reference).reason != ""


def test_an_estimate_in_collision_is_moved_to_the_nearest_free_state() -> None:
    subject = replanner()
    inside = np.array([0.5, 0.85, math.pi / 2, 0.0])  # its front is 5 cm inside the first box
    cycle = subject.step(Estimate(0.0, inside, 0.0), subject.begin(start()))
    assert subject.dirt.exact.distance(*cycle.predicted.states[0][:3]) > 0.0
    assert math.dist(cycle.predicted.states[0][:2], inside[:2]) < 0.13


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
    second = subject.step(Estimate(1.0, too_fast_beside_the_contingency(first, share), 0.0), first.reference)
    assert second.kind is Kind.CONTINGENCY
    assert second.reference is first.contingency


@pytest.mark.parametrize("share", [2.05, -2.05])
def test_an_emergency_is_what_is_left_when_none_is_safe_and_the_one_in_hand_begins_elsewhere(share: float) -> None:
    subject = replanner(safety=MARGIN)
    first = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    state = too_fast_beside_the_contingency(first, share)
    second = subject.step(Estimate(1.0, state, 0.0), first.reference)
    assert (second.kind, second.reference.start) == (Kind.CONTINGENCY, 1.0)
    assert second.reference is not first.contingency
    expected = emergency(subject.dirt, state, 1.0)
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
    second = subject.step(Estimate(1.0, state, 0.0), first.reference)
    assert (second.reference is first.contingency) == kept


def planners(**settings: object) -> Planners:
    return Planners.of(turns(), mushr(), Planner(**{"mode": "replanning", **settings}))  # type: ignore[arg-type]


def test_without_margin_and_foresight_what_plans_is_what_checks() -> None:
    for same in (planners(), planners(safety=MARGIN), planners(safety=Clearance(foresight=1.0))):
        assert same.planning is same.checking


def test_planning_keeps_margin_and_foresight_and_checking_does_not() -> None:
    ours = planners(safety=FARSIGHTED, margin=0.03, goal_margin=0.1)
    shape, wide = mushr().footprint, ours.planning.vehicle.footprint
    assert ours.checking.vehicle.footprint == shape
    assert (wide.length, wide.width) == (pytest.approx(shape.length + 0.06), pytest.approx(shape.width + 0.06))
    assert wide.offset == shape.offset
    assert (ours.planning.safety.cycle, ours.checking.safety.cycle) == (3.0, 1.0)
    for dirt in (ours.planning, ours.checking):
        assert (dirt.safety.enabled, dirt.safety.delta, dirt.safety.delta_per_speed) == (True, 0.02, 0.05)
        assert dirt.goal is not None
        assert dirt.goal.radius == pytest.approx(0.15)  # the scene's is 0.25 m


def test_a_goal_is_not_shrunk_to_nothing() -> None:
    goal = planners(goal_margin=0.4).checking.goal
    assert goal is not None
    assert goal.radius == SMALLEST_GOAL


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
    assert cycles[0].kind is Kind.PLAN
    assert 0.0 < cycles[0].clearance < 0.03


def test_a_vehicle_that_rests_nearer_than_the_clearance_stays_there() -> None:
    cycles = drive(replanner(safety=Clearance(delta=0.15, delta_per_speed=0.0)), 3, begin=BESIDE_THE_WALL)
    assert [cycle.kind for cycle in cycles] == [Kind.CONTINGENCY] * 3
    assert "lacks clearance" in cycles[0].reason
    np.testing.assert_allclose(cycles[-1].predicted.end, BESIDE_THE_WALL, atol=1e-6)


def test_with_recover_it_leaves_with_the_clearance_that_it_has_and_then_keeps_what_is_asked_for() -> None:
    subject = replanner(safety=Clearance(delta=0.15, delta_per_speed=0.0), recover=True)
    cycles = drive(subject, 8, begin=BESIDE_THE_WALL)
    assert cycles[0].kind is Kind.PLAN
    assert min(cycle.clearance for cycle in cycles) >= 0.1 - LEEWAY - 1e-3
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


@pytest.mark.parametrize(("away", "radius"), [(0.2, 0.1), (0.1, 0.05), (0.004, SMALLEST_GOAL)])
def test_the_goal_region_shrinks_before_a_vehicle_that_has_not_arrived(away: float, radius: float) -> None:
    """By its own estimate it has: a plan from within the scene's region, 0.25 m, would else be to stay there."""
    subject = replanner()
    subject.begin(np.array([1.0, 5.0 - away, math.pi / 2, 0.0]))
    plan = subject._proposal.plan
    assert plan is not None
    assert math.dist(plan.states[-1][:2], (1.0, 5.0)) <= radius
    assert (len(plan.durations) > 0) == (away > SMALLEST_GOAL)


def test_the_goal_region_is_the_whole_one_again_when_the_vehicle_is_farther_away() -> None:
    subject = replanner()
    subject.begin(np.array([1.0, 4.9, math.pi / 2, 0.0]))
    subject._proposer.propose(1, start(), None)
    assert subject.dirt.goal is not None
    assert subject.dirt.goal.radius == 0.25


def test_a_contingency_goes_on_when_no_other_is_safe() -> None:
    subject = replanner(safety=MARGIN)
    first = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    doomed = np.array([0.5, 0.78, math.pi / 2, 0.6])
    second = subject.step(Estimate(1.0, doomed, 0.0), first.reference)
    third = subject.step(Estimate(1.9, doomed, 0.0), second.reference)
    assert third.reference is second.reference


def along(subject: Replanner, state: Floats, number: int) -> tuple[float, float]:
    """Smallest distance (m) of a manoeuvre to an obstacle, and its speed (m/s) where it hits one."""
    dirt, distance = subject.dirt, math.inf
    for _ in range(round(dirt.safety.horizon / 0.1)):
        samples, _ = dirt.edge(state, stop_control(dirt.vehicle, state, number), 0.1)
        distance = min(distance, float(dirt.exact.distances(samples[:, :3]).min()))
        if distance <= 0.0:
            return 0.0, abs(float(state[3]))
        state = samples[-1]
        if abs(state[3]) <= dirt.safety.rest_speed:
            break
    return distance, 0.0


@pytest.mark.slow
def test_an_emergency_takes_the_manoeuvre_that_keeps_the_most_distance_or_hits_slowest() -> None:
    subject = replanner(model="mushr-lag")  # which coasts for 0.6 m
    subject.begin(start())
    dirt, rng, found, hits = subject.dirt, np.random.default_rng(0), 0, 0
    while found < 20:
        state = np.array(
            [rng.uniform(0.3, 1.9), rng.uniform(-0.5, 4.5), rng.uniform(-3.1, 3.1), rng.uniform(0.4, 0.65)]
        )
        if dirt.exact.distance(*state[:3]) <= 0.01 or dirt.contingency(state) is not None:
            continue
        found += 1
        reference = emergency(dirt, state, 3.0)
        assert (reference.kind, reference.start) == (Kind.CONTINGENCY, 3.0)
        assert abs(reference.states[-1][3]) <= 0.01
        each = [along(subject, state, number) for number in range(len(dirt.vehicle.manoeuvres))]
        best = max(each, key=lambda pair: (pair[0], -pair[1]))
        ours = [along(subject, state, number) for number in range(len(each))
                if np.array_equal(reference.controls[0], stop_control(dirt.vehicle, state, number))]  # fmt: skip
        assert ours == [best]
        hits += best[0] == 0.0
    assert 0 < hits < found  # some can still be avoided, some cannot


def test_a_contingency_that_is_over_asks_for_nothing() -> None:
    """Brakes that went on would push a car that stands."""
    subject = replanner(model="mushr-drive", safety=FARSIGHTED)
    cycle = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start()))
    assert cycle.contingency is not None
    assert cycle.contingency.controls[0][0] < 0.0  # it brakes
    np.testing.assert_array_equal(cycle.contingency.rest, np.zeros(2))
    np.testing.assert_array_equal(emergency(subject.dirt, start(), 0.0).rest, np.zeros(2))


def test_looking_ahead_leaves_the_controller_as_it_is() -> None:
    controller = make_controller(Geometric(kind="geometric"), Model(mushr()))  # which remembers errors
    planner = Planner(mode="replanning", iterations=300)
    subject = Replanner(Planners.of(turns(), mushr(), planner), planner, controller, 0, period=1 / 30)
    reference = subject.step(Estimate(0.0, start(), 0.0), subject.begin(start())).reference
    untouched = make_controller(Geometric(kind="geometric"), Model(mushr()))
    beside = start() + np.array([0.05, 0.1, 0.1, 0.3])
    for k in range(5):
        estimate = Estimate(0.3 + k / 30, beside, 0.0)
        subject._roll(beside, estimate.time, estimate.time + 1.0, reference)
        np.testing.assert_array_equal(controller.command(estimate, reference), untouched.command(estimate, reference))


def test_what_is_verified_is_all_that_may_be_executed(monkeypatch: pytest.MonkeyPatch) -> None:
    heads = list[Plan]()

    def judge(_: Dirt, head: Plan) -> Verification:
        heads.append(head)
        return Verification(0.0, None, ())

    monkeypatch.setattr("kraft.proposer.verify", judge)
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
    monkeypatch.setattr("kraft.proposer.verify", lambda *_: Verification(0.0, None, ("plan: collides",)))
    with pytest.raises(Defect, match=r"cycle 0 fails verification: plan: collides"):
        replanner().begin(start())


def test_a_plan_that_comes_too_late_is_dropped_in_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    subject = replanner(cycle=0.2, lead=0.0)
    subject._proposer._realtime = True
    subject.begin(start())
    late = itertools.chain([0.0], itertools.repeat(5.0))
    monkeypatch.setattr("kraft.proposer.clock.perf_counter", lambda: next(late))
    monkeypatch.setattr(subject.dirt, "grow", lambda **_: subject.dirt.progress)
    proposal = subject._proposer.propose(1, start(), None)
    assert proposal.missed
    assert proposal.plan is None
    assert "longer than there was time" in proposal.reason


def test_by_the_clock_a_search_without_the_margin_has_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search with the margin finds nothing: half of the time is its, the rest that of the one without."""
    subject = replanner(margin=0.03, cycle=0.5, lead=0.05)
    subject._proposer._realtime = True
    now, granted, both = [0.0], list[float](), subject._proposer._planners
    monkeypatch.setattr("kraft.proposer.clock.perf_counter", lambda: now[0])
    for dirt in (both.planning, both.checking):

        def grow(seconds: float, dirt: Dirt = dirt, grow: Callable[..., Progress] = dirt.grow) -> Progress:
            granted.append(seconds)
            now[0] += seconds
            return grow(iterations=300)

        monkeypatch.setattr(dirt, "grow", grow)
    monkeypatch.setattr(both.planning, "plan", lambda: None)
    proposal = subject._proposer.propose(0, start(), None)
    assert granted == pytest.approx([0.175, 0.175, 0.0])  # of 0.8 x 0.5 s - 0.05 s; with a plan it goes on
    assert proposal.plan is not None
    assert not proposal.missed


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


def test_a_reference_interpolates_states_and_holds_controls() -> None:
    reference = Reference(
        Kind.PLAN, np.array([1.0, 2.0, 4.0]), np.array([[0.0], [1.0], [5.0]]), np.array([[0.1], [0.2]]), np.zeros(1)
    )
    assert [float(reference.state_at(t)[0]) for t in (0.0, 1.0, 1.5, 3.0, 4.0, 9.0)] == [0.0, 0.0, 0.5, 3.0, 5.0, 5.0]
    assert [float(reference.control_at(t)[0]) for t in (0.0, 1.0, 2.0, 3.9, 4.0)] == [0.1, 0.1, 0.2, 0.2, 0.0]


def test_a_plan_becomes_a_reference_with_the_control_of_each_step() -> None:
    subject = replanner()
    subject.begin(start())
    plan = subject.dirt.plan()
    assert plan is not None
    reference = plan_reference(plan, 2.0, np.zeros(2))
    ends = np.cumsum(plan.durations)
    for k, end in enumerate(ends):
        np.testing.assert_array_equal(reference.control_at(2.0 + end - 1e-6), plan.controls[k])
    np.testing.assert_array_equal(reference.control_at(2.0 + plan.cost + 1e-6), np.zeros(2))


def test_a_vehicle_without_a_stop_function_stops_with_zero_control() -> None:
    coasting = replace(mushr(), stop=None, manoeuvres=("coast",))
    np.testing.assert_array_equal(stop_control(coasting, start(), 0), np.zeros(2))
    np.testing.assert_array_equal(stop_control(mushr(), start(), 3), [0.0, 0.38])
