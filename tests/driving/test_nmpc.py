"""NMPC: expressions equal the derivatives they were made from, and its optimum is that of a search over all controls."""

from __future__ import annotations

import builtins
import copy
import functools
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.diagnostics import raised
from support.replanner import mushr, start, turns

from kraft.driving.car_model import CarModel
from kraft.driving.control import make_controller
from kraft.driving.control.nmpc import NmpcController
from kraft.driving.control.nmpc_problem import symbolic_derivative_of
from kraft.driving.control_settings import Kinodynamic, Nmpc
from kraft.driving.geodesic import geodesic_plan
from kraft.driving.messages import Estimate, Reference, ReferenceKind
from kraft.driving.planner_settings import PlannerSettings
from kraft.driving.references import contingency_reference, plan_reference
from kraft.driving.solvers import Solvers
from kraft.errors import Code, MissingDependency
from kraft.scenario.loader import load_scenario
from kraft.vehicles.benchmark import BENCHMARK
from kraft.vehicles.car import CAR, CAR_LAG
from kraft.vehicles.f1tenth import F1TENTH
from kraft.vehicles.load import load_vehicle
from kraft.vehicles.mushr import MUSHR, MUSHR_FORCE
from kraft.vehicles.unicycle2 import JACKAL, UNICYCLE2
from ompl_ext.arrays import Floats
from ompl_ext.kernels.specialise import step_kernels
from ompl_ext.poses import pose_of
from ompl_ext.vehicle import Vehicle

casadi = pytest.importorskip("casadi")


@functools.cache
def solvers() -> Solvers:
    return Solvers.of(turns(), mushr(), PlannerSettings(mode="replanning", type="geodesic"))


@functools.cache
def model() -> CarModel:
    return CarModel(mushr())


def nmpc(settings: Nmpc) -> NmpcController:
    controller = make_controller(settings, model(), solvers().checking)
    assert isinstance(controller, NmpcController)
    return controller


MODELS = (MUSHR, MUSHR_FORCE, F1TENTH, JACKAL, UNICYCLE2, BENCHMARK, CAR, CAR_LAG)


@pytest.mark.parametrize("vehicle", MODELS, ids=lambda each: each.name)
def test_the_expression_of_every_bundled_model_is_its_derivative(vehicle: Vehicle) -> None:
    random = np.random.default_rng(1)
    x, u, p = (casadi.SX.sym(*of) for of in (
        ("x", len(vehicle.state)), ("u", len(vehicle.controls)), ("p", len(vehicle.parameter_array)),
    ))  # fmt: skip
    expression = casadi.Function("f", [x, u, p], [symbolic_derivative_of(vehicle)(x, u, p)])
    low, high = vehicle.control_bounds.T
    for _ in range(10):
        state, control = random.normal(size=len(vehicle.state)), random.uniform(low, high)
        parameters = tuple(vehicle.parameter_array.tolist())
        inputs: Any = tuple(control.tolist())
        if vehicle.actuation is not None:
            inputs = vehicle.actuation.py_func(inputs, parameters)  # type: ignore[attr-defined]
        expected = vehicle.derivative.py_func(tuple(state.tolist()), inputs, parameters)  # type: ignore[attr-defined]
        found = np.asarray(expression(state, control, vehicle.parameter_array)).ravel()
        assert found == pytest.approx(np.array(expected), abs=1e-9)


BRANCHING = """from ompl_ext import Footprint, Vehicle, cos, derivative, sin


@derivative
def motion(x, u, p):
    push = u[0]
    if x[3] > 0.5:
        push = 0.0
    return x[3] * cos(x[2]), x[3] * sin(x[2]), u[1], push - x[3]


BRANCHING = Vehicle(
    name="branching", derivative=motion, state=("x", "y", "theta", "v"), top_speed=1.0,
    controls={"throttle": (0.0, 1.0), "steering": (-1.0, 1.0)}, footprint=Footprint(0.4, 0.2),
)
"""


def test_a_derivative_that_branches_by_statements_is_refused(tmp_path: Path) -> None:
    (tmp_path / "branching.py").write_text(BRANCHING)
    vehicle = load_vehicle(f"{tmp_path / 'branching.py'}:BRANCHING")
    (problem,) = raised(lambda: symbolic_derivative_of(vehicle))
    assert problem.code is Code.MISMATCH


def test_without_casadi_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = builtins.__import__

    def refused(name: str, *arguments: Any, **named: Any) -> Any:
        if name == "casadi":
            raise ImportError(name)
        return imported(name, *arguments, **named)

    monkeypatch.setattr(builtins, "__import__", refused)
    with pytest.raises(MissingDependency, match=r"pip install .*\[mpc\]"):
        nmpc(Nmpc(kind="nmpc"))


