"""Tracking with gains from the model: any vehicle is brought back to its plan, and one that cannot be is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from support.diagnostics import raised

from kraft.driving.car_model import CarModel, model_of
from kraft.driving.control import LqrController, make_controller, settings_for
from kraft.driving.control.lqr import check_controllable
from kraft.driving.control_settings import Geometric, Kinodynamic, Lqr, OpenLoop
from kraft.driving.messages import Estimate, Reference, ReferenceKind, Stop
from kraft.driving.method import load_method
from kraft.driving.needs import uses_steps
from kraft.driving.vehicle_model import VehicleModel, stop_control
from kraft.errors import Code
from kraft.vehicles.load import load_vehicle
from ompl_ext.arrays import Floats
from ompl_ext.vehicle import Vehicle

STEP = 0.1
TICK = 1.0 / 30.0
DEFAULT = Lqr(kind="lqr")


@cache
def model(name: str) -> VehicleModel:
    return model_of(load_vehicle(name))


def planned(of: VehicleModel, control: Floats, kind: ReferenceKind = ReferenceKind.PLAN, steps: int = 40) -> Reference:
    """A motion from rest that begins with a control and goes on with half of it."""
    states, controls = [np.zeros(len(of.vehicle.state))], []
    for k in range(steps):
        controls.append(control if k < 10 else 0.5 * control)
        states.append(of.advance(states[-1], controls[-1], STEP))
    times = STEP * np.arange(steps + 1, dtype=float)
    return Reference(kind, times, np.array(states), np.array(controls), of.rest, Stop(0, 0.0))


def deviation(of: VehicleModel, plan: Reference, settings: Lqr | OpenLoop, off: tuple[float, float, float]) -> float:
    """Distance from the plan at its end, of a vehicle that begins beside it (m, m, rad)."""
    controller, state = make_controller(settings, of), plan.states[0].copy()
    state[of.pose] += off
    for now, after in pairwise(np.arange(plan.start, plan.end - 1e-9, TICK)):
        state = of.advance(state, controller.command(Estimate(float(now), state, 0.0), plan), float(after - now))
    return float(np.hypot(*(state - plan.state_at(float(after)))[of.pose[:2]]))


@pytest.mark.parametrize(
    ("name", "control"),
    [("unicycle2", (0.5, 0.1)), ("mushr-drive", (0.9, 0.2)), ("unicycle2", (0.5, -0.1))],
)
@pytest.mark.parametrize("off", [(0.0, 0.1, 0.0), (-0.1, 0.0, 0.0), (0.05, -0.05, 0.15)])
def test_a_vehicle_beside_its_plan_returns_to_it(
    name: str, control: tuple[float, float], off: tuple[float, float, float]
) -> None:
    plan = planned(model(name), np.array(control))
    without = deviation(model(name), plan, OpenLoop(kind="open_loop"), off)
    assert deviation(model(name), plan, DEFAULT, off) < min(0.03, 0.4 * without)


def test_on_the_plan_the_control_is_the_planned_one() -> None:
    of = model("unicycle2")
    plan = planned(of, np.array([0.5, 0.1]))
    controller = make_controller(DEFAULT, of)
    for k in (0, 5, 17):
        command = controller.command(Estimate(float(plan.times[k]), plan.states[k], 0.0), plan)
        assert command == pytest.approx(plan.controls[k], abs=1e-12)


def test_a_contingency_is_never_driven_faster_to_make_up_for_a_lag() -> None:
    of = model("unicycle2")
    plan = planned(of, np.array([0.25, 0.0]))
    lagging = plan.states[20].copy()
    lagging[[of.x, of.v]] -= 0.1
    at = Estimate(float(plan.times[20]), lagging, 0.0)
    controller = make_controller(DEFAULT, of)
    as_plan, as_stop = (controller.command(at, replace(plan, kind=kind)) for kind in ReferenceKind)
    assert as_plan[0] > plan.controls[20][0] + 0.1
    assert as_stop[0] == pytest.approx(plan.controls[20][0], abs=1e-9)


def test_past_the_end_the_vehicles_own_manoeuvre_stops_it() -> None:
    of = model("unicycle2")
    plan = planned(of, np.array([0.5, 0.1]))
    controller, state = make_controller(DEFAULT, of), plan.states[-1]
    assert abs(state[4]) > 0.1  # it turns
    for k in range(90):
        at = Estimate(plan.end + TICK * k, state, 0.0)
        assert np.array_equal(controller.command(at, plan), stop_control(of.vehicle, state, 0))
        state = of.advance(state, controller.command(at, plan), TICK)
    assert np.abs(state[of.velocities]).max() < 0.01


def test_gains_follow_the_parameters_of_the_model() -> None:
    of = VehicleModel(load_vehicle("unicycle2"))
    plan = planned(of, np.array([0.5, 0.1]))
    off = plan.states[5] + np.array([0.0, 0.05, 0.0, 0.0, 0.0])
    controller = make_controller(DEFAULT, of)
    before = controller.command(Estimate(0.5, off, 0.0), plan)
    of.set_parameters(np.array([1.0, 1.0, 0.6, 2.0]))
    after = controller.command(Estimate(0.5, off, 0.0), plan)
    assert not np.allclose(before, after, atol=1e-3)
    assert np.array_equal(after, make_controller(DEFAULT, of).command(Estimate(0.5, off, 0.0), plan))


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        (DEFAULT, "unicycle2"),
        (DEFAULT, "mushr-drive"),
        (Kinodynamic(kind="kinodynamic"), "mushr-drive"),
        (Geometric(kind="geometric"), "mushr-drive"),
        (OpenLoop(kind="open_loop"), "unicycle2"),
    ],
)
def test_a_reference_that_stands_has_a_control_before_its_time(settings: Lqr | OpenLoop, name: str) -> None:
    """On the wall clock the controller ticks before the drive begins, on a reference of a single pose."""
    of = model(name)
    state = np.zeros(len(of.vehicle.state))
    stands = Reference(
        ReferenceKind.CONTINGENCY, np.zeros(1), state[None], np.empty((0, len(of.low))), of.rest, Stop(0, 0.0)
    )
    command = make_controller(settings, of).command(Estimate(-0.6, state, 0.0), stands)
    assert of.advance(state, command, 0.1) == pytest.approx(state, abs=1e-9)


def test_a_law_for_cars_gives_way_to_the_lqr_for_another_vehicle_alone() -> None:
    laws = Kinodynamic(kind="kinodynamic", rate_hz=20.0), Geometric(kind="geometric", rate_hz=20.0)
    for law in laws:
        assert settings_for(law, model("unicycle2").vehicle) == Lqr(kind="lqr", rate_hz=20.0)
        assert settings_for(law, model("mushr-drive").vehicle) is law
    assert isinstance(make_controller(laws[0], model("unicycle2")), LqrController)
    assert not isinstance(make_controller(laws[0], model("mushr-drive")), LqrController)
    assert settings_for(OpenLoop(kind="open_loop"), model("unicycle2").vehicle) == OpenLoop(kind="open_loop")


def test_the_steps_of_a_model_are_needed_to_regulate_and_to_identify() -> None:
    car, other = model("mushr-drive").vehicle, model("unicycle2").vehicle
    assert [uses_steps(load_method("kraft"), vehicle) for vehicle in (car, other)] == [False, True]
    assert uses_steps(load_method("adaptive-kraft"), car)


def weakened(parameter: str) -> Vehicle:
    """A robot one of whose controls hardly does anything."""
    return load_vehicle("unicycle2").with_parameters({parameter: 1e-7})


@pytest.mark.parametrize("parameter", ["alpha_max", "a_max"])
def test_a_vehicle_that_its_controls_cannot_correct_is_refused_at_the_line_of_its_model(parameter: str) -> None:
    (problem,) = raised(lambda: make_controller(DEFAULT, model_of(weakened(parameter))))
    assert (problem.path, problem.code) == ("model", Code.MISMATCH)
    assert problem.file.endswith("unicycle2.yaml")
    assert problem.line is not None


@pytest.mark.parametrize("name", ["unicycle2", "mushr", "mushr-drive", "benchmark"])
def test_the_bundled_vehicles_can_be_controlled(name: str) -> None:
    check_controllable(model(name))


def test_the_directions_of_a_vehicle_are_found_by_its_model() -> None:
    of = model("unicycle2")
    assert of.drive_control(1.0, 0.0).tolist() == [1.0, 0.0]
    assert of.drive_control(0.5, -0.5).tolist() == [0.5, -0.5]
    assert of.drive_control(0.0, 0.0).tolist() == [-1.0, 0.0]  # it does not slow down by itself
    car = model("mushr-drive")
    assert isinstance(car, CarModel)
    assert car.drive_control(0.5, 1.0).tolist() == [0.5, 0.38]


def test_a_control_that_leads_to_velocities_is_found_by_the_model() -> None:
    of, state = model("unicycle2"), np.array([0.0, 0.0, 0.0, 0.3, 0.4])
    wanted = np.array([0.0, 0.0, 0.0, 0.25, 0.3])
    control = of.control_to(state, np.zeros(2), wanted, STEP)
    assert of.advance(state, control, STEP)[of.velocities] == pytest.approx(wanted[of.velocities], abs=0.01)
