"""The oracle: it knows the true car and state, makes up for delays, and nobody else can."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.diagnostics import raised

from kraft.driving.car_model import CarModel
from kraft.driving.method import load_method
from kraft.errors import Code
from kraft.scenario import load_scenario
from kraft.scenario.truth import VehicleGap
from kraft.simulation.world import World
from kraft.trial.oracle import true_vehicle
from kraft.trial.plant import Radio
from kraft.trial.result import Outcome, TrialResult, TrialSpec
from kraft.trial.trial import run_trial
from kraft.vehicles.load import load_vehicle

CARS: list[dict[str, float]] = [
    {"drive_scale": 0.8},
    {"drive_scale": 1.25, "steering_scale": 1.2, "steering_offset_deg": -4, "mass_scale": 0.85},
    {"steering_scale": 0.8, "steering_offset_deg": 6},
]


def run(
    settings: dict[str, Any], method: str = "oracle", scenario: str = "boxes", seed: int = 0, vehicle: str | None = None
) -> TrialResult:
    found = load_method(method)
    model = load_vehicle(vehicle or found.planner.vehicle or "mushr")
    return run_trial(TrialSpec(load_scenario(scenario, settings), found, model, seed))


def errors_told_and_not(gap: dict[str, float]) -> tuple[float, float]:
    """Median errors of the position after 2 s of random commands (m), with the model of the true car and without."""
    scene, random = load_scenario("training", {"truth.vehicle": gap}), np.random.default_rng(0)
    vehicle = load_vehicle("mushr-drive")
    models = [CarModel(true_vehicle(vehicle, scene.truth.vehicle)), CarModel(vehicle)]
    errors = []
    for _ in range(12):
        world = World(scene)
        states = [np.append(world.pose, 0.0) for _ in models]
        for _ in range(4):
            command = np.array([random.uniform(0.3, 1.0), random.uniform(-0.38, 0.38)])
            world.apply(command)
            world.step(250)
            states = [model.advance(state, command, 0.5) for model, state in zip(models, states, strict=True)]
        errors.append([float(np.hypot(*(state[:2] - world.pose[:2]))) for state in states])
    told, not_told = np.median(errors, axis=0).tolist()
    return told, not_told


@pytest.fixture(scope="module")
def own_error() -> float:
    """Error of the model where it is that of the true car, m."""
    return errors_told_and_not({})[1]


@pytest.mark.parametrize("car", CARS)
def test_the_model_of_the_true_car_predicts_it_as_well_as_the_model_predicts_its_own(
    car: dict[str, float], own_error: float
) -> None:
    told, not_told = errors_told_and_not(car)
    assert told < 1.4 * own_error
    assert told < 0.7 * not_told


@pytest.fixture(scope="module")
def prompt() -> TrialResult:
    """The oracle in Boxes, without delays."""
    return run({})


def test_noise_and_missing_poses_change_nothing(prompt: TrialResult) -> None:
    clear, blind = prompt, run({"sensing.dropout": 1.0, "sensing.noise_scale": 3.0})
    assert [step.pose for step in clear.steps] == [step.pose for step in blind.steps]
    assert clear.outcome is Outcome.SUCCESS


def test_delays_are_made_up_for(prompt: TrialResult) -> None:
    late = run({"sensing.command_delay": 0.25, "sensing.communication_delay": 0.2, "sensing.latency": 0.3})
    assert late.outcome is Outcome.SUCCESS
    half = {name: r.measures.deviation_quantiles((0.5,))[-1][1] for name, r in (("prompt", prompt), ("late", late))}
    assert half["late"] < half["prompt"] + 0.02


def test_a_model_that_cannot_be_told_the_car_is_refused() -> None:
    scene = load_scenario("boxes", {"truth.vehicle.drive_scale": 0.8})
    problems = raised(lambda: true_vehicle(load_vehicle("mushr"), scene.truth.vehicle))
    assert [d.code for d in problems] == [Code.MISMATCH]
    assert true_vehicle(load_vehicle("mushr"), load_scenario("boxes").truth.vehicle) == load_vehicle("mushr")


def test_the_oracle_is_told_of_a_car_that_changes() -> None:
    change = {"time": 2.0, "vehicle": {"drive_scale": 0.8, "steering_offset_deg": 4}}
    cycles = run({"truth.changes": [change], "trial.timeout": 4.5}).cycles
    own = load_vehicle(load_method("oracle").planner.vehicle or "mushr")
    told = true_vehicle(own, VehicleGap(drive_scale=0.8, steering_offset_deg=4)).parameter_array
    changed = [cycle.parameters for cycle in cycles if cycle.parameters is not None]
    assert [cycle.time for cycle in cycles if cycle.parameters is not None] == [2.25]
    assert np.array_equal(changed[0], told)
    problems = raised(lambda: run({"truth.changes": [change]}, scenario="boxes", vehicle="mushr"))
    assert [d.code for d in problems] == [Code.MISMATCH]


def test_lost_messages_are_decided_by_the_seed() -> None:
    def delivered(loss: float, seed: int) -> list[bool]:
        radio = Radio(loss, seed)
        arrived = [radio.delivers() for _ in range(2000)]
        assert radio.lost == arrived.count(False)
        return arrived

    assert delivered(0.3, 3) == delivered(0.3, 3) != delivered(0.3, 4)
    assert np.mean(delivered(0.3, 3)) == pytest.approx(0.7, abs=0.04)
    assert all(delivered(0.0, 3))
    assert delivered(1.0, 3).index(False) == 1  # the first plan is on board before the drive


def test_without_messages_the_first_plan_is_driven_to_its_end() -> None:
    alone = run({"sensing.message_loss": 1.0, "trial.timeout": 15}, "kraft", "turns")
    assert alone.measures.messages_lost == len(alone.cycles) - 1
    first = alone.cycles[0].reference
    after = [step.command for step in alone.steps if step.time > first.end + 2.0]
    assert all(command == pytest.approx(first.rest) for command in after)


def test_a_car_whose_friction_takes_all_of_its_drive_has_no_model() -> None:
    problems = raised(lambda: true_vehicle(load_vehicle("mushr-drive"), VehicleGap(drive_scale=0.13)))
    assert [each.code for each in problems] == [Code.MISMATCH]