def test_with_an_old_casadi_the_extra_is_named_too(monkeypatch: pytest.MonkeyPatch) -> None:
    import casadi

    monkeypatch.setattr(casadi, "has_conic", lambda _: False)
    with pytest.raises(MissingDependency, match=r"PIQP: pip install .*\[mpc\]"):
        nmpc(Nmpc(kind="nmpc"))


def straight(speed: float) -> Reference:
    """Plan that turns left a little in free space, at a constant speed."""
    times = np.linspace(0.0, 2.0, 41)
    theta = math.pi / 2 + 0.3 * times
    x = 1.2 + speed / 0.3 * (np.sin(theta) - 1.0)
    y = -0.3 - speed / 0.3 * np.cos(theta)
    states = np.column_stack([x, y, theta, np.full(41, speed)])
    return Reference(ReferenceKind.PLAN, times, states, np.zeros((40, 2)), np.zeros(2))


@pytest.mark.parametrize("solver", ["sqp", "ipopt"])
def test_the_optimum_is_that_of_a_search_over_all_controls(solver: Any) -> None:
    """Two steps of 0.2 s: each of the two controls takes 15 values in each step."""
    settings = Nmpc(kind="nmpc", solver=solver, objective="plan", steps=2, step=0.2, iterations=100, margin=0.0)
    plan, state = straight(0.4), np.array([1.25, -0.32, math.pi / 2, 0.3])
    found = nmpc(settings).solve(Estimate(0.0, state, 0.0), plan)
    grids = [np.linspace(low, high, 15) for low, high in zip(model().low, model().high, strict=True)]
    tried = np.array(list(itertools.product(*grids, *grids))).reshape(-1, 2, 2)
    searched = costs_of(settings, plan, state, tried)
    own = costs_of(settings, plan, state, found.controls[None])
    assert found.solved
    assert own[0] == pytest.approx(found.cost, abs=2e-3)
    assert found.cost <= searched.min() + 1e-6
    assert found.cost == pytest.approx(searched.min(), abs=0.03 * np.median(searched))
    best = tried[searched.argmin()]
    assert np.all(np.abs(found.controls - best) <= 1.5 * (model().high - model().low) / 14)


def costs_of(settings: Nmpc, plan: Reference, state: Any, controls: Any) -> Any:
    """Costs (n,) of controls (n, steps, nu) in free space, from the definition."""
    kernels, count = step_kernels(mushr()), len(controls)
    states = np.empty((settings.steps + 1, count, 4))
    kernels.simulate(
        np.tile(state, (count, 1)), np.ascontiguousarray(controls.transpose(1, 0, 2)),
        np.tile(model().parameters, (count, 1)), np.full((settings.steps, count), settings.step), False, np.zeros(kernels.block), states,
    )  # fmt: skip
    total, last = np.zeros(count), np.tile(model().rest, (count, 1))
    for k in range(settings.steps):
        after, wanted = states[k + 1], plan.state_at(settings.step * (k + 1))
        total += settings.step * ((after[:, :2] - wanted[:2]) ** 2).sum(axis=1) / settings.position**2
        turned = 2.0 - 2.0 * np.cos(after[:, 2] - wanted[2])
        total += settings.step * turned / math.radians(settings.heading_deg) ** 2
        total += settings.step * (after[:, 3] - wanted[3]) ** 2 / settings.speed**2
        total += (((controls[:, k] - last) / (settings.change * (model().high - model().low))) ** 2).sum(axis=1)
        last = controls[:, k]
    return total


def test_it_follows_the_path_around_the_first_obstacle_and_copies_send_the_same() -> None:
    controller, state = nmpc(Nmpc(kind="nmpc")), start()
    plan = geodesic_plan(solvers().checking, state)
    assert plan is not None
    path = plan_reference(mushr(), plan, 0.0)
    for k in range(45):
        now = Estimate(k / 7.5, state, 0.0)
        foreseen = copy.deepcopy(controller).command(now, path)
        command = controller.command(now, path)
        assert np.array_equal(foreseen, command)
        state = model().advance(state, command, 1 / 7.5)
        assert solvers().checking.exact.distance(*pose_of(state, mushr())) > 0.0
    assert state[1] > 2.0


def test_both_solvers_find_the_same_optimum_beside_an_obstacle() -> None:
    state = np.array([1.2, 0.4, 1.9, 0.5])
    plan = geodesic_plan(solvers().checking, state)
    assert plan is not None
    path, now = plan_reference(mushr(), plan, 0.0), Estimate(0.0, state, 0.0)
    own, other = (nmpc(Nmpc(kind="nmpc", solver=each, iterations=100)).solve(now, path) for each in ("sqp", "ipopt"))
    assert own.solved
    assert other.solved
    assert own.cost == pytest.approx(other.cost, rel=3e-3)
    assert own.controls[0] == pytest.approx(other.controls[0], abs=0.02)


