"""Units of controls: stated where a vehicle states them, never guessed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from kraft.vehicles import SHARE, control_title, control_unit
from kraft.vehicles.load import load_vehicle


@pytest.mark.parametrize(
    ("vehicle", "control", "unit"),
    [
        ("mushr", "steering", "rad"),
        ("mushr", "throttle", SHARE),
        ("jackal", "left", "m/s"),
        ("kraft.vehicles.dynobench:UNICYCLE1_V0", "omega", "rad/s"),
        ("kraft.vehicles.benchmark:BENCHMARK", "steering", SHARE),
    ],
)
def test_a_control_has_the_unit_of_its_vehicle(vehicle: str, control: str, unit: str) -> None:
    loaded = load_vehicle(vehicle)
    assert control_unit(loaded, control) == unit
    assert control_title(loaded, control) == f"{control}, {unit}"


def test_a_model_that_takes_commands_in_any_unit_has_none() -> None:
    car = load_vehicle("kraft.vehicles.car:CAR")
    assert control_unit(car, "steering") == SHARE
    controls = {**car.controls, "steering": (-400.0, 400.0)}
    pulses = replace(car, controls=controls, parameters={**car.parameters, "full_steering": 400.0})
    assert control_unit(pulses, "steering") is None
    assert control_title(pulses, "steering") == "steering"
