"""The choice between the car with terms and the known models."""

from __future__ import annotations

import pytest
from support.cars import car, drive

from kraft.errors import NegativeResult
from kraft.sysid import Identification, Settings, model_choice, prediction_errors
from kraft.sysid.base_vehicle import for_commands, load_base_vehicle, with_backward_commands, with_coasting
from kraft.sysid.model_choice import identify_car


def test_a_fast_car_without_lags_is_not_fitted_with_lags() -> None:
    model = car(a_drive=8.75, damping=2.5, friction=0.0)
    logs = [drive(model, seed, low=(0.3, -0.5)) for seed in range(5)]
    stages = list[str]()
    found = identify_car(logs, on_stage=stages.append)
    assert stages[:2] == ["model 1 of 3, car-lag, its wheelbase", "model 1 of 3, car-lag, the terms that the logs need"]
    assert found.base.name == "car"
    assert found.base.vehicle.controls["throttle"][0] == 0.0  # which no log has
    errors = prediction_errors(found.base.definition, [drive(model, 90)], found.identification.values)
    assert errors.position[3.0] < 0.03


def test_a_known_model_that_is_not_compared_is_named_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: object) -> Identification:
        raise NegativeResult("the equations are singular")

    logs = [drive(car(), seed) for seed in range(2)]
    not_compared = "is not among the compared models"
    monkeypatch.setattr(model_choice, "KNOWN_ITERATIONS", 1)
    found = identify_car(logs).identification
    assert f"mushr-lag {not_compared}: its fit did not converge within 1 iteration" in found.notes
    monkeypatch.setattr(model_choice, "identify", singular)
    found = identify_car(logs).identification
    assert {model.model for model in found.models} <= {"car", "car-lag"}
    for name in model_choice.KNOWN:
        assert f"{name} {not_compared}: its fit failed: the equations are singular" in found.notes
    settings = Settings(values={"a_drive": 4.0})
    assert model_choice._known("mushr-lag", logs, settings, lambda *_: None) == "it has no parameter a_drive"


def test_a_known_car_has_the_backward_commands_of_the_logs() -> None:
    """The model knows no braking, and predicts it nevertheless: without these commands its plans could only coast."""
    base = load_base_vehicle("mushr-lag")
    forward, braking = drive(car(), 0, low=(0.1, -0.5)), drive(car(), 1, low=(-0.6, -0.5))
    assert with_backward_commands(base, [forward]) is base
    changed = with_backward_commands(base, [forward, braking])
    (part,) = braking.parts
    assert changed.vehicle.controls["throttle"] == (pytest.approx(part.commands[:, 0].min()), 1.0)
    assert part.commands[:, 0].min() < -0.2
    assert changed.vehicle.controls["steering"] == base.vehicle.controls["steering"]


def test_a_car_that_no_log_shows_without_throttle_can_be_planned_to_stop() -> None:
    """With throttle of at least 0.15 alone, no contingency would ever come to rest."""
    logs = [drive(car(), 0), drive(car(), 1)]
    base = for_commands(load_base_vehicle("car"), logs)
    low, high = base.vehicle.controls["throttle"]
    assert low > 0.15
    changed = with_coasting(base).vehicle.controls
    assert changed == {**base.vehicle.controls, "throttle": (0.0, high)}
    braking = for_commands(load_base_vehicle("car"), [drive(car(), 1, low=(-0.6, -0.5))])
    assert with_coasting(braking) is braking
