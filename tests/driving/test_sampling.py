"""MPPI and the dynamic window: costs are those of the model in the map, updates are the published ones."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.diagnostics import raised
from support.replanner import drive, mushr, share_kept, start, turns

from kraft.driving.bound import DeviationBound
from kraft.driving.car_model import CarModel
from kraft.driving.control import make_controller, sampling, set_map
from kraft.driving.control.sampling import DwaController, MppiController, Rollouts, Updates, updated
from kraft.driving.control_settings import Dwa, Kinodynamic, Mppi, Nmpc
from kraft.driving.geodesic import geodesic_plan
from kraft.driving.messages import Estimate, Reference, ReferenceKind
from kraft.driving.method import load_method
from kraft.driving.plan_search import PlanSearch
from kraft.driving.planner_settings import Clearance, PlannerSettings
from kraft.driving.proposer import Proposer
from kraft.driving.references import contingency_reference, plan_reference
from kraft.driving.replanner import Replanner
from kraft.driving.solvers import Solvers, method_safety
from kraft.errors import Code, InputError
from ompl_ext.arrays import Floats, Floats32Cube
from ompl_ext.kernels.costtogo import UNREACHABLE
from ompl_ext.obstacles import Polygon
from ompl_ext.poses import pose_of

GEODESIC = PlannerSettings(mode="replanning", type="geodesic")
SMALL = Mppi(kind="mppi", rollouts=64, steps=20)
MOVING = np.array([1.0037, 0.2041, 1.56, 0.5])  # not on the border of cells


@cache
def solvers() -> Solvers:
    return Solvers.of(turns(), mushr(), GEODESIC)


@cache
def model() -> CarModel:
    return CarModel(mushr())


@cache
def farthest() -> float:
    """Largest cost-to-go in the map, s."""
    togo = solvers().checking.problem.togo
    return float(togo[togo < UNREACHABLE].max())


def way(state: Floats) -> Reference:
    plan = geodesic_plan(solvers().checking, state)
    assert plan is not None
    return plan_reference(mushr(), plan, 0.0)


def mppi(settings: Mppi = SMALL, seed: int = 1) -> MppiController:
    controller = make_controller(settings, model(), solvers().checking, seed)
    assert isinstance(controller, MppiController)
    return controller


def test_the_update_is_that_of_pytorch_mppi() -> None:
    """Two steps, two controls, four samples on fixed noise, cut to bounds of [-0.3, 0.5] and [-0.3, 0.4].

    The costs and the expected controls were computed with pytorch-mppi 0.9.1 and torch 2.15.0: dynamics x + 0.1 u from
    (0, 0), running cost |x - (1, 0.5)|^2, noise_sigma diag(0.25, 0.09), lambda_ 0.5.  Its weight of the controls in the
    costs is lambda_, which is gamma here.
    """
    nominal, low, high = np.array([[0.1, -0.2], [0.3, 0.0]]), np.array([-0.3, -0.3]), np.array([0.5, 0.4])
    noise = np.array(
        [[[0.5, -0.5, 0.25, 0.0], [0.1, 0.2, -0.3, 0.0]], [[-0.25, 0.5, 0.0, 0.75], [0.4, -0.1, 0.2, -0.2]]]
    )
    bounded = np.clip(nominal[:, :, None] + noise, low[None, :, None], high[None, :, None]) - nominal[:, :, None]
    costs = np.zeros(4)
    for k in range(4):
        x = np.zeros(2)
        for t in range(2):
            x = x + 0.1 * (nominal[t] + bounded[t, :, k])
            costs[k] += ((x - [1.0, 0.5]) ** 2).sum() + 0.5 * (nominal[t] * bounded[t, :, k] / [0.25, 0.09]).sum()
    assert costs == pytest.approx([2.095413888888889, 2.3491777777777774, 2.507561111111111, 2.5457], abs=1e-12)
    expected = [[0.20987261929007056, -0.12784968375231587], [0.2802456522375464, 0.1415049380442719]]
    assert updated(nominal, bounded.astype(np.float32), costs, 0.5) == pytest.approx(np.array(expected), abs=1e-7)


def rolled_out(settings: Mppi, start: Floats, nominal: Floats, noise: Floats, precision: Floats) -> float:
    """Cost of one rollout, from the definition: the model step by step, clearances in the map, the cost-to-go."""
    car, dirt, cost, state = model(), solvers().checking, 0.0, start.copy()
    assert dirt.goal is not None
    for t in range(len(nominal)):
        control = car.clamped(nominal[t] + noise[t])
        cost += settings.gamma * float((precision * nominal[t] * (control - nominal[t])).sum())
        state = car.advance(state, control, settings.step)
        x, y, theta = pose_of(state, mushr())
        clear = float(dirt.clearances(np.array([[x, y, theta]]))[0])
        if clear < 0.0:
            return cost + (settings.collision + settings.goal * farthest()) * (1.0 + (len(nominal) - t) / len(nominal))
        cost += settings.near * settings.step * max(1.0 - clear / settings.margin, 0.0) ** 2
        cost += settings.goal * settings.step
        if math.dist((x, y), dirt.goal.center) < dirt.problem.scalar[24]:
            return cost
    dirt.start(state)
    togo: float = dirt.tree_arrays.value[0, 7]
    return cost + settings.goal * togo


@pytest.mark.parametrize("hold", [1, 8, 30])
def test_costs_are_those_of_the_model_in_the_map(hold: int) -> None:
    settings, precision = Mppi(kind="mppi", steps=30), np.array([4.0, 9.0])
    random = np.random.default_rng(5)
    nominal = np.column_stack([np.full(30, 0.75), np.full(30, -0.02)])
    drawn = np.repeat(random.normal(0.0, 0.3, (1, 2, 50)), math.ceil(30 / hold), axis=0).astype(np.float32)
    noise = np.empty((30, 2, 50), np.float32)
    found = Rollouts(solvers().checking, model(), settings, precision, 30).costs(
        Estimate(0.0, MOVING, 0.0), way(MOVING), nominal, drawn, noise, hold, settings.gamma
    )
    given = np.repeat(drawn.astype(float), hold, axis=0)[:30]
    expected = [rolled_out(settings, MOVING, nominal, given[:, :, k], precision) for k in range(50)]
    assert found == pytest.approx(expected, rel=1e-3)
    assert max(found) > settings.collision > min(found)
    assert np.all(nominal[:, 0, None] + noise[:, 0] <= 1.0 + 1e-6)


def test_the_cost_of_a_rollout_does_not_depend_on_those_beside_it() -> None:
    settings, precision = Mppi(kind="mppi", steps=30), np.array([4.0, 9.0])
    nominal = np.column_stack([np.full(30, 0.75), np.full(30, -0.02)])
    drawn = np.repeat(np.random.default_rng(5).normal(0.0, 0.3, (1, 2, 70)), 30, axis=0).astype(np.float32)
    rollouts = Rollouts(solvers().checking, model(), settings, precision, 30)

    def costs(chosen: list[int]) -> tuple[Floats, Floats32Cube]:
        noise = np.empty((30, 2, len(chosen)), np.float32)
        samples = np.ascontiguousarray(drawn[:, :, chosen])
        return rollouts.costs(Estimate(0.0, MOVING, 0.0), way(MOVING), nominal, samples, noise), noise

    together, noise = costs(list(range(70)))
    assert 10 < int((together > settings.collision).sum()) < 60  # some end early, and others go on in their place
    for k in range(70):
        alone, left = costs([k])
        assert alone[0] == together[k]
        assert np.array_equal(left[:, :, 0], noise[:, :, k])


def test_steps_of_rollouts_are_within_half_a_millimetre_of_the_exact_motion() -> None:
    random, settings = np.random.default_rng(3), Mppi(kind="mppi", objective="plan", near=0.0, position=0.0005)
    for _ in range(20):
        held = random.uniform([0.1, -0.38], [0.6, 0.38], (7, 2))
        controls, states = np.repeat(held, 8, axis=0), [start()]
        for k in range(560):
            states.append(model().advance(states[-1], controls[k // 10], settings.step / 10))
        exact = replace(way(start()), times=np.arange(57) * settings.step, states=np.array(states[::10]))
        rollouts = Rollouts(solvers().checking, model(), settings, np.ones(2), 56)
        still, noise = np.zeros((7, 2, 1), np.float32), np.empty((56, 2, 1), np.float32)
        (cost,) = rollouts.costs(Estimate(0.0, start(), 0.0), exact, controls, still, noise, 8)
        assert cost < 56 * settings.step


@pytest.mark.parametrize("cutoff", [0.0, 3.0])
def test_costs_up_to_a_cutoff_above_the_least_one_are_exact_and_others_are_more(cutoff: float) -> None:
    settings, precision = Mppi(kind="mppi", steps=30), np.array([4.0, 9.0])
    nominal = np.column_stack([np.full(30, 0.75), np.full(30, -0.02)])
    drawn = np.repeat(np.random.default_rng(5).normal(0.0, 0.3, (1, 2, 300)), 30, axis=0).astype(np.float32)
    noise = np.empty((30, 2, 300), np.float32)
    exact, found = (
        Rollouts(solvers().checking, model(), settings, precision, 30, most).costs(
            Estimate(0.0, MOVING, 0.0), way(MOVING), nominal, drawn, noise, 1, settings.gamma
        )
        for most in (math.inf, cutoff)
    )
    known = np.isfinite(found)
    assert np.array_equal(found[known], exact[known])
    assert known[exact <= exact.min() + cutoff].all()
    assert np.count_nonzero(~known) > 100


@pytest.mark.parametrize("objective", ["goal", "plan"])
def test_rollouts_that_do_not_count_hardly_change_the_controls(objective: str, monkeypatch: pytest.MonkeyPatch) -> None:
    settings, path = Mppi(kind="mppi", objective=objective), way(MOVING)  # type: ignore[arg-type]
    chosen = []
    for negligible in (sampling.NEGLIGIBLE, math.inf):
        monkeypatch.setattr(sampling, "NEGLIGIBLE", negligible)
        controller = mppi(settings)
        chosen.append([controller.command(Estimate(k / 30, MOVING, 0.0), path) for k in range(10)])
    assert np.abs(np.array(chosen[0]) - np.array(chosen[1])).max() < 1e-3


def test_a_copy_sends_the_same_commands_and_leaves_the_controller_as_it_is() -> None:
    one, two = mppi(), mppi()
    commands = []
    for controller in (one, two):
        state, sent = MOVING.copy(), []
        for k in range(4):
            if controller is one:
                ahead = copy.deepcopy(one)
                foreseen = ahead.command(Estimate(k / 30, state, 0.0), way(MOVING))
            sent.append(controller.command(Estimate(k / 30, state, 0.0), way(MOVING)))
            if controller is one:
                assert np.array_equal(foreseen, sent[-1])
            state = model().advance(state, sent[-1], 1 / 30)
        commands.append(np.array(sent))
    assert np.array_equal(*commands)
    assert not np.array_equal(commands[0][0], mppi(seed=2).command(Estimate(0.0, MOVING, 0.0), way(MOVING)))


@pytest.mark.parametrize("heading", [None, 1.5])
def test_updates_begin_with_the_controls_of_the_plan_where_its_last_moves_are_too_short_for_the_costs(
    heading: float | None,
) -> None:
    """With hardly any noise a command is the control that its update began with."""
    task = turns()
    goal = replace(task.goal, heading=heading, heading_tolerance=None if heading is None else 0.1)
    checking = Solvers.of(replace(task, goal=goal), mushr(), GEODESIC).checking
    settings = SMALL.model_copy(update={"objective": "plan", "spread": 1e-6})
    controller = make_controller(settings, model(), checking, 1)
    path = way(MOVING)
    plan = replace(path, controls=np.tile([0.4, -0.3], (len(path.times) - 1, 1)))
    begun = [0.4, -0.3] if heading is not None else model().rest
    assert controller.command(Estimate(0.2, MOVING, 0.0), plan) == pytest.approx(begun, abs=1e-4)


@pytest.mark.parametrize(
    "settings", [Mppi(kind="mppi", rollouts=1000), Dwa(kind="dwa"), Nmpc(kind="nmpc")], ids=lambda each: each.kind
)
def test_a_copy_computes_its_controls_less_often_and_comes_almost_to_the_same_place(
    settings: Mppi | Dwa | Nmpc, monkeypatch: pytest.MonkeyPatch
) -> None:
    if settings.kind == "nmpc":
        pytest.importorskip("casadi")
    due = list[float]()
    asked = Updates.are_due

    def counted(self: Updates, time: float) -> bool:
        if found := asked(self, time):
            due.append(time)
        return found

    monkeypatch.setattr(Updates, "are_due", counted)
    controller, ends, state, path = make_controller(settings, model(), solvers().checking), [], MOVING, way(MOVING)
    for k in range(15):  # has found its way
        state = model().advance(state, controller.command(Estimate(k / 30, state, 0.0), path), 1 / 30)
    copied = copy.deepcopy(controller)
    for each, updates in ((copied, [0.5, 0.75]), (controller, [k / 30 for k in range(15, 25)])):
        at = state
        due.clear()
        for k in range(15, 25):
            at = model().advance(at, each.command(Estimate(k / 30, at, 0.0), path), 1 / 30)
        assert due == pytest.approx(updates, abs=1 / 30)
        ends.append(at)
    assert math.dist(ends[0][:2], ends[1][:2]) < 0.02


def test_a_prediction_of_a_controller_at_rest_begins_with_an_update() -> None:
    updates = Updates(4.0)
    assert [updates.are_due(time) for time in (0.0, 0.1, 0.1)] == [True] * 3
    copied = copy.deepcopy(updates)
    assert [copied.are_due(time) for time in (0.1, 0.2, 0.34, 0.35)] == [True, False, False, True]
    copied.restart()
    assert copied.are_due(0.36)


@pytest.mark.parametrize("settings", [Mppi(kind="mppi", rollouts=200), Dwa(kind="dwa")], ids=lambda each: each.kind)
def test_it_drives_around_the_first_obstacle(settings: Mppi | Dwa) -> None:
    controller, state = make_controller(settings, model(), solvers().checking), start()
    reference = way(state)
    for k in range(8 * 15):
        state = model().advance(state, controller.command(Estimate(k / 15, state, 0.0), reference), 1 / 15)
        assert solvers().checking.exact.distance(*pose_of(state, mushr())) > 0.0
    assert state[1] > 2.2


@pytest.mark.parametrize(
    "settings", [Mppi(kind="mppi", rollouts=200), Dwa(kind="dwa"), Nmpc(kind="nmpc")], ids=lambda each: each.kind
)
def test_a_wall_that_the_planner_gets_is_on_the_map_of_the_controller(settings: Mppi | Dwa | Nmpc) -> None:
    """The path that is followed leads through it."""
    wall = Polygon(np.array([[0.0, 1.2], [2.0, 1.2], [2.0, 1.3], [0.0, 1.3]]))
    blocked = solvers().with_obstacles((wall,), GEODESIC)
    reference, tops = way(MOVING), []
    for knows in (False, True):
        controller, state = make_controller(settings, model(), solvers().checking), MOVING
        if knows:
            set_map(controller, blocked.checking)
        for k in range(30):
            state = model().advance(state, controller.command(Estimate(k / 15, state, 0.0), reference), 1 / 15)
        tops.append(float(state[1]))
    assert tops[0] > 1.2
    assert tops[1] < 1.1


def test_the_window_stops_where_every_arc_collides() -> None:
    controller = make_controller(Dwa(kind="dwa"), model(), solvers().checking)
    assert isinstance(controller, DwaController)
    facing = np.array([0.5, 0.75, math.pi / 2, 0.6])  # 5 cm from the box
    assert controller.command(Estimate(0.0, facing, 0.0), way(start()))[0] == 0.0


@pytest.mark.parametrize("settings", [SMALL, Dwa(kind="dwa")], ids=lambda each: each.kind)
def test_a_contingency_is_tracked_by_the_law_of_the_other_methods(settings: Mppi | Dwa) -> None:
    safe = solvers().checking.contingency(MOVING, 0.0)
    assert safe is not None
    stop = contingency_reference(mushr(), safe)
    law = make_controller(Kinodynamic(kind="kinodynamic", k_along=3.0), model())
    controller = make_controller(settings, model(), solvers().checking)
    off = Estimate(0.2, MOVING + np.array([0.02, 0.1, 0.05, 0.0]), 0.0)
    assert np.array_equal(controller.command(off, stop), law.command(off, stop))


def test_without_a_map_it_is_refused() -> None:
    (problem,) = raised(lambda: make_controller(SMALL, model()))
    assert problem.code is Code.CONFLICT


SAFE = Clearance(delta=0.05, delta_per_speed=0.25)


@pytest.mark.parametrize("kind", ["goal", "plan"])
def test_what_is_committed_keeps_the_clearance_and_has_a_way_to_stop(kind: str) -> None:
    planner = PlannerSettings(
        mode="replanning", type="geodesic" if kind == "goal" else "dirt", iterations=300, safety=SAFE
    )
    solvers = Solvers.of(turns(), mushr(), planner)
    settings = Mppi(kind="mppi", rollouts=64, objective=kind)  # type: ignore[arg-type]
    controller = make_controller(settings, model(), solvers.checking)
    subject = Replanner(solvers, planner, controller, 0, period=1 / 30)
    cycles = drive(subject, 5)
    assert cycles[0].kind == ReferenceKind.PLAN
    for cycle in cycles:
        assert cycle.contingency is not None
        if cycle.kind == ReferenceKind.PLAN:
            assert cycle.predicted.slack >= 0.0


METHOD = """name: mine
title: Mine
planner: {mode: replanning, type: geodesic, safety: {delta: 0.05}, recover: true, on_board: contingency}
controller: {kind: mppi}
"""


def test_contingencies_are_switched_off_by_one_key(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text(METHOD.replace("mode:", "contingency: false, mode:"))
    planner = load_method(tmp_path / "m.yaml").planner
    assert not method_safety(planner).enabled
    assert (planner.safety, planner.bound, planner.recover, planner.on_board) == (None, None, False, "plan")


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("kind: mppi", "kind: kinodynamic", "planner.type"),
        ("type: geodesic, ", "", "controller.objective"),
        ("kind: mppi", "kind: mppi, objective: plan", "planner.type"),
        ("mode: replanning", "mode: one-shot", "planner.type"),
        ("kind: mppi", "kind: mppi, rollouts: 1", "controller.rollouts"),
    ],
)
def test_a_planner_and_a_controller_that_do_not_fit_are_refused(old: str, new: str, place: str, tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text(METHOD.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_method(tmp_path / "m.yaml")
    assert place in [each.path for each in caught.value.diagnostics]


def test_a_car_that_stands_though_it_drives_keeps_less_of_the_bound() -> None:
    """A controller that waits before obstacles has safe plans in every cycle, so that no lack of a plan tells it."""
    planner = load_method("nmpc").planner
    assert planner.bound is not None
    made = Solvers.of(turns(), mushr(), planner)
    shares = []
    for speed in (0.0, 0.5):
        proposer, state = Proposer(PlanSearch(made, planner, 0)), start().copy()
        proposer.set_bound(DeviationBound(0.05, per_speed=0.1, horizon=planner.bound.horizon))
        plan = proposer.propose(0, state, None).plan
        for k in range(1, 13):
            state[1] += speed * planner.cycle  # along the way
            proposer.propose(k, state, plan)
        shares.append(share_kept(proposer))
    assert shares[0] < shares[1] == planner.bound.shares[0]


def test_the_geodesic_leads_to_the_goal_and_keeps_the_inscribed_disc_free() -> None:
    plan = geodesic_plan(solvers().checking, start())
    assert plan is not None
    goal = solvers().checking.goal
    assert goal is not None
    assert plan.trajectory[-1][:2] == pytest.approx(goal.center)
    assert plan.cost * mushr().top_speed == pytest.approx(9.25 * 0.6228, abs=0.3)
    assert not solvers().checking.is_occupied(plan.trajectory[:, :2]).any()


@pytest.mark.parametrize("settings", [SMALL, Dwa(kind="dwa")], ids=lambda each: each.kind)
def test_far_from_the_goal_a_free_way_costs_less_than_a_collision(settings: Mppi | Dwa) -> None:
    """With 200 s more to go everywhere, a free rollout costs more than what the settings state for a collision."""
    solver = Solvers.of(turns(), mushr(), GEODESIC).checking
    togo = solver.problem.togo
    solver._problem = solver.problem._replace(togo=np.where(togo < UNREACHABLE, togo + 200.0, togo))
    far, near = (make_controller(settings, model(), each, 1) for each in (solver, solvers().checking))
    found = [each.command(Estimate(0.0, MOVING, 0.0), way(start())) for each in (far, near)]
    assert found[0] == pytest.approx(found[1], abs=1e-6)


def test_the_first_proposal_of_a_car_that_has_not_driven_keeps_the_whole_bound() -> None:
    planner = load_method("nmpc").planner
    assert planner.bound is not None
    proposer = Proposer(PlanSearch(Solvers.of(turns(), mushr(), planner), planner, 0))
    proposer.set_bound(DeviationBound(0.05, per_speed=0.1, horizon=planner.bound.horizon))
    proposer.propose(0, start(), None)
    assert share_kept(proposer) == planner.bound.shares[0]


def test_a_fixed_clearance_that_was_lowered_for_a_standing_car_is_asked_for_again() -> None:
    planner = PlannerSettings(mode="replanning", type="geodesic", safety=Clearance(delta=0.15, delta_per_speed=0.0))
    proposer = Proposer(PlanSearch(Solvers.of(turns(), mushr(), planner), planner, 0))
    proposer.dirt.set_delta(0.01)
    proposer.propose(1, start(), None)
    assert proposer.dirt.safety.delta == 0.15


def test_the_goal_stays_whole_for_others_that_use_the_solvers() -> None:
    planner = load_method("adaptive-kraft").planner
    made = Solvers.of(turns(), mushr(), planner)
    near = start().copy()
    near[:2] = np.add(made.goal.center, (0.02, 0.0))
    Proposer(PlanSearch(made, planner, 0)).propose(0, near, None)
    assert made.checking.goal is not None
    assert made.checking.goal.radius < made.goal.radius
    Proposer(PlanSearch(made, planner, 0)).propose(0, start(), None)
    assert made.checking.goal.radius == made.goal.radius