def test_without_an_optimum_the_best_controls_so_far_are_sent_and_counted() -> None:
    state = np.array([1.2, 0.4, 1.9, 0.5])
    plan = geodesic_plan(solvers().checking, state)
    assert plan is not None
    path, now = plan_reference(mushr(), plan, 0.0), Estimate(0.0, state, 0.0)
    stopped, other = (nmpc(Nmpc(kind="nmpc", solver=each, iterations=1)) for each in ("sqp", "ipopt"))
    begun = stopped.solve(now, path)
    assert not begun.solved
    assert stopped.unsolved == 1
    assert begun.states[1] == pytest.approx(model().advance(state, begun.controls[0], 0.1), abs=5e-3)
    assert begun.cost > nmpc(Nmpc(kind="nmpc")).solve(now, path).cost
    ends = [model().low, model().rest, model().high]
    held = [np.array(control) for control in itertools.product(*zip(*ends, strict=True))]
    sent = other.command(now, path)
    assert any(np.array_equal(sent, control) for control in held)
    assert other.unsolved == 1


def test_the_controls_of_a_plan_are_the_first_guess_and_that_of_a_new_plan() -> None:
    """A plan that turns to the right replaces one that turns to the left: the guess is that plan's controls at once."""
    controller, begin = nmpc(Nmpc(kind="nmpc", objective="plan", solver="ipopt", iterations=1)), start()
    for steering in (0.3, -0.3):
        controls = np.tile([1.0, steering], (40, 1))
        states = [begin]
        for control in controls:
            states.append(model().advance(states[-1], control, 0.05))
        times = np.linspace(0.0, 2.0, 41)
        plan = Reference(ReferenceKind.PLAN, times, np.array(states), controls, model().rest)
        assert controller.command(Estimate(0.0, begin, 0.0), plan) == pytest.approx([1.0, steering])


def reversing(car: CarModel, begin: Floats) -> Reference:
    """Plan that moves a car a little aside: backwards, then ahead with the steering the other way."""
    controls = np.repeat([[-0.5, 0.38], [1.0, -0.38], [-0.5, -0.38]], [12, 12, 6], axis=0)
    states = [begin]
    for control in controls:
        states.append(car.advance(states[-1], control, 0.05))
    return Reference(ReferenceKind.PLAN, np.linspace(0.0, 1.5, 31), np.array(states), controls, car.rest)


@pytest.mark.parametrize("begin", [(1.3, 0.7, 0.0, 0.0), (1.516, 0.266, 0.268, 0.0)], ids=["in the open", "in the gap"])
def test_a_plan_to_a_goal_with_a_heading_is_tracked_through_its_reversals_and_as_near_to_obstacles(begin: Any) -> None:
    """In the gap of `parking` the plan takes the discs, which are larger than the footprint, nearer than their margin."""
    vehicle = load_vehicle("mushr-drive")
    car = CarModel(vehicle)
    parking = Solvers.of(load_scenario("parking").task(), vehicle, PlannerSettings(mode="replanning")).checking
    controller = make_controller(Nmpc(kind="nmpc", objective="plan"), car, parking)
    assert isinstance(controller, NmpcController)
    plan = reversing(car, np.array(begin))
    found = controller.solve(Estimate(0.0, plan.states[0], 0.0), plan)
    wanted = np.array([plan.state_at(0.1 * k) for k in range(21)])
    assert all(parking.exact.distance(*pose_of(state, vehicle)) > 0.0 for state in wanted)
    assert found.controls[0] == pytest.approx([-0.5, 0.38], abs=0.05)
    assert np.hypot(*(found.states - wanted)[:, :2].T).max() < 0.01
    assert np.degrees(np.abs(found.states - wanted)[:, 2].max()) < 1.0


def test_a_contingency_is_tracked_by_the_law_of_the_other_methods() -> None:
    moving = np.array([1.0, 0.2, math.pi / 2, 0.5])
    safe = solvers().checking.contingency(moving, 0.0)
    assert safe is not None
    stop = contingency_reference(mushr(), safe)
    law = make_controller(Kinodynamic(kind="kinodynamic", k_along=3.0), model())
    now = Estimate(0.2, moving + np.array([0.02, 0.1, 0.05, 0.0]), 0.0)
    assert np.array_equal(nmpc(Nmpc(kind="nmpc")).command(now, stop), law.command(now, stop))
